"""Lesson 05's film: every estimate of a window, update by update, and how it is drawn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import nn

from lessons.n05_windows import hand_over
from tapip3d_lite.clip import Clip
from tapip3d_lite.figures.flat import INK, check_drawable, draw_image, label_axes
from tapip3d_lite.geometry import project
from tapip3d_lite.model.frames import frames_from_clip

ESTIMATE, TRUTH, START = "#d55e00", "#0072b2", "#e69f00"


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
def film(
    tracker: nn.Module, clip: Clip, queries: np.ndarray, truth: np.ndarray, handed: Callable[..., tuple] = hand_over
) -> Film:
    """Run a tracker of the world space forward and keep every estimate.

    Args:
        tracker: a `Tracker`.
        clip: at the tracker's image size.
        queries: (N, 4) world.
        truth: (T, N, 3) world.
        handed: what a window begins with, as the exercise `05.hand_over`.
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
            begin = handed(whole, np.zeros(whole.shape[:2]), queries, step.start)[0] if starts else whole
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
    figure = Figure(figsize=(10.2, 3.2), layout="constrained")
    image, top, error = figure.subplots(1, 3)
    draw_image(image, clip.video[last], f"frame {last}, track {track}")
    truth, now = shown.truth[span, track], path[iteration, : errors.shape[1]]
    for xyz, color, mark, name in ((truth, TRUTH, "o", "truth"), (now, ESTIMATE, "x", f"after {iteration} updates")):
        uv, _ = project(xyz[:, None], clip.intrinsics[span], clip.extrinsics[span])  # each frame by its camera
        image.plot(*uv[:, 0].T, f"{mark}-", color=color, lw=1.5, ms=4)
        top.plot(*xyz[:, :2].T, f"{mark}-", color=color, lw=1.5, ms=5, label=name)
    label_axes(top, "y (m)", "x (m)")
    everything = np.concatenate([path[:, : len(truth)].reshape(-1, 3), truth])[:, :2]
    middle, reach = (everything.min(0) + everything.max(0)) / 2, np.ptp(everything, axis=0).max() / 2 * 1.1 + 1e-3
    top.set_xlim(middle[0] - reach, middle[0] + reach)
    top.set_ylim(middle[1] - reach, middle[1] + reach)
    top.set_aspect("equal")
    top.locator_params(nbins=4)
    top.legend(fontsize=8, frameon=False)
    top.set_title(f"window {window}, from above", fontsize=9, color=INK)
    for i in range(iteration + 1):
        strength = 0.25 + 0.75 * (i == iteration)
        error.plot(range(*span.indices(len(clip))), 100 * errors[i], "x-", color=ESTIMATE, alpha=strength)
    error.set_ylim(0, 105 * errors.max() + 1e-3)
    error.set_title(f"mean {100 * errors[iteration].mean():.1f} cm", fontsize=9, color=INK)
    label_axes(error, "error (cm)", "frame")
    return figure
