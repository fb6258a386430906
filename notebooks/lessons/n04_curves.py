"""Curves and maps of lesson 04: the waves of an offset, painted floors, rates with intervals, what two forms cost."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import ScalarFormatter
from torch import Tensor

from tapip3d_lite.figures.flat import INK, label_axes
from tapip3d_lite.model.blocks import DEGREES, fourier
from tapip3d_lite.model.cloud import Level

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9")  # of the palette of Okabe and Ito


def fourier_waves(reach: float = 1.0, samples: int = 400) -> Figure:
    """The sines of offsets up to `reach`, a row a degree, and how alike two embeddings are at a distance.

    Args:
        reach: largest offset along one axis, normalised units.
        samples: along the axis.
    """
    fine = 64  # a wave that is finer than a pixel is drawn as its mean, not as an alias of itself
    x = torch.linspace(0, reach, samples * fine, dtype=torch.float64)[:, None]
    count = len(DEGREES)
    waves = fourier(x)[:, 1 : 1 + count].unflatten(0, (samples, fine)).mean(1).numpy()
    figure = Figure(figsize=(10.2, 2.9), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.5, 1])
    image = left.imshow(
        waves.T,
        aspect="auto",
        cmap="RdBu",
        interpolation="nearest",
        extent=(0, reach, DEGREES[-1] + 0.5, DEGREES[0] - 0.5),
    )
    left.set_title(r"$\sin(2^i\delta)$, one row a degree $i$", fontsize=9, color=INK)
    label_axes(left, "degree i", "offset (normalised)")
    left.grid(False)
    figure.colorbar(image, ax=left, fraction=0.04, pad=0.02).ax.tick_params(labelsize=8)
    distance = np.geomspace(1e-5, 10, samples * fine)
    for (low, high), color, style in zip(((-2, 1), (2, 6), (7, 13)), COLORS, ("-", "--", "-."), strict=False):
        degrees = np.arange(low, high + 1)
        # The product of two embeddings depends on their distance only: sin a sin b + cos a cos b = cos(a - b).
        alike = np.cos(2.0**degrees * distance[:, None]).mean(-1).reshape(samples, fine).mean(1)
        right.semilogx(distance[::fine], alike, style, color=color, label=f"degrees {low} to {high}")
    right.set_title("likeness of two embeddings", fontsize=9, color=INK)
    label_axes(right, r"mean of cos($2^i$ · distance)", "distance (normalised)")
    right.legend(fontsize=8, frameon=False)
    return figure


def floors(level: Level, paints: Mapping[str, Callable[[Tensor], Tensor]], frame: int = 0) -> Figure:
    """What the cells of a frame show when a function of their place (..., 3) paints them (..., 1 or 3), a panel a paint.

    Args:
        level: of a cloud in the world, (1, T, h, w, ...).
        paints: title to function.
        frame: which frame.
    """
    figure = Figure(figsize=(2.9 * len(paints), 3.0), layout="constrained")
    for ax, (title, paint) in zip(figure.subplots(1, len(paints), squeeze=False)[0], paints.items(), strict=True):
        shown = paint(level.points[0, frame]).expand(-1, -1, 3)
        low, high = (torch.quantile(shown.flatten(0, 1), q, dim=0) for q in (0.02, 0.98))
        shown = ((shown - low) / (high - low).clamp(min=1e-6)).clamp(0, 1)
        ax.imshow(torch.where(level.valid[0, frame][..., None], shown, 0.5).numpy())
        ax.set_title(title, fontsize=9, color=INK)
        ax.set_xticks([])
        ax.set_yticks([])
    return figure


def rates(panels: Mapping[str, Mapping[str, tuple[Sequence[float], np.ndarray]]], xlabel: str, ylabel: str) -> Figure:
    """Curves with 95 % intervals of the mean, a panel an entry.

    Args:
        panels: title to (curve to (x values (X,), one row of y values per repetition (R, X))); the same curves in all.
        xlabel: below each panel.
        ylabel: beside the first.
    """
    figure = Figure(figsize=(3.7 * len(panels) + 2.2, 2.9), layout="constrained")
    for ax, (title, curves) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True):
        for i, (name, (x, y)) in enumerate(curves.items()):
            y = np.asarray(y, float)
            error = 1.96 * y.std(0, ddof=1) / np.sqrt(len(y)) if len(y) > 1 else None
            style = ("-", "--", "-.", ":", (0, (1, 3)))[i % 5]
            look = {"color": COLORS[i % 5], "ls": style, "marker": "osD^v"[i % 5], "ms": 4, "lw": 1.6, "capsize": 2}
            ax.errorbar(x, y.mean(0), error, label=name, **look)
        label_axes(ax, ylabel, xlabel)
        ax.set_title(title, fontsize=9, color=INK)
        ax.set_xscale("log", base=2)
        ax.xaxis.set_major_formatter(ScalarFormatter())
    figure.legend(*ax.get_legend_handles_labels(), fontsize=8, frameon=False, loc="outside right center")
    return figure


def cost_curves(cost: Mapping[int, Mapping[tuple[int, str], tuple[float, int]]]) -> Figure:
    """Multiply-adds and time over the number of neighbours, for token widths and for both forms.

    Args:
        cost: token width to ((K, `"clear"` or `"fast"`) to (milliseconds, multiply-adds)).
    """
    figure = Figure(figsize=(10.2, 2.9), layout="constrained")
    forms = {"clear": ("-", "o"), "fast": ("--", "s")}
    for ax, (value, unit, label) in zip(
        figure.subplots(1, 2), ((1, 1e6, "multiply-adds (millions)"), (0, 1, "time (ms)")), strict=True
    ):
        for (width, table), color in zip(cost.items(), COLORS, strict=False):
            for form, (style, marker) in forms.items():
                sizes = [k for k, name in table if name == form]
                y = [table[k, form][value] / unit for k in sizes]
                ax.loglog(sizes, y, style, marker=marker, color=color, ms=4, lw=1.5, label=f"D = {width}, {form}")
        ax.set_xticks(sizes, [str(k) for k in sizes])
        ax.minorticks_off()
        label_axes(ax, label, "neighbours K")
    lines = [Line2D([], [], color=c, lw=3, label=f"D = {width}") for width, c in zip(cost, COLORS, strict=False)]
    lines += [Line2D([], [], color=INK, ls=s, marker=m, ms=4, label=f"{form} form") for form, (s, m) in forms.items()]
    figure.legend(handles=lines, fontsize=9, frameon=False, loc="outside right center", handlelength=3)
    return figure
