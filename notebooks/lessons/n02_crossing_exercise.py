"""Exercise of notebook 02: where two curves cross, by linear interpolation."""

from __future__ import annotations

import numpy as np

from lessons.checker import Exercise, Mistake

Array = np.ndarray

# Signs of world - camera along the noise: one crossing, several, none, above from the start, and a touch before it.
_PATTERNS = {
    1: ([-1, 1], [-1, -1, 1]),
    2: ([1, -1, 1], [-1, 1, 1, -1, -1], [-1, 1, -1, 1]),
    3: ([-1, -1, -1], [1, 1, -1, 1], [-1, -1, 1, 1]),
    4: ([-1, 0, -1, -1, 1], [0, 0, 1, 1, -1], [-1, -1, 0, 1, -1, 1]),
}


def _curves(rng: np.random.Generator, size: int) -> tuple[Array, Array, Array]:
    pattern = np.array(_PATTERNS[size][int(rng.random() * len(_PATTERNS[size]))])
    camera = rng.uniform(1, 3, len(pattern))
    sigma = rng.choice([-0.0, 0.2]) + np.cumsum(rng.uniform(0.1, 1, len(pattern)) ** 2)
    return sigma, camera + pattern * rng.uniform(0.1, 1, len(pattern)), camera


def crossing(sigma: Array, world: Array, camera: Array) -> float:
    """The first sigma at which `world` rises above `camera`, linear in between; nan where it never does."""
    gap = world - camera
    above = np.flatnonzero(gap > 0)
    if not len(above):
        return np.nan
    i = above[0]
    if i == 0:
        return sigma[0]
    return sigma[i - 1] + (sigma[i] - sigma[i - 1]) * -gap[i - 1] / (gap[i] - gap[i - 1])


def _around(sigma: Array, world: Array, camera: Array, share: float | None, which: int = 0) -> float:
    """A crossing with another share of the way, or another of the places where the world is above."""
    above = np.flatnonzero(world > camera)
    if not len(above):
        return np.nan
    i = above[which]
    if i == 0:
        return sigma[0]
    gap = np.abs(world - camera)[[i - 1, i]]
    share = gap[0] / gap.sum() if share is None else share
    return sigma[i - 1] + share * (sigma[i] - sigma[i - 1])


def _all_crossings(sigma: Array, world: Array, camera: Array) -> Array:
    gap = world - camera
    i = np.flatnonzero((gap[:-1] <= 0) & (gap[1:] > 0))
    return sigma[i] + (sigma[i + 1] - sigma[i]) * -gap[i] / (gap[i + 1] - gap[i])


def _last(sigma: Array, world: Array, camera: Array) -> float:
    found = _all_crossings(sigma, world, camera)
    start = [sigma[0]] if world[0] > camera[0] else []
    return [np.nan, *start, *found][-1]


def _rising_only(sigma: Array, world: Array, camera: Array) -> float:
    return [*_all_crossings(sigma, world, camera), np.nan][0]


CROSSING = Exercise(
    "02.crossing",
    reference=crossing,
    cases=_curves,
    mistakes=(
        Mistake(
            "a measured sigma",
            lambda s, w, c: _around(s, w, c, 1.0),
            "this is the first measured sigma above; the curves cross between it and the one before.",
        ),
        Mistake(
            "the sigma before",
            lambda s, w, c: _around(s, w, c, 0.0),
            "this is the last measured sigma below; the curves cross between it and the next.",
        ),
        Mistake(
            "half way",
            lambda s, w, c: _around(s, w, c, 0.5),
            "the middle is a guess; on straight lines the gap shrinks in proportion, so its two ends say where it is zero.",
        ),
        Mistake(
            "smallest gap",
            lambda s, w, c: s[np.argmin(np.abs(w - c))],
            "the measured sigma with the smallest gap is near some crossing at best; find where the gap is zero.",
        ),
        Mistake("last crossing", _last, "the curves can cross more than once; take the first."),
        Mistake(
            "start forgotten",
            _rising_only,
            "where the world is above from the start, there is no place before it: return the first sigma.",
        ),
        Mistake(
            "never counts as the last",
            lambda s, w, c: s[-1] if not (w > c).any() else crossing(s, w, c),
            "where the world never rises above, there is no crossing: return nan.",
        ),
        Mistake(
            "the other way",
            lambda s, w, c: crossing(s, c, w),
            "you looked for the place where the camera rises above the world.",
        ),
        Mistake(
            "touching counts",
            lambda s, w, c: s[int(np.argmax(w >= c))] if ((w == c) & (np.arange(len(s)) <= np.argmax(w >= c))).any()
            else crossing(s, w, c),
            "equal is not above yet; the curves may touch and part again.",
        ),
        Mistake(
            "ends of the gap mixed up",
            lambda s, w, c: _around(s, w, c, None) if not (w > c).any() or w[0] > c[0] else _mirrored(s, w, c),
            "the crossing lies nearer to the end with the smaller gap.",
        ),
    ),
)  # fmt: skip


def _mirrored(sigma: Array, world: Array, camera: Array) -> float:
    i = np.flatnonzero(world > camera)[0]
    return sigma[i - 1] + sigma[i] - crossing(sigma, world, camera)
