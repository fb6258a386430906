"""Lesson 06: watching a tracker learn, a live picture with a stop button, and learnt tracks beside the truth."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping, Sequence

import ipywidgets as widgets
import numpy as np
from IPython.display import display
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from lessons.backward_ways import plain_backward, saving_backward
from lessons.checker import check
from lessons.milestone import milestone
from lessons.n06_augmentations import TITLES, augmented, before_and_after, motion_paths
from lessons.n06_chain import Chain
from lessons.n06_exercises import EXERCISES
from lessons.n06_judge import (
    controls_figure,
    error_figure,
    errors,
    frozen,
    grey,
    lives_on,
    memory_figure,
    ratio,
    reveal,
    verdict,
)
from lessons.n06_setting import SMALL, follow, gpu_setting, judged_by, large_scene, setting, small_scene
from lessons.n06_step import apart, double, example, gradients, parts, training_step
from lessons.pictures import pipeline, show
from lessons.place import folder
from lessons.progress import collect, in_use, progress, reset
from lessons.saved_bytes import SavedBytes
from lessons.widgets import explore
from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.figures import png_bytes
from tapip3d_lite.figures.curves import Line, learning_curves
from tapip3d_lite.figures.flat import check_drawable, draw_image
from tapip3d_lite.geometry import project
from tapip3d_lite.lab.train import interruptible
from tapip3d_lite.training.run_folder import read_log
from tapip3d_lite.training.trainer import Trainer

__all__ = [
    "EXERCISES",
    "SMALL",
    "TITLES",
    "Chain",
    "SavedBytes",
    "apart",
    "augmented",
    "before_and_after",
    "check",
    "collect",
    "controls_figure",
    "double",
    "error_figure",
    "errors",
    "example",
    "explore",
    "folder",
    "follow",
    "frozen",
    "gpu_setting",
    "gradients",
    "grey",
    "in_use",
    "judged_by",
    "large_scene",
    "learning_curve",
    "lives_on",
    "memory_figure",
    "milestone",
    "motion_paths",
    "parts",
    "pipeline",
    "plain_backward",
    "progress",
    "ratio",
    "reset",
    "reveal",
    "saving_backward",
    "setting",
    "show",
    "small_scene",
    "tracks_and_truth",
    "train_live",
    "train_unseen",
    "training_step",
    "verdict",
]

_TRUTH, _LEARNT, _MISS, _STILL = "#009e73", "#d55e00", "#f0e442", "#56b4e9"  # of Okabe and Ito


def learning_curve(lines: Sequence[Line], zero_motion: Mapping[str, float] | None = None) -> Figure:
    """The learning curves of one training, from the lines of its log so far.

    Args:
        lines: of the log; may be empty.
        zero_motion: scores of zero motion on the held-out clips, drawn dashed: `APD3D_none`, `APD3D_none_dynamic`.
    """
    return learning_curves([("", lines)], zero_motion)


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
    figure = Figure(figsize=(3.4 * len(frames), 7.2), layout="constrained")
    axes = figure.subplots(2, len(frames), squeeze=False)
    for column, t in enumerate(frames):
        check_drawable(clip, frame=t)
        for ax, tracks, word in ((axes[0, column], clip.tracks, "truth"), (axes[1, column], pred, "learnt")):
            draw_image(ax, clip.video[t], f"{word} · frame {t}")
            _moves(ax, clip, tracks, t, clip.tracks if tracks is pred else None)
    marks = [
        Line2D([], [], marker="o", ls="", color=_TRUTH, mec="white", label="moving point, where it is"),
        Line2D([], [], marker="s", ls="", color=_LEARNT, mec="white", label="moving point, where the tracker says"),
        Line2D([], [], color=_MISS, lw=2, label="what it misses by"),
        Line2D([], [], marker="^", ls="", color=_STILL, mec="white", label="point at rest"),
    ]
    figure.legend(handles=marks, loc="outside lower center", ncols=2, frameon=True, facecolor="#8a919c", fontsize=9)
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
            zero_motion: scores of zero motion, drawn dashed.
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
        """Stop the training after its present step, as the button does."""
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
    trainer: Trainer, zero_motion: Mapping[str, float] | None = None, every: float = 5.0
) -> list[Line]:
    """Train in a notebook's cell, watched: until the recipe's end, Stop, or "Kernel, Interrupt".

    To be awaited: between two steps the kernel listens to the button. It is the cell's own thread that trains; in
    another one a step takes twice as long on two cores, as OpenMP then lets its two teams of threads sleep instead of
    waiting awake. Whatever ends the training, everything is saved, and the same call goes on from there.

    Args:
        trainer: as it stands.
        zero_motion: scores of zero motion, drawn dashed.
        every: seconds between two drawings, at least; more where drawing would take more than a twentieth of the time.

    Returns:
        All lines of the log.

    Raises:
        FloatingPointError: the loss is not finite; the trainer has saved the batch.
    """
    log = trainer.folder.path / "log.jsonl"
    live = LivePlot(read_log(log) if log.exists() else (), zero_motion)
    due = time.monotonic() + every
    display(live.box)
    try:
        with interruptible() as interrupted:
            for line in trainer.steps(lambda: live.stopped or interrupted()):
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


async def train_unseen(trainer: Trainer) -> int:
    """Train to the end without showing how it goes, since a guess is sealed; returns the number of steps of tracking.

    Stop by "Kernel, Interrupt": the training then ends where it is.
    """
    with interruptible() as interrupted:
        count = 0
        for line in trainer.steps(interrupted):
            count += line["stage"] == "tracking"
            await asyncio.sleep(0)
    return count


def _moves(ax: Axes, clip: Clip, tracks: Tracks, t: int, truth: Tracks | None) -> None:
    """Paths in the world from each query to frame t, seen by the camera of frame t; moving points that it shows."""
    mask = clip.tracks.visible[t] & (clip.tracks.queries[:, 0] <= t)
    dynamic = np.ones(len(mask), bool) if clip.tracks.dynamic is None else clip.tracks.dynamic
    camera = [np.repeat(x[t : t + 1], t + 1, 0) for x in (clip.intrinsics, clip.extrinsics)]
    color, mark = (_TRUTH, "o") if truth is None else (_LEARNT, "s")
    for n in np.flatnonzero(mask & dynamic):
        start = int(clip.tracks.queries[n, 0])
        uv = project(tracks.xyz[start : t + 1, n : n + 1], *(x[start:] for x in camera))[0][:, 0]
        ax.plot(*uv.T, color="white", lw=0.8, alpha=0.8)
        if truth is not None:
            goal = project(truth.xyz[t, n][None, None], camera[0][:1], camera[1][:1])[0][0, 0]
            ax.plot([uv[-1, 0], goal[0]], [uv[-1, 1], goal[1]], color=_MISS, lw=1.6)
        ax.plot(*uv[-1], mark, color=color, ms=4.5, mec="white", mew=0.5)
    still = mask & ~dynamic
    uv = project(tracks.xyz[t : t + 1, still], camera[0][:1], camera[1][:1])[0][0]
    ax.plot(*uv.T, "^", color=_STILL, ms=4, mec="white", mew=0.3)
