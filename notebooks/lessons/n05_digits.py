"""Lesson 05: what becomes of the last digit of a query, and through which parts of the tracker it grows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from unittest import mock

import numpy as np
import torch
from torch import Tensor, nn

from tapip3d_lite.clip import Clip
from tapip3d_lite.model import blocks, neighbors, updater
from tapip3d_lite.model.blocks import DEGREES
from tapip3d_lite.recorder import Recorder
from tapip3d_lite.trackers import load_tracker
from tapip3d_lite.training.start import by_degree, wave_weights

Array = np.ndarray


@torch.no_grad()
def grown(tracker: nn.Module, clip: Clip, queries: Array, kept: Sequence[str] = (), degree: int = 4) -> Array:
    """How far estimates move (updates, T, N), in metres, where each query moves by the last digit of single precision.

    Updates are those of all windows of one pass forward, in their order; a frame that an update does not touch has NaN.

    Args:
        tracker: without fast parts, which have none to hold on to.
        clip: of the tracker's image size.
        queries: (N, 4) in frame 0.
        kept: what stays, bit for bit, as it was before the move: `"neighbours"`, the indices of the nearest cells;
            `"fine waves"`, sines and cosines above a degree.
        degree: the finest one that may move.
    """
    log: list[Tensor] = []
    moved = queries.copy()
    moved[:, 1:] = np.nextafter(queries[:, 1:].astype(np.float32), np.float32(np.inf))
    before = _updates(tracker, clip, queries, _holding(kept, degree, log.append))
    replay = iter(log)
    after = _updates(tracker, clip, moved, _holding(kept, degree, None, lambda: next(replay)))
    return np.linalg.norm(after - before, axis=-1)


def _updates(tracker: nn.Module, clip: Clip, queries: Array, held: object) -> Array:
    with held, Recorder(tracker, range(len(queries))) as record:
        tracker.track(clip, queries, support_grid=0, bidirectional=False)
    found = np.full((len(record.steps), len(clip), len(queries), 3), np.nan)
    for i, step in enumerate(record.steps):
        count = min(len(step.xyz), len(clip) - step.start)
        found[i, step.start : step.start + count] = step.xyz[:count]
    return found


@contextmanager
def _holding(
    kept: Sequence[str], degree: int, store: Callable[[Tensor], None] | None, recall: Callable[[], Tensor] | None = None
) -> Iterator[None]:
    """Store what is kept, or put back what was stored."""
    search, waves = neighbors.knn, blocks.fourier

    def held(value: Tensor) -> Tensor:
        if recall is not None:
            return recall()
        store(value)
        return value

    def knn(*arguments: object, **options: object) -> Tensor:
        return held(search(*arguments, **options))

    def fourier(x: Tensor) -> Tensor:
        found = waves(x)
        fine = by_degree([j > degree for j in DEGREES], x.shape[-1], plain=False)
        return torch.where(fine, held(found), found)

    with mock.patch.object(neighbors, "knn", knn if "neighbours" in kept else search):
        chosen = fourier if "fine waves" in kept else waves
        with mock.patch.object(blocks, "fourier", chosen), mock.patch.object(updater, "fourier", chosen):
            yield


@torch.no_grad()
def without_waves(name: str, degree: int) -> nn.Module:
    """A tracker by name, without fast parts, that hears no sines and cosines above a degree."""
    tracker = load_tracker(name, fast=False)
    for weight, axes in wave_weights(tracker):
        weight *= by_degree([float(j <= degree) for j in DEGREES], axes)
    return tracker
