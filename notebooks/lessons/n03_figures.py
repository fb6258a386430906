"""Figures of lesson 03: two neighbourhoods in the image and in space, shares of right neighbours, and the wedge of a proof."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from lessons.n03_around import NAMES, Around
from tapip3d_lite.clip import Clip
from tapip3d_lite.figures.flat import INK, draw_image, label_axes
from tapip3d_lite.figures.scene_3d import animation_args, axis_limits, fixed_axes
from tapip3d_lite.geometry import transform

RIGHT, WRONG, POINT = "#0072b2", "#d55e00", "#f0e442"  # of the palette of Okabe and Ito
MARKS = {  # (kind, right) to a mark in the scene that can be turned
    ("knn", True): ("circle", 5),
    ("knn", False): ("x", 5),
    ("window", True): ("square-open", 8),
    ("window", False): ("diamond-open", 8),
}
_CURVES = (("#e69f00", "s", "--"), ("#0072b2", "o", "-"), ("#009e73", "^", ":"))


def two_neighborhoods(
    clip: Clip, objects: np.ndarray, track: int, frame: int = 0, neighbors: int = 9, level: int = 0, stride: int = 4
) -> Figure:
    """The window and the nearest neighbours of a true point, each in the image and in space, seen from the side.

    Args:
        clip: with true tracks.
        objects: (T, H, W), from `simulate.object_maps`.
        track: whose true position in the frame is the query; hollow where it is hidden.
        frame: frame index.
        neighbors: K.
        level: of the cloud; each halves the resolution.
        stride: pixels per cell of level 0.

    Raises:
        ValueError: no such frame or track, or a point outside the image.
    """
    around = Around.of(clip, objects, track, frame, neighbors, level, stride)
    box = around.box()
    figure = Figure(figsize=(11.4, 3.2), layout="constrained")
    for column, kind in enumerate(NAMES):
        ax = figure.add_subplot(1, 4, 2 * column + 1)
        right = around.right[kind].sum()
        _in_image(ax, around, kind, box, f"{NAMES[kind]}: {right} of {neighbors} right")
        _in_space(figure.add_subplot(1, 4, 2 * column + 2), around, kind, box)
    figure.suptitle(f"frame {frame}, the point is {'seen' if around.seen else 'hidden'}", fontsize=9, color=INK)
    words = ("the point (hollow: hidden)", "cell on the point's own object", "cell on another object")
    looks = zip(("*", "o", "X"), (POINT, RIGHT, WRONG), (11, 7, 7), strict=True)
    handles = [Line2D([], [], ls="", marker=m, color=c, ms=s, mec=INK, mew=0.6) for m, c, s in looks]
    figure.legend(handles, words, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure


def neighborhoods_3d(
    clip: Clip,
    objects: np.ndarray,
    track: int,
    frame: int = 0,
    counts: Sequence[int] = (1, 4, 9, 16, 25, 32),
    first: int = 16,
) -> go.Figure:
    """Both neighbourhoods of a true point in space, to be turned, with a slider over K; camera coordinates, metres.

    Args:
        clip: with true tracks.
        objects: (T, H, W).
        track: whose true position in the frame is the query.
        frame: frame index.
        counts: values of K, rising.
        first: of these, the one that is shown at first.
    """
    steps = [Around.of(clip, objects, track, frame, k) for k in counts]
    cloud, rgb = steps[-1].surroundings(steps[-1].box())
    colors = [f"rgb({r},{g},{b})" for r, g, b in rgb]
    query = transform(steps[0].xyz[None], clip.extrinsics[frame])
    traces = list(range(2, 2 + len(MARKS)))
    frames = [
        go.Frame(name=str(k), data=[_marks(at, kind, right) for kind, right in MARKS], traces=traces)
        for k, at in zip(counts, steps, strict=True)
    ]
    edge = {"line": {"width": 2, "color": INK}}
    fixed = [_markers(cloud, "pixels", 3, colors), _markers(query, "the point", 8, POINT, symbol="diamond", **edge)]
    opened = list(counts).index(first)
    figure = go.Figure(data=[*fixed, *frames[opened].data], frames=frames)
    limits = axis_limits(np.concatenate([cloud, query, *(steps[-1].points(kind) for kind in NAMES)]))
    axes = fixed_axes(limits)
    for name, title in (("x", "x, to the right (m)"), ("y", "y, down (m)"), ("z", "depth z (m)")):
        axes[f"{name}axis"]["title"] = {"text": title, "font": {"size": 11}}
    axes["yaxis"]["range"].reverse()  # the image's y points down
    view = {"up": {"x": 0, "y": 1, "z": 0}, "eye": {"x": -1.6, "y": 0.7, "z": -0.9}}
    args = animation_args(0)
    steps_of_k = [{"label": str(k), "method": "animate", "args": [[str(k)], args]} for k in counts]
    slider = {"steps": steps_of_k, "active": opened, "currentvalue": {"prefix": "K = "}, "pad": {"t": 4, "b": 24}}
    figure.update_layout(
        scene=axes | {"camera": view},
        height=460,
        margin={"l": 0, "r": 0, "t": 34, "b": 0},
        uirevision="keep",
        sliders=[slider],
    )
    return figure


def share_curves(
    labels: Sequence[str], panels: Mapping[str, Mapping[str, np.ndarray]], xlabel: str, ylabel: str
) -> Figure:
    """Shares with 95 % intervals of the mean over clips, a panel an entry.

    Args:
        labels: (n,) of the places along x.
        panels: title to (curve to (C, n), one row a clip; NaN where a clip has nothing there); the same curves in all.
        xlabel: below each panel.
        ylabel: beside the first.
    """
    figure = Figure(figsize=(2.9 * len(panels) + 1.9, 3.0), layout="constrained")
    axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for ax, (title, curves) in zip(axes, panels.items(), strict=True):
        for i, ((name, values), (color, marker, line)) in enumerate(zip(curves.items(), _CURVES, strict=False)):
            clips = np.maximum((~np.isnan(values)).sum(0), 1)
            mean = np.nansum(values, 0) / clips
            error = 1.96 * np.sqrt(np.nansum((values - mean) ** 2, 0) / np.maximum(clips - 1, 1) / clips)
            style = {"marker": marker, "ls": line, "ms": 4, "lw": 1.6, "capsize": 2, "color": color}
            ax.errorbar(np.arange(len(labels)) + 0.06 * i, mean, error, label=name, **style)
        label_axes(ax, ylabel if ax is axes[0] else "", xlabel)
        ax.set_xticks(range(len(labels)), labels, fontsize=7)
        ax.set_title(title, fontsize=9, color=INK)
    figure.legend(*axes[0].get_legend_handles_labels(), fontsize=8, frameon=False, loc="outside right center")
    return figure


@dataclass(frozen=True)
class Proof:
    """What a search in a window knows.

    Attributes:
        query: (3,), camera frame.
        radius: of the window, in columns.
        last: distance of the k-th cell that was found.
        bound: distance to the nearest wall.
    """

    query: np.ndarray
    radius: int
    last: float
    bound: float


def proof_view(points: np.ndarray, intrinsics: np.ndarray, proofs: Mapping[str, Proof]) -> Figure:
    """A row of the map from above: the wedge of rays that a window visits, and the ball of the k nearest in it.

    Args:
        points: (W, 3) of the queries' row, camera frame.
        intrinsics: (3, 3).
        proofs: title to what is known; a panel each.
    """
    figure = Figure(figsize=(4.4 * len(proofs), 3.7), layout="constrained")
    for ax, (title, proof) in zip(figure.subplots(1, len(proofs), squeeze=False)[0], proofs.items(), strict=True):
        x, _, z = proof.query
        column = np.floor(intrinsics[0, 0] * x / z + intrinsics[0, 2] + 0.5)
        far = points[:, 2].max() * 1.1
        for name, out in (("walls of the window", -1), (None, 1)):
            slope = (column + out * (proof.radius + 1) - intrinsics[0, 2]) / intrinsics[0, 0]
            ax.plot([0, far * slope], [0, far], color=INK, lw=1, ls="--", label=name)
        inside = np.abs(np.arange(len(points)) - column) <= proof.radius
        looks = ((inside, RIGHT, "o", "cell, visited"), (~inside, "#6b7280", "x", "cell, not visited"))
        for which, color, marker, name in looks:
            ax.scatter(points[which, 0], points[which, 2], s=16, c=color, marker=marker, label=name, lw=1)
        circles = ((proof.last, RIGHT, "-", "ball of the K found"), (proof.bound, WRONG, "-.", "ball up to the wall"))
        for size, color, line, name in circles:
            ax.add_patch(Circle((x, z), size, fill=False, color=color, lw=1.6, ls=line, label=name))
        ax.plot(x, z, "*", ms=13, color=POINT, mec=INK, label="query", ls="")
        reach = 1.4 * max(proof.bound, proof.last, 0.05)
        ax.set_xlim(x - reach, x + reach)
        ax.set_ylim(z - reach, z + reach)
        ax.set_aspect("equal")
        label_axes(ax, "depth z (m)", "x (m)")
        ax.set_title(title, fontsize=9, color=INK)
    figure.legend(*ax.get_legend_handles_labels(), fontsize=8, frameon=False, loc="outside right center")
    return figure


def _in_image(ax: Axes, around: Around, kind: str, box: tuple[float, ...], title: str) -> None:
    draw_image(ax, around.clip.video[around.frame], title)
    left, top, end, bottom = box
    ax.set_xlim(left - 0.5, end + 0.5)
    ax.set_ylim(bottom + 0.5, top - 0.5)
    _marked(ax, around, kind, around.pixels(kind), around.uv)


def _in_space(ax: Axes, around: Around, kind: str, box: tuple[float, ...]) -> None:
    """The same part of the scene from the side: camera coordinates, depth to the right, up is up, one scale."""
    points, rgb = around.surroundings(box)
    ax.scatter(points[:, 2], -points[:, 1], c=rgb / 255, s=5, linewidths=0)
    cells, query = around.points(kind), transform(around.xyz[None], around.clip.extrinsics[around.frame])[0]
    _marked(ax, around, kind, cells[:, [2, 1]] * [1, -1], query[[2, 1]] * [1, -1])
    ax.set_aspect("equal", adjustable="datalim")
    label_axes(ax, "height, −y (m)", "depth z (m)")
    ax.set_title("the same, seen from the side", fontsize=8, color=INK)


def _marked(ax: Axes, around: Around, kind: str, cells: np.ndarray, query: np.ndarray) -> None:
    for which, color, marker in ((around.right[kind], RIGHT, "o"), (~around.right[kind], WRONG, "X")):
        ax.scatter(*cells[which].T, s=34, color=color, marker=marker, edgecolors="white", linewidths=0.6)
    ax.scatter(*query, s=110, marker="*", color=POINT if around.seen else "none", edgecolors=INK, linewidths=1)


def _marks(around: Around, kind: str, right: bool) -> go.Scatter3d:
    symbol, size = MARKS[kind, right]
    whose = "on the point's own object" if right else "on another object"
    points = around.points(kind)[around.right[kind] == right]
    return _markers(points, f"{NAMES[kind]}, {whose}", size, RIGHT if right else WRONG, symbol=symbol)


def _markers(points: np.ndarray, name: str, size: int, color: object, **style: object) -> go.Scatter3d:
    x, y, z = points.astype(np.float32).T
    marker = {"size": size, "color": color, "line": {"width": 0}} | style
    return go.Scatter3d(x=x, y=y, z=z, name=name, mode="markers", marker=marker, hoverinfo="name")
