"""Intervals, verdicts and power on synthetic results whose truth is known."""

import math

import numpy as np
import pytest

from tapip3d_lite.lab.statistics import effect, holm, paired, student, verdicts


def drawn(rng, seeds=3, clips=30, by_seed=0.0, rest=1.0, mean=0.0):
    """Differences (S, C) whose clips have a standard deviation of 1."""
    parts = by_seed * rng.normal(size=(seeds, 1)), rng.normal(size=(1, clips)), rest * rng.normal(size=(seeds, clips))
    return mean + sum(parts)


def two_way_bootstrap(values, n, seed):
    """The 95 % percentile interval of the mean of (S, C) values when seeds and clips are both drawn again."""
    rng = np.random.default_rng(seed)
    seeds, clips = (rng.multinomial(k, np.full(k, 1 / k), n) / k for k in values.shape)  # shares (n, S), (n, C)
    return np.quantile(((seeds @ values) * clips).sum(1), [0.025, 0.975])


def share(hits):
    hits = list(hits)
    return sum(hits) / len(hits)


@pytest.mark.parametrize("rest", [0.5, 1.0])
@pytest.mark.parametrize("by_seed", [0.0, 0.2, 0.4, 1.0, 3.0])
def test_the_interval_holds_the_truth_in_95_percent(by_seed, rest):
    rng = np.random.default_rng(round(10 * by_seed + rest))
    found = (effect(drawn(rng, by_seed=by_seed, rest=rest, mean=0.3)) for _ in range(1500))
    assert 0.93 <= share(one.low <= 0.3 <= one.high for one in found) <= 0.97


def test_intervals_over_clips_alone_or_by_bootstrap_lie_where_seeds_differ():
    rng = np.random.default_rng(0)
    values = [drawn(rng, by_seed=0.7, rest=0.5) for _ in range(300)]
    clips = [effect(one.mean(0, keepdims=True), drawn=False) for one in values]
    assert share(one.low <= 0 <= one.high for one in clips) < 0.65
    bounds = [two_way_bootstrap(one, 500, seed) for seed, one in enumerate(values)]
    assert share(low <= 0 <= high for low, high in bounds) < 0.9
    enough = [two_way_bootstrap(drawn(rng, 12, 30, 0.7, 0.5), 500, seed) for seed in range(300)]
    assert share(low <= 0 <= high for low, high in enough) > 0.9


def test_one_seed_proves_nothing_and_a_given_tracker_needs_none():
    values = 1.0 + np.random.default_rng(0).normal(size=(1, 30)) / 100
    alone, given = effect(values), effect(values, drawn=False)
    assert alone.mean == given.mean and math.isnan(alone.low) and verdicts([alone]) == ["undecided"]
    half = student(0.05, 29) * values.std(ddof=1) / 30**0.5
    assert given.high - given.mean == pytest.approx(half) and verdicts([given]) == ["better"]


def test_student_is_students_t():
    for level, degrees, value in [(0.05, 1, 12.706), (0.05, 2, 4.3027), (0.001, 5, 6.869), (0.05, 58, 2.0017)]:
        assert student(level, degrees) == pytest.approx(value, rel=1e-3)


def test_p_is_at_most_a_little_stricter_than_the_interval():
    rng = np.random.default_rng(3)
    for mean in np.linspace(0, 2, 40):
        one = effect(drawn(rng, by_seed=0.3, mean=mean))
        excludes = one.low > 0 or one.high < 0
        assert (one.p < 0.05) <= excludes and excludes <= (one.p < 0.12)


def test_pairing_removes_what_rows_share():
    rng = np.random.default_rng(1)
    hard, theirs = 5 * rng.normal(size=(1, 30)), 0.1 * rng.normal(size=(3, 30))
    ours = theirs + 0.05 + 0.02 * rng.normal(size=(3, 30))
    one = paired(hard + ours, hard + theirs)
    assert one.low > 0 and one.high - one.low < 0.1 < effect(hard + ours).high
    given = paired(hard + ours, hard + theirs[:1])  # stands beside every seed
    assert given.seeds == 3 and given.mean == pytest.approx((ours - theirs[:1]).mean())


def test_clips_without_a_score_are_left_out():
    values = drawn(np.random.default_rng(2))
    holes = values.copy()
    holes[1, 4] = holes[:, 7] = np.nan
    assert effect(holes) == effect(np.delete(values, [4, 7], 1)) and effect(holes).clips == 28
    nothing = effect(np.full((3, 5), np.nan))
    assert math.isnan(nothing.mean) and nothing.clips == 0 and verdicts([nothing]) == ["undecided"]


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([]) == [] and holm([0.7, 0.9]) == [1.0, 1.0]


@pytest.mark.parametrize("by_seed", [0.0, 0.3, 1.0])
def test_a_table_without_differences_claims_one_in_at_most_5_percent(by_seed):
    rng = np.random.default_rng(4)
    tables = []
    for _ in range(400):
        base = drawn(rng, by_seed=by_seed)
        tables.append(verdicts([paired(drawn(rng, by_seed=by_seed), base) for _ in range(6)]))
    assert share(table != ["undecided"] * 6 for table in tables) <= 0.05


def test_the_smallest_difference_is_seen_in_80_percent():
    rng = np.random.default_rng(5)
    size = np.mean([effect(drawn(rng, by_seed=0.2)).seen for _ in range(200)])
    assert 0.72 <= share(effect(drawn(rng, by_seed=0.2, mean=size)).low > 0 for _ in range(400)) <= 0.88


@pytest.mark.parametrize("values", [np.zeros(3), np.zeros((2, 3, 4))])
def test_other_shapes_are_refused(values):
    with pytest.raises(ValueError, match=r"\(seeds, clips\)"):
        effect(values)
    with pytest.raises(ValueError, match="same seeds"):
        paired(np.zeros((2, 4)), np.zeros((3, 4)))
    with pytest.raises(ValueError, match="same clips"):
        paired(np.zeros((2, 4)), np.zeros((2, 5)))
