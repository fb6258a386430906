"""Lesson 08: differences of a study's rows by seed and clip, an interval that knows no seeds, comparisons of a row with itself."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from tapip3d_lite.evaluation.intervals import Estimate
from tapip3d_lite.lab.statistics import student

Array = np.ndarray
Results = Mapping[str, Mapping[int, Mapping[str, Any]]]


def matrix(results: Results, row: str, metric: str) -> Array:
    """A trained row's scores (S, C) by seed and clip; NaN where one is undefined."""
    seeds = [results[row][seed]["scores"] for seed in sorted(results[row])]
    return np.array([[one[clip][metric] for clip in sorted(one)] for one in seeds], float)


def differences(results: Results, one: str, other: str, metric: str) -> Array:
    """Scores of one row minus another's (S, C), by seed and clip, without clips where one is undefined."""
    d = matrix(results, one, metric) - matrix(results, other, metric)
    return d[:, ~np.isnan(d).any(0)]


def over_clips(d: Array) -> Estimate:
    """The mean of differences (C,) with a 95 % interval that takes clips for the only thing that was drawn."""
    half = student(0.05, len(d) - 1) * float(d.std(ddof=1)) / math.sqrt(len(d))
    return Estimate(float(d.mean()), float(d.mean()) - half, float(d.mean()) + half)


def with_itself(studies: Sequence[Results], metric: str) -> dict[str, Estimate]:
    """Every trained row of some studies compared with itself, one seed with another, by intervals over clips alone."""
    found = {}
    for results in studies:
        for row, seeds in results.items():
            if len(seeds) < 2:
                continue
            scores = matrix(results, row, metric)
            for i, j in combinations(range(len(scores)), 2):
                d = scores[i] - scores[j]
                found[f"{row}: seed {i} - seed {j}"] = over_clips(d[~np.isnan(d)])
    return found


def excludes_zero(one: Estimate) -> bool:
    """Whether an interval leaves 0 out."""
    return one.low > 0 or one.high < 0


def parts_of(d: Array, squares: tuple[float, float, float]) -> tuple[float, float, float]:
    """Standard deviations of seeds, clips and the rest, as the mean squares A, B, E of differences (S, C) estimate them."""
    (seeds, clips), (a, b, e) = d.shape, squares
    return math.sqrt(max(a - e, 0) / clips), math.sqrt(max(b - e, 0) / seeds), math.sqrt(e)
