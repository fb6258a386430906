"""Look inside a tracker at work: neighbourhoods, attention, tokens and the path after every update.

Forward hooks watch the tracker's parts from outside, so the tracker itself carries no flags and is as fast as ever
when nobody looks.

    with Recorder(tracker, columns=[0, 5]) as record:
        tracker.track(clip)
    record.steps[0].levels[1].support_from_context   # (S, 2, K + 1, K)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any

import torch
from torch import Tensor, nn

from tapip3d_lite.model.contexts import N2N
from tapip3d_lite.model.neighbors import Neighbors


@dataclass
class LevelRecord:
    """What happened at one level; n chosen queries, S frames. Attention is averaged over heads.

    Attributes:
        near: context neighbourhoods (S, n, K, ...), normalised coordinates.
        support_from_context: (S, n, K + 1, K), how support tokens look at context tokens.
        context_from_support: (S, n, K, K + 1).
        pool_support: (S, n, K + 1), weights of the pooling.
        pool_context: (S, n, K).
        support_tokens: (n, K + 1, D).
        context_tokens: (S, n, K, D).
    """

    near: Neighbors
    support_from_context: Tensor | None = None
    context_from_support: Tensor | None = None
    pool_support: Tensor | None = None
    pool_context: Tensor | None = None
    support_tokens: Tensor | None = None
    context_tokens: Tensor | None = None


@dataclass
class StepRecord:
    """One update of one window.

    Attributes:
        levels: one record a level.
        tokens: (S, n, width) trajectory tokens.
        coords: (S, n, 3) the estimate before the update, normalised.
        moved: (S, n, 3) the correction.
    """

    levels: list[LevelRecord] = field(default_factory=list)
    tokens: Tensor | None = None
    coords: Tensor | None = None
    moved: Tensor | None = None


class Recorder:
    """A context manager that records the chosen tracks of every update, for batches of one.

    Args:
        tracker: the tracker to watch.
        columns: which tracks, counted among those of a window (all of a clip's queries are in its last window, in
            their order, before the support grid).
    """

    def __init__(self, tracker: nn.Module, columns: Sequence[int]) -> None:
        self.tracker, self.columns = tracker, list(columns)
        self.steps: list[StepRecord] = []
        self._parts: list[list[tuple]] = []
        self._handles: list[Any] = []

    def __enter__(self) -> Recorder:
        tracker = self.tracker
        self._parts = [[] for _ in range(tracker.config.levels)]
        self._handles = [
            tracker.context.register_forward_hook(self._see_context),
            tracker.updater.register_forward_hook(self._see_update),
        ]
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for handle in self._handles:
            handle.remove()

    def _see_context(self, module: nn.Module, inputs: tuple, output: Tensor) -> None:
        index, kept, near = inputs
        self._parts[index].append((kept.detach(), near))

    @torch.no_grad()
    def _see_update(self, module: nn.Module, inputs: tuple, output: Tensor) -> None:
        step = StepRecord()
        for index, parts in enumerate(self._parts):
            kept = torch.cat([kept for kept, _ in parts], 1)
            near = _joined([near for _, near in parts])
            chosen = [c for c in self.columns if c < kept.shape[1]]
            step.levels.append(self._level(index, kept[0, chosen], _chosen(near, chosen)))
            parts.clear()
        step.tokens = inputs[0][0, :, chosen]
        step.coords = near.center[0, :, chosen]
        step.moved = output[0, :, chosen, :3].float()
        self.steps.append(step)

    def _level(self, index: int, kept: Tensor, near: Neighbors) -> LevelRecord:
        context = self.tracker.context
        if not isinstance(context, N2N):
            return LevelRecord(near)
        pair = context.pairs[index % len(context.pairs)]
        tokens = near.features + context.embed.offset(index, near.offsets)
        support = kept[:, : kept.shape[1] - context.use_features].expand(len(tokens), -1, -1, -1)
        ways = pair.support_from_context, pair.context_from_support
        bags = ways[0](support, tokens), ways[1](tokens, support)
        looks = [
            way.attention.weights(way.norm(x), way.norm_context(y)).mean(-3)
            for way, x, y in zip(ways, (support, tokens), (tokens, support), strict=True)
        ]
        pools = [
            pool.attention.weights(pool.token.expand(*[1] * (bag.ndim - 2), 1, -1), bag).mean(-3).squeeze(-2)
            for pool, bag in zip((pair.pool_support, pair.pool_context), bags, strict=True)
        ]
        return LevelRecord(near, *looks, *pools, support[0], tokens)


def _chosen(near: Neighbors, columns: list[int]) -> Neighbors:
    indices = None if near.indices is None else near.indices[0, :, columns]
    return Neighbors(near.features[0, :, columns], near.points[0, :, columns], near.center[0, :, columns], indices)


def _joined(parts: list[Neighbors]) -> Neighbors:
    def join(name: str) -> Tensor | None:
        values = [getattr(part, name) for part in parts]
        return None if values[0] is None else torch.cat(values, 2)

    return Neighbors(*(join(name) for name in ("features", "points", "center", "indices")))
