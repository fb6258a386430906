"""Two measures of an RGB-D clip that need no ground truth: do its frames agree, and are its planes flat?

`check_clip` compares them before and after each correction that it considers.
"""

from __future__ import annotations

import numpy as np

from tapip3d_lite.clip import Clip
from tapip3d_lite.geometry import project, unproject

CAP = 0.25  # relative depth errors above this count as this: the point is simply lost
_QUANTILE = 0.25


def consistency(clip: Clip, samples: int = 1500, pairs: int = 8) -> float:
    """Static-scene error: how well points carried between frames meet the depth there, over all frame pairs.

    The number is a low quantile of relative depth errors, since much of a correct clip fails the test rightly: what
    moves, what gets hidden, what leaves the view.

    Args:
        clip: the clip.
        samples: pixels lifted per pair.
        pairs: frame pairs, spread over the clip at growing gaps.

    Returns:
        0 for a perfect static scene; at most 0.25, the value of a point that is lost altogether.
    """
    rng = np.random.default_rng(0)
    errors = [_carry(clip, t, s, samples, rng) for t, s in _frame_pairs(len(clip), pairs)]
    pooled = np.concatenate(errors) if errors else np.zeros(1)
    return float(np.quantile(pooled, _QUANTILE)) if pooled.size else CAP


def flatness(clip: Clip, frames: int = 4) -> float:
    """Lower quartile of the relative second differences of inverse depth: near 0 where scenes hold planes.

    Args:
        clip: the clip.
        frames: how many frames to look at.

    Returns:
        The quartile over pixels, dimensionless; the step is a twelfth of the image.
    """
    step = max(1, min(clip.size) // 12)
    values = [_second_differences(clip.depths[t], step) for t in np.linspace(0, len(clip) - 1, frames).astype(int)]
    values = np.concatenate(values)
    return float(np.quantile(values, 0.25)) if values.size else 0.0


def _frame_pairs(frames: int, pairs: int) -> list[tuple[int, int]]:
    gaps = sorted({max(1, round(frames * share)) for share in (0.1, 0.25, 0.5)})
    chosen = [(t, t + gap) for gap in gaps for t in np.linspace(0, max(frames - gap - 1, 0), pairs // 2).astype(int)]
    return [(t, s) for t, s in dict.fromkeys(chosen) if s < frames]


def _carry(clip: Clip, t: int, s: int, samples: int, rng: np.random.Generator) -> np.ndarray:
    """Capped relative depth errors of pixels of frame t seen from frame s."""
    v, u = np.nonzero(clip.depths[t])
    if not len(v):
        return np.zeros(0)
    pick = rng.integers(0, len(v), samples)
    uv = np.stack([u[pick], v[pick]], -1).astype(np.float64)
    cameras = [clip.intrinsics[[t, s]].astype(np.float64), clip.extrinsics[[t, s]].astype(np.float64)]
    points = unproject(uv, clip.depths[t, v[pick], u[pick]].astype(np.float64), cameras[0][0], cameras[1][0])
    target, z = project(points, cameras[0][1], cameras[1][1])
    seen = _bilinear_inverse(clip.depths[s], target)
    inside = np.isfinite(seen) & (z > 0)
    error = np.full(samples, CAP)
    error[inside] = np.minimum(np.abs(z[inside] * seen[inside] - 1), CAP)
    return error[~np.isnan(seen)]  # a pixel without depth speaks neither for nor against


def _bilinear_inverse(depth: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """1/z at sub-pixel positions (exact on planes): NaN on invalid depth, infinite outside the image."""
    height, width = depth.shape
    with np.errstate(divide="ignore"):
        inverse = np.where(depth > 0, 1 / depth.astype(np.float64), np.nan)
    inside = ((uv >= 0) & (uv <= (width - 1, height - 1))).all(-1)
    safe = np.where(inside[:, None], uv, 0)
    u0, v0 = np.minimum(safe.astype(int), (width - 2, height - 2)).T
    a, b = safe[:, 0] - u0, safe[:, 1] - v0
    top = inverse[v0, u0] * (1 - a) + inverse[v0, u0 + 1] * a
    bottom = inverse[v0 + 1, u0] * (1 - a) + inverse[v0 + 1, u0 + 1] * a
    return np.where(inside, top * (1 - b) + bottom * b, np.inf)


def _second_differences(depth: np.ndarray, step: int) -> np.ndarray:
    with np.errstate(divide="ignore"):
        inverse = np.where(depth > 0, 1 / depth.astype(np.float64), np.nan)
    horizontal = inverse[:, 2 * step :] + inverse[:, : -2 * step] - 2 * inverse[:, step:-step]
    vertical = inverse[2 * step :] + inverse[: -2 * step] - 2 * inverse[step:-step]
    relative = [horizontal / inverse[:, step:-step], vertical / inverse[step:-step]]
    values = np.abs(np.concatenate([r.ravel() for r in relative]))
    return values[np.isfinite(values)]
