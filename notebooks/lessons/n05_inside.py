"""Lesson 05's look inside the updater: what it is given, how it looks over time, what it puts out; and parts removed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from unittest import mock

import numpy as np
import torch
from torch import Tensor, nn

from tapip3d_lite.clip import Clip
from tapip3d_lite.model import tracker as library
from tapip3d_lite.model.blocks import FACTOR, fourier
from tapip3d_lite.recorder import Recorder

REMOVALS = ("motion", "other tracks", "other frames", "whole block")


@dataclass(frozen=True)
class Inside:
    """What happened in a clip's first window, update by update; all queries lie in its first frame.

    Attributes:
        given: per update, the arguments (coords, logits, evidence, uv, size, time) of the tokens, for one clip.
        tokens: per update (S, N, G), the tokens themselves.
        x: per update, per group (S, N + V, U), what the group is given; one more at the end, after the last group.
        looks: (M, groups, N, heads, S, S), attention over time.
        xyz: (M + 1, S, N, 3), world: the queries, then the estimates after each update.
        vis: (M + 1, S, N), logits: 0, then after each update.
    """

    given: list[tuple]
    tokens: list[Tensor]
    x: list[list[Tensor]]
    looks: np.ndarray
    xyz: np.ndarray
    vis: np.ndarray


@torch.no_grad()
def inside(tracker: nn.Module, clip: Clip, queries: np.ndarray) -> Inside:
    """Track the first window of a clip and keep what the updater is given and does.

    Args:
        tracker: with the updater `transformer`.
        clip: at least a window long.
        queries: (N, 4) in frame 0.
    """
    updater, count = tracker.updater, len(queries)
    given, tokens, x, looks = [], [], [], []

    def assemble(*arguments: object) -> Tensor:
        given.append(tuple(a[0] if isinstance(a, Tensor) and a.ndim > 2 else a for a in arguments))
        tokens.append(make_tokens(*arguments))
        x.append([])
        looks.append([])
        return tokens[-1]

    def before(block: nn.Module, inputs: tuple[Tensor]) -> None:
        normed = block.norm(inputs[0][0])  # (N + V, S, U)
        x[-1].append(inputs[0][0].transpose(0, 1))
        looks[-1].append(block.attention.weights(normed, normed)[:count])

    make_tokens, window = library.trajectory_tokens, clip.cut(0, tracker.config.window)
    with ExitStack() as stack:
        stack.enter_context(mock.patch.object(library, "trajectory_tokens", assemble))
        for block in updater.time:
            stack.callback(block.register_forward_pre_hook(before).remove)
        last = updater.scatter[-1].register_forward_hook(lambda *call: x[-1].append(call[2][0]))
        stack.callback(last.remove)
        record = stack.enter_context(Recorder(tracker, range(count)))
        tracker.track(window, queries, support_grid=0, bidirectional=False)
    start = np.broadcast_to(queries[:, 1:], (tracker.config.window, count, 3))
    xyz = np.stack([start, *(step.xyz.numpy() for step in record.steps)])
    vis = np.stack([np.zeros(start.shape[:2]), *(step.logits.numpy() for step in record.steps)])
    weights = torch.stack([torch.stack(groups) for groups in looks]).numpy()
    return Inside(given, [t[0] for t in tokens], x, weights, xyz, vis)


def hearing(group: Callable[..., Tensor], x: Tensor, count: int, blocks: tuple) -> np.ndarray:
    """(N, N): how strongly a small change of point j's token moves point i's, in the same frame, by gradients.

    Args:
        group: as the exercise `05.group`.
        x: tokens (S, N + V, U).
        count: N.
        blocks: attention over time, then to read, to talk and to write.
    """
    x = x.clone().requires_grad_()
    out = group(x, count, *blocks)
    direction = torch.randn(out.shape[-1], generator=torch.Generator().manual_seed(0), dtype=out.dtype)
    rows = []
    for i in range(count):
        (grad,) = torch.autograd.grad((out[-1, i] * direction).sum(), x, retain_graph=True)
        rows.append(grad[-1, :count].norm(dim=-1))
    return torch.stack(rows).numpy()


@contextmanager
def without(tracker: nn.Module, part: str) -> Iterator[nn.Module]:
    """A tracker whose updater lacks one part while the context lasts.

    Args:
        tracker: with the updater `transformer`.
        part: `"motion"`: every token says that the point stands still; `"other tracks"`: each point is solved alone,
            the virtual tracks hear nobody else; `"other frames"`: each frame is solved alone; `"whole block"`: the
            block in which points read the virtual tracks is taken out, with its MLP.

    Raises:
        ValueError: no such part.
    """
    if part not in REMOVALS:
        raise ValueError(f"part: expected one of {', '.join(REMOVALS)}; got {part!r}")
    updater, whole = tracker.updater, tracker.updater.forward

    def changed(tokens: Tensor, active: Tensor | None = None) -> Tensor:
        if part == "motion":
            return whole(_still(tracker, tokens), active)
        batch, frames, count, width = tokens.shape
        if part == "other tracks":
            one = tokens.transpose(1, 2).reshape(batch * count, frames, 1, width)
            return whole(one).reshape(batch, count, frames, -1).transpose(1, 2)
        one = tokens.reshape(batch * frames, 1, count, width)
        mask = None if active is None else active.repeat_interleave(frames, 0)
        return whole(one, mask).reshape(batch, frames, count, -1)

    with ExitStack() as stack:
        if part == "whole block":
            for block in updater.scatter:
                stack.callback(block.register_forward_hook(lambda _, inputs, out: inputs[0]).remove)
        else:
            stack.enter_context(mock.patch.object(updater, "forward", changed))
        yield tracker


def _still(tracker: nn.Module, tokens: Tensor) -> Tensor:
    start = 1 + tracker.config.levels * tracker.context.width
    channels, tokens = slice(start, start + 6 * FACTOR), tokens.clone()
    tokens[..., channels] = fourier(tokens.new_zeros(6)) + tracker.time[:, None, channels]
    return tokens
