"""Lesson 01, its exercises: from RGB-D to point maps and feature clouds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lessons.checker import Exercise, Mistake, check
from lessons.guesses import reveal
from lessons.milestone import milestone
from lessons.pictures import pipeline, show
from lessons.progress import collect, in_use, progress, reset
from lessons.widgets import explore
from tapip3d_lite.geometry import invert, resize_intrinsics, transform, unproject

__all__ = [
    "EXERCISES",
    "check",
    "collect",
    "explore",
    "in_use",
    "milestone",
    "pipeline",
    "progress",
    "random_extrinsics",
    "random_intrinsics",
    "reset",
    "reveal",
    "show",
]

Array = np.ndarray


def random_intrinsics(rng: np.random.Generator) -> Array:
    """Intrinsics (3, 3) with different fx, fy, cx, cy, so that no mix-up goes unseen."""
    fx, fy = rng.uniform(20, 40), rng.uniform(50, 80)
    return np.array([[fx, 0, rng.uniform(8, 12)], [0, fy, rng.uniform(3, 6)], [0, 0, 1]])


def random_extrinsics(rng: np.random.Generator) -> Array:
    """A rigid world-to-camera motion (4, 4)."""
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = q * np.sign(np.linalg.det(q)), rng.uniform(0.5, 2, 3)
    return pose


def _pixels(rng: np.random.Generator, size: int) -> tuple:
    return rng.uniform(0, 20, (size, 2)), rng.uniform(1, 4, size), random_intrinsics(rng)


def _transposed(uv: Array, z: Array, k: Array) -> Array:
    return z[:, None] * (np.concatenate([uv, np.ones((len(uv), 1))], -1) @ np.linalg.inv(k))


UNPROJECT = Exercise(
    "01.unproject",
    reference=unproject,
    cases=_pixels,
    mistakes=(
        Mistake(
            "pixel-centre slip",
            lambda uv, z, k: unproject(uv + 0.5, z, k),
            "you are half a pixel off: here pixel centres are whole numbers, so nothing is added to u and v.",
        ),
        Mistake(
            "transposed matrix",
            _transposed,
            "K^-1 acts on column vectors; for rows of pixels multiply by its transpose from the right.",
        ),
        Mistake(
            "missing depth",
            lambda uv, z, k: unproject(uv, np.ones_like(z), k),
            "the ray K^-1 (u, v, 1) has z = 1; multiply it by the depth.",
        ),
        Mistake(
            "u and v swapped",
            lambda uv, z, k: unproject(uv[:, ::-1], z, k),
            "u counts columns and goes with fx, cx; v counts rows and goes with fy, cy.",
        ),
        Mistake(
            "ray length for depth",
            lambda uv, z, k: _along_ray(uv, z, k),
            "z is the depth along the optical axis, not the length of the ray: do not normalise the ray.",
        ),
    ),
)


def _along_ray(uv: Array, z: Array, k: Array) -> Array:
    ray = unproject(uv, np.ones_like(z), k)
    return z[:, None] * ray / np.linalg.norm(ray, axis=-1, keepdims=True)


def _camera_points(rng: np.random.Generator, size: int) -> tuple:
    return rng.normal(size=(size, 3)), random_extrinsics(rng)


TO_WORLD = Exercise(
    "01.to_world",
    reference=lambda points, extrinsics: transform(points, invert(extrinsics)),
    cases=_camera_points,
    mistakes=(
        Mistake(
            "wrong direction",
            lambda x, e: transform(x, e),
            "extrinsics map world to camera; you need the way back, E^-1.",
        ),
        Mistake(
            "translation kept",
            lambda x, e: x @ e[:3, :3] + e[:3, 3],
            "the inverse of x' = R x + t is R^T (x' - t): the translation goes first, and with a minus.",
        ),
        Mistake(
            "translation forgotten",
            lambda x, e: x @ e[:3, :3],
            "you undid the rotation only; subtract t before.",
        ),
        Mistake(
            "transposed rotation",
            lambda x, e: (x - e[:3, 3]) @ e[:3, :3].T,
            "points are rows here: multiplying rows by R from the right already applies R^T.",
        ),
    ),
)


def _sizes(rng: np.random.Generator, size: int) -> tuple:
    old = tuple(int(x) for x in rng.integers(40, 90, 2))
    return random_intrinsics(rng), old, (old[0] // 2 + size, old[1] * 2)


def _scaled(k: Array, rows: float, columns: float) -> Array:
    return k * np.array([[columns], [rows], [1.0]])


def _focal_only(k: Array, old: tuple, new: tuple) -> Array:
    return np.where(np.eye(3) > 0, resize_intrinsics(k, old, new), k)


RESIZE = Exercise(
    "01.resize_intrinsics",
    reference=resize_intrinsics,
    cases=_sizes,
    tolerance=1e-6,
    mistakes=(
        Mistake(
            "W'/W",
            lambda k, old, new: _scaled(k, new[0] / old[0], new[1] / old[1]),
            "with whole numbers at pixel centres, corner centres map to corner centres: use (W'-1)/(W-1).",
        ),
        Mistake(
            "height and width swapped",
            lambda k, old, new: resize_intrinsics(k, old[::-1], new[::-1]),
            "sizes are (H, W): row 0 of K (fx, cx) scales with the width, row 1 with the height.",
        ),
        Mistake("principal point forgotten", _focal_only, "cx and cy scale too: multiply whole rows of K."),
        Mistake(
            "ratio upside down",
            lambda k, old, new: resize_intrinsics(k, new, old),
            "the ratio is upside down: a larger image has a larger focal length in pixels.",
        ),
    ),
)


def _lengths(rng: np.random.Generator, size: int) -> tuple:
    return int(rng.integers(5, 9) * size), int(rng.integers(2, 4) * size)


def nearest_cells(length: int, cells: int) -> Array:
    """Source index of each of `cells` cells of a level, among `length` pixels: floor((i + 0.5) length / cells)."""
    return np.minimum(np.floor((np.arange(cells) + 0.5) * length / cells), length - 1).astype(int)


NEAREST = Exercise(
    "01.nearest_cells",
    reference=nearest_cells,
    cases=_lengths,
    mistakes=(
        Mistake(
            "left edge",
            lambda n, m: np.floor(np.arange(m) * n / m).astype(int),
            "you take the pixel at the cell's left edge; take the one at its middle, i + 0.5.",
        ),
        Mistake(
            "corners aligned",
            lambda n, m: np.rint(np.linspace(0, n - 1, m)).astype(int),
            "you aligned the corner cells with the corner pixels; every cell covers n / m pixels instead.",
        ),
        Mistake(
            "ratio upside down",
            lambda n, m: np.floor((np.arange(m) + 0.5) * m / n).astype(int),
            "one cell covers length / cells pixels; you used the inverse.",
        ),
    ),
)


def _point_maps(rng: np.random.Generator, size: int) -> tuple:
    height, width = size, size + 1
    sides = rng.integers(2, 5, 2)
    return rng.normal(size=(height * sides[0], width * sides[1], 3)), (height, width)


def point_level(points: Array, cells: tuple[int, int], index: Callable[[int, int], Array] = nearest_cells) -> Array:
    """One level (h, w, 3) of the point pyramid: of a point map (H, W, 3), the pixel nearest to each cell's middle."""
    return points[index(len(points), cells[0])][:, index(points.shape[1], cells[1])]


def _averaged(points: Array, cells: tuple[int, int]) -> Array:
    return points.reshape(cells[0], len(points) // cells[0], cells[1], -1, 3).mean((1, 3))


LEVEL = Exercise(
    "01.point_level",
    reference=point_level,
    cases=_point_maps,
    mistakes=(
        Mistake(
            "averaged",
            _averaged,
            "you averaged: the mean of a front and a back point lies on neither. Pick one pixel for each cell.",
        ),
        Mistake(
            "corner pixel",
            lambda p, cells: point_level(p, cells, lambda n, m: np.arange(m) * n // m),
            "you pick each cell's first pixel; its middle lies half a cell further on.",
        ),
        Mistake(
            "rows paired with columns",
            lambda p, cells: p[nearest_cells(len(p), cells[0]), nearest_cells(p.shape[1], cells[1])],
            "points[rows, columns] pairs the two lists; points[rows][:, columns] takes every column of every row.",
        ),
        Mistake(
            "corners aligned",
            lambda p, cells: point_level(p, cells, lambda n, m: np.rint(np.linspace(0, n - 1, m)).astype(int)),
            "you aligned the corner cells with the corner pixels; every cell covers H / h by W / w pixels instead.",
        ),
    ),
)

EXERCISES = (UNPROJECT, TO_WORLD, RESIZE, NEAREST, LEVEL)
