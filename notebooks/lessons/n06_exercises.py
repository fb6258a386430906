"""Exercises of notebook 06: what counts, the loss and its discount; the backward pass is in `n06_chain`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lessons.checker import Exercise, Mistake
from lessons.n06_chain import BACKWARD
from tapip3d_lite.geometry import transform

Array = np.ndarray


def counted(frames: Array, times: Array, length: int) -> Array:
    """Which pairs of frame and track are scored (S, N): from the query's frame on, and only real frames."""
    return (frames[:, None] >= times) & (frames < length)[:, None]


def _window(rng: np.random.Generator, size: int) -> tuple[Array, Array, int]:
    length = 3 + 2 * size
    frames = np.arange(length - 4, length + 2)  # the last two are padded
    times = rng.integers(length - 4, length, 2 + size)
    times[:2] = length - 4, length - 2  # asked at the window's first frame, and later
    return frames, times, length


COUNTED = Exercise(
    "06.counted",
    reference=counted,
    cases=_window,
    mistakes=(
        Mistake(
            "after the query only",
            lambda frames, times, length: (frames[:, None] > times) & (frames < length)[:, None],
            "the query's own frame counts too: there the answer is known, and its visibility is asked.",
        ),
        Mistake(
            "padded frames count",
            lambda frames, times, length: frames[:, None] >= times,
            "frames from `length` on do not exist; the window only repeats the last one to be full.",
        ),
        Mistake(
            "everything real counts",
            lambda frames, times, length: np.repeat((frames < length)[:, None], len(times), 1),
            "before the query's frame nobody has asked for the point yet: these frames do not count.",
        ),
        Mistake(
            "one frame too many",
            lambda frames, times, length: (frames[:, None] >= times) & (frames <= length)[:, None],
            "frames are numbered from 0, so the last real one is length - 1.",
        ),
        Mistake(
            "tracks by frames",
            lambda *case: counted(*case).T,
            "one row a frame, one column a track: (S, N).",
        ),
    ),
)


def update_loss(xyz: Array, truth: Array, logits: Array, visible: Array, extrinsics: Array, counts: Array) -> float:
    """Mean over what counts of |x - x*| / d plus three times the entropy of visibility."""
    return _loss(xyz, truth, logits, visible, extrinsics, counts)


def _loss(
    xyz: Array, truth: Array, logits: Array, visible: Array, extrinsics: Array, counts: Array, **slip: object
) -> float:
    """The loss of one update; `slip` makes one mistake."""
    depth_of = xyz if slip.get("own_depth") else truth
    depth = np.linalg.norm(depth_of, axis=-1) if slip.get("ray") else transform(depth_of, extrinsics)[..., 2]
    depth = truth[..., 2] if slip.get("world_z") else depth
    gap = xyz - truth
    distance = (gap**2).sum(-1) if slip.get("squared") else np.sqrt((gap**2).sum(-1))
    sign = np.where(visible, -1, 1) * (-1 if slip.get("inverted") else 1)
    entropy = np.logaddexp(0, sign * logits)
    each = (distance if slip.get("undivided") else distance / depth) + slip.get("alpha", 3) * entropy
    return float(each.mean() if slip.get("all") else each[counts].mean())


def _update(rng: np.random.Generator, size: int) -> tuple[Array, ...]:
    frames, tracks = 1 + size, 2 * size
    truth = rng.uniform(-1, 1, (frames, tracks, 3)) + [0, 0, 2.0]
    extrinsics = np.tile(np.eye(4), (frames, 1, 1))
    extrinsics[:, 2, 3] = rng.uniform(1, 4, frames)
    counts = rng.random((frames, tracks)) < 0.6
    counts[0, 0], counts[-1, -1] = True, False
    xyz, logits = truth + 0.3 * rng.normal(size=truth.shape), 2 * rng.normal(size=counts.shape)
    return xyz, truth, logits, rng.random(counts.shape) < 0.6, extrinsics, counts


def _slipped(**slip: object) -> Callable[..., float]:
    return lambda *case: _loss(*case, **slip)


LOSS = Exercise(
    "06.loss",
    reference=update_loss,
    cases=_update,
    mistakes=(
        Mistake(
            "wrong frame",
            _slipped(world_z=True),
            "d is the depth in the camera of each frame; the world's z is something else. Use `extrinsics`.",
        ),
        Mistake(
            "distance along the ray",
            _slipped(ray=True),
            "d is the z of the point in the camera, not its distance from some origin.",
        ),
        Mistake(
            "the estimate's depth",
            _slipped(own_depth=True),
            "divide by the depth of the truth; by its own, an estimate could buy a lower loss by running away.",
        ),
        Mistake("not divided by depth", _slipped(undivided=True), "the distance is divided by the depth of the truth."),
        Mistake(
            "squared",
            _slipped(squared=True),
            "the distance itself, not its square: outliers must not rule.",
        ),
        Mistake(
            "alpha forgotten",
            _slipped(alpha=1),
            "the entropy of visibility weighs alpha = 3 times.",
        ),
        Mistake(
            "sign of visibility",
            _slipped(inverted=True),
            "where the point is visible the loss is -log sigma(v), elsewhere -log(1 - sigma(v)): you have them swapped.",
        ),
        Mistake(
            "mean over everything",
            _slipped(all=True),
            "the mean runs over what counts, `x[counts].mean()`; the rest must not dilute it.",
        ),
    ),
)


def discounted(losses: Array, gamma: float) -> float:
    """Sum over updates m = 1 ... M of gamma^(M - m) times the update's loss."""
    return float((np.asarray(losses) * gamma ** np.arange(len(losses) - 1, -1, -1)).sum())


DISCOUNT = Exercise(
    "06.discount",
    reference=discounted,
    cases=lambda rng, size: (rng.uniform(0.5, 2, 1 + size), float(rng.uniform(0.5, 0.9))),
    mistakes=(
        Mistake(
            "first counts most",
            lambda losses, gamma: float((losses * gamma ** np.arange(len(losses))).sum()),
            "the LAST update weighs 1 and the first one least: the powers fall to 0 at m = M.",
        ),
        Mistake(
            "one power too many",
            lambda losses, gamma: gamma * discounted(losses, gamma),
            "the last update weighs gamma^0 = 1.",
        ),
        Mistake(
            "mean",
            lambda losses, gamma: discounted(losses, gamma) / len(losses),
            "the updates are summed, not averaged.",
        ),
        Mistake(
            "normalised",
            lambda losses, gamma: discounted(losses, gamma) / discounted(np.ones(len(losses)), gamma),
            "the weights are not made to sum to one.",
        ),
        Mistake("no discount", lambda losses, gamma: float(np.sum(losses)), "you sum without weights; use gamma."),
    ),
)


EXERCISES = (COUNTED, LOSS, DISCOUNT, BACKWARD)
