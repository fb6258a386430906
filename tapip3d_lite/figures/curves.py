"""Figure of the benchmark: means with intervals, tracker by tracker, for all points and for those that move."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from tapip3d_lite.evaluation.benchmark import SPLITS, Results, estimate
from tapip3d_lite.figures.flat import INK

COLORS = ("#8a8f98", "#e8a33d", "#2b6cb0", "#d1495b", "#2f855a", "#6b46c1")
NAMES = {
    "AJ3D_none": "AJ 3D",
    "APD3D_none": "APD 3D",
    "AJ3D": "AJ 3D, median scale",
    "APD3D": "APD 3D, median scale",
    "OA": "OA",
}


def score_figure(
    results: Results,
    metrics: Sequence[str] = ("AJ3D_none", "APD3D_none", "OA"),
    splits: Sequence[str] = SPLITS,
) -> Figure:
    """Dots with 95 % bootstrap intervals over clips: one panel a split, filled for all points, hollow for dynamic ones.

    Args:
        results: from `score_trackers` or `load_results`.
        metrics: names without `_dynamic`.
        splits: those that no tracker was scored on are left out.

    Raises:
        ValueError: there are no scores on any of the splits.
    """
    splits = [split for split in splits if any(split in scores for scores in results.values())]
    if not splits:
        raise ValueError("score_figure: no scores on these splits; run the benchmark first")
    step = len(results) + 1.0
    figure = Figure(figsize=(3.4 * len(splits), 1.0 + 0.24 * step * len(metrics)), layout="constrained")
    axes = figure.subplots(1, len(splits), squeeze=False, sharey=True)[0]
    for ax, split in zip(axes, splits, strict=True):
        for row, metric in enumerate(metrics):
            _dots(ax, results, split, metric, row * step)
        _dress(ax, split)
    axes[0].set_yticks([row * step + (step - 2) / 2 for row in range(len(metrics))])
    axes[0].set_yticklabels([NAMES.get(metric, metric) for metric in metrics])
    axes[0].set_ylim(step * len(metrics) - 1, -1)
    handles = [_mark(color, True, label) for color, label in zip(_colors(results), results, strict=True)]
    handles += [_mark(INK, True, "all points"), _mark(INK, False, "points on moving bodies")]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=8)
    return figure


def _dots(ax: Axes, results: Results, split: str, metric: str, top: float) -> None:
    for index, (color, label) in enumerate(zip(_colors(results), results, strict=True)):
        if split not in results[label]:
            continue
        for part, shift in (("", -0.17), ("_dynamic", 0.17)):
            value, y = estimate(results, label, split, metric + part), top + index + shift
            ax.plot([value.low, value.high], [y, y], color=color, lw=1.6, alpha=0.75, solid_capstyle="round")
            ax.plot(value.mean, y, "o", ms=5, color=color, mfc="white" if part else color, mew=1.3)


def _dress(ax: Axes, split: str) -> None:
    ax.set_title(split, fontsize=10, color=INK)
    ax.set_xlim(0, 1)
    ax.grid(axis="x", color="#e3e5e8", lw=0.7)
    ax.set_axisbelow(True)
    ax.spines[["top", "right", "left"]].set_visible(False)
    ax.tick_params(length=0, labelsize=8, colors=INK)
    ax.set_xlabel("mean over clips, 95 % interval", fontsize=8, color=INK)


def _colors(results: Results) -> list[str]:
    return [COLORS[index % len(COLORS)] for index in range(len(results))]


def _mark(color: str, filled: bool, label: str) -> Line2D:
    return Line2D([], [], marker="o", ls="", ms=5, color=color, mfc=color if filled else "white", mew=1.3, label=label)
