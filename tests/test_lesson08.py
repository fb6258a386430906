"""Lesson 08: its intervals against the library's, rows compared with themselves, orders that are guessed, and a milestone."""

from dataclasses import replace

import numpy as np
import pytest

from lessons import n08
from tapip3d_lite import lab
from tapip3d_lite.lab.statistics import effect
from tests.milestones import notices

METRIC = "APD3D_none_dynamic"


def results(**rows):
    """What a study keeps, from scores (S, C) by row; NaN becomes None."""
    found = {}
    for name, scores in rows.items():
        found[name] = {
            s: {
                "training": f"{name} s{s}",
                "scores": {f"c{c}": {METRIC: None if x != x else x} for c, x in enumerate(row)},
            }
            for s, row in enumerate(scores)
        }
    return found


@pytest.fixture
def scores():
    rng = np.random.default_rng(0)
    return rng.normal(0.4, 0.1, 30) + rng.normal(0, 0.01, (3, 1)) + rng.normal(0, 0.02, (3, 30))


def test_differences_are_paired_and_leave_out_what_is_undefined(scores):
    other = scores - 0.05
    other[1, 4] = np.nan
    d = n08.differences(results(one=scores, other=other), "one", "other", METRIC)
    assert d.shape == (3, 29)
    np.testing.assert_allclose(d, 0.05)


def test_an_interval_over_clips_is_the_librarys_of_what_no_seed_changes(scores):
    mine, theirs = n08.over_clips(scores[0]), effect(scores[:1], drawn=False)
    np.testing.assert_allclose(mine, (theirs.mean, theirs.low, theirs.high))
    assert not n08.excludes_zero(n08.over_clips(scores[0] - scores[0].mean()))
    assert n08.excludes_zero(mine) and n08.excludes_zero(n08.over_clips(-scores[0]))


def test_a_row_is_compared_with_itself_in_every_pair_of_seeds(scores):
    lucky = scores.copy()
    lucky[2] += 0.2
    found = n08.with_itself([results(a=scores, b=lucky), {"static": {0: {"training": None, "scores": {}}}}], METRIC)
    assert len(found) == 6 and next(iter(found)) == "a: seed 0 - seed 1"
    assert found["b: seed 0 - seed 2"].high < 0 and found["b: seed 1 - seed 2"].high < 0
    assert n08.with_itself([results(a=scores), results(a=scores)], METRIC).keys() == {k for k in found if k[0] == "a"}
    n08.with_itself_chart(found, METRIC).canvas.draw()
    n08.by_seed_and_clip(scores - lucky, "a minus b").canvas.draw()
    n08.power_chart(lambda s, c: 1 / s / c, (1, 2), (3, 4), 0.1).canvas.draw()


def test_deviations_of_seeds_clips_and_the_rest_are_found_again():
    rng = np.random.default_rng(1)
    d = rng.normal(0, 0.03, (300, 1)) + rng.normal(0, 0.08, 400) + rng.normal(0, 0.05, (300, 400))
    found = n08.parts_of(d, n08.EXERCISES[0].reference(d))
    np.testing.assert_allclose(found, (0.03, 0.08, 0.05), rtol=0.1)
    assert n08.parts_of(np.array([[0.0, 1], [1, 0]]), (0.0, 0.0, 1.0)) == (0, 0, 1)  # none is below zero


class Study:
    """As much of a study as an order needs."""

    def __init__(self, found):
        self.found = found

    def results(self):
        return self.found


def test_an_order_is_right_where_it_has_all_that_the_study_decides(scores):
    rng = np.random.default_rng(2)
    made = Study(results(a=scores, b=scores + rng.normal(0, 0.02, scores.shape), c=scores - 0.2))
    names = ["a", "b", "c"]

    def said(guess):
        return n08.reveal_order(guess, made, names, METRIC, lambda: None).verdict

    assert said(None).status == "sealed" and said("show me").status == "shown"
    assert said(["a", "b"]).status == "sealed" and "a, b, c" in said("abc").message
    assert said(["a", "b", "c"]).status == said(["b", "a", "c"]).status == "passed"
    wrong = said(["c", "a", "b"])
    assert wrong.status == "wrong" and "a is better than c; b is better than c" in wrong.message
    assert "of 3 pairs this study decides 2; your order has 0" in wrong.message


def test_the_budget_is_the_laboratorys_with_less_of_everything():
    made, usual = n08.budget(40), lab.BUDGETS["lab"]
    assert made.recipe.steps == 40 and made.scene is usual.scene and made.recipe.tracker == usual.recipe.tracker
    assert replace(made.recipe, **{x: getattr(usual.recipe, x) for x in (
        "clips", "steps", "matching_steps", "average", "evaluate_every", "validation"
    )}) == usual.recipe  # fmt: skip


def test_tables_are_shipped_at_two_budgets():
    assert {"coordinates", "n2n", "neighbours", "systems", "systems-sensor", "controls"} <= set(n08.tables())
    (small, against), (large, _) = n08.shipped("n2n"), n08.shipped("n2n", "gpu")
    wanted = replace(lab.BUDGETS["lab"].recipe, batch=8, evaluate_every=500)
    assert large.plan.budget.recipe.to_dict() == wanted.to_dict()
    assert list(small.plan.rows) == list(large.plan.rows) and against in small.plan.rows
    assert len(large.table(against).claims) == 4


def test_the_milestone_notices_what_is_not_the_references():
    notices(n08, "08", ("no factors", "rising", "sign alone", "no seeds"))
