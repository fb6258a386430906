"""Backpropagation whose memory grows neither with the number of updates nor with the number of windows.

Estimates are detached after every update (paper and released code), so the loss of an update has gradients through this
update only, and its graph can be backpropagated and freed at once. Tensors that several updates use become leaves, which
add up gradients: tokens of the cloud and of the queries until the end of a window, image features until the end of the
clip. What computed them is then backpropagated once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from tapip3d_lite.model.frames import Frames
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.model.windows import Step, Window
from tapip3d_lite.training.loss import LossConfig, Truth, step_loss


def add_gradients(
    tracker: Tracker,
    frames: Frames,
    queries: Tensor,
    truth: Truth,
    config: LossConfig,
    features: Tensor | None = None,
    watch: Callable[[Step], None] | None = None,
    **options: Any,
) -> Tensor:
    """Add the gradients of the whole loss to the parameters' gradients, one update at a time.

    Queries (B, N, 4) are rows (t, x, y, z), world, and `truth` belongs to the same tracks. `features` (B, T, C, h, w) are
    those of an encoder that is not trained along; without them the frames are encoded. `watch` is called with every
    update before its tensors are freed; `options` are those of `Tracker.steps`, e.g. `active`, `iterations`, `space`.
    Returns the position and visibility parts (2,) of the loss, without gradient.
    """
    features = tracker.encoder(frames.rgb) if features is None else features
    whole, window = Leaves(), Leaves()
    leaf = whole.of(features)
    iterations, totals = options.get("iterations") or tracker.config.iterations, []
    pending = 0.0
    for step in tracker.steps(frames, queries, features=leaf, on_window=window.shared, **options):
        parts = step_loss(step, truth, iterations, config)
        pending = pending + sum(parts)
        if not (tracker.trial.get("grad2") and (iterations - 1 - step.iteration) % 2):
            pending.backward()
            pending = 0.0
        if step.iteration == iterations - 1:
            window.backward(retain_graph=True)  # the queries' neighbourhoods also serve the next window
        totals.append(torch.stack(parts).detach())
        if watch is not None:
            watch(step)
        del step, parts
    whole.backward()
    return torch.stack(totals).sum(0) if totals else queries.new_zeros(2)


def losses(parts: Tensor) -> dict[str, float]:
    """The loss by name, from the tensor (2,) of `add_gradients`; this waits for the GPU."""
    position, visibility = parts.tolist()
    return {"loss": position + visibility, "position": position, "visibility": visibility}


class Leaves:
    """Detached copies of tensors, which add up gradients until `backward` sends these on to the tensors."""

    def __init__(self) -> None:
        self._pairs: list[tuple[Tensor, Tensor]] = []

    def of(self, tensor: Tensor) -> Tensor:
        """A leaf with the values of a tensor; the tensor itself if it needs no gradient."""
        if not tensor.requires_grad:
            return tensor
        leaf = tensor.detach().requires_grad_()
        self._pairs.append((tensor, leaf))
        return leaf

    def shared(self, window: Window) -> Window:
        """The window with leaves in place of all tensors that its updates share."""
        levels = [replace(x, features=self.of(x.features), extra=self._all(x.extra)) for x in window.levels]
        return replace(window, levels=levels, kept=[self._all(kept) for kept in window.kept])

    def _all(self, value: Any) -> Any:
        if isinstance(value, list | tuple):
            return type(value)(map(self._all, value))
        if isinstance(value, dict):
            return {name: self._all(item) for name, item in value.items()}
        if isinstance(value, Tensor):
            return self.of(value)
        return value.map(self.of) if hasattr(value, "map") else value

    def backward(self, retain_graph: bool = False) -> None:
        """Backpropagate the collected gradients from the tensors on, and forget these tensors."""
        pairs = [(tensor, leaf.grad) for tensor, leaf in self._pairs if leaf.grad is not None]
        self._pairs = []
        if pairs:
            torch.autograd.backward(*zip(*pairs, strict=True), retain_graph=retain_graph)
