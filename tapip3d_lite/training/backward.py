"""Backpropagation whose memory grows neither with the number of updates nor with the number of windows.

Paper, section 3.5 ("memory"): estimates are detached after every update, so each update's loss reaches back only
through that update. Its graph can therefore be walked and freed at once. What all updates share is treated as input:
image features are a leaf that collects their gradients, and the encoder is backpropagated once at the end.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from tapip3d_lite.model.frames import Frames
from tapip3d_lite.model.scene import Step
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.training.loss import LossConfig, Truth, step_loss


def saving_backward(
    tracker: Tracker,
    frames: Frames,
    queries: Tensor,
    truth: Truth,
    config: LossConfig,
    features: Tensor | None = None,
    watch: Callable[[Step], None] | None = None,
    **options: Any,
) -> dict[str, float]:
    """Add the gradients of the whole loss to the parameters, one update at a time.

    Args:
        tracker: in training mode.
        frames: T frames.
        queries: (B, N, 4) rows (t, x, y, z), world.
        truth: of the same tracks.
        config: weights of the loss.
        features: (B, T, C, h, w) of an encoder that is not trained along; None: encode the frames.
        watch: called with every update before it is forgotten.
        options: of `Tracker.steps`, e.g. `active`, `iterations`, `space`.

    Returns:
        `position` and `visibility`, the two parts of the loss, and their sum `loss`.
    """
    features = tracker.encoder(frames.rgb) if features is None else features
    leaf = features.detach().requires_grad_(features.requires_grad)
    totals, iterations = [0.0, 0.0], options.get("iterations") or tracker.config.iterations
    for step in tracker.steps(frames, queries, features=leaf, **options):
        parts = step_loss(step, truth, iterations, config)
        # What updates share (tokens of the cloud, the support) is walked again by the next one, so it must stay; the
        # update's own graph goes with the last reference to its results.
        sum(parts).backward(retain_graph=True)
        totals = [total + float(part.detach()) for total, part in zip(totals, parts, strict=True)]
        if watch is not None:
            watch(step)
        del step, parts
    if leaf.grad is not None:
        features.backward(leaf.grad)
    return {"loss": sum(totals), "position": totals[0], "visibility": totals[1]}


def plain_backward(
    tracker: Tracker, frames: Frames, queries: Tensor, truth: Truth, config: LossConfig, **options: Any
) -> dict[str, float]:
    """The same gradients the usual way: sum the losses of all updates, then walk everything at once."""
    iterations = options.get("iterations") or tracker.config.iterations
    steps = tracker.steps(frames, queries, features=tracker.encoder(frames.rgb), **options)
    parts = [torch.stack(step_loss(step, truth, iterations, config)) for step in steps]
    if not parts:
        return {"loss": 0.0, "position": 0.0, "visibility": 0.0}
    total = torch.stack(parts).sum(0)
    total.sum().backward()
    position, visibility = total.detach().tolist()
    return {"loss": position + visibility, "position": position, "visibility": visibility}
