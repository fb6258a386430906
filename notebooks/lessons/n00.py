"""Lesson 00, its bars and exercises: queries from pixels, where a camera stands, visibility by depth, hits within a ball."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from lessons.checker import Exercise, Mistake, check
from lessons.guesses import reveal
from lessons.milestone import milestone
from lessons.n01 import random_extrinsics, random_intrinsics
from lessons.pictures import pipeline, show
from lessons.progress import collect, in_use, progress, reset
from lessons.widgets import explore
from tapip3d_lite.figures.flat import label_axes
from tapip3d_lite.geometry import invert, transform, unproject

__all__ = [
    "EXERCISES",
    "check",
    "collect",
    "explore",
    "in_use",
    "milestone",
    "pipeline",
    "progress",
    "reset",
    "reveal",
    "scores_bar",
    "show",
]

Array = np.ndarray


def scores_bar(scores: Mapping[str, Mapping[str, float]], metrics: Sequence[str] = ("AJ3D", "APD3D", "OA")) -> Figure:
    """Scores of several trackers side by side, with the numbers written on the bars.

    Args:
        scores: tracker name to the dictionary that `evaluate` returns.
        metrics: which entries to show.
    """
    figure = Figure(figsize=(1.6 * len(metrics) + 1.5, 2.4), layout="constrained")
    ax = figure.add_subplot()
    step = 0.8 / len(scores)
    for i, (name, values) in enumerate(scores.items()):
        at = np.arange(len(metrics)) + (i - (len(scores) - 1) / 2) * step
        bars = ax.bar(at, [values[m] for m in metrics], step * 0.92, label=name, color=f"C{i}")
        ax.bar_label(bars, fmt="%.2f", fontsize=7, padding=1)
    ax.set_xticks(range(len(metrics)), metrics)
    ax.set_ylim(0, 1.1)
    label_axes(ax, "score", "")
    ax.legend(fontsize=7, frameon=False, ncols=len(scores), loc="upper center", bbox_to_anchor=(0.5, 1.18))
    return figure


def _one_pixel(rng: np.random.Generator, size: int) -> tuple:
    frames, height, width = size + 2, 8 + size, 12 + size
    depths = rng.uniform(1, 5, (frames, height, width))
    intrinsics = np.stack([random_intrinsics(rng) for _ in range(frames)])
    extrinsics = np.stack([random_extrinsics(rng) for _ in range(frames)])
    t, u, v = int(rng.integers(1, frames)), int(rng.integers(1, height)), int(rng.integers(1, height))
    return t, u, v if v != u else (v + 1) % height, depths, intrinsics, extrinsics


def lift(t: int, u: int, v: int, depths: Array, intrinsics: Array, extrinsics: Array, slip: float = 0.0) -> Array:
    """The query (4,) of a pixel: (t, x, y, z) in the world."""
    uv, z = np.array([[u, v]]) + slip, depths[t, v, u][None]
    return np.array([t, *unproject(uv, z, intrinsics[t], extrinsics[t])[0]])


def _in_camera(t: int, u: int, v: int, depths: Array, intrinsics: Array, extrinsics: Array) -> Array:
    return np.array([t, *unproject(np.array([[u, v]]), depths[t, v, u][None], intrinsics[t])[0]])


def _forwards(t: int, u: int, v: int, depths: Array, intrinsics: Array, extrinsics: Array) -> Array:
    camera = _in_camera(t, u, v, depths, intrinsics, extrinsics)
    return np.array([t, *transform(camera[None, 1:], extrinsics[t])[0]])


LIFT = Exercise(
    "00.lift",
    reference=lift,
    cases=_one_pixel,
    mistakes=(
        Mistake(
            "camera frame",
            _in_camera,
            "this is the point in the camera's frame; queries live in the world, so apply the inverse of extrinsics[t].",
        ),
        Mistake(
            "extrinsics the wrong way",
            _forwards,
            "extrinsics map world to camera and you start in the camera: apply their inverse.",
        ),
        Mistake(
            "row and column swapped",
            lambda t, u, v, d, k, e: lift(t, u, v, d.swapaxes(1, 2)[:, : d.shape[1]], k, e),
            "an image is indexed by row, then column: depths[t, v, u].",
        ),
        Mistake(
            "first frame's camera",
            lambda t, u, v, d, k, e: lift(t, u, v, d, k[:1].repeat(len(k), 0), e[:1].repeat(len(e), 0)),
            "the pixel belongs to frame t: take that frame's camera, not the first one's.",
        ),
        Mistake(
            "pixel-centre slip",
            lambda t, u, v, d, k, e: lift(t, u, v, d, k, e, slip=0.5),
            "pixel centres are whole numbers here; nothing is added to u and v.",
        ),
        Mistake("frame index forgotten", lambda *a: lift(*a)[1:], "a query has four numbers; the first is t."),
    ),
)


def _poses(rng: np.random.Generator, size: int) -> tuple:
    return (np.stack([random_extrinsics(rng) for _ in range(size)]),)


CENTER = Exercise(
    "00.camera_position",
    reference=lambda extrinsics: invert(extrinsics)[:, :3, 3],
    cases=_poses,
    mistakes=(
        Mistake(
            "last column",
            lambda e: e[:, :3, 3],
            "the last column is where the world's origin lies as seen from the camera; you want the opposite view.",
        ),
        Mistake(
            "minus the last column",
            lambda e: -e[:, :3, 3],
            "this is right for a camera that is not turned; the rotation must be undone as well: -R^T t.",
        ),
        Mistake(
            "rotation not transposed",
            lambda e: -np.einsum("tij,tj->ti", e[:, :3, :3], e[:, :3, 3]),
            "undoing a rotation is multiplying by its transpose: -R^T t.",
        ),
        Mistake(
            "sign lost",
            lambda e: np.einsum("tji,tj->ti", e[:, :3, :3], e[:, :3, 3]),
            "solve R x + t = 0 for x and watch the sign.",
        ),
    ),
)


def _projected(rng: np.random.Generator, size: int) -> tuple:
    height, width, count = 5 + size, 9 + 2 * size, 12 * size
    depth = rng.uniform(1, 3, (height, width))
    uv = rng.uniform([-3, -3], [width + 2, height + 2], (count, 2))
    column, row = (np.rint(uv).astype(int) % (width, height)).T
    # Half of the points lie on their surface up to the slack, half elsewhere; some behind the camera.
    z = np.where(
        rng.random(count) < 0.5, depth[row, column] * rng.uniform(0.99, 1.01, count), rng.uniform(-1, 4, count)
    )
    return uv, z, depth, 0.02


def visible(uv: Array, z: Array, depth: Array, slack: float) -> Array:
    """Which points (N,) are inside the image, in front of the camera and not behind the surface."""
    inside, surface = _surface(uv, depth)
    return inside & (z > 0) & (z <= surface * (1 + slack))


def _surface(uv: Array, depth: Array) -> tuple[Array, Array]:
    """Whether (N,) the nearest pixel is inside the image, and the depth (N,) there or at the nearest border."""
    last = np.array(depth.shape[::-1]) - 1
    nearest = np.rint(uv).astype(int)
    column, row = nearest.clip(0, last).T
    return ((nearest >= 0) & (nearest <= last)).all(-1), depth[row, column]


def _without_border(uv: Array, z: Array, depth: Array, slack: float) -> Array:
    return (z > 0) & (z <= _surface(uv, depth)[1] * (1 + slack))


def _behind_too(uv: Array, z: Array, depth: Array, slack: float) -> Array:
    inside, surface = _surface(uv, depth)
    return inside & (z <= surface * (1 + slack))


def _reversed(uv: Array, z: Array, depth: Array, slack: float) -> Array:
    inside, surface = _surface(uv, depth)
    return inside & (z > 0) & (z >= surface * (1 + slack))


VISIBLE = Exercise(
    "00.visible",
    reference=visible,
    cases=_projected,
    mistakes=(
        Mistake(
            "row and column swapped",
            lambda uv, z, d, s: visible(uv[:, ::-1], z, d, s),
            "uv is (column, row) and depth is indexed by (row, column): depth[v, u].",
        ),
        Mistake(
            "image border ignored",
            _without_border,
            "a point outside the image cannot be seen; check 0 <= u < W and 0 <= v < H before you look up the depth.",
        ),
        Mistake(
            "behind the camera",
            _behind_too,
            "a point behind the camera projects into the image as well; ask for z > 0.",
        ),
        Mistake(
            "no slack",
            lambda uv, z, d, s: visible(uv, z, d, 0.0),
            "surface points lie on the depth map only up to rounding: allow z up to (1 + slack) times the depth.",
        ),
        Mistake(
            "cut off instead of rounded",
            lambda uv, z, d, s: visible(np.floor(uv), z, d, s),
            "pixel centres are whole numbers, so the nearest pixel comes from rounding, not from cutting off.",
        ),
        Mistake(
            "inequality reversed",
            _reversed,
            "a point is hidden when it lies deeper than the surface, so visible means z <= surface.",
        ),
    ),
)


def _pairs(rng: np.random.Generator, size: int) -> tuple:
    frames, count = size + 1, 6 * size
    p = np.concatenate([rng.uniform(-1, 1, (frames, count, 2)), rng.uniform(2, 6, (frames, count, 1))], -1)
    q = p + rng.normal(size=p.shape) * rng.choice([0.02, 0.08, 0.3], (frames, count, 1))
    seen = rng.random((frames, count)) < 0.6
    seen[0, 0] = True
    return p, q, seen, rng.uniform(80, 160), int(rng.choice([2, 4, 8]))


def within(p: Array, q: Array, seen: Array, focal: float, k: int) -> Array:
    """Share of the truly visible points that are hit within k pixels at their own depth."""
    return _share(p, q, seen, k * p[..., 2] / focal)


def _share(p: Array, q: Array, seen: Array, radius: Array | float) -> Array:
    return (np.linalg.norm(q - p, axis=-1) < radius)[seen].mean()


WITHIN = Exercise(
    "00.within",
    reference=within,
    cases=_pairs,
    mistakes=(
        Mistake(
            "hidden points counted",
            lambda p, q, v, f, k: within(p, q, np.ones_like(v), f, k),
            "only points that are truly visible count, above and below the fraction bar.",
        ),
        Mistake(
            "divided by all points",
            lambda p, q, v, f, k: within(p, q, v, f, k) * v.mean(),
            "divide by the number of visible points, not by the number of all.",
        ),
        Mistake(
            "depth left out",
            lambda p, q, v, f, k: _share(p, q, v, k / f),
            "k pixels are a length that grows with depth: k p_z / f, not k / f.",
        ),
        Mistake(
            "pixels for metres",
            lambda p, q, v, f, k: _share(p, q, v, float(k)),
            "the error is in metres and k in pixels; turn k into metres first: k p_z / f.",
        ),
        Mistake(
            "axis by axis",
            lambda p, q, v, f, k: (np.abs(q - p) < k * p[..., 2:] / f).all(-1)[v].mean(),
            "the ball is round: compare the length of q - p, not its components.",
        ),
    ),
)

EXERCISES = (LIFT, CENTER, VISIBLE, WITHIN)
