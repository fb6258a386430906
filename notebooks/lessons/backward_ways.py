"""Two ways to the same gradients: by their definition, and as the library trains, with little memory."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from tapip3d_lite.model.frames import Frames
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.training.backward import add_gradients, losses
from tapip3d_lite.training.loss import LossConfig, Truth, step_loss


def saving_backward(tracker: Tracker, *arguments: Any, **options: Any) -> dict[str, float]:
    """Call `add_gradients`, and return the loss by name: `position`, `visibility` and their sum `loss`."""
    return losses(add_gradients(tracker, *arguments, **options))


def plain_backward(
    tracker: Tracker, frames: Frames, queries: Tensor, truth: Truth, config: LossConfig, **options: Any
) -> dict[str, float]:
    """The gradients by their definition: sum the losses of all updates, then backpropagate everything at once."""
    iterations = options.get("iterations") or tracker.config.iterations
    steps = tracker.steps(frames, queries, features=tracker.encoder(frames.rgb), **options)
    parts = [torch.stack(step_loss(step, truth, iterations, config)) for step in steps]
    total = torch.stack(parts).sum(0) if parts else queries.new_zeros(2)
    if parts:
        total.sum().backward()
    return losses(total.detach())
