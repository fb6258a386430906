"""Exercises of notebook 02: coordinate spaces, the bend of a path, cancelling the camera, gravity from a track."""

from __future__ import annotations

import numpy as np

from lessons.checker import Exercise, Mistake
from lessons.n01 import random_extrinsics, random_intrinsics
from lessons.n02_straightness import fit_windows, from_space, to_space
from tapip3d_lite.geometry import invert, transform, unproject

Array = np.ndarray


def _cameras(rng: np.random.Generator, frames: int) -> tuple[Array, Array]:
    intrinsics = np.stack([random_intrinsics(rng) for _ in range(frames)])
    return intrinsics, np.stack([random_extrinsics(rng) for _ in range(frames)])


def _filmed(rng: np.random.Generator, size: int) -> tuple:
    """World paths (T, N, 3) in front of all cameras."""
    frames = size + 1
    intrinsics, extrinsics = _cameras(rng, frames)
    camera = np.concatenate([rng.uniform(-1, 1, (frames, size, 2)), rng.uniform(2, 6, (frames, size, 1))], -1)
    return transform(camera, invert(extrinsics)), intrinsics, extrinsics


def to_uvd(xyz: Array, intrinsics: Array, extrinsics: Array) -> Array:
    """World paths (T, N, 3) as (u, v, z) in each frame's own image."""
    return to_space(xyz, intrinsics, extrinsics, "uvd")


def _without_division(xyz: Array, intrinsics: Array, extrinsics: Array) -> Array:
    camera = transform(xyz, extrinsics)
    uv = camera[..., :2] * intrinsics[:, None, [0, 1], [0, 1]] + intrinsics[:, None, :2, 2]
    return np.concatenate([uv, camera[..., 2:]], -1)


def _transposed(extrinsics: Array) -> Array:
    turned = extrinsics.copy()
    turned[:, :3, :3] = turned[:, :3, :3].swapaxes(1, 2)
    return turned


def _first(cameras: Array) -> Array:
    return np.repeat(cameras[:1], len(cameras), 0)


def _with_third(uvd: Array, third: Array) -> Array:
    return np.concatenate([uvd[..., :2], third[..., None]], -1)


TO_UVD = Exercise(
    "02.to_uvd",
    reference=to_uvd,
    cases=_filmed,
    mistakes=(
        Mistake(
            "extrinsics inverted",
            lambda x, k, e: to_uvd(x, k, invert(e)),
            "extrinsics already map world to camera; do not invert them here.",
        ),
        Mistake(
            "transposed matrix",
            lambda x, k, e: to_uvd(x, k, _transposed(e)),
            "points are rows: R acts on them as x @ R.T (plus t), not as x @ R.",
        ),
        Mistake("missing division by z", _without_division, "perspective divides: u = fx x / z + cx. You left out z."),
        Mistake(
            "world height for depth",
            lambda x, k, e: _with_third(to_uvd(x, k, e), x[..., 2]),
            "the third number is the depth: z in the camera's frame, not the world's z.",
        ),
        Mistake(
            "ray length for depth",
            lambda x, k, e: _with_third(to_uvd(x, k, e), np.linalg.norm(transform(x, e), axis=-1)),
            "depth is measured along the viewing axis, not along the ray.",
        ),
        Mistake(
            "first frame's camera",
            lambda x, k, e: to_uvd(x, _first(k), _first(e)),
            "every frame has its own camera: use intrinsics[t] and extrinsics[t].",
        ),
        Mistake(
            "pixel-centre slip",
            lambda x, k, e: to_uvd(x, k, e) + np.array([0.5, 0.5, 0]),
            "you are half a pixel off: pixel centres are whole numbers here.",
        ),
    ),
)


def _path(rng: np.random.Generator, size: int) -> tuple:
    return (rng.normal(size=(3 + 2 * size, 3)).cumsum(0),)


def bend(path: Array) -> Array:
    """RMS distance between a path (S, 3) and its best constant-velocity fit."""
    return _rms(path - fit_windows(path[:, None], len(path), 1)[0, :, 0])


def _rms(rest: Array) -> Array:
    return np.sqrt((rest**2).sum(-1).mean())


def _chord(path: Array) -> Array:
    share = np.linspace(0, 1, len(path))[:, None]
    return _rms(path - (path[0] + share * (path[-1] - path[0])))


def _through_origin(path: Array) -> Array:
    t = np.arange(len(path))[:, None]
    return _rms(path - t * (t * path).sum(0) / (t**2).sum())


BEND = Exercise(
    "02.bend",
    reference=bend,
    cases=_path,
    mistakes=(
        Mistake(
            "line through the ends",
            _chord,
            "the line through the first and the last point is not the best one; least squares uses them all.",
        ),
        Mistake(
            "rest instead of motion",
            lambda x: _rms(x - x.mean(0)),
            "this is the distance to a resting point; fit a constant velocity as well.",
        ),
        Mistake("no offset", _through_origin, "your line starts at the origin; fit an offset a beside the velocity b."),
        Mistake(
            "mean over coordinates",
            lambda x: bend(x) / np.sqrt(3),
            "sum the squares over x, y, z first, then take the mean over frames.",
        ),
        Mistake(
            "no square root",
            lambda x: bend(x) ** 2,
            "this is the mean square, in square metres; take the root.",
        ),
    ),
)


def _measured(rng: np.random.Generator, size: int) -> tuple:
    xyz, intrinsics, extrinsics = _filmed(rng, size)
    return to_uvd(xyz, intrinsics, extrinsics), intrinsics, extrinsics


def cancel(uvd: Array, intrinsics: Array, extrinsics: Array) -> Array:
    """Paths (T, N, 3) of (u, v, z) in world coordinates."""
    return from_space(uvd, intrinsics, extrinsics, "uvd")


def _camera(uvd: Array, intrinsics: Array) -> Array:
    return unproject(uvd[..., :2], uvd[..., 2], intrinsics)


CANCEL = Exercise(
    "02.cancel",
    reference=cancel,
    cases=_measured,
    mistakes=(
        Mistake(
            "wrong direction",
            lambda x, k, e: transform(_camera(x, k), e),
            "extrinsics map world to camera; to cancel the camera's motion apply their inverse.",
        ),
        Mistake(
            "still in the camera",
            lambda x, k, e: _camera(x, k),
            "these are camera coordinates: the camera's motion is still in them. Apply the inverse of extrinsics[t].",
        ),
        Mistake(
            "translation kept",
            lambda x, k, e: _camera(x, k) @ e[:, :3, :3] + e[:, None, :3, 3],
            "the inverse of x' = R x + t is R^T (x' - t): subtract t first, then turn back.",
        ),
        Mistake(
            "transposed matrix",
            lambda x, k, e: (_camera(x, k) - e[:, None, :3, 3]) @ e[:, :3, :3].swapaxes(1, 2),
            "points are rows: x @ R already applies R^T to each of them.",
        ),
        Mistake(
            "missing depth",
            lambda x, k, e: cancel(_with_third(x, np.ones_like(x[..., 2])), k, e),
            "multiply the ray by the depth: x = (u - cx) z / fx.",
        ),
        Mistake(
            "off by one in time",
            lambda x, k, e: cancel(x, k, np.concatenate([e[:1], e[:-1]])),
            "you undo the camera of the frame before; frame t needs extrinsics[t].",
        ),
        Mistake(
            "first frame's camera",
            lambda x, k, e: cancel(x, _first(k), _first(e)),
            "with one camera for all frames its motion is not cancelled; use the camera of each frame.",
        ),
        Mistake(
            "pixel-centre slip",
            lambda x, k, e: cancel(x + np.array([0.5, 0.5, 0]), k, e),
            "you are half a pixel off: pixel centres are whole numbers here.",
        ),
    ),
)


def _thrown(rng: np.random.Generator, size: int) -> tuple:
    fps, frames = float(rng.choice([12, 24, 30])), 4 + size
    seconds = np.arange(frames) / fps
    # Any planet will do, so that 9.81 cannot be typed in; always a throw with speed of its own.
    fall = rng.uniform(1, 20)
    return rng.uniform(0, 2) + rng.uniform(2, 6) * seconds - fall / 2 * seconds**2, fps


def gravity(height: Array, fps: float) -> Array:
    """Downward acceleration (m/s^2) from the heights (T,) of a body in free flight."""
    return -np.diff(height, n=2).mean() * fps**2


GRAVITY = Exercise(
    "02.gravity",
    reference=gravity,
    cases=_thrown,
    mistakes=(
        Mistake(
            "sign", lambda h, fps: -gravity(h, fps), "height is measured upwards and the body falls: mind the sign."
        ),
        Mistake(
            "fps once",
            lambda h, fps: gravity(h, fps) / fps,
            "a second difference is per frame squared: multiply by fps twice.",
        ),
        Mistake("frames for seconds", lambda h, fps: gravity(h, 1.0), "this is per frame; convert it to seconds."),
        Mistake(
            "velocity",
            lambda h, fps: -np.diff(h).mean() * fps,
            "this is a velocity; the acceleration is the difference of differences.",
        ),
        Mistake(
            "half of it",
            lambda h, fps: gravity(h, fps) / 2,
            "the second difference of -g t^2 / 2 is -g per frame squared, without the half.",
        ),
    ),
)

EXERCISES = (TO_UVD, BEND, CANCEL, GRAVITY)
