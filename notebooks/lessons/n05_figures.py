"""Lesson 05's figures: the token, attention over time, who hears whom, corrections, cost, windows, differences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from lessons.n05_film import ESTIMATE, START, TRUTH
from tapip3d_lite.figures.flat import INK, label_axes

OKABE = ("#56b4e9", "#0072b2", "#009e73", "#cc79a7", "#d55e00", "#e69f00", "#f0e442")
# Student's t for 95 % intervals of a mean, by degrees of freedom; the normal 1.96 is too narrow for a few clips.
_T95 = (12.71, 4.30, 3.18, 2.78, 2.57, 2.45, 2.36, 2.31, 2.26, 2.23, 2.20, 2.18, 2.16, 2.14, 2.13)


def token_bar(parts: Mapping[str, int]) -> Figure:
    """A token as one bar, its parts side by side with their names and widths."""
    figure = Figure(figsize=(10.2, 2.5), layout="constrained")
    ax, start, whole = figure.subplots(), 0, sum(parts.values())
    for i, (name, width) in enumerate(parts.items()):
        ax.barh(0, width, left=start, color=OKABE[i % len(OKABE)], alpha=0.55, edgecolor=INK, lw=0.6)
        if width > whole / 20:
            ax.text(
                start + width / 2, 0, f"{name.replace(', ', chr(10))}\n{width}", ha="center", va="center", fontsize=9
            )
        else:
            ax.annotate(f"{name}: {width}", (start, 0.4), (start, 0.62), fontsize=9, arrowprops={"arrowstyle": "-"})
        start += width
    label_axes(ax, "", f"channel, 0 to {whole - 1}")
    ax.set(yticks=[], xlim=(-2, whole + 2), ylim=(-0.45, 0.95))
    return figure


def looks_over_time(looks: np.ndarray) -> Figure:
    """Attention over time of one track in one group, (heads, S, S): a panel a head, a cross at each row's maximum."""
    figure = Figure(figsize=(10.2, 3.1), layout="constrained")
    axes = figure.subplots(1, len(looks), sharey=True)
    for i, (ax, weights) in enumerate(zip(axes, looks, strict=True)):
        shown = ax.imshow(weights, cmap="viridis", vmin=0, vmax=1)
        ax.set_xticks(range(0, len(weights), 2))
        ax.set_title(f"head {i + 1}", fontsize=10, color=INK)
        label_axes(ax, "frame that looks" if i == 0 else "", "frame that is seen")
        ax.grid(visible=False)
        for t, row in enumerate(weights):
            best = int(row.argmax())
            ax.text(best, t, "×", ha="center", va="center", fontsize=11, color="white" if row[best] < 0.6 else "black")
    figure.colorbar(shown, ax=axes, label="weight (a row sums to 1)", fraction=0.03)
    return figure


def heard(matrices: Sequence[np.ndarray], still: int) -> Figure:
    """Who hears whom, (N, N) for each group; the first rows are moving points, those from `still` on at rest."""
    figure = Figure(figsize=(10.2, 3.5), layout="constrained")
    axes = figure.subplots(1, len(matrices), sharey=True)
    for i, (ax, matrix) in enumerate(zip(axes, matrices, strict=True)):
        others = np.where(np.eye(len(matrix), dtype=bool), np.nan, matrix) / np.diag(matrix).mean()
        shown = ax.imshow(100 * others, cmap="viridis")
        for side in (ax.axhline, ax.axvline):
            side(still - 0.5, color="white", lw=1.2)
        ax.set_title(f"group {i + 1}", fontsize=10, color=INK)
        label_axes(ax, "point that hears" if i == 0 else "", "point that is heard")
        ax.grid(visible=False)
        figure.colorbar(shown, ax=ax, fraction=0.046, label="% of own effect" if i == len(matrices) - 1 else "")
    return figure


def corrections(xyz: np.ndarray, vis: np.ndarray, seen: np.ndarray) -> Figure:
    """What the head puts out for one track: (M + 1, S, 3) places and (M + 1, S) logits, from the start on; true `seen` (S,)."""
    figure = Figure(figsize=(10.2, 3.0), layout="constrained")
    moved, logit = figure.subplots(1, 2)
    frames, steps = np.arange(xyz.shape[1]), np.linalg.norm(np.diff(xyz, axis=0), axis=-1)
    width = 0.8 / len(steps)
    for m, step in enumerate(steps):
        look = {"color": OKABE[m + 1], "label": f"update {m + 1}"}
        moved.bar(frames + (m - (len(steps) - 1) / 2) * width, 100 * step, width, hatch=("", "//", "..")[m % 3], **look)
        logit.plot(frames, vis[m + 1], f"{'os^vD'[m % 5]}-", ms=5, lw=1, **look)
    logit.axhline(0, color=INK, lw=0.8, ls="--")
    hidden = frames[~seen]
    logit.plot(hidden, np.zeros(len(hidden)), "x", color=INK, ms=9, mew=2, label="hidden in truth")
    for ax, label in ((moved, "length of the correction (cm)"), (logit, "logit of visibility after it")):
        label_axes(ax, label, "frame of the window")
        ax.legend(fontsize=9, frameon=False)
    return figure


def cost_chart(
    counts: Mapping[int, Mapping[str, float]], seconds: Mapping[int, Mapping[str, Sequence[float]]]
) -> Figure:
    """Multiply-adds and seconds by the number of points, through virtual tracks and with full attention."""
    figure = Figure(figsize=(10.2, 3.0), layout="constrained")
    axes = figure.subplots(1, 2)
    for way, color, marker in (("full", TRUTH, "o"), ("virtual", ESTIMATE, "s")):
        for ax, values in zip(
            axes, ([c[way] / 1e6 for c in counts.values()], [1000 * min(s[way]) for s in seconds.values()]), strict=True
        ):
            ax.loglog(list(counts), values, f"{marker}-", color=color, label=way)
    for ax, label in zip(axes, ("multiply-adds (millions)", "time (ms)"), strict=True):
        label_axes(ax, label, "points N")
        ax.set_xticks(list(counts), [str(n) for n in counts])
        ax.minorticks_off()
        ax.grid(alpha=0.25)
        ax.legend(frameon=False, fontsize=9)
    return figure


def windows_chart(frames: int, window: int, starts: Sequence[int], times: Sequence[int] = ()) -> Figure:
    """Windows over time: what is handed over, what is new; queries as stars in their first window.

    Args:
        frames: T.
        window: S.
        starts: the windows' first frames.
        times: query frames.
    """
    figure = Figure(figsize=(10.2, 0.45 * len(starts) + 1.1), layout="constrained")
    ax, half = figure.subplots(), window // 2
    for row, start in enumerate(int(s) for s in starts):
        for left, name in (
            (start, "query" if row == 0 else "handed over"),
            (start + half, "query" if row == 0 else "last place repeated"),
        ):
            old = name == "handed over"
            ax.barh(
                row,
                half,
                left=left - 0.5,
                color=TRUTH if old else START,
                alpha=0.5,
                edgecolor=INK,
                hatch="//" if old else "",
                lw=0.6,
            )
            ax.text(
                left + half / 2 - 0.5,
                row,
                name,
                ha="center",
                va="center",
                fontsize=9,
                color=INK,
                bbox={"fc": "white", "ec": "none", "alpha": 0.75, "pad": 1},
            )
        mine = [t for t in times if t < start + window and (row == 0 or t >= start + half)]
        ax.plot(mine, [row + 0.27] * len(mine), "*", color=INK, ms=11)
    ax.axvline(frames - 0.5, color=INK, ls="--", lw=1)
    ax.set_yticks(range(len(starts)))
    ax.invert_yaxis()
    label_axes(ax, "window", "frame (dashed: the clip's end)")
    return figure


def interval(values: np.ndarray) -> tuple[float, float]:
    """Mean of a few numbers and half the width of its 95 % interval, by Student's t; infinite for a single number."""
    if len(values) < 2:
        return float(np.mean(values)), float("inf")
    factor = _T95[len(values) - 2] if len(values) - 2 < len(_T95) else 2.1
    return float(np.mean(values)), float(factor * np.std(values, ddof=1) / np.sqrt(len(values)))


def paired(differences: Mapping[str, np.ndarray], xlabel: str) -> Figure:
    """Differences clip by clip as dots, with their mean and its 95 % interval; a row an entry."""
    figure = Figure(figsize=(10.2, 0.45 * len(differences) + 0.9), layout="constrained")
    ax = figure.subplots()
    for row, values in enumerate(differences.values()):
        mean, half = interval(values)
        ax.plot(values, [row] * len(values), "o", color=TRUTH, alpha=0.45, ms=5)
        ax.errorbar(mean, row, xerr=half if len(values) > 1 else None, fmt="D", color=INK, ms=6, capsize=3)
    ax.axvline(0, color=INK, lw=0.8, ls="--")
    label_axes(ax, "", xlabel)
    ax.set_yticks(range(len(differences)), list(differences), fontsize=9)
    ax.set_ylim(len(differences) - 0.5, -0.5)
    return figure


def growth_chart(rows: Mapping[str, np.ndarray], updates: int) -> Figure:
    """How far estimates move, in metres, update by update: medians as lines, the middle nine tenths as bands.

    Args:
        rows: by name (updates of all windows, points), NaN where there is no estimate.
        updates: of one window.
    """
    figure = Figure(figsize=(8.2, 3.6), layout="constrained")
    ax = figure.subplots()
    looks = ((OKABE[1], "o", "-"), (OKABE[4], "s", "--"), (OKABE[2], "^", ":"))
    for (name, values), (color, marker, line) in zip(rows.items(), looks, strict=False):
        x = np.arange(1, len(values) + 1)
        low, middle, high = np.nanpercentile(values, [5, 50, 95], axis=1) + 1e-8
        ax.fill_between(x, low, high, color=color, alpha=0.15, lw=0)
        ax.plot(x, middle, line, color=color, marker=marker, ms=5, label=name)
    for edge in range(updates, len(x), updates):
        ax.axvline(edge + 0.5, color=INK, lw=0.8, ls=":")
    ax.set_yscale("log")
    ax.set_xticks(x)
    label_axes(ax, "moved (m)", "update (dotted: the next window)")
    ax.legend(fontsize=9, frameon=False)
    ax.tick_params(labelsize=9)
    return figure
