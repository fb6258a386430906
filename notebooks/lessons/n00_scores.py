"""Lesson 00, exercises about scores: hits, two scores of one threshold, the scale of a prediction."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lessons.checker import Exercise, Mistake

Array = np.ndarray


def _pairs(rng: np.random.Generator, size: int) -> tuple:
    """Truths and predictions, focal lengths that differ from frame to frame, and one miss exactly as long as the radius."""
    frames, count, k = size + 1, 4 * size, int(rng.choice([2, 4, 8]))
    p = np.concatenate([rng.uniform(-1, 1, (frames, count, 2)), rng.uniform(2, 6, (frames, count, 1))], -1)
    focal = np.append(128.0, rng.uniform(60, 220, frames - 1))
    radius = k * p[..., 2] / focal[:, None]
    q = p + rng.normal(size=p.shape) * rng.choice([0.2, 0.6, 2], (frames, count, 1)) * radius[..., None]
    q[:, 1::2, 2] = p[:, 1::2, 2] * rng.choice([0.4, 1.6], (frames, count // 2))  # far off in depth
    p[0, 0], q[0, 0] = [0.5, -0.25, 5], np.array([0.5, -0.25, 5]) + k / 128 * np.array([3, 4, 0])
    return p, q, focal, k


def hits(p: Array, q: Array, focal: Array, k: int) -> Array:
    """Whether (T, N) each prediction lies nearer to its truth than k pixels at the true depth."""
    return _nearer(p, q, k * p[..., 2] / focal[:, None])


def _nearer(p: Array, q: Array, radius: Array | float) -> Array:
    return np.linalg.norm(q - p, axis=-1) < radius


HITS = Exercise(
    "00.hits",
    reference=hits,
    cases=_pairs,
    mistakes=(
        Mistake(
            "predicted depth",
            lambda p, q, f, k: _nearer(p, q, k * q[..., 2] / f[:, None]),
            "the radius belongs to the truth: k z* / focal with the true depth; else a prediction far away would widen its own target.",
        ),
        Mistake(
            "depth left out",
            lambda p, q, f, k: _nearer(p, q, k / f[:, None]),
            "k pixels are a length that grows with depth: k z* / focal, not k / focal.",
        ),
        Mistake(
            "pixels for metres",
            lambda p, q, f, k: _nearer(p, q, float(k)),
            "the error is in metres and k in pixels; turn k into metres first: k z* / focal.",
        ),
        Mistake(
            "multiplied by the focal length",
            lambda p, q, f, k: _nearer(p, q, k * p[..., 2] * f[:, None]),
            "a longer focal length shows more pixels a metre: divide by focal.",
        ),
        Mistake(
            "first frame's lens",
            lambda p, q, f, k: _nearer(p, q, k * p[..., 2] / f[0]),
            "each frame has its own focal length: focal[:, None] goes along time.",
        ),
        Mistake(
            "distance to the camera",
            lambda p, q, f, k: _nearer(p, q, k * np.linalg.norm(p, axis=-1) / f[:, None]),
            "depth is z, the third coordinate, not the length of the ray.",
        ),
        Mistake(
            "axis by axis",
            lambda p, q, f, k: (np.abs(q - p) < (k * p[..., 2] / f[:, None])[..., None]).all(-1),
            "the ball is round: compare the length of the difference, not its components.",
        ),
        Mistake(
            "in the image only",
            lambda p, q, f, k: _nearer(p[..., :2], q[..., :2], k * p[..., 2] / f[:, None]),
            "an error along the ray counts as well: use all three coordinates.",
        ),
        Mistake(
            "border included",
            lambda p, q, f, k: np.linalg.norm(q - p, axis=-1) <= k * p[..., 2] / f[:, None],
            "the benchmark's inequality is strict: a miss as long as the radius is a miss.",
        ),
    ),
)


def _flags(rng: np.random.Generator, size: int) -> tuple:
    shape = (size + 1, 5 * size)
    hit, seen, said = (rng.random(shape) < share for share in rng.uniform(0.3, 0.8, 3))
    seen[0] = rng.random(shape[1]) < 0.2  # frames differ in how much of them is seen
    for flags, first in ((hit, (1, 1, 0)), (seen, (1, 0, 1)), (said, (1, 1, 1))):
        flags[0, :3] = first  # each kind of mistake, also in the smallest case
    return hit, seen, said


def two_scores(hit: Array, seen: Array, said: Array) -> tuple[float, float]:
    """APD_k and J_k of one threshold from flags (T, N): hit, truly visible, said to be visible."""
    return _scores(hit, seen, said, said & ~(hit & seen))


def _scores(hit: Array, seen: Array, said: Array, wrong: Array) -> tuple[float, float]:
    return (hit & seen).sum() / seen.sum(), (hit & seen & said).sum() / (seen.sum() + wrong.sum())


def _with_within(within: Callable[..., float]) -> Callable[..., tuple]:
    return lambda h, v, w: (within(h, v, w), two_scores(h, v, w)[1])


def _with_jaccard(jaccard: Callable[..., float]) -> Callable[..., tuple]:
    return lambda h, v, w: (two_scores(h, v, w)[0], jaccard(h, v, w))


def _frame_by_frame(hit: Array, seen: Array, said: Array) -> tuple[float, float]:
    rows = [two_scores(h, v, w) for h, v, w in zip(hit, seen, said, strict=True) if v.any()]
    return tuple(np.mean(rows, axis=0))


SCORES = Exercise(
    "00.two_scores",
    reference=two_scores,
    cases=_flags,
    mistakes=(
        Mistake(
            "APD: hidden points counted",
            _with_within(lambda h, v, w: h.mean()),
            "APD_k: only points that are truly visible count, above and below the fraction bar.",
        ),
        Mistake(
            "APD: divided by all points",
            _with_within(lambda h, v, w: (h & v).mean()),
            "APD_k: divide by the number of visible points, not by the number of all.",
        ),
        Mistake(
            "APD: the word asked for",
            _with_within(lambda h, v, w: (h & v & w).sum() / v.sum()),
            "APD_k does not ask what was said about visibility; J_k does.",
        ),
        Mistake(
            "J: divided by the visible points",
            _with_jaccard(lambda h, v, w: (h & v & w).sum() / v.sum()),
            "J_k: below the bar stand the false claims as well: said to be visible, but hidden in truth or missed.",
        ),
        Mistake(
            "J: only hidden points are false claims",
            _with_jaccard(lambda h, v, w: (h & v & w).sum() / (v.sum() + (w & ~v).sum())),
            "J_k: a visible point that is called visible and missed counts twice below the bar: as not found, and as a false claim.",
        ),
        Mistake(
            "J: only misses are false claims",
            _with_jaccard(lambda h, v, w: (h & v & w).sum() / (v.sum() + (w & ~h).sum())),
            "J_k: a point near a hidden truth that is called visible is a false claim, however near: said & ~(hit & seen).",
        ),
        Mistake(
            "J: visible points called hidden cost nothing",
            _with_jaccard(lambda h, v, w: (h & v & w).sum() / w.sum()),
            "J_k: a visible point that is called hidden costs, too: it stands below the bar and not above.",
        ),
        Mistake(
            "J: hidden hits counted",
            _with_jaccard(lambda h, v, w: (h & w).sum() / (v.sum() + (w & ~(h & v)).sum())),
            "J_k: above the bar stand only points that are truly visible.",
        ),
        Mistake(
            "J: the word left out above",
            _with_jaccard(lambda h, v, w: (h & v).sum() / (v.sum() + (w & ~(h & v)).sum())),
            "J_k: above the bar stand only points that are also said to be visible.",
        ),
        Mistake("order", lambda *a: two_scores(*a)[::-1], "return APD_k first, then J_k."),
        Mistake(
            "frame by frame",
            _frame_by_frame,
            "sum over all frames and tracks first, then divide once; a mean of the frames' ratios weighs frames with few points too much.",
        ),
    ),
)


def _scaled(rng: np.random.Generator, size: int) -> tuple:
    """Predictions in another unit, with misses; what only one side calls visible lies elsewhere altogether."""
    shape = (size + 1, 4 * size + 1)
    p = rng.normal(size=(*shape, 3)) * 0.7 + [0.5, -0.2, 4]
    q = p * rng.uniform(0.2, 3) * rng.lognormal(0, 0.3, (*shape, 1)) + rng.normal(size=p.shape) * 0.3
    seen, said = rng.random(shape) < 0.7, rng.random(shape) < 0.7
    seen[0, :3], said[0, :3] = True, True
    p[~said] *= rng.uniform(2, 4)
    q[~seen] *= rng.uniform(3, 6)
    q[~(seen | said)] *= -5
    return p, q, seen, said


def median_scale(p: Array, q: Array, seen: Array, said: Array) -> float:
    """The factor that takes predictions q (T, N, 3) to the truth's size: ratio of median distances from the camera."""
    return _ratio(p, q, seen & said, np.median)


def _ratio(p: Array, q: Array, where: Array, average: Callable[[Array], float]) -> float:
    near, far = (np.linalg.norm(x[where], axis=-1) for x in (p, q))
    return average(near) / average(far)


SCALE = Exercise(
    "00.median_scale",
    reference=median_scale,
    cases=_scaled,
    mistakes=(
        Mistake(
            "the wrong way round",
            lambda *a: 1 / median_scale(*a),
            "the factor multiplies the prediction: truth above, prediction below.",
        ),
        Mistake(
            "median of ratios",
            lambda p, q, v, w: np.median(np.linalg.norm(p, axis=-1)[v & w] / np.linalg.norm(q, axis=-1)[v & w]),
            "it is the ratio of two medians, not the median of the ratios.",
        ),
        Mistake(
            "mean",
            lambda p, q, v, w: _ratio(p, q, v & w, np.mean),
            "take the median: a few points that went astray would pull a mean away.",
        ),
        Mistake(
            "all points",
            lambda p, q, v, w: _ratio(p, q, np.ones_like(v), np.median),
            "only points that are visible in truth and are said to be visible count.",
        ),
        Mistake(
            "truly visible points",
            lambda p, q, v, w: _ratio(p, q, v, np.median),
            "a visible point that the tracker calls hidden does not count: seen & said.",
        ),
        Mistake(
            "points said to be visible",
            lambda p, q, v, w: _ratio(p, q, w, np.median),
            "a hidden point that the tracker calls visible does not count: seen & said.",
        ),
        Mistake(
            "either",
            lambda p, q, v, w: _ratio(p, q, v | w, np.median),
            "both must hold, visible and said to be visible: & and not |.",
        ),
        Mistake(
            "depth for distance",
            lambda p, q, v, w: _ratio(p[..., 2:], q[..., 2:], v & w, np.median),
            "the benchmark takes the distance from the camera, the norm of all three coordinates, not the depth.",
        ),
        Mistake(
            "frame by frame",
            lambda p, q, v, w: np.mean([median_scale(*x) for x in zip(p, q, v, w, strict=True) if (x[2] & x[3]).any()]),
            "one factor for the whole clip: take the medians over all frames together.",
        ),
    ),
)
