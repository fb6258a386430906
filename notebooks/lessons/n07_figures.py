"""Lesson 07's figures: growing thresholds, scores by threshold and by word, image and space, intervals, failures, depth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import plotly.graph_objects as go
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.evaluation.intervals import Estimate
from tapip3d_lite.figures import tracks_3d
from tapip3d_lite.figures.flat import INK, label_axes
from tapip3d_lite.geometry import THRESHOLDS

Array = np.ndarray
# Safe for the colour-blind (Okabe and Ito); each tracker has its mark and line as well.
LOOKS = {"lite": ("#0072b2", "o", "-"), "klt": ("#d55e00", "s", "--"), "static": ("#009e73", "^", "-.")}
LOOKS |= {"shuffled": ("#8a919c", "x", ":")}
_TRUTH, _ESTIMATE = "#009e73", "#d55e00"


def balls(points: Mapping[str, tuple[float, float]], focal: float, reach: float = 0.2) -> Figure:
    """The balls of the five thresholds around some points, at one scale, and a miss in each.

    Args:
        points: name to (depth, length of the miss) in metres.
        focal: pixels.
        reach: half a panel's side in metres.
    """
    figure = Figure(figsize=(3.3 * len(points), 3.5), layout="constrained")
    axes = figure.subplots(1, len(points), sharey=True)
    for ax, (name, (depth, miss)) in zip(axes, points.items(), strict=True):
        for i, k in enumerate(THRESHOLDS):
            radius = 100 * k * depth / focal
            ax.add_patch(Circle((0, 0), radius, fill=False, ec=INK, lw=1.2, ls=("-", "--")[i % 2]))
            if radius * 0.72 < 100 * reach:
                ax.text(-radius * 0.71, radius * 0.71, k, fontsize=9, ha="center", va="center", bbox=_PAPER)
        ax.annotate(
            "", (60 * miss, -80 * miss), (0, 0), arrowprops={"arrowstyle": "-|>", "color": _ESTIMATE, "lw": 2.2}
        )
        ax.set(xlim=(-100 * reach, 100 * reach), ylim=(-100 * reach, 100 * reach), aspect="equal")
        ax.set_title(name, fontsize=10, color=INK)
        label_axes(ax, "cm" if ax is axes[0] else "", "cm")
        ax.grid(visible=False)
    return figure


_PAPER = {"fc": "white", "ec": "none", "pad": 0.6}


def by_threshold_chart(found: Mapping[str, Array], claimed: Mapping[str, Array], depth: float, focal: float) -> Figure:
    """APD_k and J_k by threshold for some trackers; below, what a threshold is in centimetres at a depth in metres."""
    figure = Figure(figsize=(10.2, 3.4), layout="constrained")
    for ax, rows, name in zip(figure.subplots(1, 2, sharey=True), (found, claimed), ("APD", "J"), strict=True):
        for tracker, values in rows.items():
            color, marker, line = LOOKS[tracker]
            ax.plot(range(5), values, marker + line, color=color, label=tracker, ms=6)
        ticks = [f"{k} px\n{100 * k * depth / focal:.1f} cm" for k in THRESHOLDS]
        ax.set_xticks(range(5), ticks)
        label_axes(ax, f"share of moving points, {name} at the threshold", f"threshold, in cm at {depth:.1f} m")
        ax.tick_params(labelsize=9)
        ax.set_ylim(-0.02, 1)
    ax.legend(frameon=False, fontsize=9)
    return figure


def by_word_chart(
    thresholds: Sequence[float], scores: Mapping[str, Sequence[float]], ends: Mapping[str, float]
) -> Figure:
    """Scores over the probability from which on a point is called visible, with levels to compare with."""
    figure = Figure(figsize=(7.2, 3.3), layout="constrained")
    ax = figure.subplots()
    for (name, values), color, marker in zip(scores.items(), ("#0072b2", "#e69f00"), "os", strict=False):
        ax.plot(thresholds, values, f"{marker}-", color=color, label=name, ms=5)
    for (name, value), line in zip(ends.items(), ("--", ":", "-."), strict=False):
        ax.axhline(value, color=INK, lw=1, ls=line, label=name)
    label_axes(ax, "score", "called visible from this probability on (0: always, 1: never)")
    ax.tick_params(labelsize=9)
    ax.set_ylim(-0.02, 1)
    ax.legend(frameon=False, fontsize=9, loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


def flat_and_space(errors: Mapping[str, tuple[Array, Array]], slope: float) -> Figure:
    """Errors in the image over errors in space, both in pixels, a panel an entry; the line is the most that is possible."""
    figure = Figure(figsize=(4.4 * len(errors) + 1, 3.9), layout="constrained")
    axes = figure.subplots(1, len(errors), sharex=True, sharey=True)
    for ax, (name, (space, flat)) in zip(axes, errors.items(), strict=True):
        ax.loglog(np.maximum(space, 0.02), np.maximum(flat, 0.02), ".", color="#0072b2", ms=2.5, alpha=0.35)
        ends = np.array([0.02, 400])
        ax.plot(ends, slope * ends, color=_ESTIMATE, lw=1.4, label="most that is possible for small errors")
        for side in (ax.axvline, ax.axhline):
            side(4, color=INK, lw=0.8, ls=":")
        ax.set(xlim=(0.015, 400), ylim=(0.015, 400))
        ax.set_title(name, fontsize=10, color=INK)
        label_axes(ax, "error in the image (px)" if ax is axes[0] else "", "error in space (px at the true depth)")
        ax.tick_params(labelsize=9)
    axes[0].legend(frameon=False, fontsize=9, loc="upper left")
    return figure


def _bar(ax: Axes, row: float, value: Estimate, look: tuple[str, str, str]) -> None:
    color, marker, _ = look
    width = [[value.mean - value.low], [value.high - value.mean]]
    ax.errorbar(value.mean, row, xerr=width, fmt=marker, color=color, ms=6, capsize=4, lw=1.6)


def two_rows(pairs: tuple[Array, Array], names: tuple[str, str], rows: Mapping[str, Estimate], metric: str) -> Figure:
    """Two trackers' scores joined clip by clip, and intervals of their difference, a row an entry."""
    figure = Figure(figsize=(10.2, 3.3), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.3))
    for one, other in zip(*pairs, strict=True):
        rises = other >= one
        left.plot([0, 1], [one, other], "o-" if rises else "s--", color="#56b4e9" if rises else INK, ms=4, lw=1)
    left.set_xticks([0, 1], names)
    left.set_xlim(-0.3, 1.3)
    label_axes(left, f"{metric}, a line a clip", "")
    _differences(right, rows, f"difference in {metric}: {names[1]} minus {names[0]}")
    for ax in (left, right):
        ax.tick_params(labelsize=9)
    return figure


def differences_chart(rows: Mapping[str, Estimate], xlabel: str) -> Figure:
    """Differences with their intervals, a row an entry, around a dashed zero."""
    figure = Figure(figsize=(10.2, 0.42 * len(rows) + 1), layout="constrained")
    ax = figure.subplots()
    _differences(ax, rows, xlabel)
    ax.tick_params(labelsize=9)
    return figure


def _differences(ax: Axes, rows: Mapping[str, Estimate], xlabel: str) -> None:
    for row, (name, value) in enumerate(rows.items()):
        _bar(ax, row, value, ("#d55e00", "s", "") if "unpaired" in name else ("#0072b2", "o", ""))
    ax.axvline(0, color=INK, lw=0.9, ls="--")
    ax.set_yticks(range(len(rows)), list(rows))
    ax.set_ylim(len(rows) - 0.4, -0.6)
    label_axes(ax, "", xlabel)


def coverage_chart(held: Mapping[str, Mapping[str, float]]) -> Figure:
    """How often intervals hold the truth: a group of bars an entry, a bar a unit; dashed what they promise."""
    figure = Figure(figsize=(7.2, 3.0), layout="constrained")
    ax, step = figure.subplots(), 0.8 / len(held)
    for i, (name, shares) in enumerate(held.items()):
        at = np.arange(len(shares)) + (i - (len(held) - 1) / 2) * step
        look = {"color": ("#56b4e9", "#0072b2", "#cc79a7")[i % 3], "hatch": ("", "//", "..")[i % 3], "ec": "white"}
        ax.bar_label(
            ax.bar(at, list(shares.values()), step * 0.92, label=name, **look), fmt="{:.0%}", fontsize=9, bbox=_PAPER
        )
    ax.axhline(0.95, color=INK, ls="--", lw=1)
    ax.set_xticks(range(len(shares)), [f"{unit} taken for\nindependent" for unit in shares])
    label_axes(ax, "share of intervals\nthat hold the truth", "")
    ax.tick_params(labelsize=9)
    ax.set_ylim(0, 1.12)
    ax.legend(frameon=False, fontsize=9, ncols=len(held), loc="upper left")
    return figure


def shares_chart(clips: Mapping[str, float], totals: Array) -> Figure:
    """Scores of single clips, worst first, and which share of all error the worst tracks hold; totals (N,) are each track's."""
    figure = Figure(figsize=(10.2, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    names = sorted(clips, key=clips.get)
    left.bar_label(left.barh(range(len(names)), [clips[n] for n in names], color="#56b4e9"), fmt="%.2f", fontsize=9)
    left.set_yticks(range(len(names)), names)
    left.invert_yaxis()
    label_axes(left, "", "AJ3D of moving points, unscaled")
    share = np.cumsum(np.sort(totals)[::-1]) / totals.sum()
    at = np.arange(1, len(totals) + 1) / len(totals)
    right.plot(100 * at, 100 * share, color="#0072b2", label="tracks, worst first")
    right.plot([0, 100], [0, 100], color=INK, ls="--", lw=1, label="if all were alike")
    right.axvline(10, color=INK, ls=":", lw=1)
    label_axes(right, "% of all error", "% of the tracks")
    right.legend(frameon=False, fontsize=9, loc="lower right")
    for ax in (left, right):
        ax.tick_params(labelsize=9)
    return figure


def worst_in_3d(clip: Clip, pred: Tracks, which: Array) -> tuple[go.Figure, Figure]:
    """Some tracks beside their true paths in 3D: the scene with its slider, and its twin.

    Args:
        clip: with true tracks of the same queries.
        pred: the tracker's.
        which: indices of the tracks.
    """
    estimate, truth = pred.select(which), clip.tracks.select(which)
    scene = tracks_3d(clip, estimate, tail=len(clip), title=f"{clip.name}, {len(which)} worst tracks")
    line = {"color": "black", "width": 4, "dash": "dash"}
    gap = np.full((1, len(which), 3), np.nan)
    paths = np.concatenate([truth.xyz, gap]).swapaxes(0, 1).reshape(-1, 3)
    scene.add_trace(go.Scatter3d(**dict(zip("xyz", paths.T, strict=True)), mode="lines", line=line, name="truth"))
    figure = Figure(figsize=(10.2, 4.2), layout="constrained")
    for place, (turn, word) in enumerate(((-70, "from the side"), (20, "turned by 90 degrees"))):
        ax = figure.add_subplot(1, 2, place + 1, projection="3d")
        for n in range(len(which)):
            ax.plot(*truth.xyz[:, n].T, color=_TRUTH, lw=2.4, ls="--", label="truth" if n == 0 else None)
            ax.plot(*estimate.xyz[:, n].T, color=_ESTIMATE, lw=1.4, label="estimate" if n == 0 else None)
            t = int(np.linalg.norm(estimate.xyz[:, n] - truth.xyz[:, n], axis=-1).argmax())
            ax.plot(*np.stack([estimate.xyz[t, n], truth.xyz[t, n]], -1), color=INK, lw=1, ls=":")
            ax.scatter(*truth.queries[n, 1:], color=INK, s=22, marker="*", label="query" if n == 0 else None)
        ax.view_init(22, turn)
        ax.set_aspect("equal")
        ax.tick_params(labelsize=8)
        ax.set_title(word, fontsize=10, color=INK)
    ax.legend(frameon=False, fontsize=9)
    return scene, figure


def depth_chart(noise: Sequence[float], scores: Mapping[str, Mapping[str, Sequence[float]]]) -> Figure:
    """Scores over the noise of depth: a panel a metric, a line a tracker."""
    figure = Figure(figsize=(10.2, 3.2), layout="constrained")
    for ax, (metric, rows) in zip(figure.subplots(1, len(scores), sharey=True), scores.items(), strict=True):
        for tracker, values in rows.items():
            color, marker, line = LOOKS[tracker]
            ax.plot(range(len(noise)), values, marker + line, color=color, label=tracker, ms=6)
        ax.set_xticks(range(len(noise)), [f"{100 * n:g} %" for n in noise])
        ax.set_title(metric, fontsize=10, color=INK)
        label_axes(ax, "score", "noise of every pixel's depth")
        ax.tick_params(labelsize=9)
        ax.set_ylim(-0.02, 1)
    ax.legend(frameon=False, fontsize=9, loc="upper right")
    return figure
