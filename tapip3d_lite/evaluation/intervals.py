"""Bootstrap confidence intervals of means over clips, and of differences between trackers on the same clips."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike


class Estimate(NamedTuple):
    """A mean with its interval."""

    mean: float
    low: float
    high: float


def bootstrap_interval(values: ArrayLike, n: int = 10_000, level: float = 0.95, seed: int = 0) -> Estimate:
    """Mean over clips with its percentile bootstrap interval.

    Args:
        values: (C,) one score for each clip; NaN marks clips where it is undefined and is left out.
        n: resamples.
        level: share of the resampled means inside the interval.
        seed: of the random generator that resamples.

    Returns:
        Mean, low and high; low and high are NaN for fewer than two values, all three for none.

    Raises:
        ValueError: not one-dimensional, or a level outside (0, 1).
    """
    values = np.asarray(values, float)
    if values.ndim != 1:
        raise ValueError(f"bootstrap_interval: values must be one number a clip, (C,), got shape {values.shape}")
    if not 0 < level < 1:
        raise ValueError(f"bootstrap_interval: level must lie in (0, 1), got {level}; 0.95 is usual")
    values = values[~np.isnan(values)]
    if len(values) < 2:
        return Estimate(float(values.mean()) if len(values) else np.nan, np.nan, np.nan)
    picks = np.random.default_rng(seed).integers(len(values), size=(n, len(values)))
    low, high = np.quantile(values[picks].mean(1), [(1 - level) / 2, (1 + level) / 2])
    return Estimate(float(values.mean()), float(low), float(high))


def paired_difference(ours: ArrayLike, theirs: ArrayLike, n: int = 10_000, seed: int = 0) -> Estimate:
    """Mean of ours - theirs with its 95 % interval, over clips where both are defined.

    Pairing removes the variance between easy and hard clips, which both trackers share.
    """
    ours, theirs = np.asarray(ours, float), np.asarray(theirs, float)
    if ours.shape != theirs.shape:
        raise ValueError(f"paired_difference: expected as many clips each, got {ours.shape} and {theirs.shape}")
    return bootstrap_interval(ours - theirs, n, seed=seed)
