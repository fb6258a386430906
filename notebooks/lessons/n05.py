"""Lesson 05: the token's parts, the updater from inside, windows, a trajectory that converges, parts removed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lessons.checker import check
from lessons.guesses import reveal
from lessons.milestone import Use, milestone
from lessons.n05_digits import grown, without_waves
from lessons.n05_exercises import EXERCISES
from lessons.n05_figures import (
    corrections,
    cost_chart,
    growth_chart,
    heard,
    interval,
    looks_over_time,
    paired,
    token_bar,
    windows_chart,
)
from lessons.n05_film import converging, film
from lessons.n05_inside import hearing, inside, without
from lessons.pictures import pipeline, show
from lessons.progress import collect, in_use, progress, reset
from lessons.widgets import explore
from tapip3d_lite.model.blocks import FACTOR
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.windows import State

__all__ = [
    "BOTH_WAYS",
    "EXERCISES",
    "check",
    "collect",
    "converging",
    "corrections",
    "cost_chart",
    "explore",
    "film",
    "grown",
    "growth_chart",
    "heard",
    "hearing",
    "in_use",
    "inside",
    "interval",
    "looks_over_time",
    "milestone",
    "paired",
    "parts",
    "pipeline",
    "progress",
    "reset",
    "reveal",
    "show",
    "time_in_turns",
    "time_ratios",
    "token_bar",
    "token_parts",
    "windows_chart",
    "without",
    "without_waves",
]

BOTH_WAYS = True  # the milestone asks for points in all frames, and tracks them both ways in time


def parts(use: Use) -> dict[str, object]:
    """The exercises' functions at their places in the tracker, for clips that come one by one."""
    token, group = use("05.token"), use("05.group")
    starts, handed, joined = use("05.windows"), use("05.hand_over"), use("05.backward")

    def tokens(
        coords: Tensor, logits: Tensor, evidence: Tensor, uv: Tensor, size: tuple[int, int], time: Tensor
    ) -> Tensor:
        return token(coords[0], logits[0], evidence[0], uv[0], size, time.to(coords.dtype))[None]

    def forward(self: nn.Module, tokens: Tensor, active: Tensor | None = None) -> Tensor:
        count, x = tokens.shape[2], self.input(tokens[0])  # (S, N, U)
        x = torch.cat([x, self.virtual[0].to(x.dtype).expand(len(x), -1, -1)], 1)  # (S, N + V, U)
        for i, block in enumerate(self.time):
            if i % self.every:
                x = block(x.transpose(0, 1)).transpose(0, 1)
            else:
                j = i // self.every
                x = group(x, count, block, self.gather[j], self.mix[j], self.scatter[j])
        heads = [head(x[:, :count]) for head in (self.head, self.vis_head) if head is not None]
        return torch.cat(heads, -1)[None]

    def ends(frames: int, window: int) -> list[int]:
        return [int(start) + window for start in starts(frames, window)]

    def initial(self: State, start: int, stop: int, columns: Tensor) -> tuple[Tensor, Tensor]:
        before = slice(max(0, start - (stop - start) // 2), start + (stop - start) // 2 if start else stop)
        queries = torch.cat([self.times[0, :, None], self.queries[0]], -1)[columns]  # the first window has none before
        case = self.coords[0, before][:, columns], self.logits[0, before][:, columns], queries
        found = handed(*(x.numpy() for x in case), start)
        return tuple(torch.as_tensor(np.asarray(x)).to(self.coords.dtype)[None] for x in found)

    return {
        "tapip3d_lite.model.tracker:trajectory_tokens": tokens,
        "tapip3d_lite.model.updater:Transformer.forward": forward,
        "tapip3d_lite.model.tracker:window_ends": ends,
        "tapip3d_lite.model.windows:State.initial": initial,
        "lessons.milestone:both_ways": joined,
    }


def token_parts(config: TrackerConfig, width: int) -> dict[str, int]:
    """Channels of every part of the token; `width` is the context's width at one level."""
    levels = {f"evidence, level {i}": width for i in range(config.levels)}
    motion = {"motion to next and last frame": 6 * FACTOR}
    return {"visibility": 1} | levels | motion | ({"pixel": 2 * FACTOR} if config.use_uv else {})


def time_in_turns(calls: Mapping[str, Callable[[], Any]], rounds: int) -> dict[str, list[float]]:
    """Seconds of functions, by name, that take turns: other work on the machine then slows all of them alike.

    Args:
        calls: the functions; each runs once before, unmeasured.
        rounds: how often each is measured.
    """
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds + 1):
        for name, call in calls.items():
            start = perf_counter()
            call()
            seconds[name].append(perf_counter() - start)
    return {name: times[1:] for name, times in seconds.items()}


def time_ratios(slow: Sequence[float], fast: Sequence[float]) -> tuple[float, float, float]:
    """(minimum, median, maximum) of how many times longer `slow` took than `fast`, round by round."""
    values = [a / b for a, b in zip(slow, fast, strict=True)]
    return min(values), median(values), max(values)
