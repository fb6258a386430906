"""Lesson 07: what scores see, intervals, failures; the learner's scores and intervals in the library's evaluation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

import tapip3d_lite as t3d
from lessons.checker import check
from lessons.guesses import reveal
from lessons.milestone import CLIP, Use, plugged, report
from lessons.n00 import card
from lessons.n07_exercises import EXERCISES
from lessons.n07_figures import (
    balls,
    by_threshold_chart,
    by_word_chart,
    coverage_chart,
    depth_chart,
    differences_chart,
    flat_and_space,
    shares_chart,
    two_rows,
    worst_in_3d,
)
from lessons.n07_trials import by_threshold, coverage, errors, shuffled, spoken, unscaled
from lessons.pictures import pipeline, show
from lessons.progress import collect, in_use, progress, reset
from lessons.verdict import Verdict
from lessons.widgets import explore
from tapip3d_lite.evaluation import intervals
from tapip3d_lite.geometry import RASTER

__all__ = [
    "EXERCISES",
    "balls",
    "by_threshold",
    "by_threshold_chart",
    "by_word_chart",
    "card",
    "check",
    "collect",
    "coverage",
    "coverage_chart",
    "depth_chart",
    "differences_chart",
    "errors",
    "explore",
    "flat_and_space",
    "in_use",
    "milestone",
    "parts",
    "pipeline",
    "progress",
    "reset",
    "reveal",
    "shares_chart",
    "show",
    "shuffled",
    "spoken",
    "two_rows",
    "unscaled",
    "worst_in_3d",
]

Array = np.ndarray


def parts(use: Use) -> dict[str, object]:
    """The learner's counts, pixels and intervals at their places in the library, and the list of the worst tracks."""
    scores, to_raster, interval, worst = (use(f"07.{name}") for name in ("scores", "raster", "interval", "worst"))

    def counted(inside: Mapping[int, Array], v: Array, w: Array, scored: Array, suffix: str) -> dict[str, float]:
        oa, apd, aj = map(float, scores(np.stack(list(inside.values())), v, w, scored))
        return {"OA": oa, f"APD{suffix}": apd, f"AJ{suffix}": aj}

    def project(points: Array, intrinsics: Array) -> tuple[Array, Array]:
        size = t3d.load_clip(CLIP).size  # `evaluate` stretches to the raster itself, so that is undone
        return to_raster(points, intrinsics, size) / (RASTER / np.array(size[::-1])), points[..., 2]

    def bootstrap(values: ArrayLike, n: int = 10_000, seed: int = 0) -> intervals.Estimate:
        values = np.asarray(values, float)
        picks = np.random.default_rng(seed).integers(len(values), size=(n, len(values)))
        return intervals.Estimate(*map(float, interval(values, 0 * values, picks, picks)))

    return {
        "tapip3d_lite.evaluation.metrics:_scores": counted,
        "tapip3d_lite.evaluation.evaluate:project": project,
        "tapip3d_lite.evaluation.intervals:bootstrap_interval": bootstrap,
        "lessons.n07:_worst": worst,
    }


def milestone(*lessons: str, trackers: Sequence[str] = ("lite", "klt", "static")) -> Verdict:
    """Score trackers with the learner's functions in the library's evaluation, and compare with the library.

    Passed: each function is the learner's, the evaluation called each, and no score, interval or worst track differs.
    """
    calls: dict[str, int] = {}
    tracks = _tracks(tuple(trackers))
    with plugged(lessons or ("07",), calls):
        mine = _judged(tracks)
    library = _judged(tracks)
    apart = float(np.abs(mine - library).max())
    opening = f"{len(calls)} functions in the evaluation; {mine.size} numbers of {', '.join(trackers)} on one clip"
    return report(calls, apart < 1e-6, opening, f"largest difference from the library's numbers: {apart:.7f}")


_worst = EXERCISES[3].reference  # the library has no such list, so the reference stands in its place


@cache
def _tracks(trackers: tuple[str, ...]) -> tuple:
    clip = t3d.load_clip(CLIP).cut(0, 12)
    clip = replace(clip, tracks=clip.tracks.select(slice(0, None, 3)), queries=None)
    return clip, [t3d.load_tracker(name).track(clip) for name in trackers]


def _judged(tracks: tuple) -> Array:
    """Scores in 3D and 2D of all, moving and still points, the paired interval of two trackers, the five worst tracks."""
    clip, found = tracks
    rows = [t3d.evaluate(one, clip) for one in found]
    names = [name for name in rows[0] if name.startswith(("AJ", "APD", "OA"))]
    table = np.array([[row[name] for name in names] for row in rows])
    p, q, focal = errors(found[0], clip)[1:]
    return np.concatenate(
        [
            table.ravel(),
            intervals.paired_difference(table[0], table[-1]),
            _worst(p, q, clip.tracks.visible, focal, 5),
        ]
    )
