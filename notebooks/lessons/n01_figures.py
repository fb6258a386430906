"""The figures of lesson 01: pure functions from numbers to pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import plotly.graph_objects as go
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tapip3d_lite.clip import Clip
from tapip3d_lite.figures import depth_map, frame_with_tracks, show_3d
from tapip3d_lite.figures.flat import label_axes
from tapip3d_lite.geometry import point_map

Array = np.ndarray
BLUE, RED, GREEN, GREY = "#0072b2", "#d55e00", "#009e73", "#9aa1ab"  # of the palette of Okabe and Ito
NEAR = 1.6  # times the median depth: what lies beyond is left out, so that the bodies are large


def panels(*draws: Callable[[Axes], object], width: float = 3.6, height: float = 3.1) -> Figure:
    """One figure, one panel for each function draw(ax)."""
    figure = Figure(figsize=(width * len(draws), height), layout="constrained")
    for ax, draw in zip(figure.subplots(1, len(draws), squeeze=False)[0], draws, strict=True):
        draw(ax)
    return figure


def image_and_depth(clip: Clip, frame: int, *more: Callable[[Axes], object]) -> Figure:
    """A frame, its depth, and what other functions draw beside them."""
    nothing = clip.tracks.select(slice(0))
    return panels(
        lambda ax: frame_with_tracks(clip, nothing, frame, ax=ax), lambda ax: depth_map(clip, frame, ax=ax), *more
    )


def from_the_side(clip: Clip, frame: int) -> Callable[[Axes], None]:
    """A panel with a frame's pixels as points in the camera's frame, seen from its side."""

    def draw(ax: Axes) -> None:
        x = point_map(clip.depths[frame], clip.intrinsics[frame]).reshape(-1, 3)
        near = (x[:, 2] > 0) & (x[:, 2] < NEAR * np.median(x[:, 2]))
        colors = clip.video[frame].reshape(-1, 3)[near] / 255
        ax.scatter(x[near, 2], -x[near, 1], c=colors, s=2, linewidths=0)
        ax.set_aspect("equal")
        label_axes(ax, "up in the image (m)", "depth (m)")
        ax.set_title("the same pixels as points, from the side", fontsize=8)

    return draw


def slip_over_depth(z: Array, slip: Array, limit: Array) -> Figure:
    """How far points of depths z (N,) were moved, and how far they may be off, both (N,) in metres."""

    def draw(ax: Axes) -> None:
        order = np.argsort(z)[:: max(1, len(z) // 400)]
        ax.plot(z[order], 1000 * slip[order], "o", ms=2.5, color=RED, label="moved by half a pixel in u and in v")
        ax.plot(z[order], 1000 * limit[order], "--", color=BLUE, label="the strictest threshold of TAPVid-3D")
        ax.set(xlim=(0, None), ylim=(0, None))
        label_axes(ax, "distance (mm)", "depth of the point (m)")
        ax.legend(fontsize=8, frameon=False)

    return panels(draw, width=5.2, height=2.8)


def lines_over_pixels(curves: Mapping[str, Array], x: Array, vertical: str, horizontal: str = "u (px)") -> Figure:
    """Named curves over pixel coordinates x; told apart by colour and by dashes."""

    def draw(ax: Axes) -> None:
        for (name, y), color, dash in zip(curves.items(), (BLUE, RED, GREEN), ("-", "--", "-."), strict=False):
            ax.plot(x, y, dash, color=color, label=name, marker="o" if len(x) < 20 else None, ms=4)
        label_axes(ax, vertical, horizontal)
        ax.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))

    return panels(draw, width=6.6, height=2.6)


def two_liftings(pairs: Mapping[str, tuple[Array, Array]]) -> Figure:
    """For each title the same points lifted from two frames, both (N, 3), from above; lines join copies."""

    def draw(title: str, first: Array, last: Array) -> Callable[[Axes], None]:
        def panel(ax: Axes) -> None:
            for p, q in zip(first, last, strict=True):
                ax.plot([p[0], q[0]], [p[1], q[1]], color=GREY, lw=0.8, zorder=0)
            hollow = {"s": 40, "facecolors": "none", "edgecolors": BLUE}
            ax.scatter(first[:, 0], first[:, 1], **hollow, label="from the first frame")
            ax.scatter(last[:, 0], last[:, 1], s=8, color=RED, label="from the last frame")
            ax.set_aspect("equal", adjustable="datalim")
            label_axes(ax, "y (m)", "x (m)")
            ax.set_title(title, fontsize=9)

        return panel

    figure = panels(*(draw(title, *pair) for title, pair in pairs.items()), width=4.4, height=3.9)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    return figure


def cells_from_the_side(surface: Array, kinds: Mapping[str, tuple[Array, Array]]) -> Figure:
    """For each title cells (n, 3) and whether they fly (n,), over the true surface (m, 3), from the camera's side."""
    near = NEAR * np.median(surface[:, 2])
    shown = surface[surface[:, 2] < near]

    def draw(title: str, cells: Array, fly: Array) -> Callable[[Axes], None]:
        def panel(ax: Axes) -> None:
            ax.scatter(shown[:, 2], -shown[:, 1], s=2, color="#c9ced6", linewidths=0, label="true surface")
            ax.scatter(cells[~fly, 2], -cells[~fly, 1], s=9, color=BLUE, linewidths=0, label="cell on a surface")
            ax.scatter(cells[fly, 2], -cells[fly, 1], s=18, color=RED, marker="x", lw=1.2, label="flying cell")
            ax.set_xlim(shown[:, 2].min() - 0.3, near)
            ax.set_ylim(-shown[:, 1].max() - 0.2, -shown[:, 1].min() + 0.2)
            label_axes(ax, "up in the image (m)", "depth (m)")
            ax.set_title(f"{title}: {fly.sum()} of {len(cells)} fly", fontsize=9)

        return panel

    figure = panels(*(draw(title, *kind) for title, kind in kinds.items()), width=4.6, height=3.5)
    figure.legend(
        *figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8, markerscale=2
    )
    return figure


def cells_in_space(surface: Array, cells: Array, fly: Array) -> show_3d:
    """The same in three dimensions."""
    groups = [("true surface", surface, GREY, "circle", "o", 1.0)]
    groups += [
        ("cell on a surface", cells[~fly], BLUE, "circle", "o", 3),
        ("flying cell", cells[fly], RED, "diamond", "D", 4),
    ]
    near = NEAR * np.median(surface[:, 2])
    scene, twin = go.Figure(), Figure(figsize=(6.4, 4.4), layout="constrained")
    ax = twin.add_subplot(projection="3d", computed_zorder=False)
    drawn = []
    for name, xyz, color, symbol, mark, size in groups:
        x, y, z = xyz[xyz[:, 2] < near].T.astype(np.float32)
        drawn.append((x, z, -y))
        marker = {"size": size, "color": color, "symbol": symbol}
        scene.add_scatter3d(x=x, y=z, z=-y, name=name, mode="markers", marker=marker, hoverinfo="skip")
        ax.scatter(x, z, -y, s=size**2, color=color, marker=mark, lw=size / 3, label=name, depthshade=False)
    names = {"xaxis_title": "right (m)", "yaxis_title": "depth (m)", "zaxis_title": "up (m)"}
    view = {"aspectmode": "data", "camera": {"eye": {"x": -1.0, "y": -1.3, "z": 0.6}}}
    legend = {"itemsizing": "constant", "x": 0.02, "y": 0.98}
    scene.update_layout(scene=names | view, legend=legend, height=480, margin=dict.fromkeys("lrtb", 0))
    ax.set_box_aspect([np.ptp(np.concatenate(axis)) for axis in zip(*drawn, strict=True)], zoom=1.1)
    ax.view_init(elev=20, azim=-128)
    ax.set_xlabel("right (m)", fontsize=8)
    ax.set_ylabel("depth (m)", fontsize=8)
    ax.set_zlabel("up (m)", fontsize=8)
    ax.tick_params(labelsize=7)
    ax.legend(fontsize=8, frameon=False, loc="upper left", markerscale=2)
    return show_3d(scene, twin)


def levels_from_above(levels: Sequence[tuple[Array, Array]]) -> Figure:
    """Levels of a cloud, each colours (n, 3) and points (n, 3) of the camera's frame, seen from above."""
    x, _, z = np.concatenate([points for _, points in levels]).T

    def draw(level: int) -> Callable[[Axes], None]:
        def panel(ax: Axes) -> None:
            colors, points = levels[level]
            style = {"edgecolors": "#30343b", "linewidths": 0.2 + 0.25 * level}
            ax.scatter(points[:, 0], points[:, 2], c=colors, s=9 * 2.4**level, **style)
            ax.set_xlim(1.12 * x.min(), 1.12 * x.max())
            ax.set_ylim(0.85 * z.min(), 1.05 * z.max())
            label_axes(ax, "depth (m)" if level == 0 else "", "right (m)")
            ax.set_title(f"level {level}: {len(points)} cells", fontsize=9)

        return panel

    return panels(*(draw(level) for level in range(len(levels))), width=2.6, height=3.3)
