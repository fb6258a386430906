"""What a few seeds and a few clips can prove: intervals of differences, verdicts of a table, and the power of a study.

    d[s, c] = mu + a[s] + b[c] + e[s, c]        a score's difference for seed s on clip c
    Var(mean) = (A + B - E) / (S C)             A, B, E: mean squares of seeds, of clips, and of what is left

Seeds and clips are both drawn, so both must be resampled: an interval over clips alone lies. With three seeds a
bootstrap lies, too (its interval holds the truth in 73 to 99 % of the cases, by the test beside it), since three seeds
hardly vary when they are drawn again; so the interval comes from the analysis of variance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

_ANGLES = np.linspace(0, np.pi / 2, 8001)
_MOST = 500.0  # degrees of freedom, from which on the normal distribution is near enough


@dataclass(frozen=True)
class Effect:
    """A mean over seeds and clips.

    Attributes:
        mean, low, high: with its 95 % interval; NaN where seeds or clips are too few.
        p: of the mean under the hypothesis that the truth is 0; it is a little stricter than the interval.
        seen: the smallest difference that a study like this one finds in 80 % of the cases, by one comparison alone.
        seeds, clips: that count; clips where the score is undefined do not.
    """

    mean: float
    low: float = math.nan
    high: float = math.nan
    p: float = 1.0
    seen: float = math.nan
    seeds: int = 0
    clips: int = 0


def effect(values: ArrayLike, drawn: bool = True) -> Effect:
    """The mean of scores, or of paired differences, (S, C) of S seeds on the same C clips, with its interval.

    Args:
        values: NaN where a score is undefined; such clips are left out.
        drawn: whether rows are seeds, drawn from many; False for one row (1, C) of what no seed changes.

    Raises:
        ValueError: not one number for each seed and clip.
    """
    values = np.asarray(values, float)
    if values.ndim != 2 or (not drawn and len(values) != 1):
        raise ValueError(f"effect: values must be (seeds, clips), one row where no seed is drawn, got {values.shape}")
    values = values[:, ~np.isnan(values).any(0)]
    seeds, clips = values.shape
    mean = float(values.mean()) if values.size else math.nan
    if clips < 2 or (drawn and seeds < 2):
        return Effect(mean, seeds=seeds, clips=clips)
    squares = _mean_squares(values) if drawn else (0.0, values.var(ddof=1), 0.0)
    half, power = _half_width(0.05, squares, seeds, clips), _half_width(0.4, squares, seeds, clips)
    p = float((_errors(squares, seeds, clips) >= abs(mean)).mean())
    return Effect(mean, mean - half, mean + half, p, half + power, seeds, clips)


def paired(ours: ArrayLike, theirs: ArrayLike, drawn: bool = True) -> Effect:
    """The mean of ours - theirs, paired by seed and clip: (S, C) each, or (1, C) of a tracker that was not trained."""
    ours, theirs = np.asarray(ours, float), np.asarray(theirs, float)
    if ours.ndim != 2 or theirs.ndim != 2 or ours.shape[1] != theirs.shape[1]:
        raise ValueError(f"paired: expected (seeds, clips) of the same clips, got {ours.shape} and {theirs.shape}")
    if len({len(ours), len(theirs)} - {1}) > 1:
        raise ValueError(f"paired: expected the same seeds, got {len(ours)} and {len(theirs)}; leave out the others")
    return effect(ours - theirs, drawn)


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's correction: p-values of a family of comparisons such that one error in all of it has the level of each."""
    order, adjusted, worst = np.argsort(p_values, kind="stable"), [1.0] * len(p_values), 0.0
    for rank, index in enumerate(order):
        worst = max(worst, min(1.0, (len(p_values) - rank) * p_values[index]))
        adjusted[index] = worst
    return adjusted


def verdicts(effects: Sequence[Effect], level: float = 0.05) -> list[str]:
    """`"better"`, `"worse"` or `"undecided"` for each difference of one table, after Holm's correction over it."""
    words = zip(effects, holm([one.p for one in effects]), strict=True)
    return ["undecided" if not p <= level else "better" if one.mean > 0 else "worse" for one, p in words]


def _mean_squares(values: np.ndarray) -> tuple[float, float, float]:
    """Mean squares (A, B, E) of seeds, clips, and the rest."""
    seeds, clips = values.shape
    rows, columns, mean = values.mean(1, keepdims=True), values.mean(0, keepdims=True), values.mean()
    rest = ((values - rows - columns + mean) ** 2).sum() / ((seeds - 1) * (clips - 1))
    return clips * float(rows.var(ddof=1)), seeds * float(columns.var(ddof=1)), float(rest)


def _half_width(level: float, squares: tuple[float, float, float], seeds: int, clips: int) -> float:
    """Half the width of the interval that misses the truth in a share `level` of the cases.

    A weighted mean of two approximations that err in opposite directions: Satterthwaite's, one Student's t for the whole
    variance, holds 92 to 97 % where it should hold 95, and the draws of `_errors` 95 to 98 %.
    """
    a, b, e = squares
    if seeds == 1:
        return student(level, clips - 1) * math.sqrt(b / clips)
    degrees, total = (seeds - 1, clips - 1, (seeds - 1) * (clips - 1)), max(a + b - e, 0.0)
    spread = sum(x**2 / df for x, df in zip(squares, degrees, strict=True))
    common = student(level, total**2 / spread if spread else _MOST) * math.sqrt(total / seeds / clips)
    return (2 * common + float(np.quantile(_errors(squares, seeds, clips), 1 - level))) / 3


def _errors(squares: tuple[float, float, float], seeds: int, clips: int) -> np.ndarray:
    """Draws of |mean - truth|, given the mean squares: each could come from any variance that is plausible for it.

    Deep in the tail, where Holm's correction looks, these alone are right: none of three seeds' variance may be there
    by chance, and then only the draws know that it could be large.
    """
    normal, *plausible = _draws(seeds, clips)
    a, b, e = (x * ratio for x, ratio in zip(squares, plausible, strict=True))
    return normal * np.sqrt(np.maximum(a + b - e, 0.0) / (seeds * clips))


@lru_cache(maxsize=32)
def _draws(seeds: int, clips: int, count: int = 20_000) -> tuple[np.ndarray, ...]:
    """|z|, and for each mean square the ratios of variances that are plausible to it; without drawn seeds 1."""
    rng = np.random.default_rng(0)
    degrees = [seeds - 1, clips - 1, (seeds - 1) * (clips - 1)]
    ratios = [df / rng.chisquare(df, count) if df else np.ones(count) for df in degrees]
    return np.abs(rng.normal(size=count)), *ratios


def student(level: float, degrees: float) -> float:
    """The value that |t| exceeds with probability `level`, for Student's t with (at least one) degrees of freedom."""
    degrees = round(min(max(degrees, 1.0), _MOST), 2)
    return math.sqrt(degrees) * math.tan(float(np.interp(level, _tail(degrees), _ANGLES[::-1])))


@lru_cache(maxsize=4096)
def _tail(degrees: float) -> np.ndarray:
    """The probability that |t| / sqrt(df) exceeds tan(angle), for the angles from pi / 2 down to 0."""
    density = np.cos(_ANGLES) ** (degrees - 1)  # with t = sqrt(df) tan(angle)
    sums = np.concatenate([[0.0], np.cumsum((density[:0:-1] + density[-2::-1]) / 2)])
    return sums / sums[-1]
