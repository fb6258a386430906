"""Lesson 10's figures: errors of carried depths, a pair matched both ways, depth from five sources, scores, camera paths."""

from __future__ import annotations

from collections.abc import Mapping

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.evaluation.intervals import Estimate
from tapip3d_lite.figures.flat import INK, draw_image, frame_with_tracks, label_axes

Array = np.ndarray
_BLUE, _ORANGE, _GREY = "#0072b2", "#d55e00", "#8a919c"  # of Okabe and Ito
_ERRORS = matplotlib.colormaps["viridis"].with_extremes(bad="#e4e6ea")
_DEPTHS = matplotlib.colormaps["viridis_r"].with_extremes(bad="#b8b8b8")


def errors_figure(image: Array, maps: Mapping[str, Array], title: str) -> Figure:
    """A frame, and for each entry the relative errors (H, W) of its pixels in another frame; grey: nothing to compare."""
    figure = Figure(
        figsize=(3.4 * (len(maps) + 1) + 0.6, 3.4 * image.shape[0] / image.shape[1] + 0.3), layout="constrained"
    )
    first, *rest = figure.subplots(1, len(maps) + 1)
    draw_image(first, image, title)
    for ax, (name, errors) in zip(rest, maps.items(), strict=True):
        shown = np.ma.masked_invalid(np.clip(errors, 1e-3, 1))
        picture = ax.imshow(shown, cmap=_ERRORS, norm=LogNorm(1e-3, 1))
        _plain(ax, name)
    bar = figure.colorbar(picture, ax=rest, fraction=0.046, pad=0.02)
    bar.set_label("relative depth error", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    return figure


def _plain(ax: Axes, title: str) -> None:
    ax.set(xticks=[], yticks=[])
    ax.set_title(title, fontsize=9, color=INK)
    ax.spines[:].set_visible(False)


def remedies_chart(found: Mapping[str, tuple[float, float]], usual: tuple[float, float]) -> Figure:
    """Depth and colour error of a clip as it is and once each suspect is undone; dashed what is usual."""
    figure = Figure(figsize=(10.2, 0.34 * len(found) + 0.9), layout="constrained")
    titles = "relative depth error of what rests", "colour error of what rests"
    for i, ax in enumerate(figure.subplots(1, 2, sharey=True)):
        values = [numbers[i] for numbers in found.values()]
        colors = [_BLUE if max(n / u for n, u in zip(x, usual, strict=True)) <= 1 else _GREY for x in found.values()]
        ax.axvline(usual[i], color=INK, ls="--", lw=1)
        paper = {"fc": "white", "ec": "none", "pad": 0.8}
        ax.bar_label(ax.barh(list(found), values, color=colors), fmt="%.3f", fontsize=9, padding=3, bbox=paper)
        ax.set_xlim(0, 1.25 * max(values))
        label_axes(ax, "", titles[i])
        ax.tick_params(labelsize=9)
    ax.invert_yaxis()
    return figure


def matched_figure(image: Array, depth: Array, kept: Array, truth: Array) -> Figure:
    """A left image, the depth of all matches, that of those both ways agree on, and the true depth (all (H, W))."""
    figure = Figure(figsize=(10.2, 2.4), layout="constrained")
    axes = figure.subplots(1, 4)
    draw_image(axes[0], image, "")
    axes[0].set_title("left image", fontsize=9, color=INK)
    _depths(axes[1:], {"all matches": depth, "both ways agree": kept, "true depth": truth}, truth)
    return figure


def sources_figure(image: Array, depths: Mapping[str, Array], truth: Array) -> Figure:
    """One frame and its depth (H, W) from each source, in one scale; grey: unknown."""
    columns = (len(depths) + 2) // 2
    figure = Figure(figsize=(10.2, 2 * 10.2 / columns * image.shape[0] / image.shape[1] + 0.2), layout="constrained")
    axes = figure.subplots(2, columns).ravel()
    draw_image(axes[0], image, "")
    axes[0].set_title("frame", fontsize=9, color=INK)
    _depths(axes[1 : len(depths) + 1], depths, truth)
    for ax in axes[len(depths) + 1 :]:
        ax.set_visible(False)
    return figure


def _depths(axes: list[Axes], depths: Mapping[str, Array], truth: Array) -> None:
    low, high = np.quantile(truth[truth > 0], [0, 0.99])
    for ax, (name, depth) in zip(axes, depths.items(), strict=True):
        picture = ax.imshow(np.ma.masked_equal(depth, 0), cmap=_DEPTHS, vmin=low, vmax=high)
        _plain(ax, name)
    bar = axes[0].figure.colorbar(picture, ax=list(axes), fraction=0.02, pad=0.01, extend="max")
    bar.set_label("depth (m)", fontsize=8)
    bar.ax.tick_params(labelsize=8)


def costs_chart(own: Mapping[str, Estimate], lost: Mapping[str, Estimate], metric: str, against: str) -> Figure:
    """Scores with their intervals, a row an entry, and beside them the paired difference from one of them."""
    figure = Figure(figsize=(10.2, 0.36 * len(own) + 1), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for ax, rows in ((left, own), (right, lost)):
        for row, name in enumerate(own):
            if name in rows:
                value, color = rows[name], _ORANGE if "filtered" in name else _BLUE
                bars = [[value.mean - value.low], [value.high - value.mean]]
                mark = "s" if "filtered" in name else "o"
                ax.errorbar(value.mean, row, xerr=bars, fmt=mark, color=color, ms=6, capsize=3)
        ax.tick_params(labelsize=9)
    right.axvline(0, color=INK, ls="--", lw=1)
    left.set_yticks(range(len(own)), list(own))
    left.set_ylim(len(own) - 0.5, -0.5)
    label_axes(left, "", metric)
    label_axes(right, "", f"difference in {metric} from {against}, paired by clip")
    return figure


def paths_figure(paths: Mapping[str, tuple[Array, Array]], steps: Mapping[str, Array]) -> Figure:
    """True and estimated camera paths (T, 3) from above, a panel a clip, and the error (T - 1,) of each step, in metres."""
    figure = Figure(figsize=(10.2, 3.2), layout="constrained")
    *above, right = figure.subplots(1, len(paths) + 1)
    looks = ((_BLUE, "o-"), (_ORANGE, "s--"))
    for ax, (name, (true, found)), (color, style) in zip(above, paths.items(), looks, strict=True):
        ax.plot(*true[:, :2].T, color=INK, lw=4, alpha=0.3, label="true")
        ax.plot(*found[:, :2].T, style, color=color, ms=3, lw=1, label="estimated")
        ax.plot(*true[0, :2], "*", color=INK, ms=9)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_title(f"{name}, from above", fontsize=9, color=INK)
        label_axes(ax, "y (m)", "x (m)")
        ax.legend(frameon=False, fontsize=8)
        right.plot(np.arange(1, len(true)), 1000 * steps[name], style, color=color, ms=4, lw=1, label=name)
    right.set_yscale("log")
    right.legend(frameon=False, fontsize=8)
    label_axes(right, "error of a step (mm)", "frame")
    for ax in (*above, right):
        ax.tick_params(labelsize=8)
    return figure


def picks_figure(clip: Clip, tracks: Tracks, frames: tuple[int, ...]) -> Figure:
    """Some points in some frames, each with its tail."""
    height, width = clip.size
    figure = Figure(figsize=(10.2, 10.2 / len(frames) * height / width + 0.3), layout="constrained")
    for ax, t in zip(figure.subplots(1, len(frames)), frames, strict=True):
        frame_with_tracks(clip, tracks, t, ax=ax)
    return figure
