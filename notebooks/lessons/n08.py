"""Lesson 08: the paper's tables as they are shipped, an order to be guessed, a live row; the learner's statistics in the tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lessons.checker import check
from lessons.guesses import SHOW, Revealed, reveal
from lessons.milestone import Use, plugged, report
from lessons.n07_figures import differences_chart
from lessons.n08_exercises import EXERCISES
from lessons.n08_figures import by_seed_and_clip, power_chart, with_itself_chart
from lessons.n08_trials import differences, excludes_zero, over_clips, parts_of, with_itself
from lessons.pictures import pipeline, show
from lessons.place import folder
from lessons.progress import collect, in_use, progress, reset
from lessons.verdict import Verdict
from lessons.widgets import explore
from tapip3d_lite.lab import BUDGETS, Budget, Study
from tapip3d_lite.lab.papers import PAPER, TABLES, open_study
from tapip3d_lite.lab.statistics import paired
from tapip3d_lite.lab.table import Table, matrix

__all__ = [
    "EXERCISES",
    "budget",
    "by_seed_and_clip",
    "check",
    "collect",
    "differences",
    "differences_chart",
    "excludes_zero",
    "explore",
    "folder",
    "in_use",
    "milestone",
    "over_clips",
    "parts",
    "parts_of",
    "pipeline",
    "power_chart",
    "progress",
    "reset",
    "reveal",
    "reveal_order",
    "shipped",
    "show",
    "tables",
    "with_itself",
    "with_itself_chart",
]


def tables() -> list[str]:
    """Names of the tables that the library brings along."""
    return [name for name in TABLES if (PAPER / name / "study.json").exists()]


def shipped(name: str, budget: str | None = None, scratch: Path | None = None) -> tuple[Study, str]:
    """A table of the paper as the library brings it along, and the row that others are compared with.

    With a `budget` the one that was trained so; clips that are looked at are simulated in `scratch`, by default
    `folder("store")`. ValueError for an unknown name.
    """
    study, against = open_study(name, accept_code=True, budget=budget, shipped=True)
    study.plan.scratch = scratch or folder("store")
    return study, against


def budget(steps: int, clips: int = 60, held_out: int = 16) -> Budget:
    """The laboratory's tracker and recipe with fewer clips, fewer steps and less matching."""
    lab = BUDGETS["lab"]
    options = {"clips": clips, "steps": steps, "matching_steps": max(20, steps // 2), "average": max(1, steps // 8)}
    options |= {"evaluate_every": max(1, steps // 4), "validation": 2}
    return replace(lab, recipe=replace(lab.recipe, **options), held_out=held_out, points=48)


def reveal_order(
    guess: Sequence[str] | str | None, study: Study, rows: Sequence[str], metric: str, then: Callable[[], object]
) -> Revealed:
    """Open a sealed order of rows, best first, for a guess of it.

    What counts are the pairs that the study decides, each alone: an interval of their paired difference without 0. The
    guess is right where it has all of them.

    Args:
        guess: the names of the rows, best first; None keeps the seal, `"show me"` opens it without a guess.
        study: with scores of all rows.
        rows: whose order is asked for.
        metric: that orders them.
        then: as for `reveal`.
    """
    if guess is None or guess == SHOW:
        return reveal(guess, "the order below", then=then)
    if isinstance(guess, str) or sorted(guess) != sorted(rows):
        text = f"expected the names {', '.join(rows)}, best first, or {SHOW!r}; got {guess!r}."
        return Revealed(Verdict("sealed", text), None)
    results = study.results()
    scores = {row: matrix(results[row], metric) for row in rows}
    decided, missed = 0, []
    for i, one in enumerate(guess):
        for other in guess[i + 1 :]:
            found = paired(scores[one], scores[other])
            decided += excludes_zero(found)
            missed += [f"{other} is better than {one}"] if found.high < 0 else []
    text = f"of {len(rows) * (len(rows) - 1) // 2} pairs this study decides {decided}; your order has {decided - len(missed)} of them"
    return Revealed(Verdict("wrong" if missed else "passed", "; ".join([text, *missed])), then)


def parts(use: Use) -> dict[str, object]:
    """The learner's mean squares, correction and verdicts at their places in the laboratory."""
    squares, holm, beside = (use(f"08.{name}") for name in ("squares", "holm", "beside"))
    words = {1: "agree", 0: "undecided", -1: "disagree"}

    def judged(theirs: float, ours: float, p: float) -> str:
        return words[int(beside(np.array([theirs]), np.array([ours]), np.array([p]))[0])]

    return {
        "tapip3d_lite.lab.statistics:_mean_squares": squares,
        "tapip3d_lite.lab.statistics:holm": lambda p: list(map(float, holm(np.array(p, float)))),
        "tapip3d_lite.lab.claims:beside": judged,
        "lessons.n08:_seen": use("08.seen"),
    }


_seen = EXERCISES[3].reference  # the library has no such plan, so the reference stands in its place


def milestone(*lessons: str, table: str = "n2n") -> Verdict:
    """Make a shipped table with the learner's functions in the laboratory, and compare it with the library's.

    Passed: each function is the learner's, the table called each, and no number or verdict differs.
    """
    calls: dict[str, int] = {}
    with plugged(lessons or ("08",), calls):
        mine = _judged(table)
    library = _judged(table)
    same = [a == b for a, b in zip(mine[0], library[0], strict=True)]
    apart = float(np.nanmax(np.abs(np.array(mine[1]) - np.array(library[1]))))
    opening = (
        f"{len(calls)} functions in the laboratory; the table {table}: {len(same)} verdicts and {len(mine[1])} numbers"
    )
    closing = f"verdicts that differ: {same.count(False)}; largest difference of a number: {apart:.7f}"
    return report(calls, all(same) and apart < 1e-6, opening, closing)


def _judged(name: str) -> tuple[list[str], list[float]]:
    """Verdicts and bounds of a table's differences and claims, and what studies of other sizes would see."""
    study, against = shipped(name)
    table: Table = study.table(against)
    gaps = [row[metric] for row in table.rows for metric in table.metrics if "difference" in row[metric]]
    words = [gap["verdict"] for gap in gaps] + [claim["verdict"] for claim in table.claims]
    ours = [gap["difference"] for gap in gaps] + [claim["ours"] for claim in table.claims]
    bounds = [one[key] for one in ours for key in ("mean", "low", "high")]
    return words, bounds + [_seen(0.01, 0.05, 0.03, seeds, 30) for seeds in (2, 3, 10)]
