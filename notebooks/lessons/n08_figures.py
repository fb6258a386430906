"""Lesson 08's figures: differences by seed and clip, a row against itself, what a study of a size would see."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from lessons.n08_trials import excludes_zero
from tapip3d_lite.evaluation.intervals import Estimate
from tapip3d_lite.figures.flat import INK, label_axes

Array = np.ndarray
_LOOKS = (("#0072b2", "o", "-"), ("#d55e00", "s", "--"), ("#009e73", "^", "-."), ("#cc79a7", "D", ":"))  # Okabe and Ito


def by_seed_and_clip(d: Array, title: str) -> Figure:
    """Differences (S, C) as a map, clips in the order of their means; beside it each seed's mean, below each clip's."""
    d = d[:, np.argsort(d.mean(0))]
    figure = Figure(figsize=(9.6, 3.6), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=[6, 1], height_ratios=[len(d), 3.2])
    top = figure.add_subplot(grid[0, 0])
    most = float(np.abs(d).max())
    image = top.imshow(d, cmap="PuOr_r", vmin=-most, vmax=most, aspect="auto")
    top.set_yticks(range(len(d)), [f"seed {s}" for s in range(len(d))], fontsize=9)
    top.set_xticks([])
    top.set_title(title, fontsize=10, color=INK)
    right = figure.add_subplot(grid[0, 1])
    right.barh(range(len(d)), d.mean(1), color="#0072b2")
    right.set(ylim=(len(d) - 0.5, -0.5), yticks=[])
    right.locator_params(axis="x", nbins=2)
    label_axes(right, "", "mean")
    below = figure.add_subplot(grid[1, 0])
    below.bar(range(d.shape[1]), d.mean(0), color=INK, width=0.7)
    below.set_xlim(-0.5, d.shape[1] - 0.5)
    below.set_xticks([])
    label_axes(below, "", f"means of {d.shape[1]} clips, in their order")
    for ax in (right, below):
        (ax.axvline if ax is right else ax.axhline)(0, color=INK, lw=0.8)
        ax.tick_params(labelsize=9)
    corner = figure.add_subplot(grid[1, 1])
    corner.axis("off")
    figure.colorbar(image, ax=corner, location="bottom", fraction=0.9).ax.tick_params(labelsize=8)
    return figure


def with_itself_chart(rows: Mapping[str, Estimate], metric: str) -> Figure:
    """Intervals of rows compared with themselves, by size; those that leave 0 out stand out."""
    figure = Figure(figsize=(9.6, 3.4), layout="constrained")
    ax = figure.subplots()
    ordered = sorted(rows.values(), key=lambda one: one.mean)
    for x, one in enumerate(ordered):
        color, marker = ("#d55e00", "s") if excludes_zero(one) else ("#56b4e9", "o")
        ax.plot([x, x], [one.low, one.high], color=color, lw=2)
        ax.plot(x, one.mean, marker, color=color, ms=5)
    ax.axhline(0, color=INK, lw=0.9, ls="--")
    ax.set_xticks([])
    label_axes(ax, f"difference in {metric}", "pairs of trainings that differ in the seed alone, by their difference")
    return figure


def power_chart(seen: Callable[[int, int], float], seeds: Sequence[int], clips: Sequence[int], wanted: float) -> Figure:
    """The smallest difference that a study sees, over its number of seeds, a line for each number of clips."""
    figure = Figure(figsize=(7.2, 3.4), layout="constrained")
    ax = figure.subplots()
    for (color, marker, line), count in zip(_LOOKS, clips, strict=False):
        ax.plot(seeds, [seen(s, count) for s in seeds], line, color=color, marker=marker, ms=5, label=f"{count} clips")
    ax.axhline(wanted, color=INK, lw=0.9, ls="--")
    ax.annotate(f"{wanted:g}", (seeds[-1], wanted), xytext=(4, 2), textcoords="offset points", fontsize=9)
    ax.set(ylim=(0, None), xticks=list(seeds))
    label_axes(ax, "smallest difference seen", "seeds")
    ax.legend(fontsize=9, frameon=False)
    ax.tick_params(labelsize=9)
    return figure
