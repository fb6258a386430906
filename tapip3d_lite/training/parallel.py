"""Several processes, one training: each computes gradients of its own clips, and all step with their mean."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import distributed, nn


class Group:
    """The processes that torchrun started, or this one alone.

    Attributes:
        rank: of this process, from 0.
        size: number of processes.
        is_main: whether this process writes files and shows the bar.
    """

    def __init__(self, device: torch.device | str = "cpu") -> None:
        active = distributed.is_available() and distributed.is_initialized()
        self.rank, self.size = (distributed.get_rank(), distributed.get_world_size()) if active else (0, 1)
        self.is_main, self._device = self.rank == 0, device

    @torch.no_grad()
    def copy_from_main(self, parameters: Iterable[nn.Parameter]) -> None:
        """Overwrite parameters by those of the main process."""
        for parameter in parameters if self.size > 1 else ():
            distributed.broadcast(parameter, 0)

    def average(self, parameters: Sequence[nn.Parameter]) -> None:
        """Replace gradients by their mean over processes, in place."""
        if self.size == 1:
            return
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
        flat = torch.cat([gradient.flatten() for gradient in gradients]) / self.size
        distributed.all_reduce(flat)
        parts = flat.split([gradient.numel() for gradient in gradients])
        for parameter, gradient, part in zip(parameters, gradients, parts, strict=True):
            parameter.grad = gradient.copy_(part.view_as(gradient))

    def sum(self, value: float) -> float:
        """The sum of a number over processes."""
        if self.size == 1:
            return value
        total = torch.tensor(value, dtype=torch.float64, device=self._device)
        distributed.all_reduce(total)
        return total.item()
