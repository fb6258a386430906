"""What a training step costs: where its time goes, and how many bytes it keeps for the backward pass.

Paper, section 3.5 ("memory"): with the memory-saving backward memory grows neither with updates nor with windows.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import wraps
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from tests.bench.timing import stages
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.frames import frames_from_clip
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.simulate import simulate_clip
from tapip3d_lite.training.backward import plain_backward, saving_backward
from tapip3d_lite.training.recipe import TrainConfig
from tapip3d_lite.training.data import training_clips
from tapip3d_lite.training.loss import LossConfig, Truth
from tapip3d_lite.training.trainer import Trainer


class SavedBytes:
    """Counts the bytes that autograd keeps for backward while it is entered.

    Attributes:
        now: bytes kept at this moment; a tensor that two operations keep counts twice.
        most: the greatest number so far.
    """

    def __init__(self) -> None:
        self.now = self.most = 0

    def __enter__(self) -> SavedBytes:
        self._hooks = torch.autograd.graph.saved_tensors_hooks(lambda x: _Held(x, self), lambda held: held.tensor)
        self._hooks.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._hooks.__exit__(*error)


class _Held:
    def __init__(self, tensor: Tensor, counter: SavedBytes) -> None:
        self.tensor, self.counter, self.bytes = tensor.detach(), counter, tensor.numel() * tensor.element_size()
        counter.now += self.bytes
        counter.most = max(counter.most, counter.now)

    def __del__(self) -> None:
        self.counter.now -= self.bytes


def backward_memory(
    iterations: Sequence[int] = (1, 2, 4, 6),
    windows: Sequence[int] = (1, 2, 4),
    tracks: int = 48,
    preset: str = "lite",
    **changes: Any,
) -> list[dict[str, float]]:
    """Greatest number of bytes kept for backward in one step, with a frozen encoder, by both ways.

    Args:
        iterations: numbers of updates M, each with one window.
        windows: numbers of windows, each with the fewest updates.
        tracks: N.
        preset, changes: of the tracker.

    Returns:
        A row a setting: `iterations`, `windows`, `saving` and `plain` bytes.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        tracker = Tracker(TrackerConfig.preset(preset, **changes)).train()
    tracker.encoder.requires_grad_(False)
    settings = dict.fromkeys([*((m, windows[0]) for m in iterations), *((iterations[0], w) for w in windows)])
    ways = {"saving": saving_backward, "plain": plain_backward}
    return [
        {"iterations": m, "windows": w} | {name: _bytes_kept(way, tracker, m, w, tracks) for name, way in ways.items()}
        for m, w in settings
    ]


def _bytes_kept(way: Callable[..., Any], tracker: Tracker, iterations: int, windows: int, tracks: int) -> int:
    size, frames = tracker.config.image_size, (windows + 1) * tracker.config.window // 2
    clip = simulate_clip(seed=0, frames=frames, size=size, tracks=tracks)
    truth = Truth(
        torch.from_numpy(clip.tracks.xyz)[None],
        torch.from_numpy(clip.tracks.visible)[None],
        torch.from_numpy(clip.queries[:, 0]).long()[None],
    )
    tracker.zero_grad()
    with SavedBytes() as memory:
        queries = torch.from_numpy(clip.queries)[None]
        way(tracker, frames_from_clip(clip), queries, truth, LossConfig(), iterations=iterations)
    return memory.most


def step_split(config: TrainConfig, clips: Sequence[Path], steps: int = 10, warm: int = 3) -> dict[str, float]:
    """Median seconds of the parts of a tracking step, as a recipe starts (`short` examples).

    Args:
        config: the recipe; its matching stage is left out.
        clips: training clips.
        steps: that are measured.
        warm: steps before that are not; they also encode clips and keep their features.

    Returns:
        Seconds of `data`, `k-NN`, `context`, `updater`, `windows' support`, `backward`, `optimiser`, of `loss and the rest`
        (the first frames' neighbours are k-NN's), and of the `whole step`; with a trained encoder also of its forward pass.
    """
    count = max(config.steps, steps + warm)  # of fewer, fewer would be short
    config = replace(config, matching_steps=0, steps=count, validation=0, save_every=10**9)
    rows: list[dict[str, float]] = []
    with tempfile.TemporaryDirectory() as folder:
        trainer = Trainer(folder, config, clips)
        with _parts(trainer) as seconds:
            for _ in range(steps + warm):
                before, start = dict(seconds), perf_counter()
                trainer._one_step()
                whole = perf_counter() - start
                row = {name: value - before[name] for name, value in seconds.items()}
                rows.append(row | {"loss and the rest": whole - sum(row.values()), "whole step": whole})
    return {name: median(row[name] for row in rows[warm:]) for name in rows[0]}


@contextmanager
def _parts(trainer: Trainer) -> Iterator[dict[str, float]]:
    """Collect seconds by part; modules by their forward passes, the others by wrapping the calls."""
    tracker = trainer.tracker
    modules = {"k-NN": tracker.neighborhood, "context": tracker.context, "updater": tracker.updater}
    if trainer.config.train_encoder:
        modules["encoder"] = tracker.encoder
    calls = {
        "data": (trainer, "example"),
        "windows' support": (tracker, "window"),
        "backward": (torch.Tensor, "backward"),
        "optimiser": (trainer.optimizer, "step"),
    }
    with stages(modules) as seconds:
        seconds |= dict.fromkeys(calls, 0.0)
        kept = {name: getattr(owner, function) for name, (owner, function) in calls.items()}
        for name, (owner, function) in calls.items():
            setattr(owner, function, _timed(kept[name], name, seconds))
        try:
            yield seconds
        finally:
            for name, (owner, function) in calls.items():
                setattr(owner, function, kept[name])


def _timed(function: Callable[..., Any], name: str, seconds: dict[str, float]) -> Callable[..., Any]:
    @wraps(function)  # the learning rate's schedule recognises its optimiser by a mark on `step`
    def run(*arguments: Any, **options: Any) -> Any:
        start = perf_counter()
        try:
            return function(*arguments, **options)
        finally:
            seconds[name] += perf_counter() - start

    return run


def report(config: TrainConfig, folder: Path) -> str:
    """Both measurements of a recipe as Markdown; two clips are taken from a folder of training clips, or simulated."""
    large = config.tracker_config().image_size > (128, 128)
    split = step_split(config, training_clips(folder, 2, progress=False, workers=1, large=large))
    sizes = {name: value for name, value in config.tracker.items() if name != "iterations"}  # those are varied
    memory = backward_memory(tracks=config.sampling.tracks, preset=config.preset, **sizes)
    return f"{split_table(split)}\n\nKept for the backward pass:\n\n{memory_table(memory)}"


def split_table(seconds: dict[str, float]) -> str:
    """A Markdown table of `step_split`."""
    whole = seconds["whole step"]
    rows = [f"| {name} | {value * 1000:.1f} | {value / whole:.0%} |" for name, value in seconds.items()]
    return "\n".join(["| part of a step | ms | share |", "|---|---|---|", *rows])


def memory_table(rows: list[dict[str, float]]) -> str:
    """A Markdown table of `backward_memory`."""
    lines = ["| M | windows | saving, MB | plain, MB |", "|---|---|---|---|"]
    lines += [
        f"| {r['iterations']} | {r['windows']} | {r['saving'] / 1e6:.1f} | {r['plain'] / 1e6:.1f} |" for r in rows
    ]
    return "\n".join(lines)
