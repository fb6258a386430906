"""Exercises of notebook 06: what counts, the loss and its discount; the backward pass is in `n06_chain`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from lessons.checker import Exercise, Mistake
from lessons.n06_chain import BACKWARD
from tapip3d_lite.geometry import transform


def counted(frames: Tensor, times: Tensor, length: int) -> Tensor:
    """Which pairs of frame and track are scored (S, N): from the query's frame on, and only real frames."""
    return (frames[:, None] >= times) & (frames < length)[:, None]


def _window(rng: np.random.Generator, size: int) -> tuple[Tensor, Tensor, int]:
    length = 3 + 2 * size
    frames = torch.arange(length - 4, length + 2)  # the last two are padded
    times = torch.from_numpy(rng.integers(length - 4, length, 2 + size))
    times[0], times[1] = length - 4, length - 2  # asked at the window's first frame, and later
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
            lambda frames, times, length: (frames < length)[:, None].expand(-1, len(times)),
            "before the query's frame nobody has asked for the point yet: these frames do not count.",
        ),
        Mistake(
            "one frame too many",
            lambda frames, times, length: (frames[:, None] >= times) & (frames <= length)[:, None],
            "frames are numbered from 0, so the last real one is length - 1.",
        ),
        Mistake(
            "the window's own numbers",
            lambda frames, times, length: counted(torch.arange(len(frames)), times, length),
            "the window need not begin at frame 0: use the numbers in `frames`, not the rows.",
        ),
        Mistake(
            "tracks by frames",
            lambda *case: counted(*case).T,
            "one row a frame, one column a track: (S, N).",
        ),
    ),
)


def update_loss(
    xyz: Tensor, truth: Tensor, logits: Tensor, visible: Tensor, extrinsics: Tensor, counts: Tensor
) -> Tensor:
    """Mean over what counts of |x - x*| / z* plus three times the entropy of visibility."""
    return _loss(xyz, truth, logits, visible, extrinsics, counts)


def _loss(
    xyz: Tensor, truth: Tensor, logits: Tensor, visible: Tensor, extrinsics: Tensor, counts: Tensor, **slip: object
) -> Tensor:
    """The loss of one update; `slip` makes one mistake."""
    camera = _in_camera(xyz if slip.get("own_depth") else truth, extrinsics, slip.get("camera"))
    depth = camera.norm(dim=-1) if slip.get("ray") else camera[..., 2]
    gap = xyz.detach() - truth if slip.get("detached") else xyz - truth
    distance = gap.square().sum(-1) if slip.get("squared") else gap.norm(dim=-1)
    distance = gap.abs().sum(-1) if slip.get("manhattan") else distance
    sign = torch.where(visible, -1, 1) * (-1 if slip.get("inverted") else 1)
    entropy = slip.get("alpha", 3) * torch.nn.functional.softplus(sign * logits)
    position = distance if slip.get("undivided") else distance / depth
    if slip.get("visible_only"):
        return position[counts & visible].mean() + entropy[counts].mean()
    if slip.get("all"):
        return (position + entropy).mean()
    if slip.get("means"):
        return distance[counts].mean() / depth[counts].mean() + entropy[counts].mean()
    total = (position + entropy)[counts]
    return total.sum() if slip.get("sum") else total.mean()


def _in_camera(points: Tensor, extrinsics: Tensor, slip: object) -> Tensor:
    """Points (S, N, 3) in the camera of their frame."""
    if slip == "none":
        return points
    if slip == "not turned":
        return points + extrinsics[:, None, :3, 3]
    if slip == "turned back":  # the rotation's transpose
        return (points[..., None, :] @ extrinsics[:, None, :3, :3])[..., 0, :] + extrinsics[:, None, :3, 3]
    if slip == "inverse":
        return transform(points, torch.linalg.inv(extrinsics))
    return transform(points, extrinsics[:1].expand_as(extrinsics) if slip == "first" else extrinsics)


def _update(rng: np.random.Generator, size: int) -> tuple[Tensor, ...]:
    """Turned cameras, another one in each frame; every wrong depth is positive too, and none is the right one."""
    frames, tracks = 1 + size, 2 * size
    extrinsics = np.tile(np.eye(4), (frames, 1, 1))
    for pose in extrinsics:
        pose[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        pose[:3, :3] *= np.linalg.det(pose[:3, :3])
        pose[:3, 3] = rng.uniform(-1, 1, 2).tolist() + [rng.uniform(4, 6)]
    truth = rng.uniform(-1.6, 1.6, (frames, tracks, 3)) + [0, 0, 0.5]
    counts = rng.random((frames, tracks)) < 0.6
    visible = rng.random(counts.shape) < 0.6
    counts[0, 0], counts[-1, -1] = True, False
    visible[0, 0], counts[0, 1], visible[0, 1] = True, True, False  # a hidden point counts
    xyz, logits = truth + 2 * rng.normal(size=truth.shape), rng.normal(size=counts.shape)
    return tuple(map(torch.from_numpy, (xyz, truth, logits, visible, extrinsics, counts)))


def _slipped(**slip: object) -> Callable[..., Tensor]:
    return lambda *case: _loss(*case, **slip)


LOSS = Exercise(
    "06.loss",
    reference=update_loss,
    cases=_update,
    tolerance=1e-6,
    gradients=(0, 2),
    mistakes=(
        Mistake(
            "the world's z",
            _slipped(camera="none"),
            "z* is the depth in the camera of each frame; the world's z is something else. Use `extrinsics`.",
        ),
        Mistake(
            "rotation ignored",
            _slipped(camera="not turned"),
            "you added the camera's translation without turning the points first: the rotation `extrinsics[:, :3, :3]` "
            "belongs to it.",
        ),
        Mistake(
            "rotation transposed",
            _slipped(camera="turned back"),
            "you turned with the transposed rotation: x_camera = R x_world + b, so its z needs the third row of R, "
            "not the third column.",
        ),
        Mistake(
            "camera to world",
            _slipped(camera="inverse"),
            "extrinsics map the world to the camera already; do not invert them.",
        ),
        Mistake(
            "one camera for all frames",
            _slipped(camera="first"),
            "each frame has a camera of its own: `extrinsics[:, None]` lines up with (S, N, ...).",
        ),
        Mistake(
            "ray length",
            _slipped(ray=True),
            "z* is the z of the point in its camera, along the optical axis; you took its distance from the camera.",
        ),
        Mistake(
            "the estimate's depth",
            _slipped(own_depth=True),
            "divide by the depth of the truth; by its own, an estimate could buy a lower loss by running away.",
        ),
        Mistake("not divided by depth", _slipped(undivided=True), "the distance is divided by the depth of the truth."),
        Mistake("squared", _slipped(squared=True), "the distance itself, not its square: outliers must not rule."),
        Mistake(
            "sum of absolute values",
            _slipped(manhattan=True),
            "the distance is the Euclidean norm: root of the sum of squares.",
        ),
        Mistake("alpha forgotten", _slipped(alpha=1), "the entropy of visibility weighs alpha = 3 times."),
        Mistake(
            "sign of visibility",
            _slipped(inverted=True),
            "where the point is visible the entropy is -log sigmoid(vis), elsewhere -log(1 - sigmoid(vis)): you have "
            "them swapped.",
        ),
        Mistake(
            "mean over everything",
            _slipped(all=True),
            "the mean runs over what counts, `x[counts].mean()`; the rest must not dilute it.",
        ),
        Mistake(
            "sum instead of mean",
            _slipped(sum=True),
            "you summed over what counts; ours is the mean, so that clips of many points do not shout louder.",
        ),
        Mistake(
            "positions of visible points only",
            _slipped(visible_only=True),
            "hidden points count too: the tracker must say where a point is while it cannot see it.",
        ),
        Mistake(
            "means divided by each other",
            _slipped(means=True),
            "divide each distance by its own point's depth, then take the mean; you divided one mean by the other.",
        ),
        Mistake(
            "no gradient to the estimate",
            _slipped(detached=True),
            "the number is right, but nothing can learn from it: do not detach `xyz`, nor leave torch on the way.",
        ),
    ),
)


def discounted(losses: Tensor, gamma: float) -> Tensor:
    """Sum over windows and updates m = 1 ... M of gamma^(M - m) times the update's loss."""
    return (losses * gamma ** torch.arange(losses.shape[1] - 1, -1, -1)).sum()


def _all_windows(rng: np.random.Generator, size: int) -> tuple[Tensor, float]:
    losses = rng.uniform(0.5, 2, (1 + size % 3 + (size == 3), 1 + size))  # two, three, two, two windows
    return torch.from_numpy(losses), float(rng.uniform(0.5, 0.9))


DISCOUNT = Exercise(
    "06.discount",
    reference=discounted,
    cases=_all_windows,
    gradients=(0,),
    mistakes=(
        Mistake(
            "first counts most",
            lambda losses, gamma: discounted(losses.flip(1), gamma),
            "the LAST update weighs 1 and the first one least: the powers fall to 0 at m = M.",
        ),
        Mistake(
            "one power too many",
            lambda losses, gamma: gamma * discounted(losses, gamma),
            "the last update weighs gamma^0 = 1.",
        ),
        Mistake(
            "on through the windows",
            lambda losses, gamma: discounted(losses.reshape(1, -1), gamma),
            "every window begins anew with m = 1: the last update of each window weighs 1.",
        ),
        Mistake(
            "along the windows",
            lambda losses, gamma: discounted(losses.T, gamma),
            "rows are windows, columns are updates: the powers fall along a row.",
        ),
        Mistake(
            "mean",
            lambda losses, gamma: discounted(losses, gamma) / losses.numel(),
            "windows and updates are summed, not averaged.",
        ),
        Mistake(
            "normalised",
            lambda losses, gamma: discounted(losses, gamma) / discounted(torch.ones_like(losses[:1]), gamma),
            "the weights are not made to sum to one.",
        ),
        Mistake("no discount", lambda losses, gamma: losses.sum(), "you sum without weights; use gamma."),
    ),
)


EXERCISES = (COUNTED, LOSS, DISCOUNT, BACKWARD)
