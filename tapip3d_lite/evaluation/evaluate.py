"""Scores of tracks against a clip's ground truth, as the benchmarks define them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.evaluation.metrics import scale_factor, tapvid2d_metrics, tapvid3d_metrics
from tapip3d_lite.geometry import RASTER, project, transform


def evaluate(pred: Tracks, clip: Clip) -> dict[str, float]:
    """Scores of predicted tracks on a clip with truth.

    3D scores follow TAPVid-3D: camera frame, intrinsics scaled by 256 / min(H, W), all frames. `AJ3D` and `APD3D` use
    median scaling; `AJ3D_none` and `APD3D_none` none, which is stricter and fair where depth is given in true units.
    2D scores follow TAP-Vid "strided" (all frames but the query's). Where the clip knows which points move,
    `_dynamic` and `_static` variants score these alone, with the scale of the whole clip.

    Args:
        pred: tracks of the truth's queries, in their order.
        clip: provides the cameras and the truth, `clip.tracks`.

    Returns:
        `AJ3D, APD3D, OA, AJ2D, APD2D, AJ3D_none, APD3D_none, EPE` (mean 3D error over visible truth, scene units) and
        their variants; fractions in [0, 1], NaN where undefined.

    Raises:
        ValueError: the clip has no truth, or the prediction follows other queries.
    """
    truth = clip.tracks
    if truth is None:
        raise ValueError(f"evaluate: clip {clip.name!r} has no true tracks; simulate one or load a file with tracks")
    if len(pred.xyz) != len(clip):
        raise ValueError(f"pred: expected {len(clip)} frames as in the clip, got {len(pred.xyz)}; cut both alike")
    if pred.queries.shape != truth.queries.shape or not np.allclose(pred.queries, truth.queries, atol=1e-4):
        raise ValueError(
            f"evaluate: the prediction follows {pred.queries.shape[0]} queries that are not the {truth.queries.shape[0]} "
            "of the truth; call track(clip) without queries"
        )
    with np.errstate(invalid="ignore"):  # a prediction that is not finite is a miss, not a reason to stop
        p, q = (transform(tracks.xyz.astype(np.float64), clip.extrinsics) for tracks in (truth, pred))
    factor = scale_factor(p, q, truth.visible & pred.visible, None, "median")
    scores = _scores(clip, truth, pred, p, q, factor)
    if truth.dynamic is not None:
        for name, mask in (("dynamic", truth.dynamic), ("static", ~truth.dynamic)):
            part = _scores(clip, truth.select(mask), pred.select(mask), p[:, mask], q[:, mask], factor)
            scores |= {f"{key}_{name}": value for key, value in part.items()}
    return scores


def _scores(clip: Clip, truth: Tracks, pred: Tracks, p: np.ndarray, q: np.ndarray, factor: float) -> dict[str, float]:
    height, width = clip.size
    intrinsics = clip.intrinsics * np.array([RASTER / min(height, width)] * 2 + [1], np.float32)[:, None]
    scaled = tapvid3d_metrics(p, truth.visible, factor * q, pred.visible, intrinsics, scaling="none")
    plain = tapvid3d_metrics(p, truth.visible, q, pred.visible, intrinsics, scaling="none")
    raster = np.array([RASTER / width, RASTER / height])
    with np.errstate(invalid="ignore"):
        true_uv, uv = (project(x, clip.intrinsics)[0] * raster for x in (p, q))
        error = np.linalg.norm(p - q, axis=-1)[truth.visible]
    flat = tapvid2d_metrics(true_uv, truth.visible, uv, pred.visible, truth.queries, mode="strided")
    return {
        **{name: scaled[name] for name in ("AJ3D", "APD3D", "OA")},
        **{name: flat[name] for name in ("AJ2D", "APD2D")},
        **{f"{name}_none": plain[name] for name in ("AJ3D", "APD3D")},
        "EPE": float(error.mean()) if error.size else float("nan"),
    }


def mean_scores(scores: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Unweighted mean over clips, entry by entry; clips where an entry is undefined are left out of it."""
    names = dict.fromkeys(name for one in scores for name in one)
    columns = {name: [one[name] for one in scores if name in one and not np.isnan(one[name])] for name in names}
    return {name: float(np.mean(values)) if values else float("nan") for name, values in columns.items()}


def score_table(
    rows: Mapping[str, Mapping[str, float]], metrics: Sequence[str] = ("AJ3D", "APD3D", "OA", "AJ3D_none", "APD3D_none")
) -> str:
    """A Markdown table, one row an entry, three decimals, nan where an entry lacks a metric."""
    cells = ([name, *(f"{row.get(m, float('nan')):.3f}" for m in metrics)] for name, row in rows.items())
    return markdown_table(["", *metrics], cells)


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table of cells."""
    lines = ["".join(f"| {cell} " if cell else "| " for cell in row) + "|" for row in (head, *rows)]
    return "\n".join([lines[0], "|---" * len(head) + "|", *lines[1:]])
