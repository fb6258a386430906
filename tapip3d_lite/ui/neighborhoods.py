"""Figures of notebook 03: two neighbourhoods in the image and in space, and shares of right neighbours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from tapip3d_lite.clip import Clip
from tapip3d_lite.evaluation.neighborhoods import Cells, track_objects
from tapip3d_lite.geometry import project, transform, unproject
from tapip3d_lite.ui.figures2d import INK, _image, _plot, check_drawable

QUERY, RIGHT, WRONG = "#e8a33d", "#2b6cb0", "#d1495b"
NAMES = {"window": "window in the image", "knn": "k-NN in 3D"}


def two_neighborhoods(
    clip: Clip, objects: np.ndarray, track: int, frame: int = 0, neighbors: int = 9, level: int = 0, stride: int = 4
) -> Figure:
    """The window and the nearest neighbours of a true point, each in the image and in space: blue right, red wrong.

    Args:
        clip: with true tracks.
        objects: (T, H, W), see `simulate.object_maps`.
        track: whose true position in the frame is the query; hollow where it is hidden.
        frame: frame index.
        neighbors: K.
        level: of the cloud; each halves the resolution.
        stride: pixels per cell of level 0.

    Raises:
        ValueError: no such frame or track, or a point outside the image.
    """
    check_drawable(clip, frame=frame)
    if not 0 <= track < clip.tracks.xyz.shape[1]:
        raise ValueError(f"track: expected 0 to {clip.tracks.xyz.shape[1] - 1}, got {track}; choose another")
    xyz, seen = clip.tracks.xyz[frame, track : track + 1], clip.tracks.visible[frame, track]
    uv, z = project(xyz, clip.intrinsics[frame], clip.extrinsics[frame])
    if z[0] <= 0 or (uv < -0.5).any() or (uv > np.array(clip.size[::-1]) - 0.5).any():
        raise ValueError(f"track {track} is outside the image in frame {frame}; choose another frame or track")
    cells, own = Cells.of(clip, objects, frame, stride << level), track_objects(clip, objects)[track]
    found = {kind: cells.near(xyz, uv, neighbors, kind)[0] for kind in NAMES}
    places = np.concatenate([uv, *(cells.uv.reshape(-1, 2)[i] for i in found.values())])
    box = _square(places, clip.size)
    everything = cells.points.reshape(-1, 3)[np.concatenate(list(found.values()))]
    figure = Figure(figsize=(11.2, 3.0), layout="constrained")
    for column, (kind, index) in enumerate(found.items()):
        right = cells.objects.ravel()[index] == own
        title = f"frame {frame} · {NAMES[kind]}: {right.sum()} of {neighbors} right"
        ax = figure.add_subplot(1, 4, 2 * column + 1)
        _in_image(ax, clip, frame, cells.uv.reshape(-1, 2)[index], right, box, title)
        ax.scatter(*uv[0], s=90, marker="*", color=QUERY if seen else "none", edgecolors="white" if seen else QUERY)
        ax = figure.add_subplot(1, 4, 2 * column + 2, projection="3d", computed_zorder=False)
        _in_space(ax, clip, frame, cells.points.reshape(-1, 3)[index], right, box, xyz[0], everything)
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
        _plot(ax, ylabel if ax is axes[0] else "", xlabel)
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
    _plot(ax, "depth z (m)", "x (m)")
    ax.legend(fontsize=7, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _square(places: np.ndarray, size: tuple[int, int], margin: float = 8) -> tuple[float, float, float, float]:
    """(left, top, right, bottom) of a square around places (n, 2), moved into the image where it fits."""
    side = min(np.ptp(places, axis=0).max() + 2 * margin, min(size) - 1)
    middle = (places.min(0) + places.max(0)) / 2
    low = np.clip(middle - side / 2, 0, np.array(size[::-1]) - 1 - side)
    return (*low, *(low + side))


def _in_image(
    ax: Axes, clip: Clip, frame: int, uv: np.ndarray, right: np.ndarray, box: tuple[float, ...], title: str
) -> None:
    _image(ax, clip.video[frame], title)
    left, top, end, bottom = box
    ax.set_xlim(left - 0.5, end + 0.5)
    ax.set_ylim(bottom + 0.5, top - 0.5)
    for which, color, marker in ((right, RIGHT, "o"), (~right, WRONG, "X")):
        ax.scatter(*uv[which].T, s=34, color=color, marker=marker, edgecolors="white", linewidths=0.6)


def _in_space(
    ax: Axes,
    clip: Clip,
    frame: int,
    cells: np.ndarray,
    right: np.ndarray,
    box: tuple[float, ...],
    query: np.ndarray,
    everything: np.ndarray,
) -> None:
    """The same part of the scene, seen from the side, cut off in depth just behind and before `everything`."""
    left, top, end, bottom = (round(x) for x in box)
    v, u = (x.ravel() for x in np.mgrid[top : bottom + 1, left : end + 1])
    depth, camera = clip.depths[frame, v, u], transform(np.stack([query, *cells]), clip.extrinsics[frame])
    limits = transform(everything, clip.extrinsics[frame])[:, 2]
    shown = (depth > limits.min() - 0.5) & (depth < limits.max() + 0.5) & (depth > 0)
    uv = np.stack([u, v], -1)[shown].astype(np.float32)
    x, y, z = unproject(uv, depth[shown], clip.intrinsics[frame]).T
    ax.scatter(x, z, -y, c=clip.video[frame, v, u][shown] / 255, s=4, depthshade=False, linewidths=0, alpha=0.7)
    for which, color, marker in ((right, RIGHT, "o"), (~right, WRONG, "X")):
        x, y, z = camera[1:][which].T
        style = {"s": 26, "color": color, "marker": marker, "edgecolors": "white", "linewidths": 0.5}
        ax.scatter(x, z, -y, depthshade=False, **style)
    x, y, z = camera[0]
    ax.scatter(x, z, -y, s=80, color=QUERY, marker="*", edgecolors="white", linewidths=0.5, depthshade=False)
    spans = [max(np.ptp(values), 1e-3) for values in (ax.get_xlim(), ax.get_ylim(), ax.get_zlim())]
    ax.set_box_aspect(spans, zoom=1.15)
    ax.view_init(elev=22, azim=-25)
    ax.set(xticklabels=[], yticklabels=[], zticklabels=[])
    ax.set_ylabel("depth", fontsize=7, labelpad=-12)
