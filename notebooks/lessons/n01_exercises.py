"""The exercises of lesson 01 on cameras: there, back, and resized."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from lessons.checker import Exercise, Mistake
from tapip3d_lite.geometry import invert, resize_intrinsics, transform, unproject

Array = np.ndarray


def random_intrinsics(rng: np.random.Generator, skew: float = 0.0) -> Array:
    """Intrinsics (3, 3) with different fx, fy, cx, cy, so that no mix-up goes unseen."""
    fx, fy = rng.uniform(20, 40), rng.uniform(50, 80)
    return np.array([[fx, skew, rng.uniform(8, 12)], [0, fy, rng.uniform(3, 6)], [0, 0, 1]])


def random_extrinsics(rng: np.random.Generator) -> Array:
    """A rigid world-to-camera motion (4, 4)."""
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = q * np.sign(np.linalg.det(q)), rng.uniform(0.5, 2, 3)
    return pose


# --- lift pixels ----------------------------------------------------------------------------------------------------


def _pixels(rng: np.random.Generator, size: int) -> tuple:
    """Pixels inside and outside the image, seen by as many cameras as there are frames."""
    uv, z = rng.uniform(-5, 25, (size + 4, 2)), rng.uniform(1, 4, (size, size + 4))
    return uv, z, np.stack([random_intrinsics(rng, skew=rng.uniform(2, 5)) for _ in range(size)])


def _rays(uv: Array, k: Array) -> Array:
    return unproject(uv, np.ones((len(k), len(uv))), k)


def _homogeneous(uv: Array) -> Array:
    return np.concatenate([uv, np.ones((len(uv), 1))], -1)


def _along_ray(uv: Array, z: Array, k: Array) -> Array:
    rays = _rays(uv, k)
    return z[..., None] * rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def _without_skew(uv: Array, z: Array, k: Array) -> Array:
    straight = k.copy()
    straight[:, 0, 1] = 0
    return unproject(uv, z, straight)


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
            "half a pixel taken off",
            lambda uv, z, k: unproject(uv - 0.5, z, k),
            "you took half a pixel off: here pixel centres are whole numbers already, so u and v go in as they are.",
        ),
        Mistake(
            "divided by depth",
            lambda uv, z, k: _rays(uv, k) / z[..., None],
            "projecting divides by the depth; lifting is the way back and multiplies by it.",
        ),
        Mistake(
            "transposed matrix",
            lambda uv, z, k: z[..., None] * (_homogeneous(uv) @ np.linalg.inv(k)),
            "K^-1 acts on column vectors; for rows of pixels multiply by its transpose from the right.",
        ),
        Mistake(
            "K for its inverse",
            lambda uv, z, k: z[..., None] * (_homogeneous(uv) @ k.swapaxes(1, 2)),
            "K turns points into pixels; you need the way back, K^-1.",
        ),
        Mistake(
            "missing depth",
            lambda uv, z, k: _rays(uv, k),
            "the ray K^-1 (u, v, 1) has z = 1; multiply it by the depth.",
        ),
        Mistake(
            "depth replaces the last number",
            lambda uv, z, k: np.concatenate([_rays(uv, k)[..., :2], z[..., None]], -1),
            "the depth scales the whole ray, X and Y as well, not only its last number.",
        ),
        Mistake(
            "u and v swapped",
            lambda uv, z, k: unproject(uv[:, ::-1], z, k),
            "u counts columns and goes with fx, cx; v counts rows and goes with fy, cy.",
        ),
        Mistake(
            "ray length for depth",
            _along_ray,
            "z is the depth along the optical axis, not the length of the ray: do not normalise the ray.",
        ),
        Mistake(
            "skew ignored",
            _without_skew,
            "(u - cx) / fx is right only where K has no skew, K[0, 1]; the whole K^-1 is right for every K.",
        ),
        Mistake(
            "first camera for all",
            lambda uv, z, k: unproject(uv, z, k[:1]),
            "every frame has its own K; you lifted all of them with the first frame's.",
        ),
    ),
)


# --- from camera to world -------------------------------------------------------------------------------------------


def _camera_points(rng: np.random.Generator, size: int) -> tuple:
    poses = np.stack([random_extrinsics(rng) for _ in range(size)])
    return rng.normal(size=(size, size + 4, 3)), poses


def _to_world(
    sign: float = -1.0, first: bool = True, turned: bool = False, same: bool = False
) -> Callable[[Array, Array], Array]:
    """R^T (x - b), or what one gets by a slip: +b, b after the rotation, R for R^T, one camera for all frames."""

    def answer(x: Array, e: Array) -> Array:
        e = e[:1] if same else e
        rotation, b = e[:, :3, :3], sign * e[:, None, :3, 3]
        rotation = rotation.swapaxes(1, 2) if turned else rotation
        return (x + b) @ rotation if first else x @ rotation + b

    return answer


TO_WORLD = Exercise(
    "01.to_world",
    reference=lambda points, extrinsics: transform(points, invert(extrinsics)),
    cases=_camera_points,
    mistakes=(
        Mistake("wrong direction", transform, "extrinsics map world to camera; you need the way back, E^-1."),
        Mistake(
            "translation last",
            _to_world(first=False),
            "you took b off after turning, R^T x - b; b was added last, so it goes first: R^T (x - b).",
        ),
        Mistake(
            "translation kept",
            _to_world(sign=1, first=False),
            "the inverse of x' = R x + b is R^T (x' - b): the translation goes first, and with a minus.",
        ),
        Mistake("translation added", _to_world(sign=1), "the order is right, the sign is not: undo +b by -b."),
        Mistake("translation forgotten", _to_world(sign=0), "you undid the rotation only; subtract b before."),
        Mistake(
            "rotation forgotten",
            lambda x, e: x - e[:, None, :3, 3],
            "you undid the translation only; the axes still are the camera's. Turn by R^T.",
        ),
        Mistake(
            "transposed rotation",
            _to_world(turned=True),
            "points are rows here: multiplying rows by R from the right already applies R^T.",
        ),
        Mistake(
            "transposed rotation, translation last",
            _to_world(turned=True, first=False),
            "two slips: points are rows, so `points @ R` applies R^T; and b goes off before the rotation.",
        ),
        Mistake(
            "first camera for all", _to_world(same=True), "every frame has its own pose; you used the first for all."
        ),
    ),
)


# --- resize a camera ------------------------------------------------------------------------------------------------


def _sizes(rng: np.random.Generator, size: int) -> tuple:
    old = tuple(int(x) for x in rng.integers(40, 90, 2))
    new = (old[0] // 2 + size, 2 * old[1] + size)
    return random_intrinsics(rng, skew=rng.uniform(2, 5)), old, new if size % 2 else new[::-1]


def _rows(k: Array, scale: tuple[float, float], shift: float = 0.0) -> Array:
    """Rows that follow u' = (u + shift) s - shift, for scales (of rows, of columns)."""
    scaled = k.copy()
    for row, s in ((0, scale[1]), (1, scale[0])):
        scaled[row] *= s
        scaled[row, 2] += shift * (s - 1)
    return scaled


def _ratio(old: tuple, new: tuple) -> tuple[float, float]:
    return new[0] / old[0], new[1] / old[1]


def _only(kept: Array) -> Callable[..., Array]:
    """The right answer where `kept` (3, 3), the old number elsewhere."""
    return lambda k, old, new: np.where(kept, resize_intrinsics(k, old, new), k)


RESIZE = Exercise(
    "01.resize_intrinsics",
    reference=resize_intrinsics,
    cases=_sizes,
    tolerance=1e-6,
    mistakes=(
        Mistake(
            "rows times W'/W",
            lambda k, old, new: _rows(k, _ratio(old, new)),
            "the scale is right, the principal point is not: u' = s u would keep u = 0, which is the first pixel's "
            "centre. The edge at -1/2 is what stays.",
        ),
        Mistake(
            "corner centres kept",
            partial(resize_intrinsics, corners=True),
            "(W'-1)/(W-1) keeps the corner pixels' centres. That is what the released code does to its camera, but not "
            "what resizing did to the image: there the outer edges stay, at -1/2.",
        ),
        Mistake(
            "half a pixel the wrong way",
            lambda k, old, new: _rows(k, _ratio(old, new), -0.5),
            "the half pixel has the wrong sign: the image begins at u = -1/2, so count from there, u + 1/2.",
        ),
        Mistake(
            "half a pixel not taken back",
            lambda k, old, new: _rows(k, _ratio(old, new)) + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]),
            "after scaling, 1/2 of a *new* pixel has to be taken off again: (c + 1/2) s - 1/2.",
        ),
        Mistake(
            "height and width swapped",
            lambda k, old, new: resize_intrinsics(k, old[::-1], new[::-1]),
            "sizes are (H, W): row 0 of K (fx, cx) scales with the width, row 1 with the height.",
        ),
        Mistake(
            "principal point forgotten",
            _only(np.array([[1, 1, 0], [0, 1, 0], [0, 0, 1]]) > 0),
            "cx and cy move, too, not the focal lengths alone.",
        ),
        Mistake(
            "skew forgotten",
            _only(np.array([[1, 0, 1], [0, 1, 1], [0, 0, 1]]) > 0),
            "K[0, 1], the skew, belongs to u and scales with the width, too; treat whole rows alike.",
        ),
        Mistake(
            "ratio upside down",
            lambda k, old, new: resize_intrinsics(k, new, old),
            "the ratio is upside down: a larger image has a larger focal length in pixels.",
        ),
        Mistake(
            "one ratio for both",
            lambda k, old, new: _rows(k, (new[1] / old[1],) * 2, 0.5),
            "height and width have ratios of their own; you used the width's for both rows.",
        ),
    ),
)


CAMERA_EXERCISES = (UNPROJECT, TO_WORLD, RESIZE)
