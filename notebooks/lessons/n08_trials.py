"""Lesson 08: differences of a study's rows by seed and clip, an interval that knows no seeds, comparisons of a row with itself."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np

from tapip3d_lite.evaluation.intervals import Estimate
from tapip3d_lite.lab.statistics import Effect, effect
from tapip3d_lite.lab.table import Results, matrix

Array = np.ndarray


def differences(results: Results, one: str, other: str, metric: str) -> Array:
    """Scores of one row minus another's (S, C), by seed and clip, without clips where one is undefined."""
    d = matrix(results[one], metric) - matrix(results[other], metric)
    return d[:, ~np.isnan(d).any(0)]


def over_clips(d: Array) -> Estimate:
    """The mean of differences (C,) with a 95 % interval that takes clips for the only thing that was drawn."""
    found = effect(d[None], drawn=False)
    return Estimate(found.mean, found.low, found.high)


def with_itself(studies: Sequence[Results], metric: str) -> dict[str, Estimate]:
    """Every trained row of some studies compared with itself, one seed with another, by intervals over clips alone.

    Rows that share their trainings count once.
    """
    found, known = {}, set()
    for results in studies:
        for row, seeds in results.items():
            trainings = tuple(one["training"] for one in seeds.values())
            if len(seeds) < 2 or trainings in known:
                continue
            known.add(trainings)
            scores = matrix(seeds, metric)
            for i, j in combinations(range(len(scores)), 2):
                d = scores[i] - scores[j]
                found[f"{row}: seed {i} - seed {j}"] = over_clips(d[~np.isnan(d)])
    return found


def excludes_zero(one: Estimate | Effect) -> bool:
    """Whether an interval leaves 0 out."""
    return one.low > 0 or one.high < 0


def parts_of(d: Array, squares: tuple[float, float, float]) -> tuple[float, float, float]:
    """Standard deviations of seeds, clips and the rest, as the mean squares A, B, E of differences (S, C) estimate them."""
    (seeds, clips), (a, b, e) = d.shape, squares
    return math.sqrt(max(a - e, 0) / clips), math.sqrt(max(b - e, 0) / seeds), math.sqrt(e)
