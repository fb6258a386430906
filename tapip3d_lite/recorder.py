"""Look inside a tracker at work: neighbourhoods, attention, tokens and the path after every update.

A recorder stands around `Tracker.update` and computes anew, for a few tracks, what happens inside; so the tracker
carries no flags, keeps nothing, and is as fast as ever when nobody looks.

    with Recorder(tracker, columns=[0, 5]) as record:
        tracker.track(clip)
    record.steps[0].levels[1].support_from_context   # (S, 2, K + 1, K)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from tapip3d_lite.model.blocks import Block, Pool
from tapip3d_lite.model.n2n import N2N
from tapip3d_lite.model.neighbors import Neighbors
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.model.windows import Window, to_world
from tapip3d_lite.validate import checked
from tapip3d_lite.variants.p2n import P2N


@dataclass
class LevelRecord:
    """What happened at one level; n chosen tracks, S frames. Attention is averaged over heads; only the contexts
    `n2n` and `p2n` have it.

    Attributes:
        near: context neighbourhoods (S, n, K, ...), normalised coordinates; `indices` are cells of the frame.
        support: neighbourhoods in the query frame (n, 1 + K, ...), normalised; the query itself first, with index -1.
        support_from_context: (S, n, K + 1, K), how support tokens look at context tokens.
        context_from_support: (S, n, K, K + 1).
        pool_support: (S, n, K + 1), weights of the pooling.
        pool_context: (S, n, K).
        query_from_context: (S, n, K), in a tracker with the context `p2n`.
        support_tokens: (n, K + 1, D); of `p2n` the query's alone.
        context_tokens: (S, n, K, D).
    """

    near: Neighbors
    support: Neighbors
    support_from_context: Tensor | None = None
    context_from_support: Tensor | None = None
    pool_support: Tensor | None = None
    pool_context: Tensor | None = None
    query_from_context: Tensor | None = None
    support_tokens: Tensor | None = None
    context_tokens: Tensor | None = None


@dataclass
class StepRecord:
    """One update of one window.

    Attributes:
        start: the window's first frame, counted in the direction of the pass.
        columns: (n,) which of the chosen tracks this window contains.
        levels: one record a level.
        tokens: (S, n, width) trajectory tokens.
        coords: (S, n, 3) the estimate before the update, normalised.
        moved: (S, n, 3) the correction.
        logits: (S, n) visibility after the update.
        xyz: (S, n, 3) the estimate after the update, world.
    """

    start: int
    columns: list[int]
    levels: list[LevelRecord]
    tokens: Tensor
    coords: Tensor
    moved: Tensor
    logits: Tensor
    xyz: Tensor


class Recorder:
    """A context manager that records the chosen tracks of every update, for batches of one.

    Args:
        tracker: the tracker to watch.
        columns: which tracks: rows of the queries. A window that does not contain one yet records the others.
    """

    @checked
    def __init__(self, tracker: Tracker, columns: Sequence[int]) -> None:
        self.tracker, self.columns = tracker, list(columns)
        self.steps: list[StepRecord] = []

    def __enter__(self) -> Recorder:
        self._update = self.tracker.update
        self.tracker.update = self._watch
        return self

    def __exit__(self, *_: object) -> None:
        del self.tracker.update

    def _watch(self, window: Window, coords: Tensor, logits: Tensor) -> tuple[Tensor, Tensor]:
        inputs = []
        handle = self.tracker.updater.register_forward_pre_hook(lambda _, given: inputs.append(given[0]))
        try:
            after = self._update(window, coords, logits)
        finally:
            handle.remove()
        self._record(window, coords, after, inputs[0])
        return after

    @torch.no_grad()
    def _record(self, window: Window, coords: Tensor, after: tuple[Tensor, Tensor], tokens: Tensor) -> None:
        members = window.columns.tolist()
        columns = [column for column in self.columns if column in members]
        chosen = [members.index(column) for column in columns]
        before, new, logits, tokens = (x[:, :, chosen].detach() for x in (coords, *after, tokens))
        levels = [self._level(window, i, chosen, before) for i in range(len(window.levels))]
        xyz = to_world(window.norm.restore(new), window.scene.frames, window.scene.space)[0]
        states = tokens[0], before[0], (new - before)[0], logits[0]
        self.steps.append(StepRecord(window.scene.start, columns, levels, *states, xyz))

    def _level(self, window: Window, index: int, chosen: list[int], coords: Tensor) -> LevelRecord:
        scene, level = window.scene, window.levels[index]
        uv = scene.space.to_pixels(window.norm.restore(coords), scene.frames.intrinsics, scene.frames.extrinsics)
        near = _first(self.tracker.neighborhood(level, coords, level.cells(uv, scene.frames.size)))
        support = _first(window.support[index].pick(chosen))
        context = self.tracker.context
        if _computes_as(context, N2N):  # its clear form, whichever one the tracker computes with
            found = _look_at_n2n(context, index, N2N.describe(context, index, support), near)
        elif _computes_as(context, P2N):
            found = _look_at_p2n(context, index, context.describe(index, support), near)
        else:
            found = {}
        return LevelRecord(near, support, **found)


def _computes_as(context: nn.Module, kind: type) -> bool:
    """Whether a context is of this kind, and none of a user's that compares otherwise."""
    own = type(context).forward is kind.forward or type(context).__module__.startswith("tapip3d_lite.")
    return isinstance(context, kind) and own


def _look_at_n2n(context: N2N, index: int, kept: Tensor, near: Neighbors) -> dict[str, Tensor]:
    pair = context.pairs[index % len(context.pairs)]
    tokens = near.features + context.embed.offset(index, near.offsets)  # (S, n, K, D)
    support = kept[:, : kept.shape[1] - context.use_features]  # (n, K + 1, D)
    both = support.expand(len(tokens), -1, -1, -1)  # (S, n, K + 1, D)
    return {
        "support_from_context": _looks(pair.support_from_context, both, tokens),
        "context_from_support": _looks(pair.context_from_support, tokens, both),
        "pool_support": _pooled(pair.pool_support, pair.support_from_context(both, tokens)),
        "pool_context": _pooled(pair.pool_context, pair.context_from_support(tokens, both)),
        "support_tokens": support,
        "context_tokens": tokens,
    }


def _look_at_p2n(context: P2N, index: int, kept: Tensor, near: Neighbors) -> dict[str, Tensor]:
    tokens = near.features + context.embed.offset(index, near.offsets)  # (S, n, K, D)
    query = kept[:, None].expand(len(tokens), -1, -1, -1)  # (S, n, 1, D)
    weights = _looks(context.looks[index % len(context.looks)], query, tokens).squeeze(-2)
    return {"query_from_context": weights, "support_tokens": kept[:, None], "context_tokens": tokens}


def _looks(block: Block, x: Tensor, context: Tensor) -> Tensor:
    """How tokens x (..., X, D) look at their context (..., Y, D): (..., X, Y), the mean over heads."""
    return block.attention.weights(block.norm(x), block.norm_context(context)).mean(-3)


def _pooled(pool: Pool, bag: Tensor) -> Tensor:
    """Weights (..., X) of the pooling of a bag (..., X, D), the mean over heads."""
    return pool.attention.weights(pool.token.expand(*bag.shape[:-2], -1, -1), bag).mean(-3).squeeze(-2)


def _first(near: Neighbors) -> Neighbors:
    """The only clip of a batch."""
    return Neighbors(*(value if value is None else value[0] for value in vars(near).values()))
