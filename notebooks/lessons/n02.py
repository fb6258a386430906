"""Lesson 02: paths side by side in different coordinate spaces, and one path with its best simple fit."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lessons.checker import check
from lessons.guesses import reveal
from lessons.milestone import milestone
from lessons.n02_exercises import EXERCISES
from lessons.n02_straightness import SPACES, bend, fit_windows, rotations, stays_in_view, to_space
from lessons.pictures import pipeline, show
from lessons.progress import collect, in_use, progress, reset
from lessons.widgets import explore
from tapip3d_lite.clip import Clip
from tapip3d_lite.figures.flat import INK, MOVING, STILL, draw_image, label_axes

__all__ = [
    "EXERCISES",
    "SPACES",
    "bend",
    "check",
    "collect",
    "explore",
    "fit_windows",
    "in_use",
    "milestone",
    "motion_fit",
    "paths_in_spaces",
    "pipeline",
    "progress",
    "reset",
    "reveal",
    "rotations",
    "show",
    "stays_in_view",
    "to_space",
]

FIT = "#e8a33d"
LABELS = {
    "uvd": ("u (px)", "v (px)", "depth"),
    "uvlogd": ("u (px)", "v (px)", "f log d (px)"),
    "camera": ("x right", "y down", "z forward"),
    "world": ("x", "y", "z up"),
}


def paths_in_spaces(clip: Clip, still: np.ndarray, moving: np.ndarray) -> Figure:
    """The same paths in the image, from above in camera coordinates, and from above in the world.

    Args:
        clip: a clip with true tracks whose world has z up.
        still: indices of tracks to draw in blue.
        moving: indices of tracks to draw in red.
    """
    figure = Figure(figsize=(10.2, 3.2), layout="constrained")
    axes = figure.subplots(1, 3)
    draw_image(axes[0], clip.video[-1], "image: u, v")
    views = (("uvd", (0, 1)), ("camera", (0, 2)), ("world", (0, 1)))
    for ax, (space, pair) in zip(axes, views, strict=True):
        coords = to_space(clip.tracks.xyz, clip.intrinsics, clip.extrinsics, space)
        for which, color in ((still, STILL), (moving, MOVING)):
            for n in which:
                path = coords[:, n][:, list(pair)]
                ax.plot(*path.T, color=color, lw=1.3)
                ax.plot(*path[-1], "o", color=color, ms=3.5, mec="white", mew=0.4)
        if space != "uvd":
            label_axes(ax, f"{LABELS[space][pair[1]]} (m)", f"{LABELS[space][pair[0]]} (m)")
            ax.set_aspect("equal", adjustable="datalim")
            ax.set_title(f"{space}, from above", fontsize=8, color=INK)
    return figure


def motion_fit(
    clip: Clip, track: int = 0, frame: int = 0, space: str = "world", window: int = 5, degree: int = 1
) -> Figure:
    """One true path in one space, coordinate by coordinate, with the best fit to the window that starts at a frame.

    Args:
        clip: a clip with true tracks.
        track: index of the track.
        frame: the window's first frame; moved back where the window would run past the end.
        space: "uvd", "uvlogd", "camera" or "world".
        window: S, frames.
        degree: of the fit: 0 rest, 1 constant velocity, 2 constant acceleration.
    """
    start = min(frame, len(clip) - window)
    xyz = clip.tracks.xyz[:, track : track + 1]
    coords = to_space(xyz, clip.intrinsics, clip.extrinsics, space)[:, 0]
    fit = fit_windows(coords[:, None], window, degree)[start, :, 0]
    error = bend(xyz, clip.intrinsics, clip.extrinsics, space, window, degree)[start, 0]
    figure = Figure(figsize=(10.2, 2.5), layout="constrained")
    axes = figure.subplots(1, 4)
    draw_image(axes[0], clip.video[start], f"{clip.name} · frame {start}")
    _mark(axes[0], clip, track, start)
    for i, ax in enumerate(axes[1:]):
        ax.axvspan(start, start + window - 1, color="#000", alpha=0.06, lw=0)
        ax.plot(coords[:, i], ".-", color=STILL, lw=1, ms=4, label="truth")
        ax.plot(np.arange(start, start + window), fit[:, i], "--", color=FIT, lw=2, label=f"fit, degree {degree}")
        label_axes(ax, LABELS[space][i], "frame")
        _widen(ax, 0.2 if LABELS[space][i] in (*LABELS["camera"], *LABELS["world"], "depth") else 3.0)
    axes[1].legend(fontsize=7, frameon=False)
    axes[2].set_title(f"{space}: the fit misses the truth by {100 * error:.1f} cm (RMS)", fontsize=9, color=INK)
    return figure


def _mark(ax: Axes, clip: Clip, track: int, frame: int) -> None:
    uvd = to_space(clip.tracks.xyz[:, track : track + 1], clip.intrinsics, clip.extrinsics, "uvd")[:, 0]
    ax.plot(*uvd[:, :2].T, color="white", lw=1)
    seen = clip.tracks.visible[frame, track]
    ax.plot(*uvd[frame, :2], "o", ms=7, mec="white", mfc=MOVING if seen else "none")


def _widen(ax: Axes, least: float) -> None:
    """Give a nearly constant curve an axis of at least this height, so that rounding does not look like motion."""
    low, high = ax.get_ylim()
    if high - low < least:
        middle = (low + high) / 2
        ax.set_ylim(middle - least / 2, middle + least / 2)
