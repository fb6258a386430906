"""`Replay`: a training step recorded once as a CUDA graph, then replayed for each batch.

A step of a small tracker is tens of thousands of small kernels, and launching them one by one from Python takes longer
than computing them. A graph is launched by one call. The numbers are those of the step itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor, nn

_WARM = 2  # runs before recording, which compile and choose algorithms


class Inputs(Protocol):
    """What a step computes with: tensors, and frames whose number is their length."""

    frames: Any

    def map(self, change: Callable[[Tensor], Tensor]) -> Inputs:
        """The same with every tensor replaced by `change` of it, always in the same order."""


class Replay:
    """A step that sets gradients, recorded for each number of frames and of updates that occurs.

    Each recording keeps the memory of a step, so a recipe with many lengths needs many times as much.
    """

    def __init__(self, run: Callable[[Any, int], tuple[Tensor, ...]], parameters: Sequence[nn.Parameter]) -> None:
        """Prepare to record.

        Args:
            run: takes a batch and M, returns tensors, and adds gradients. It must not read numbers from the GPU.
            parameters: that get gradients.
        """
        self._run, self._parameters, self._recorded = run, list(parameters), {}

    def __call__(self, batch: Inputs, iterations: int) -> tuple[Tensor, ...]:
        """The results of `run`, which the next call overwrites; gradients are set, not added."""
        key = len(batch.frames), iterations
        if key not in self._recorded:
            self._recorded[key] = self._record(batch, iterations)
        graph, inputs, results, gradients = self._recorded[key]
        for old, new in zip(_tensors(inputs), _tensors(batch), strict=True):
            old.copy_(new)
        graph.replay()
        for parameter, gradient in zip(self._parameters, gradients, strict=True):
            parameter.grad = gradient
        return results

    def _record(self, batch: Inputs, iterations: int) -> tuple:
        inputs, side, graph = batch.map(torch.clone), torch.cuda.Stream(), torch.cuda.CUDAGraph()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            for _ in range(_WARM):
                self._forget()
                self._run(inputs, iterations)
        torch.cuda.current_stream().wait_stream(side)
        self._forget()  # gradients allocated while recording belong to the graph
        with torch.cuda.graph(graph):
            results = self._run(inputs, iterations)
        gradients = [parameter.grad for parameter in self._parameters]
        return graph, inputs, results, gradients

    def _forget(self) -> None:
        for parameter in self._parameters:
            parameter.grad = None


def _tensors(batch: Inputs) -> list[Tensor]:
    tensors: list[Tensor] = []
    batch.map(lambda x: tensors.append(x) or x)
    return tensors
