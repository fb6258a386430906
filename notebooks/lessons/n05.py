"""Lesson 05: the token's parts, windows, a trajectory that converges, and a tracker with a part removed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor, nn

from lessons.checker import check
from lessons.guesses import reveal
from lessons.milestone import milestone
from lessons.n05_exercises import EXERCISES, hand_over
from lessons.pictures import pipeline, show
from lessons.progress import collect, in_use, progress, reset
from lessons.widgets import explore
from tapip3d_lite.clip import Clip
from tapip3d_lite.figures.flat import INK, check_drawable, draw_image, label_axes
from tapip3d_lite.geometry import project
from tapip3d_lite.model.blocks import FACTOR, fourier
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.frames import frames_from_clip
from tapip3d_lite.model.tracker import Tracker

__all__ = [
    "EXERCISES",
    "check",
    "collect",
    "converging",
    "explore",
    "film",
    "in_use",
    "milestone",
    "paired",
    "pipeline",
    "progress",
    "random_tracker",
    "reset",
    "reveal",
    "show",
    "time_in_turns",
    "time_ratios",
    "token_bar",
    "token_parts",
    "windows_chart",
    "without",
]

ESTIMATE, TRUTH = "#e8a33d", "#2b6cb0"
PARTS = ("motion", "virtual tracks")


def token_parts(config: TrackerConfig, width: int) -> dict[str, int]:
    """Channels of every part of the token; `width` is the context's width at one level."""
    levels = {f"context, level {i}": width for i in range(config.levels)}
    motion = {"motion to the next and the previous frame": 6 * FACTOR}
    return {"visibility": 1} | levels | motion | ({"pixel (u, v)": 2 * FACTOR} if config.use_uv else {})


def token_bar(parts: Mapping[str, int]) -> Figure:
    """A token as one bar, its parts side by side with their widths."""
    figure = Figure(figsize=(9.6, 1.9), layout="constrained")
    ax, start = figure.subplots(), 0
    for i, (name, width) in enumerate(parts.items()):
        ax.barh(0, width, left=start, color=f"C{i}", label=f"{name}: {width}", edgecolor="white")
        start += width
    ax.set_title(f"trajectory token: {start} channels", fontsize=9, color=INK)
    label_axes(ax, "", "channel")
    ax.set_yticks([])
    ax.set_xlim(0, start)
    figure.legend(*ax.get_legend_handles_labels(), ncols=4, fontsize=7, frameon=False, loc="outside lower center")
    return figure


def windows_chart(frames: int, window: int, starts: Sequence[int], times: Sequence[int] = ()) -> Figure:
    """Windows over time: what is handed over in blue, what is new in orange; queries as stars in their first window.

    Args:
        frames: T.
        window: S.
        starts: the windows' first frames.
        times: query frames.
    """
    figure = Figure(figsize=(9.6, 0.4 * len(starts) + 1.2), layout="constrained")
    ax, half = figure.subplots(), window // 2
    for row, start in enumerate(starts):
        ax.barh(row, half, left=start - 0.5, color=ESTIMATE if row == 0 else TRUTH, alpha=0.8, edgecolor="white")
        ax.barh(row, half, left=start + half - 0.5, color=ESTIMATE, alpha=0.8, edgecolor="white")
        mine = [t for t in times if t < start + window and (row == 0 or t >= start + half)]
        ax.plot(mine, [row] * len(mine), "*", color=INK, ms=10)
    ax.axvline(frames - 0.5, color=INK, ls="--", lw=1)
    ax.set_yticks(range(len(starts)))
    ax.invert_yaxis()
    label_axes(ax, "window", "frame (dashed: the clip's end)")
    return figure


@dataclass(frozen=True)
class Film:
    """All estimates of a forward pass.

    Attributes:
        starts: first frame of each window.
        xyz: per window (M + 1, S, n, 3) world: what it begins with, then after each update.
        columns: per window (n,), its tracks.
        truth: (T, N, 3) true tracks of the queries, world.
    """

    starts: list[int]
    xyz: list[np.ndarray]
    columns: list[np.ndarray]
    truth: np.ndarray

    def errors(self, window: int, track: int) -> np.ndarray:
        """Distances (M + 1, frames) of one track from the truth in a window's real frames from its query on.

        Raises:
            ValueError: the window does not contain the track.
        """
        path, start = self.path(window, track), self.starts[window]
        truth = self.truth[start : start + path.shape[1], track]
        return np.linalg.norm(path[:, : len(truth)] - truth, axis=-1)

    def path(self, window: int, track: int) -> np.ndarray:
        """Estimates (M + 1, S, 3) of one track; `ValueError` where the window does not contain the track."""
        if not 0 <= window < len(self.starts) or track not in self.columns[window]:
            raise ValueError(f"window: expected one with track {track}, got {window}; take a later one")
        return self.xyz[window][:, :, list(self.columns[window]).index(track)]


@torch.no_grad()
def film(tracker: nn.Module, clip: Clip, queries: np.ndarray, truth: np.ndarray) -> Film:
    """Run a tracker of the world space forward and keep every estimate.

    Args:
        tracker: a `Tracker`.
        clip: at the tracker's image size.
        queries: (N, 4) world.
        truth: (T, N, 3) world.
    """
    frames = frames_from_clip(clip, tracker.config.image_size)
    starts: list[int] = []
    shots: list[list[np.ndarray]] = []
    columns: list[np.ndarray] = []
    window = tracker.config.window
    whole = np.repeat(queries[None, :, 1:], window, 0)  # the window before, all tracks
    for step in tracker.steps(frames, torch.from_numpy(queries)[None], space="world"):
        if step.iteration == 0:
            which = step.columns.numpy()
            begin = hand_over(whole, queries, step.start) if starts else whole
            starts.append(step.start)
            columns.append(which)
            shots.append([begin[:, which]])
        shots[-1].append(step.xyz[0].numpy())
        whole = np.repeat(queries[None, :, 1:], window, 0)
        whole[:, columns[-1]] = shots[-1][-1]
    return Film(starts, [np.stack(s) for s in shots], columns, truth)


def converging(clip: Clip, shown: Film, track: int = 0, window: int = 0, iteration: int = 0) -> Figure:
    """One trajectory after some updates: in the image, from above, and its error frame by frame so far.

    Args:
        clip: the clip.
        shown: from `film`.
        track: row of the queries.
        window: which window.
        iteration: 0 is what the window begins with.

    Raises:
        ValueError: no such track, window or iteration.
    """
    path, errors, start = shown.path(window, track), shown.errors(window, track), shown.starts[window]
    if not 0 <= iteration < len(path):
        raise ValueError(f"iteration: expected 0 to {len(path) - 1}, got {iteration}; choose another")
    span = slice(start, start + errors.shape[1])
    last = span.stop - 1
    check_drawable(clip, frame=last)
    figure = Figure(figsize=(9.8, 3.0), layout="constrained")
    image, top, error = figure.subplots(1, 3)
    draw_image(image, clip.video[last], f"frame {last}, track {track}")
    truth, now = shown.truth[span, track], path[iteration, : errors.shape[1]]
    for xyz, color, name in ((truth, TRUTH, "truth"), (now, ESTIMATE, f"after {iteration} updates")):
        uv, _ = project(xyz[:, None], clip.intrinsics[span], clip.extrinsics[span])  # each frame by its camera
        image.plot(*uv[:, 0].T, ".-", color=color, lw=1.5, ms=4)
        top.plot(*xyz[:, :2].T, ".-", color=color, lw=1.5, ms=5, label=name)
    label_axes(top, "y (m)", "x (m)")
    everything = np.concatenate([path[:, : len(truth)].reshape(-1, 3), truth])[:, :2]
    middle, reach = (everything.min(0) + everything.max(0)) / 2, np.ptp(everything, axis=0).max() / 2 * 1.1 + 1e-3
    top.set_xlim(middle[0] - reach, middle[0] + reach)
    top.set_ylim(middle[1] - reach, middle[1] + reach)
    top.set_aspect("equal")
    top.locator_params(nbins=4)
    top.legend(fontsize=7, frameon=False)
    top.set_title(f"window {window}, from above", fontsize=8, color=INK)
    for i in range(iteration + 1):
        strength = 0.25 + 0.75 * (i == iteration)
        error.plot(range(*span.indices(len(clip))), 100 * errors[i], ".-", color=ESTIMATE, alpha=strength)
    error.set_ylim(0, 105 * errors.max() + 1e-3)
    error.set_title(f"mean {100 * errors[iteration].mean():.1f} cm", fontsize=8, color=INK)
    label_axes(error, "error (cm)", "frame")
    return figure


def paired(differences: Mapping[str, np.ndarray], xlabel: str) -> Figure:
    """Differences clip by clip as dots, with their mean and its 95 % interval; a row an entry."""
    figure = Figure(figsize=(7.6, 0.45 * len(differences) + 0.9), layout="constrained")
    ax = figure.subplots()
    for row, values in enumerate(differences.values()):
        error = 1.96 * np.std(values, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else None
        ax.plot(values, [row] * len(values), "o", color=TRUTH, alpha=0.4, ms=4)
        ax.errorbar(np.mean(values), row, xerr=error, fmt="D", color=INK, ms=5, capsize=3)
    ax.axvline(0, color=INK, lw=0.8, ls="--")
    label_axes(ax, "", xlabel)
    ax.set_yticks(range(len(differences)), list(differences), fontsize=8)
    ax.set_ylim(len(differences) - 0.5, -0.5)
    return figure


@contextmanager
def without(tracker: nn.Module, part: str) -> Iterator[nn.Module]:
    """A tracker whose updater lacks one part while the context lasts.

    Args:
        tracker: with the updater `transformer`.
        part: `"motion"`: every token says that the point stands still; `"virtual tracks"`: points read nothing from them.

    Raises:
        ValueError: no such part.
    """
    if part not in PARTS:
        raise ValueError(f"part: expected one of {', '.join(PARTS)}; got {part!r}")
    if part == "motion":
        # Here the hooks' values are the point: they take the place of what the parts are given, or return.
        handles = [tracker.updater.register_forward_pre_hook(lambda _, inputs: _still(tracker, *inputs))]
    else:
        handles = [block.register_forward_hook(lambda _, inputs, out: inputs[0]) for block in tracker.updater.scatter]
    try:
        yield tracker
    finally:
        for handle in handles:
            handle.remove()


def random_tracker(fast: bool, **changes: Any) -> Tracker:
    """A `lite` tracker with changed settings and random weights, always the same ones: fast, or its clear form."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return Tracker(TrackerConfig.preset("lite", **changes), fast).eval()


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


def _still(tracker: nn.Module, tokens: Tensor, active: Tensor | None) -> tuple[Tensor, Tensor | None]:
    start = 1 + tracker.config.levels * tracker.context.width
    channels, tokens = slice(start, start + 6 * FACTOR), tokens.clone()
    tokens[..., channels] = fourier(tokens.new_zeros(6)) + tracker.time[:, None, channels]
    return tokens, active
