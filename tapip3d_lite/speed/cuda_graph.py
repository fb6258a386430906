"""A training step recorded once as a CUDA graph, then replayed for each batch.

A step of a small tracker is tens of thousands of small kernels, and Python takes longer to ask for each than a GPU to
run it. A graph holds them all and is started by one call. The numbers are those of the step itself. What is recorded
may not wait for the GPU, nor depend on values: `sync_free` puts a tracker into that state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from tapip3d_lite.model.neighbors import Neighbors
from tapip3d_lite.model.windows import Neighborhood, Scene, around_queries

_WARM = 2  # runs before recording: they compile, and choose algorithms


@contextmanager
def sync_free(tracker: Any) -> Iterator[None]:
    """Let a tracker do the same operations whatever the values are, while the context lasts."""

    def support(scene: Scene, queries: Tensor, coords: Tensor) -> list[Neighbors]:
        with torch.autocast(coords.device.type, enabled=False):
            return support_at_once(tracker.neighborhood, scene, queries[..., 0].long(), coords)

    tracker.sync_free, tracker.support = True, support
    try:
        yield
    finally:
        del tracker.sync_free, tracker.support  # the class's own again


class CudaGraphStep:
    """A step that adds gradients, recorded for each number of frames and updates that it meets.

    Each recording keeps a step's memory for itself, so a recipe of many lengths needs as many times as much.

    Args:
        step: from a batch and M to tensors; leaves gradients. A batch is anything with `frames` and `map(function of a
            tensor)`.
        tracker: which it trains; `sync_free` while it is recorded.
        parameters: that get gradients.
    """

    def __init__(
        self, step: Callable[[Any, int], tuple[Tensor, ...]], tracker: nn.Module, parameters: Sequence[nn.Parameter]
    ) -> None:
        self._step, self._tracker, self._parameters, self._recorded = step, tracker, list(parameters), {}

    def __call__(self, batch: Any, iterations: int) -> tuple[Tensor, ...]:
        """What the step returns, overwritten by the next call; gradients are set, not added."""
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

    def _run(self, batch: Any, iterations: int) -> tuple[Tensor, ...]:
        with sync_free(self._tracker):
            return self._step(batch, iterations)

    def _record(self, batch: Any, iterations: int) -> tuple:
        inputs, side, graph = batch.map(torch.clone), torch.cuda.Stream(), torch.cuda.CUDAGraph()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            for _ in range(_WARM):
                self._forget()
                self._run(inputs, iterations)
        torch.cuda.current_stream().wait_stream(side)
        self._forget()  # gradients made while recording belong to the graph
        with torch.cuda.graph(graph):
            results = self._run(inputs, iterations)
        gradients = [parameter.grad for parameter in self._parameters]
        return graph, inputs, results, gradients

    def _forget(self) -> None:
        for parameter in self._parameters:
            parameter.grad = None


def _tensors(batch: Any) -> list[Tensor]:
    tensors: list[Tensor] = []
    batch.map(lambda x: tensors.append(x) or x)
    return tensors


def support_at_once(neighborhood: Neighborhood, scene: Scene, times: Tensor, coords: Tensor) -> list[Neighbors]:
    """As `model.windows.query_support`: all queries in all frames, of which each query's own frame is kept.

    That is T times the work, but T times fewer calls, and nothing depends on values.
    """
    batch, count = times.shape
    own = torch.arange(batch, device=times.device)[:, None], times, torch.arange(count, device=times.device)
    found = [around_queries(neighborhood, scene, level, coords) for level in scene.levels]
    return [
        Neighbors(x.features[own], x.points[own], coords, None if x.indices is None else x.indices[own]) for x in found
    ]
