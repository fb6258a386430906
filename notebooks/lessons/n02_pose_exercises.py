"""Exercises of notebook 02 on poses: how wrong they are, and how errors accumulate."""

from __future__ import annotations

import numpy as np

from lessons.checker import Exercise, Mistake
from lessons.n01 import random_extrinsics
from lessons.n02_straightness import rotations
from tapip3d_lite.geometry import invert

Array = np.ndarray


def _walks(rng: np.random.Generator, size: int) -> tuple[Array, Array, int]:
    """Estimated and true poses of one walk, each in a world of its own; some steps are estimated without error."""
    step = int(rng.integers(1, 3)) if size > 1 else 1
    frames = 2 * size + 2
    true = np.stack([random_extrinsics(rng) for _ in range(frames)])
    wrong = rotations(rng.normal(size=(frames, 3)) * rng.choice([0, 0.3, 0.6], (frames, 1)))
    wrong[:, :3, 3] = rng.normal(size=(frames, 3)) * 0.2
    wrong[: step + 1] = wrong[0]  # the first step is right, though each of its poses is wrong
    world = random_extrinsics(rng)
    return np.linalg.inv(wrong) @ true @ world, true, step


def _relative(poses: Array, step: int) -> Array:
    return poses[step:] @ invert(poses[:-step])


def _size(pose: Array) -> tuple[Array, Array]:
    """Angles in degrees and lengths in metres of motions (..., 4, 4)."""
    chord = np.linalg.norm(pose[..., :3, :3] - np.eye(3), axis=(-2, -1))
    return np.rad2deg(2 * np.arcsin(chord / np.sqrt(8))), np.linalg.norm(pose[..., :3, 3], axis=-1)


def pose_error(estimated: Array, true: Array, step: int) -> tuple[Array, Array]:
    """How far the motion over `step` frames is off: degrees (T - step,) and metres (T - step,)."""
    return _size(_relative(estimated, step) @ invert(_relative(true, step)))


def _by_trace(pose: Array) -> Array:
    with np.errstate(invalid="ignore"):
        return np.rad2deg(np.arccos((np.trace(pose[..., :3, :3], axis1=-2, axis2=-1) - 1) / 2))


def _no_clip(estimated: Array, true: Array, step: int) -> tuple[Array, Array]:
    error = _relative(estimated, step) @ invert(_relative(true, step))
    return _by_trace(error), _size(error)[1]


def _no_difference(estimated: Array, true: Array, step: int) -> tuple[Array, Array]:
    mine, other = _size(_relative(estimated, step)), _size(_relative(true, step))
    return np.abs(mine[0] - other[0]), np.abs(mine[1] - other[1])


POSE_ERROR = Exercise(
    "02.pose_error",
    reference=pose_error,
    cases=_walks,
    mistakes=(
        Mistake(
            "absolute",
            lambda p, q, s: _size((invert(q) @ p)[s:]),
            "this compares poses, and two worlds may differ by a rigid motion; compare the motions over `step` frames.",
        ),
        Mistake(
            "step of one",
            lambda p, q, s: pose_error(p, q, 1),
            "the motion runs over `step` frames, not from each frame to the next.",
        ),
        Mistake(
            "radians",
            lambda p, q, s: (np.deg2rad(pose_error(p, q, s)[0]), pose_error(p, q, s)[1]),
            "the angle is in radians; give degrees.",
        ),
        Mistake(
            "half the angle",
            lambda p, q, s: (pose_error(p, q, s)[0] / 2, pose_error(p, q, s)[1]),
            "the arc sine gives half the angle; double it.",
        ),
        Mistake(
            "difference of sizes",
            _no_difference,
            "two motions of the same size may still differ in direction; take the size of their difference, a motion.",
        ),
        Mistake(
            "true motion not inverted",
            lambda p, q, s: _size(_relative(p, s) @ _relative(q, s)),
            "this adds the two motions; invert the true one.",
        ),
        Mistake(
            "inverse on the wrong side",
            lambda p, q, s: _size(invert(_relative(q, s)) @ _relative(p, s)),
            "the angle is the same, the distance is not: undo the true motion first, so its inverse stands on the right.",
        ),
        Mistake(
            "inverse after the step",
            lambda p, q, s: _size(invert(p[:-s]) @ p[s:] @ invert(invert(q[:-s]) @ q[s:])),
            "E[t]^-1 E[t + step] is a motion of the world; cameras follow each other as E[t + step] E[t]^-1.",
        ),
        Mistake(
            "arc cosine without a limit",
            _no_clip,
            "a trace just above 3, by rounding, has no arc cosine: clip it, or use the arc sine, exact for small angles.",
        ),
        Mistake(
            "only the estimate",
            lambda p, q, s: _size(_relative(p, s)),
            "this is the estimated motion itself; undo the true one.",
        ),
    ),
)


def _turned(rng: np.random.Generator, size: int) -> tuple[Array, Array]:
    frames = size + 2
    return (
        np.stack([random_extrinsics(rng)[:3, :3] for _ in range(frames)]),
        np.stack([random_extrinsics(rng) for _ in range(frames)]),
    )


def drift(steps: Array, extrinsics: Array) -> Array:
    """Poses (T, 4, 4) whose errors accumulate: each frame adds the rotation steps[t] (T, 3, 3) to the error before."""
    return np.einsum("tij,tjk->tik", _padded(_accumulated(steps)), extrinsics)


def _accumulated(steps: Array, left: bool = True) -> Array:
    errors = [steps[0]]
    for step in steps[1:]:
        errors.append(step @ errors[-1] if left else errors[-1] @ step)
    return np.stack(errors)


def _padded(rotation: Array) -> Array:
    pose = np.tile(np.eye(4), (len(rotation), 1, 1))
    pose[:, :3, :3] = rotation
    return pose


def _rotation_only(steps: Array, extrinsics: Array) -> Array:
    turned = drift(steps, extrinsics)
    turned[:, :3, 3] = extrinsics[:, :3, 3]
    return turned


def _from_poses_before(steps: Array, extrinsics: Array) -> Array:
    poses = [_padded(steps)[0] @ extrinsics[0]]
    for step in _padded(steps)[1:]:
        poses.append(step @ poses[-1])
    return np.stack(poses)


def _late(steps: Array, extrinsics: Array) -> Array:
    errors = np.concatenate([np.eye(3)[None], _accumulated(steps)[:-1]])
    return _padded(errors) @ extrinsics


DRIFT = Exercise(
    "02.drift",
    reference=drift,
    cases=_turned,
    mistakes=(
        Mistake(
            "not accumulated",
            lambda s, e: _padded(s) @ e,
            "each frame has only its own error here; a drift keeps all the errors before it.",
        ),
        Mistake(
            "new step first",
            lambda s, e: _padded(_accumulated(s, left=False)) @ e,
            "rotations do not commute: the new step comes after the errors before it, so it stands on their left.",
        ),
        Mistake(
            "on the right of the pose",
            lambda s, e: e @ _padded(_accumulated(s)),
            "this turns the world before the camera sees it; the error turns what the camera sees: left of the pose.",
        ),
        Mistake(
            "translation kept",
            _rotation_only,
            "a turn about the camera's centre turns b as well: the whole pose is multiplied, not its rotation only.",
        ),
        Mistake(
            "product of numbers",
            lambda s, e: _padded(np.cumprod(s, 0)) @ e,
            "np.cumprod multiplies number by number; rotations accumulate as matrices.",
        ),
        Mistake(
            "sum",
            lambda s, e: _padded(np.cumsum(s, 0)) @ e,
            "rotations accumulate as products of matrices, not as sums.",
        ),
        Mistake("one frame late", _late, "the step of frame t already belongs to frame t; frame 0 is turned as well."),
        Mistake(
            "from the pose before",
            _from_poses_before,
            "the true camera moves, too: put the accumulated error on extrinsics[t], not on the pose of the frame before.",
        ),
        Mistake(
            "undone",
            lambda s, e: _padded(_accumulated(s).swapaxes(1, 2)) @ e,
            "your errors are inverted: do not transpose the steps.",
        ),
    ),
)
