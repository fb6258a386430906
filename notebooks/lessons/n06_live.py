"""Watching a tracker learn: learning curves, a live picture with a stop button, and learnt tracks beside the truth."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping, Sequence
from typing import Any

import ipywidgets as widgets
import numpy as np
from IPython.display import display
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lessons.n02_figures import MOVING, STILL
from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.figures import png_bytes
from tapip3d_lite.figures.flat import INK, _image, _plot, check_drawable
from tapip3d_lite.geometry import project
from tapip3d_lite.lab.train import interruptible
from tapip3d_lite.training.journal import read_log
from tapip3d_lite.training.trainer import Trainer

Line = Mapping[str, Any]
_SERIES = {"apd": ("all points", STILL), "apd_dynamic": ("moving points", MOVING)}


def learning_curve(
    lines: Sequence[Line], zero_motion: Mapping[str, float] | None = None, by: str = "step", window: int = 100
) -> Figure:
    """How a training went: matching of the encoder, loss, and APD3D on examples (lines) and held-out clips (dots).

    Args:
        lines: of the log, from `read_log` or collected by `Trainer.run(watch=...)`; may be empty.
        zero_motion: scores of zero motion on the held-out clips, drawn dashed: `APD3D_none`, `APD3D_none_dynamic`.
        by: horizontal axis, `"step"` or `"minutes"` of training.
        window: steps over which the bold lines are averaged; the raw values stay behind them.

    Raises:
        ValueError: another `by`, or a window of no step.
    """
    return learning_curves([("", lines)], zero_motion, by, window)


def learning_curves(
    logs: Sequence[tuple[str, Sequence[Line]]],
    zero_motion: Mapping[str, float] | None = None,
    by: str = "step",
    window: int = 100,
) -> Figure:
    """The learning curves of several trainings, one row each.

    Args:
        logs: (name, lines) of each training.
        zero_motion: see `learning_curve`; of all of them.
        by: see `learning_curve`.
        window: see `learning_curve`.

    Raises:
        ValueError: as `learning_curve`.
    """
    if by not in ("step", "minutes") or window < 1:
        raise ValueError(f'learning_curve: expected by="step" or "minutes", window >= 1, got {by!r}, {window}')
    figure = Figure(figsize=(11, 2.9 * len(logs)), layout="constrained")
    rows = figure.subplots(len(logs), 3, squeeze=False)
    for axes, (name, lines) in zip(rows, logs, strict=True):
        _row(axes, lines, zero_motion, by, window)
        if name:
            axes[0].set_ylabel(f"{name}\n\n{axes[0].get_ylabel()}", fontsize=8)
    return figure


def _row(
    axes: Sequence[Axes], lines: Sequence[Line], zero_motion: Mapping[str, float] | None, by: str, window: int
) -> None:
    stages = [[line for line in lines if line["stage"] == name] for name in ("matching", "tracking")]
    _curve(axes[0], stages[0], "right", by, window, INK)
    _curve(axes[1], stages[1], "loss", by, window, INK)
    for name, (label, color) in _SERIES.items():
        _curve(axes[2], stages[1], name, by, window, color, label)
        _held_out(axes[2], stages[1], name.replace("apd", "APD3D_none"), by, zero_motion or {}, color)
    titles = (
        "the encoder learns to match",
        "the tracker learns to track",
        "bold: examples · dots: held out · dashed: zero motion",
    )
    labels = "right within 1.5 cells", "loss", "APD3D"
    for ax, title, label in zip(axes, titles, labels, strict=True):
        _plot(ax, label, by)
        ax.set_title(title, fontsize=8, color=INK)
    if stages[1] and not stages[0]:
        axes[0].text(0.5, 0.5, "as it was", ha="center", color=INK, fontsize=8, transform=axes[0].transAxes)
        axes[0].set(xticks=[], yticks=[])
    axes[0].set_ylim(0, 1)
    axes[2].set_ylim(0, 1)
    if stages[1]:
        axes[1].set_yscale("log")
        axes[1].tick_params(which="minor", labelsize=7)
        axes[2].legend(fontsize=7, frameon=False, loc="upper left")


def tracks_and_truth(clip: Clip, pred: Tracks, frames: Sequence[int] | None = None) -> Figure:
    """Learnt tracks next to the truth, in the image: above the truth, below the estimate and what it misses by.

    Args:
        clip: with true tracks of the same queries.
        pred: what the tracker says.
        frames: frame indices; three after the first by default.

    Raises:
        ValueError: the clip has no truth, or the tracks are of other queries.
    """
    if clip.tracks is None or clip.tracks.xyz.shape != pred.xyz.shape:
        raise ValueError(f"tracks_and_truth: expected true tracks of the same queries in clip {clip.name!r}")
    last = len(clip) - 1
    frames = [last // 3, 2 * last // 3, last] if frames is None else list(frames)
    figure = Figure(figsize=(3.1 * len(frames), 6.2), layout="constrained")
    axes = figure.subplots(2, len(frames), squeeze=False)
    for column, t in enumerate(frames):
        check_drawable(clip, frame=t)
        for ax, tracks, word in ((axes[0, column], clip.tracks, "truth"), (axes[1, column], pred, "learnt")):
            _image(ax, clip.video[t], f"{word} · frame {t}")
            _moves(ax, clip, tracks, t, clip.tracks if tracks is pred else None)
    return figure


class LivePlot:
    """A picture of a running training and a button that stops it.

    Attributes:
        box: the widget to display.
        lines: of the log, in order; add to it, then `draw`.
    """

    def __init__(self, lines: Sequence[Line] = (), zero_motion: Mapping[str, float] | None = None) -> None:
        """Show what there is already.

        Args:
            lines: of the log so far.
            zero_motion: see `learning_curve`.
        """
        self.lines, self.zero_motion = list(lines), zero_motion
        self._pressed, self._begun = False, time.monotonic()
        # An image, not an Output: programs that run notebooks (nbclient) may wait long for messages that Outputs send.
        self.picture, self.words = widgets.Image(format="png"), widgets.Label()
        self.button = widgets.Button(description="Stop", icon="stop", tooltip="Stop after this step; all is kept")
        self.button.on_click(lambda _: self.press())
        self.box = widgets.VBox([widgets.HBox([self.button, self.words]), self.picture])
        self.draw()

    def press(self) -> None:
        """What the button does."""
        self._pressed = True
        self.button.disabled = True

    @property
    def stopped(self) -> bool:
        """Whether the button was pressed."""
        return self._pressed

    def draw(self) -> None:
        """Draw all lines now."""
        self.picture.value = png_bytes(learning_curve(self.lines, self.zero_motion))
        if self.lines:
            last, minutes = self.lines[-1], (time.monotonic() - self._begun) / 60
            self.words.value = f"{last['stage']}, step {last['step']}, {minutes:.1f} min"


async def train_live(
    trainer: Trainer, minutes: float, zero_motion: Mapping[str, float] | None = None, every: float = 5.0
) -> list[Line]:
    """Train in a notebook's cell, watched: until the end, the time is up, Stop, or "Kernel, Interrupt".

    To be awaited: between two steps the kernel listens to the button. It is the cell's own thread that trains; in
    another one a step takes twice as long on two cores, as OpenMP then lets its two teams of threads sleep instead of
    waiting awake. Whatever ends the training, everything is saved, and the same call goes on from there.

    Args:
        trainer: as it stands.
        minutes: at most, of wall-clock time.
        zero_motion: see `learning_curve`.
        every: seconds between two drawings, at least; more where drawing would take more than a twentieth of the time.

    Returns:
        All lines of the log.

    Raises:
        FloatingPointError: see `Trainer.run`.
    """
    log = trainer.journal.folder / "log.jsonl"
    live = LivePlot(read_log(log) if log.exists() else (), zero_motion)
    end = time.monotonic() + 60 * minutes
    due = time.monotonic() + every
    display(live.box)
    try:
        with interruptible() as interrupted:
            for line in trainer.steps(lambda: live.stopped or interrupted() or time.monotonic() > end):
                live.lines.append(line)
                begun = time.monotonic()
                if begun > due:
                    live.draw()
                    due = time.monotonic() + max(every, 20 * (time.monotonic() - begun))
                await asyncio.sleep(0.001)
    finally:
        live.button.disabled = True
        live.draw()
    return live.lines


def _curve(
    ax: Axes, lines: Sequence[Line], name: str, by: str, window: int, color: str, label: str | None = None
) -> None:
    known = [line for line in lines if line.get(name) is not None]
    if not known:
        return
    x, y = _axis(known, by), np.array([line[name] for line in known])
    sums = np.concatenate([[0.0], np.cumsum(y)])
    stops = np.arange(1, len(y) + 1)
    starts = np.maximum(stops - window, 0)
    ax.plot(x, y, color=color, lw=0.4, alpha=0.25)
    ax.plot(x, (sums[stops] - sums[starts]) / (stops - starts), color=color, lw=1.8, label=label)


def _held_out(
    ax: Axes, lines: Sequence[Line], name: str, by: str, zero_motion: Mapping[str, float], color: str
) -> None:
    scored = [line for line in lines if f"val_{name}" in line]
    values = [line[f"val_{name}"] for line in scored]
    ax.plot(_axis(scored, by), values, "o", color=color, ms=5, mec="white", mew=0.6)
    if name in zero_motion:
        ax.axhline(zero_motion[name], color=color, lw=1, ls="--")


def _axis(lines: Sequence[Line], by: str) -> np.ndarray:
    return np.array([line["step"] if by == "step" else line["seconds"] / 60 for line in lines])


def _moves(ax: Axes, clip: Clip, tracks: Tracks, t: int, truth: Tracks | None) -> None:
    """Paths in the world from each query to frame t, seen by the camera of frame t; moving points that it shows."""
    mask = clip.tracks.visible[t] & (clip.tracks.queries[:, 0] <= t)
    dynamic = np.ones(len(mask), bool) if clip.tracks.dynamic is None else clip.tracks.dynamic
    camera = [np.repeat(x[t : t + 1], t + 1, 0) for x in (clip.intrinsics, clip.extrinsics)]
    for n in np.flatnonzero(mask & dynamic):
        start = int(clip.tracks.queries[n, 0])
        uv = project(tracks.xyz[start : t + 1, n : n + 1], *(x[start:] for x in camera))[0][:, 0]
        ax.plot(*uv.T, color="white", lw=0.8, alpha=0.8)
        ax.plot(*uv[-1], "o", color=MOVING, ms=3.5, mec="white", mew=0.4)
        if truth is not None:
            goal = project(truth.xyz[t, n][None, None], camera[0][:1], camera[1][:1])[0][0, 0]
            ax.plot([uv[-1, 0], goal[0]], [uv[-1, 1], goal[1]], color="#ffd23f", lw=1.2)
    still = mask & ~dynamic
    uv = project(tracks.xyz[t : t + 1, still], camera[0][:1], camera[1][:1])[0][0]
    ax.plot(*uv.T, "o", color=STILL, ms=2.5, mec="white", mew=0.3)
