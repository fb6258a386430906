"""Several processes, one training: gradients are averaged by torch's DistributedDataParallel.

The memory-saving backward runs many small backward passes a step, and DDP wants to average once. So those passes
only collect gradients; then a pass through a sum that is zero makes DDP average what has been collected, which is
how it accumulates gradients over several passes (`no_sync`).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel


class _Touch(nn.Module):
    """A zero that depends on every parameter."""

    def __init__(self, parameters: Sequence[nn.Parameter]) -> None:
        super().__init__()
        self.shared = nn.ParameterList(parameters)

    def forward(self) -> Tensor:
        return sum(p.sum() * 0 for p in self.shared)


class Group:
    """The processes that torchrun started, or this one alone.

    Attributes:
        rank: of this process, from 0.
        size: number of processes.
    """

    def __init__(self) -> None:
        active = distributed.is_available() and distributed.is_initialized()
        self.rank, self.size = (distributed.get_rank(), distributed.get_world_size()) if active else (0, 1)
        self._touch: nn.Module | None = None

    @property
    def leads(self) -> bool:
        """Whether this process writes files and shows the bar."""
        return self.rank == 0

    def share(self, parameters: Sequence[nn.Parameter]) -> None:
        """Give all processes the first one's parameters, whose gradients `average` will average from now on."""
        if self.size > 1:
            self._touch = DistributedDataParallel(_Touch(parameters))

    def average(self, parameters: Sequence[nn.Parameter]) -> None:
        """Replace gradients by their mean over processes."""
        if self._touch is None:
            return
        for parameter in parameters:
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
        self._touch().backward()

    def any(self, flag: bool) -> bool:
        """Whether the flag is true in any process."""
        if self._touch is None:
            return flag
        parameter = next(self._touch.parameters())
        told = torch.tensor([float(flag)], device=parameter.device)
        distributed.all_reduce(told)
        return bool(told.item())
