"""Exercises of notebook 02 on spaces: one world re-based to another, and the bend of paths through per-frame maps."""

from __future__ import annotations

import numpy as np

from lessons.checker import Exercise, Mistake
from lessons.n01 import random_extrinsics, random_intrinsics
from lessons.n02_crossing_exercise import CROSSING
from lessons.n02_pose_exercises import DRIFT, POSE_ERROR
from lessons.n02_straightness import from_space, line_through, to_space
from tapip3d_lite.geometry import invert, transform, unproject

Array = np.ndarray


def _cameras(rng: np.random.Generator, frames: int) -> tuple[Array, Array]:
    """Cameras that differ from frame to frame, inside and outside."""
    intrinsics = np.stack([random_intrinsics(rng) for _ in range(frames)])
    return intrinsics, np.stack([random_extrinsics(rng) for _ in range(frames)])


def _filmed(rng: np.random.Generator, size: int) -> tuple[Array, Array, Array]:
    """World paths (T, N, 3) in front of all cameras."""
    frames = 2 * size + 2
    intrinsics, extrinsics = _cameras(rng, frames)
    camera = np.concatenate([rng.uniform(-1, 1, (frames, size, 2)), rng.uniform(2, 6, (frames, size, 1))], -1)
    return transform(camera, invert(extrinsics)), intrinsics, extrinsics


def _worlds(rng: np.random.Generator, size: int) -> tuple[Array, Array, Array]:
    frames = size + 2
    _, extrinsics = _cameras(rng, frames)
    return rng.normal(size=(frames, size, 3)), extrinsics, _cameras(rng, frames)[1]


def rebase(points: Array, extrinsics: Array, anchors: Array) -> tuple[Array, Array]:
    """Points (T, N, 3) and cameras (T, 4, 4) of a world, both in the frame that anchors (T, 4, 4) map the world to."""
    return transform(points, anchors), extrinsics @ invert(anchors)


def _transposed(pose: Array) -> Array:
    turned = pose.copy()
    turned[:, :3, :3] = turned[:, :3, :3].swapaxes(1, 2)
    return turned


def _half_inverted(pose: Array) -> Array:
    turned = _transposed(pose)
    turned[:, :3, 3] *= -1
    return turned


def _first(cameras: Array) -> Array:
    return np.repeat(cameras[:1], len(cameras), 0)


REBASE = Exercise(
    "02.rebase",
    reference=rebase,
    cases=_worlds,
    mistakes=(
        Mistake(
            "cameras left behind",
            lambda x, e, a: (transform(x, a), e),
            "the points have moved to the new frame, the cameras have not: they must see the same as before.",
        ),
        Mistake(
            "points left behind",
            lambda x, e, a: (x, e @ invert(a)),
            "the cameras belong to the new frame, the points still to the old one.",
        ),
        Mistake(
            "anchor not inverted",
            lambda x, e, a: (transform(x, a), e @ a),
            "the new cameras get points of the new frame, so they first lead back to the old one: invert the anchor.",
        ),
        Mistake(
            "anchor on the wrong side",
            lambda x, e, a: (transform(x, a), invert(a) @ e),
            "the step that happens first stands on the right: back to the old world first, then into the camera.",
        ),
        Mistake(
            "points by the inverse",
            lambda x, e, a: (transform(x, invert(a)), e @ invert(a)),
            "anchors map from the old world to the new frame already; the points need them as they are.",
        ),
        Mistake(
            "all the other way round",
            lambda x, e, a: (transform(x, invert(a)), e @ a),
            "points and cameras fit together, but you took the anchors for maps from the new frame to the old.",
        ),
        Mistake(
            "first frame's anchor",
            lambda x, e, a: (transform(x, _first(a)), e @ invert(_first(a))),
            "each frame has its own anchor: use anchors[t].",
        ),
        Mistake(
            "R^T x - b for the inverse",
            lambda x, e, a: (transform(x, a), e @ _half_inverted(a)),
            "the inverse of x' = R x + b is R^T (x' - b) = R^T x' - R^T b: the translation is turned back, too.",
        ),
        Mistake(
            "transposed pose for the inverse",
            lambda x, e, a: (transform(x, a), e @ a.swapaxes(1, 2)),
            "only a rotation's transpose is its inverse, not that of a whole 4x4 pose.",
        ),
        Mistake(
            "transposed matrix",
            lambda x, e, a: (transform(x, _transposed(a)), e @ invert(a)),
            "points are rows: R acts on them as x @ R.T (plus b), not as x @ R.",
        ),
        Mistake(
            "translation forgotten",
            lambda x, e, a: (x @ a[:, :3, :3].swapaxes(1, 2), e @ invert(a)),
            "you only turned the points; the anchor's translation is missing.",
        ),
        Mistake(
            "no camera motion left",
            lambda x, e, a: (transform(x, a), np.tile(np.eye(4), (len(e), 1, 1))),
            "only for anchors = extrinsics are the new cameras identities; here anchors can be anything.",
        ),
    ),
)


def bend_in_uvd(xyz: Array, intrinsics: Array, extrinsics: Array) -> Array:
    """RMS distances (N,) between world paths (S, N, 3) and their constant-velocity fits in (u, v, z)."""
    return _bent(xyz, intrinsics, extrinsics)


def _bent(xyz: Array, k: Array, e: Array, space: str = "uvd", line: object = line_through) -> Array:
    return _rms(from_space(line(to_space(xyz, k, e, space)), k, e, space) - xyz)


def _rms(rest: Array) -> Array:
    return np.sqrt((rest**2).sum(-1).mean(0))


def _chord(path: Array) -> Array:
    share = np.linspace(0, 1, len(path))[:, None, None]
    return path[0] + share * (path[-1] - path[0])


def _through_origin(path: Array) -> Array:
    t = np.arange(len(path))[:, None, None]
    return t * (t * path).sum(0) / (t**2).sum()


def _back_wrong(xyz: Array, k: Array, e: Array, k_back: Array, e_back: Array) -> Array:
    return _rms(from_space(line_through(to_space(xyz, k, e, "uvd")), k_back, e_back, "uvd") - xyz)


def _half_back(xyz: Array, k: Array, e: Array) -> Array:
    line = line_through(to_space(xyz, k, e, "uvd"))
    camera = unproject(line[..., :2], line[..., 2], k)
    return _rms(camera @ e[:, :3, :3] - e[:, None, :3, 3] - xyz)


def _rays_for_depth(xyz: Array, k: Array, e: Array) -> Array:
    uvd = to_space(xyz, k, e, "uvd")
    uvd[..., 2] = np.linalg.norm(transform(xyz, e), axis=-1)
    return _rms(from_space(line_through(uvd), k, e, "uvd") - xyz)


def _true_depth_back(xyz: Array, k: Array, e: Array) -> Array:
    uvd = to_space(xyz, k, e, "uvd")
    return _rms(unproject(line_through(uvd)[..., :2], uvd[..., 2], k, e) - xyz)


BEND = Exercise(
    "02.bend_in_uvd",
    reference=bend_in_uvd,
    cases=_filmed,
    mistakes=(
        Mistake(
            "compared in uvd",
            lambda x, k, e: _rms(line_through(to_space(x, k, e, "uvd")) - to_space(x, k, e, "uvd")),
            "this adds pixels to metres; carry the fit back to 3D and compare it with the path there.",
        ),
        Mistake(
            "compared in the camera",
            lambda x, k, e: _rms(unproject(*_uv_z(line_through(to_space(x, k, e, "uvd"))), k) - x),
            "your fit ends in camera coordinates, the path is in the world: apply the inverse of extrinsics[t], too.",
        ),
        Mistake(
            "fitted in the world",
            lambda x, k, e: _bent(x, k, e, "world"),
            "this line is fitted in the world; fit it to (u, v, z).",
        ),
        Mistake(
            "fitted in the camera",
            lambda x, k, e: _bent(x, k, e, "camera"),
            "this line is fitted to camera coordinates in metres; fit it to (u, v, z).",
        ),
        Mistake(
            "first pose both ways",
            lambda x, k, e: _bent(x, k, _first(e)),
            "one pose for all frames: the camera stands still in your uvd. Every frame has its own extrinsics[t].",
        ),
        Mistake(
            "first pose on the way back",
            lambda x, k, e: _back_wrong(x, k, e, k, _first(e)),
            "the way out used the pose of each frame, the way back only that of frame 0; go back through extrinsics[t].",
        ),
        Mistake(
            "first intrinsics both ways",
            lambda x, k, e: _bent(x, _first(k), e),
            "the lens may zoom: every frame has its own intrinsics[t], you used those of frame 0.",
        ),
        Mistake(
            "first intrinsics on the way back",
            lambda x, k, e: _back_wrong(x, k, e, _first(k), e),
            "the way out used the intrinsics of each frame, the way back only those of frame 0; use intrinsics[t].",
        ),
        Mistake(
            "first camera both ways",
            lambda x, k, e: _bent(x, _first(k), _first(e)),
            "one camera for all frames: neither its motion nor its zoom is in your uvd. Use intrinsics[t], extrinsics[t].",
        ),
        Mistake(
            "R^T x - b on the way back",
            _half_back,
            "the inverse of x' = R x + b is R^T (x' - b): subtract b first, then turn back.",
        ),
        Mistake(
            "extrinsics inverted",
            lambda x, k, e: _bent(x, k, invert(e)),
            "extrinsics already map world to camera; invert them only on the way back.",
        ),
        Mistake(
            "ray length for depth",
            _rays_for_depth,
            "the third number is the depth along the viewing axis, not the length of the ray.",
        ),
        Mistake(
            "true depth on the way back",
            _true_depth_back,
            "your pixels come from the fit, your depth from the path; the third coordinate is fitted, too.",
        ),
        Mistake(
            "line through the ends",
            lambda x, k, e: _bent(x, k, e, line=_chord),
            "the line through the first and the last point is not the best one; least squares uses them all.",
        ),
        Mistake(
            "rest instead of motion",
            lambda x, k, e: _bent(x, k, e, line=lambda p: p.mean(0) + 0 * p),
            "this is the distance to a resting pixel; fit a velocity as well.",
        ),
        Mistake(
            "no offset",
            lambda x, k, e: _bent(x, k, e, line=_through_origin),
            "your line starts at (0, 0, 0); fit an offset beside the velocity.",
        ),
        Mistake(
            "mean over coordinates",
            lambda x, k, e: _bent(x, k, e) / np.sqrt(3),
            "sum the squares over x, y, z first, then take the mean over frames.",
        ),
        Mistake("no root", lambda x, k, e: _bent(x, k, e) ** 2, "this is the mean square, in m²; take the root."),
        Mistake(
            "one number for all",
            lambda x, k, e: np.sqrt((_bent(x, k, e) ** 2).mean()),
            "average over frames only: each of the N points has its own bend.",
        ),
    ),
)


def _uv_z(uvd: Array) -> tuple[Array, Array]:
    return uvd[..., :2], uvd[..., 2]


EXERCISES = (REBASE, BEND, POSE_ERROR, CROSSING, DRIFT)
