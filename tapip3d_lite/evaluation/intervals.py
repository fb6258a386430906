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


def bootstrap_interval(values: ArrayLike, n: int = 10_000, seed: int = 0) -> Estimate:
    """Mean over clips with its 95 % percentile bootstrap interval, from `n` resamples.

    `values` (C,) is one score for each clip, else ValueError; NaN marks clips where it is undefined and is left out.
    Low and high are NaN for fewer than two values, all three for none.
    """
    values = np.asarray(values, float)
    if values.ndim != 1:
        raise ValueError(f"bootstrap_interval: values must be one number a clip, (C,), got shape {values.shape}")
    values = values[~np.isnan(values)]
    if len(values) < 2:
        return Estimate(float(values.mean()) if len(values) else np.nan, np.nan, np.nan)
    picks = np.random.default_rng(seed).integers(len(values), size=(n, len(values)))
    low, high = np.quantile(values[picks].mean(1), [(1 - 0.95) / 2, (1 + 0.95) / 2])
    return Estimate(float(values.mean()), float(low), float(high))


def paired_difference(ours: ArrayLike, theirs: ArrayLike) -> Estimate:
    """Mean of ours - theirs with its 95 % interval, over clips where both are defined.

    Pairing removes the variance between easy and hard clips, which both trackers share.
    """
    ours, theirs = np.asarray(ours, float), np.asarray(theirs, float)
    if ours.shape != theirs.shape:
        raise ValueError(f"paired_difference: expected as many clips each, got {ours.shape} and {theirs.shape}")
    return bootstrap_interval(ours - theirs)
