"""Rows of a study side by side: differences with intervals, score against cost, and the track on which two differ."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.figures.flat import INK, draw_image, label_axes
from tapip3d_lite.geometry import project

_VERDICTS = {"better": "#009e73", "worse": "#d55e00", "undecided": "#8a8f98"}  # of Okabe and Ito
_TRUTH, _ROWS = "#000000", ("#0072b2", "#d55e00")


def forest_figure(rows: Mapping[str, Mapping[str, Any]], against: str | None, metric: str) -> Figure:
    """Each row's mean with its interval (left), and its difference to a row, coloured by the verdict (right).

    Args:
        rows: by name: `mean`, `low`, `high`, and maybe `difference` (the same again) and `verdict`.
        against: the row that the others are compared with.
        metric: its name, for the axes.
    """
    figure = Figure(figsize=(9, 1.2 + 0.35 * len(rows)), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for y, one in enumerate(rows.values()):
        _interval(left, y, one, INK)
        if "difference" in one:
            _interval(right, y, one["difference"], _VERDICTS[one["verdict"]])
    right.axvline(0, color=INK, lw=0.8, ls="--")
    for ax, text in ((left, metric), (right, f"minus {against} (green better, orange worse, grey undecided)")):
        label_axes(ax, "", text)
    left.set_yticks(range(len(rows)), list(rows))
    left.set_ylim(len(rows) - 0.5, -0.5)
    return figure


def cost_figure(rows: Mapping[str, tuple[float, Mapping[str, float]]], cost: str, metric: str) -> Figure:
    """Score against cost: a dot with its interval for each row, which is (cost, `mean`, `low`, `high`)."""
    figure = Figure(figsize=(5.5, 4), layout="constrained")
    ax = figure.subplots()
    for name, (x, one) in rows.items():
        ax.plot([x, x], [one["low"], one["high"]], color=INK, lw=1.4, alpha=0.7)
        ax.plot(x, one["mean"], "o", color=INK, ms=5)
        ax.annotate(name, (x, one["mean"]), xytext=(5, 3), textcoords="offset points", fontsize=8)
    label_axes(ax, metric, cost)
    return figure


def where_they_differ(seen: Mapping[str, tuple[Clip, Tracks]]) -> Figure:
    """The track on which two rows differ most: in four frames of the clip, and their 3D errors over time.

    Args:
        seen: of two rows by name: the clip as the row saw it, with true tracks, and the row's tracks.
    """
    errors = [np.linalg.norm(tracks.xyz - clip.tracks.xyz, axis=-1) for clip, tracks in seen.values()]  # (T, N)
    shown = next(iter(seen.values()))[0]
    gap = np.where(shown.tracks.visible, np.abs(errors[0] - errors[1]), 0)
    n = int(gap.mean(0).argmax())
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    grid = figure.add_gridspec(2, 4, height_ratios=[1.6, 1])
    for column, t in enumerate(np.linspace(0, len(shown) - 1, 4).astype(int)):
        ax = figure.add_subplot(grid[0, column])
        draw_image(ax, shown.video[t], f"frame {t}")
        _path(ax, shown, shown.tracks, n, t, _TRUTH)
        for (clip, tracks), color in zip(seen.values(), _ROWS, strict=True):
            _path(ax, clip, tracks, n, t, color)
    ax = figure.add_subplot(grid[1, :])
    for name, error, color in zip(seen, errors, _ROWS, strict=True):
        ax.plot(error[:, n], "o-", color=color, ms=3, label=name)
    for t in np.flatnonzero(~shown.tracks.visible[:, n]):
        ax.axvspan(t - 0.5, t + 0.5, color="#e3e5e8", lw=0)
    label_axes(ax, "error (m)", f"frame · {shown.name}, track {n} · grey: hidden · black above: the truth")
    ax.legend(fontsize=8, frameon=False)
    return figure


def _interval(ax: Any, y: float, one: Mapping[str, float], color: str) -> None:
    ax.plot([one["low"], one["high"]], [y, y], color=color, lw=1.8, solid_capstyle="round")
    ax.plot(one["mean"], y, "o", color=color, ms=5)


def _path(ax: Any, clip: Clip, tracks: Tracks, n: int, t: int, color: str) -> None:
    """One track up to frame t, as the camera of frame t sees it."""
    cameras = (np.repeat(x[t : t + 1], t + 1, 0) for x in (clip.intrinsics, clip.extrinsics))
    uv = project(tracks.xyz[: t + 1, n : n + 1], *cameras)[0][:, 0]
    ax.plot(*uv.T, color="white", lw=2.6, alpha=0.8)
    ax.plot(*uv.T, color=color, lw=1.4)
    ax.plot(*uv[-1], "o", color=color, ms=5, mec="white", mew=0.7)
