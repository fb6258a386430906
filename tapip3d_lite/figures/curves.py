"""Scores of the benchmark as means with intervals, and the learning curves of trainings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from tapip3d_lite.evaluation.benchmark import SPLITS, Results, estimate
from tapip3d_lite.figures.flat import INK, MOVING, STILL, label_axes

COLORS = ("#8a8f98", "#e8a33d", "#2b6cb0", "#d1495b", "#2f855a", "#6b46c1")
NAMES = {"AJ3D_none": "AJ 3D", "APD3D_none": "APD 3D", "AJ3D": "AJ 3D, median scale", "APD3D": "APD 3D, median scale"}
Line = Mapping[str, Any]
Log = tuple[str, Sequence[Line]]
_SERIES = {"apd": ("all points", STILL), "apd_dynamic": ("moving points", MOVING)}


def score_figure(
    results: Results, metrics: Sequence[str] = ("AJ3D_none", "APD3D_none", "OA"), splits: Sequence[str] = SPLITS
) -> Figure:
    """Dots with 95 % bootstrap intervals over clips: one panel a split, filled for all points, hollow for dynamic ones.

    Args:
        results: from `run_benchmark` or `load_results`.
        metrics: names without `_dynamic`.
        splits: those that no tracker was scored on are left out.

    Raises:
        ValueError: there are no scores on any of the splits.
    """
    splits = [split for split in splits if any(split in scores for scores in results.values())]
    if not splits:
        raise ValueError("score_figure: no scores on these splits; run the benchmark first")
    colors, step = dict(zip(results, cycle(COLORS), strict=False)), len(results) + 1.0
    figure = Figure(figsize=(3.4 * len(splits), 1.0 + 0.24 * step * len(metrics)), layout="constrained")
    axes = figure.subplots(1, len(splits), squeeze=False, sharey=True)[0]
    for ax, split in zip(axes, splits, strict=True):
        for row, metric in enumerate(metrics):
            _dots(ax, results, split, metric, row * step, colors)
        ax.set_title(split, fontsize=10, color=INK)
        ax.set_xlabel("mean over clips, 95 % interval", fontsize=8, color=INK)
        ax.set(xlim=(0, 1), axisbelow=True)
        ax.grid(axis="x", color="#e3e5e8", lw=0.7)
        ax.spines[["top", "right", "left"]].set_visible(False)
        ax.tick_params(length=0, labelsize=8, colors=INK)
    axes[0].set_yticks([(row + 0.5) * step - 1 for row in range(len(metrics))], [NAMES.get(m, m) for m in metrics])
    axes[0].set_ylim(step * len(metrics) - 1, -1)
    marks = [(color, True, label) for label, color in colors.items()]
    marks += [(INK, True, "all points"), (INK, False, "points on moving bodies")]
    handles = [Line2D([], [], label=label, **_dot(color, filled)) for color, filled, label in marks]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=8)
    return figure


def learning_curves(
    logs: Sequence[Log], zero_motion: Mapping[str, float] | None = None, by: str = "step", window: int = 100
) -> Figure:
    """How trainings went, one row each: matching of the encoder, loss, APD3D on examples (lines) and held-out clips (dots).

    Args:
        logs: name and lines of the log of each training; there may be no lines yet, and the name may be empty.
        zero_motion: scores of zero motion on the held-out clips, drawn dashed: `APD3D_none`, `APD3D_none_dynamic`.
        by: horizontal axis, `"step"` or `"minutes"` of training.
        window: steps over which the bold lines are averaged, also where a log has only some; the raw values stay behind.

    Raises:
        ValueError: another `by`, or a window of no step.
    """
    if by not in ("step", "minutes") or window < 1:
        raise ValueError(f'learning_curves: expected by="step" or "minutes", window >= 1, got {by!r}, {window}')
    taken = all(lines and not _stage(lines, "matching") for _, lines in logs)  # no encoder was trained
    figure = Figure(figsize=(8 if taken else 11, 2.9 * len(logs)), layout="constrained")
    rows = figure.subplots(len(logs), 2 if taken else 3, squeeze=False)
    for axes, (name, lines) in zip(rows, logs, strict=True):
        _row(axes, lines, zero_motion or {}, by, window)
        if name:
            axes[0].set_ylabel(f"{name}\n\n{axes[0].get_ylabel()}", fontsize=8)
    return figure


def _dots(ax: Axes, results: Results, split: str, metric: str, top: float, colors: Mapping[str, str]) -> None:
    for index, label in enumerate(results):
        if split not in results[label]:
            continue
        for part, shift in (("", -0.17), ("_dynamic", 0.17)):
            value, y = estimate(results, label, split, metric + part), top + index + shift
            ax.plot([value.low, value.high], [y, y], color=colors[label], lw=1.6, alpha=0.75, solid_capstyle="round")
            ax.plot(value.mean, y, **_dot(colors[label], filled=not part))


def _dot(color: str, filled: bool) -> dict[str, Any]:
    return {"marker": "o", "ms": 5, "color": color, "mfc": color if filled else "white", "mew": 1.3, "ls": ""}


def _row(axes: Sequence[Axes], lines: Sequence[Line], zero_motion: Mapping[str, float], by: str, window: int) -> None:
    matching, tracking = (_stage(lines, name) for name in ("matching", "tracking"))
    titles = ["the encoder learns to match", "the tracker learns to track"]
    titles += ["bold: examples · dots: held out" + " · dashed: zero motion" * bool(zero_motion)]
    for ax, title, label in list(
        zip(axes[::-1], titles[::-1], ("APD3D", "loss", "right within 1.5 cells"), strict=False)
    ):
        label_axes(ax, label, by)
        ax.set_title(title, fontsize=8, color=INK)
    if len(axes) == 3:
        _draw_matching(axes[0], matching, by, window, taken=bool(tracking and not matching))
    losses, scores = axes[-2:]
    _curve(losses, tracking, "loss", by, window, INK)
    for name, (label, color) in _SERIES.items():
        _curve(scores, tracking, name, by, window, color, label)
        held_out = name.replace("apd", "APD3D_none")
        known = _known(tracking, f"val_{held_out}")
        scores.plot(
            _place(known, by), [x[f"val_{held_out}"] for x in known], "o", color=color, ms=5, mec="white", mew=0.6
        )
        if held_out in zero_motion:
            scores.axhline(zero_motion[held_out], color=color, lw=1, ls="--")
    scores.set_ylim(0, 1)
    if tracking:
        losses.set_yscale("log")
        losses.tick_params(which="minor", labelsize=7)
        scores.legend(fontsize=7, frameon=False, loc="upper left")


def _draw_matching(ax: Axes, lines: Sequence[Line], by: str, window: int, taken: bool) -> None:
    _curve(ax, lines, "right", by, window, INK)
    if taken:
        ax.text(0.5, 0.5, "as it was", ha="center", color=INK, fontsize=8, transform=ax.transAxes)
        ax.set(xticks=[], yticks=[])
    ax.set_ylim(0, 1)


def _stage(lines: Sequence[Line], name: str) -> list[Line]:
    return [line for line in lines if line["stage"] == name]


def _known(lines: Sequence[Line], name: str) -> list[Line]:
    return [line for line in lines if line.get(name) is not None]


def _place(lines: Sequence[Line], by: str) -> list[float]:
    return [line["step"] if by == "step" else line["seconds"] / 60 for line in lines]


def _curve(
    ax: Axes, lines: Sequence[Line], name: str, by: str, window: int, color: str, label: str | None = None
) -> None:
    """Raw values, faint, and in bold their means over the last `window` steps."""
    lines = _known(lines, name)
    if not lines:
        return
    x, y, steps = (
        _place(lines, by),
        np.array([line[name] for line in lines]),
        np.array([line["step"] for line in lines]),
    )
    sums, stops = np.concatenate([[0.0], np.cumsum(y)]), np.arange(1, len(y) + 1)
    starts = np.searchsorted(steps, steps - window, side="right")
    ax.plot(x, y, color=color, lw=0.4, alpha=0.25)
    ax.plot(x, (sums[stops] - sums[starts]) / (stops - starts), color=color, lw=1.8, label=label)
