"""Lesson 03: two neighbourhoods in the image and in space, and shares of right neighbours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from lessons.checker import check
from lessons.guesses import reveal
from lessons.milestone import milestone
from lessons.n02_straightness import to_space
from lessons.n03_cells import Cells, silhouettes, track_objects
from lessons.n03_exercises import EXERCISES, search, walls
from lessons.pictures import pipeline, show
from lessons.progress import collect, in_use, progress, reset
from lessons.samples import SAMPLES
from lessons.widgets import explore
from tapip3d_lite.clip import Clip
from tapip3d_lite.figures.flat import INK, check_drawable, draw_image, label_axes
from tapip3d_lite.figures.scene_3d import animation_args, axis_limits, fixed_axes
from tapip3d_lite.geometry import project, transform, unproject

__all__ = [
    "EXERCISES",
    "SAMPLES",
    "Around",
    "Cells",
    "check",
    "collect",
    "explore",
    "in_use",
    "milestone",
    "neighborhoods_3d",
    "pipeline",
    "progress",
    "proof_view",
    "reset",
    "reveal",
    "search",
    "share_curves",
    "show",
    "silhouettes",
    "to_space",
    "track_objects",
    "two_neighborhoods",
    "walls",
]

QUERY, RIGHT, WRONG = "#e8a33d", "#2b6cb0", "#d1495b"
NAMES = {"window": "window in the image", "knn": "k-NN in 3D"}


@dataclass(frozen=True)
class Around:
    """A true point in a frame with both of its neighbourhoods.

    Attributes:
        clip: with true tracks.
        frame: frame index.
        cells: of the frame and level.
        xyz: (3,) the point, world.
        uv: (2,) its pixel.
        seen: whether it is visible.
        found: kind of neighbourhood to indices (K,) of its cells, the nearest or the upper left first.
        right: kind to (K,) bool, which of them lie on the point's own object.
    """

    clip: Clip
    frame: int
    cells: Cells
    xyz: np.ndarray
    uv: np.ndarray
    seen: bool
    found: Mapping[str, np.ndarray]
    right: Mapping[str, np.ndarray]

    @classmethod
    def of(
        cls, clip: Clip, objects: np.ndarray, track: int, frame: int, neighbors: int, level: int = 0, stride: int = 4
    ) -> Around:
        """Collect them; arguments as for `two_neighborhoods`."""
        check_drawable(clip, frame=frame)
        if not 0 <= track < clip.tracks.xyz.shape[1]:
            raise ValueError(f"track: expected 0 to {clip.tracks.xyz.shape[1] - 1}, got {track}; choose another")
        xyz = clip.tracks.xyz[frame, track : track + 1]
        uv, z = project(xyz, clip.intrinsics[frame], clip.extrinsics[frame])
        if z[0] <= 0 or (uv < -0.5).any() or (uv > np.array(clip.size[::-1]) - 0.5).any():
            raise ValueError(f"track {track} is outside the image in frame {frame}; choose another frame or track")
        cells, own = Cells.of(clip, objects, frame, stride << level), track_objects(clip, objects)[track]
        found = {kind: cells.near(xyz, uv, neighbors, kind)[0] for kind in NAMES}
        right = {kind: cells.objects.ravel()[index] == own for kind, index in found.items()}
        return cls(clip, frame, cells, xyz[0], uv[0], bool(clip.tracks.visible[frame, track]), found, right)

    def points(self, kind: str) -> np.ndarray:
        """The neighbours' points (K, 3), camera frame."""
        return transform(self.cells.points.reshape(-1, 3)[self.found[kind]], self.clip.extrinsics[self.frame])

    def pixels(self, kind: str) -> np.ndarray:
        """The neighbours' pixels (K, 2)."""
        return self.cells.uv.reshape(-1, 2)[self.found[kind]]

    def surroundings(self, box: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Points (P, 3), camera frame, and colours (P, 3) of the pixels in a box, near the neighbours in depth."""
        left, top, end, bottom = (round(x) for x in box)
        v, u = (x.ravel() for x in np.mgrid[top : bottom + 1, left : end + 1])
        depth = self.clip.depths[self.frame, v, u]
        limits = np.concatenate([self.points(kind)[:, 2] for kind in NAMES])
        shown = (depth > 0) & (depth > limits.min() - 0.5) & (depth < limits.max() + 0.5)
        uv = np.stack([u, v], -1)[shown].astype(np.float32)
        return unproject(uv, depth[shown], self.clip.intrinsics[self.frame]), self.clip.video[self.frame, v, u][shown]

    def box(self, margin: float = 8) -> tuple[float, ...]:
        """(left, top, right, bottom) of a square of pixels around everything, moved into the image where it fits."""
        places, wide = np.stack([self.uv, *self.pixels("window"), *self.pixels("knn")]), self.clip.size[::-1]
        side = min(np.ptp(places, axis=0).max() + 2 * margin, min(wide) - 1)
        low = np.clip((places.min(0) + places.max(0) - side) / 2, 0, np.array(wide) - 1 - side)
        return (*low, *(low + side))


def two_neighborhoods(
    clip: Clip, objects: np.ndarray, track: int, frame: int = 0, neighbors: int = 9, level: int = 0, stride: int = 4
) -> Figure:
    """The window and the nearest neighbours of a true point, each in the image and in space: blue right, red wrong.

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
    figure = Figure(figsize=(11.2, 3.0), layout="constrained")
    for column, kind in enumerate(NAMES):
        ax = figure.add_subplot(1, 4, 2 * column + 1)
        right = around.right[kind].sum()
        _in_image(ax, around, kind, box, f"frame {frame} · {NAMES[kind]}: {right} of {neighbors} right")
        ax = figure.add_subplot(1, 4, 2 * column + 2, projection="3d", computed_zorder=False)
        _in_space(ax, around, kind, box)
    return figure


def neighborhoods_3d(
    clip: Clip, objects: np.ndarray, track: int, frame: int = 0, counts: Sequence[int] = (1, 4, 9, 16, 32)
) -> go.Figure:
    """Both neighbourhoods of a true point in space, to be turned, with a slider over K; camera coordinates, metres.

    Args:
        clip: with true tracks.
        objects: (T, H, W).
        track: whose true position in the frame is the query.
        frame: frame index.
        counts: values of K, rising.
    """
    steps = [Around.of(clip, objects, track, frame, k) for k in counts]
    cloud, rgb = steps[-1].surroundings(steps[-1].box())
    colors = [f"rgb({r},{g},{b})" for r, g, b in rgb]
    query = transform(steps[0].xyz[None], clip.extrinsics[frame])
    styles = (("circle", "k-NN in 3D", "knn", 6), ("square-open", "window in the image", "window", 8))
    frames = [
        go.Frame(name=str(k), data=[_marks(at, *style) for style in styles], traces=[2, 3])
        for k, at in zip(counts, steps, strict=True)
    ]
    fixed = [_markers(cloud, "scene", 3, colors), _markers(query, "query", 7, QUERY, symbol="diamond")]
    figure = go.Figure(data=[*fixed, *frames[0].data], frames=frames)
    limits = axis_limits(np.concatenate([cloud, query, *(steps[-1].points(kind) for kind in NAMES)]))
    axes = fixed_axes(limits)
    axes["yaxis"]["range"].reverse()  # the image's y points down
    view = {"up": {"x": 0, "y": 1, "z": 0}, "eye": {"x": -1.6, "y": 0.7, "z": -0.9}}
    args = animation_args(0)
    steps_of_k = [{"label": str(k), "method": "animate", "args": [[str(k)], args]} for k in counts]
    figure.update_layout(
        scene=axes | {"camera": view},
        height=460,
        margin={"l": 0, "r": 0, "t": 34, "b": 0},
        uirevision="keep",
        sliders=[{"steps": steps_of_k, "currentvalue": {"prefix": "K = "}, "pad": {"t": 4, "b": 24}}],
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
    figure = Figure(figsize=(2.9 * len(panels) + 1.7, 2.8), layout="constrained")
    axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for ax, (title, curves) in zip(axes, panels.items(), strict=True):
        for i, (name, values) in enumerate(curves.items()):
            clips = np.maximum((~np.isnan(values)).sum(0), 1)
            mean = np.nansum(values, 0) / clips
            error = 1.96 * np.sqrt(np.nansum((values - mean) ** 2, 0) / np.maximum(clips - 1, 1) / clips)
            style = {"marker": "o", "ms": 3, "lw": 1.5, "capsize": 2, "color": f"C{i}"}
            ax.errorbar(np.arange(len(labels)) + 0.06 * i, mean, error, label=name, **style)
        label_axes(ax, ylabel if ax is axes[0] else "", xlabel)
        ax.set_xticks(range(len(labels)), labels, fontsize=7)
        ax.set_title(title, fontsize=9, color=INK)
    figure.legend(*axes[0].get_legend_handles_labels(), fontsize=8, frameon=False, loc="outside right center")
    return figure


def proof_view(
    points: np.ndarray, intrinsics: np.ndarray, query: np.ndarray, radius: int, last: float, bound: float
) -> Figure:
    """A row of the map from above: the wedge of rays that a window leaves unvisited, and the ball of the k nearest.

    Args:
        points: (W, 3) of the query's row, camera frame.
        intrinsics: (3, 3).
        query: (3,), camera frame.
        radius: of the window, in columns.
        last: distance of the k-th neighbour.
        bound: distance to the nearest ray outside.
    """
    figure = Figure(figsize=(6.4, 3.2), layout="constrained")
    ax = figure.add_subplot()
    x, _, z = query
    column = np.floor(intrinsics[0, 0] * x / z + intrinsics[0, 2] + 0.5)
    far = points[:, 2].max() * 1.1
    for out in (column - radius - 1, column + radius + 1):
        ax.plot([0, far * (out - intrinsics[0, 2]) / intrinsics[0, 0]], [0, far], color=INK, lw=0.8, ls="--")
    inside = np.abs(np.arange(len(points)) - column) <= radius
    for which, color, name in ((inside, RIGHT, "visited"), (~inside, "#b8bcc4", "not visited")):
        ax.scatter(points[which, 0], points[which, 2], s=9, color=color, label=name, linewidths=0)
    for size, color, name in ((last, QUERY, "k-th neighbour"), (bound, WRONG, "nearest ray outside")):
        ax.add_patch(Circle((x, z), size, fill=False, color=color, lw=1.5, label=name))
    ax.plot(x, z, "*", ms=11, color=QUERY, mec="white")
    reach = 2.2 * max(bound, last, 0.05)
    ax.set_xlim(x - 1.6 * reach, x + 1.6 * reach)
    ax.set_ylim(z - reach, z + reach)
    ax.set_aspect("equal")
    label_axes(ax, "depth z (m)", "x (m)")
    ax.legend(fontsize=7, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _in_image(ax: Axes, around: Around, kind: str, box: tuple[float, ...], title: str) -> None:
    draw_image(ax, around.clip.video[around.frame], title)
    left, top, end, bottom = box
    ax.set_xlim(left - 0.5, end + 0.5)
    ax.set_ylim(bottom + 0.5, top - 0.5)
    for which, color, marker in ((around.right[kind], RIGHT, "o"), (~around.right[kind], WRONG, "X")):
        style = {"s": 34, "color": color, "marker": marker, "edgecolors": "white", "linewidths": 0.6}
        ax.scatter(*around.pixels(kind)[which].T, **style)
    fill, edge = (QUERY, "white") if around.seen else ("none", QUERY)
    ax.scatter(*around.uv, s=90, marker="*", color=fill, edgecolors=edge)


def _in_space(ax: Axes, around: Around, kind: str, box: tuple[float, ...]) -> None:
    """The same part of the scene, seen from the side: camera coordinates, depth to the right, up is up."""
    (x, y, z), rgb = around.surroundings(box)[0].T, around.surroundings(box)[1]
    ax.scatter(x, z, -y, c=rgb / 255, s=4, depthshade=False, linewidths=0, alpha=0.7)
    query = transform(around.xyz[None], around.clip.extrinsics[around.frame])
    right, cells = around.right[kind], around.points(kind)
    marks = ((cells[right], RIGHT, "o", 26), (cells[~right], WRONG, "X", 26), (query, QUERY, "*", 80))
    for points, color, marker, size in marks:
        x, y, z = points.T
        style = {"s": size, "color": color, "marker": marker, "edgecolors": "white", "linewidths": 0.5}
        ax.scatter(x, z, -y, depthshade=False, **style)
    ax.set_box_aspect([max(np.ptp(f()), 1e-3) for f in (ax.get_xlim, ax.get_ylim, ax.get_zlim)], zoom=1.15)
    ax.view_init(elev=22, azim=-25)
    ax.set(xticklabels=[], yticklabels=[], zticklabels=[])
    ax.set_ylabel("depth", fontsize=7, labelpad=-12)


def _marks(around: Around, symbol: str, name: str, kind: str, size: int) -> go.Scatter3d:
    colors = [RIGHT if right else WRONG for right in around.right[kind]]
    return _markers(around.points(kind), name, size, colors, symbol=symbol)


def _markers(points: np.ndarray, name: str, size: int, color: object, **style: object) -> go.Scatter3d:
    x, y, z = points.astype(np.float32).T
    marker = {"size": size, "color": color, "line": {"width": 0}} | style
    return go.Scatter3d(x=x, y=y, z=z, name=name, mode="markers", marker=marker, hoverinfo="name")
