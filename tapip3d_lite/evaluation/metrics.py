"""The field's metrics: TAPVid-3D (AJ, APD, OA in 3D) and TAP-Vid (the same in the image).

Both count, for thresholds of k = 1, 2, 4, 8, 16 pixels, how often a visible true point is hit and how often visibility
is predicted correctly. In 3D a pixel is a length: k p_z / sqrt(fx fy) at the true depth p_z.

    OA    = mean [V = W]
    APD_k = sum(inside V) / sum(V)
    J_k   = sum(inside V W) / (sum(V) + sum(W (1 - inside V)))

with V true and W predicted visibility. AJ and APD are means over k. Source: Koppula et al., TAPVid-3D (2024), section
4; Doersch et al., TAP-Vid (2022), section 3.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tapip3d_lite.geometry import THRESHOLDS
from tapip3d_lite.validate import floats

Array = np.ndarray
SCALINGS = ("median", "mean", "none", "per_trajectory", "reproduce_2d", "median_on_queries")
MODES = ("first", "strided")


def tapvid3d_metrics(
    gt_xyz: Array,
    gt_visible: Array,
    xyz: Array,
    visible: Array,
    intrinsics: Array,
    queries: Array | None = None,
    scaling: str = "median",
) -> dict[str, float]:
    """TAPVid-3D metrics of one video.

    Args:
        gt_xyz, xyz: (T, N, 3) true and predicted points, camera frame of each t, scene units.
        gt_visible, visible: (T, N) bool.
        intrinsics: (T, 3, 3) or (3, 3), used as given (the benchmark scales them by 256 / min(H, W) first).
        queries: (N, 4) rows (t, ...) or (N,) query frames; needed by `per_trajectory` and `median_on_queries`.
        scaling: how the prediction's scale is matched to the truth before scoring, one of `SCALINGS`.

    Returns:
        `AJ3D`, `APD3D`, `OA` and for each k `jaccard_k`, `within_k`: fractions in [0, 1], NaN where undefined.

    Raises:
        ValueError: shapes that do not fit, an unknown scaling, or queries missing where the scaling needs them.
    """
    p, v, q, w = _checked(gt_xyz, gt_visible, xyz, visible, 3)
    focal = floats("intrinsics", intrinsics, (None,) * (np.ndim(intrinsics) or 2)).astype(np.float64)
    if focal.shape[-2:] != (3, 3) or focal.ndim not in (2, 3) or (focal.ndim == 3 and len(focal) != len(p)):
        raise ValueError(f"intrinsics: expected ({len(p)}, 3, 3) or (3, 3), got {focal.shape}")
    if not (focal[..., [0, 1], [0, 1]] > 0).all():
        raise ValueError("intrinsics: expected positive fx, fy (pixels) in K = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    scale = scale_factor(p, q, v & w, _query_frames(queries, p.shape[:2]), scaling)
    pixel = p[..., 2] / np.sqrt(focal[..., 0, 0] * focal[..., 1, 1])[..., None]
    with np.errstate(invalid="ignore", over="ignore"):
        squared = ((scale * q - p) ** 2).sum(-1)
        inside = {k: squared < (k * pixel) ** 2 for k in THRESHOLDS}
    return _scores(inside, v, w, np.ones_like(v), "3D")


def tapvid2d_metrics(
    gt_uv: Array, gt_visible: Array, uv: Array, visible: Array, queries: Array, mode: str = "first"
) -> dict[str, float]:
    """TAP-Vid metrics of one video.

    Args:
        gt_uv, uv: (T, N, 2) true and predicted pixels on a 256 x 256 raster.
        gt_visible, visible: (T, N) bool.
        queries: (N, 3 or 4) rows (t, ...) or (N,) query frames.
        mode: `"first"` scores frames after the query, `"strided"` all but the query frame.

    Returns:
        `AJ2D`, `APD2D`, `OA`, `jaccard_k`, `within_k`; fractions, NaN where undefined.

    Raises:
        ValueError: shapes that do not fit, or an unknown mode.
    """
    p, v, q, w = _checked(gt_uv, gt_visible, uv, visible, 2)
    if mode not in MODES:
        raise ValueError(f"mode: expected one of {', '.join(MODES)}, got {mode!r}")
    t, start = np.arange(len(p))[:, None], _query_frames(queries, p.shape[:2])
    if start is None:
        raise ValueError("queries: the 2D metrics leave out frames by the query's; pass queries=(N, 3) or (N,)")
    scored = t > start if mode == "first" else t != start
    with np.errstate(invalid="ignore", over="ignore"):
        squared = ((q - p) ** 2).sum(-1)
        inside = {k: squared < k**2 for k in THRESHOLDS}
    return _scores(inside, v, w, scored, "2D")


@np.errstate(invalid="ignore", over="ignore")
def scale_factor(p: Array, q: Array, both: Array, start: Array | None, scaling: str) -> Array | float:
    """The factor that multiplies predictions q (T, N, 3) before they are compared with the truth p (T, N, 3).

    `both` (T, N) says where both are visible; `start` (N,) are the query frames, or None where the scaling needs none
    (else ValueError). A number, (1, N, 1) or (T, N, 1); NaN where nothing is visible in both: every point is a miss.
    """
    if scaling not in SCALINGS:
        raise ValueError(f"scaling: expected one of {', '.join(SCALINGS)}, got {scaling!r}")
    if scaling == "none":
        return 1.0
    if scaling == "reproduce_2d":
        return p[..., 2:] / np.maximum(q[..., 2:], 1e-12)
    if scaling in ("median", "mean"):
        return _norm_ratio(p, q, both, np.nanmedian if scaling == "median" else np.nanmean)
    if start is None:
        raise ValueError(f"queries: scaling {scaling!r} needs the query frames; pass queries=(N, 4) or (N,)")
    track = np.arange(p.shape[1])
    if scaling == "per_trajectory":
        pz, qz = (np.maximum(x[start, track, 2], 1e-12) for x in (p, q))
        return (pz / qz)[None, :, None]
    at_query = np.zeros_like(both)
    at_query[start, track] = True
    return _norm_ratio(p, q, both & at_query, np.nanmedian)


def _scores(inside: dict[int, Array], v: Array, w: Array, scored: Array, suffix: str) -> dict[str, float]:
    scores = {"OA": _ratio(((v == w) & scored).sum(), scored.sum())}
    visible = (v & scored).sum()
    for k, hit in inside.items():
        true = hit & v & scored
        scores[f"within_{k}"] = _ratio(true.sum(), visible)
        claimed_wrongly = (w & ~true & scored).sum()
        scores[f"jaccard_{k}"] = _ratio((true & w).sum(), visible + claimed_wrongly)
    for name, part in ((f"AJ{suffix}", "jaccard"), (f"APD{suffix}", "within")):
        scores[name] = float(np.mean([scores[f"{part}_{k}"] for k in inside]))
    return scores


def _ratio(numerator: int, denominator: int) -> float:
    return float(numerator / denominator) if denominator else np.nan


def _norm_ratio(p: Array, q: Array, where: Array, average: Callable[[Array], float]) -> float:
    """Average |p| / average |q|, or NaN without a common visible point, which makes every point a miss."""
    norms = [np.maximum(np.linalg.norm(x[where], axis=-1), 1e-6) for x in (p, q)]
    if any(np.isnan(norm).all() for norm in norms):  # also where there is none
        return np.nan
    return float(average(norms[0]) / average(norms[1]))


def _query_frames(queries: Array | None, shape: tuple[int, int]) -> Array | None:
    if queries is None:
        return None
    frames = np.asarray(queries)
    frames = frames[:, 0] if frames.ndim == 2 and frames.shape[1] else frames
    if frames.shape != shape[1:] or frames.dtype.kind not in "iuf":
        raise ValueError(f"queries: expected {shape[1]} rows (t, ...) as there are tracks, got {np.shape(queries)}")
    if not ((frames >= 0) & (frames < shape[0]) & (frames == np.rint(frames))).all():
        raise ValueError(f"queries: expected whole frames in [0, {shape[0] - 1}], got {frames}; the order is (t, ...)")
    return frames.astype(int)


def _checked(p: Array, v: Array, q: Array, w: Array, last: int) -> tuple[Array, Array, Array, Array]:
    name = {2: "uv", 3: "xyz"}[last]
    p, v, q, w = (np.asarray(x) for x in (p, v, q, w))
    if p.ndim != 3 or p.shape[-1] != last or p.dtype.kind not in "fiu":
        raise ValueError(f"truth: expected gt_{name} (T, N, {last}), got {p.shape} {p.dtype}; time comes first")
    if q.shape != p.shape or q.dtype.kind not in "fiu":
        raise ValueError(f"prediction: expected {name} {p.shape} as the truth, got {q.shape}; track the same queries")
    p, q = p.astype(np.float64), q.astype(np.float64)
    for name, flags in (("gt_visible", v), ("visible", w)):
        if flags.shape != p.shape[:2] or flags.dtype != bool:
            raise ValueError(f"{name}: expected {p.shape[:2]} bool, got {flags.shape} {flags.dtype}")
    return p, v, q, w
