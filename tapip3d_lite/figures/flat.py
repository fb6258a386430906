"""Flat figures: frames with tracks, depth, contact sheets."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.geometry import project

INK = "#30343b"
STILL, MOVING = "#2b6cb0", "#d1495b"  # points at rest, points on moving bodies


def track_colors(clip: Clip, tracks: Tracks) -> np.ndarray:
    """One RGB colour (N, 3) in [0, 1] for each track, by where its query lies in the image; alike in all figures."""
    t = tracks.queries[:, 0].astype(int)
    uv, _ = project(tracks.queries[:, None, 1:], clip.intrinsics[t], clip.extrinsics[t])
    height, width = clip.size
    place = (uv[:, 0, 0] / width + uv[:, 0, 1] / height) / 2
    # Most queries lie around the middle of the image: the steeper slope spends the rainbow on them.
    return matplotlib.colormaps["turbo"](np.clip(0.5 + 1.7 * (place - 0.5), 0.04, 0.96))[:, :3]


def check_drawable(clip: Clip, tracks: Tracks | None = None, frame: int = 0) -> None:
    """Refuse a frame outside the clip, or tracks of another length, before a figure fails on them.

    Raises:
        ValueError: such a frame or such tracks.
    """
    if not 0 <= frame < len(clip):
        raise ValueError(f"frame: expected 0 to {len(clip) - 1} (clip {clip.name!r}), got {frame}; choose another")
    if tracks is not None and len(tracks.xyz) != len(clip):
        raise ValueError(
            f"tracks: expected {len(clip)} frames as in clip {clip.name!r}, got {len(tracks.xyz)}; cut both alike"
        )


def frame_with_tracks(
    clip: Clip, tracks: Tracks, frame: int, tail: int = 8, truth: Tracks | None = None, ax: Axes | None = None
) -> Figure:
    """A video frame with the tracked points: filled where visible, hollow where occluded, tails over past frames.

    Args:
        clip: the clip.
        tracks: what to draw, world frame.
        frame: frame index.
        tail: how many past frames the tails cover.
        truth: true tracks of the same queries; a white line then joins each estimate with the truth.
        ax: axes to draw into, else a new figure.
    """
    check_drawable(clip, tracks, frame)
    ax = ax or _axes(clip)
    draw_image(ax, clip.video[frame], f"{clip.name} · frame {frame}")
    start = max(0, frame - tail)
    span = slice(start, frame + 1)
    uv, z = project(tracks.xyz[span], clip.intrinsics[span], clip.extrinsics[span])
    uv = np.where((z > 0)[..., None], uv, np.nan)
    colors = track_colors(clip, tracks)
    for n in range(uv.shape[1]):
        ax.plot(uv[:, n, 0], uv[:, n, 1], color=colors[n], lw=1.1, alpha=0.85)
    seen = tracks.visible[frame]
    now = uv[-1]
    ax.scatter(*now[~seen].T, s=11, facecolors="none", edgecolors=colors[~seen], linewidths=0.8)
    ax.scatter(*now[seen].T, s=11, c=colors[seen], edgecolors="white", linewidths=0.3)
    if truth is not None:
        true_uv, _ = project(truth.xyz[frame], clip.intrinsics[frame], clip.extrinsics[frame])
        ax.plot(*np.stack([now, true_uv], 1).transpose(2, 1, 0), color="white", lw=0.8)
    return ax.figure


def depth_map(clip: Clip, frame: int, ax: Axes | None = None) -> Figure:
    """Depth of one frame with a colour bar in scene units; pixels without depth are grey."""
    check_drawable(clip, frame=frame)
    ax = ax or _axes(clip, extra=0.9)
    depth = clip.depths[frame]
    image = _depth(ax, depth, np.quantile(depth[depth > 0], [0, 0.99]) if depth.any() else (0, 1))
    _bare(ax, f"{clip.name} · depth, frame {frame}")
    _depth_bar(ax.figure, image, [ax])
    return ax.figure


def contact_sheet(clips: Clip | Sequence[Clip], frames: int = 6, width: float = 1.35) -> Figure:
    """Frames spread over time, one row a clip."""
    clips = [clips] if isinstance(clips, Clip) else list(clips)
    height, wide = clips[0].size
    figure = _figure(frames * width, len(clips) * width * height / wide + 0.25)
    for row, clip in enumerate(clips):
        for column, t in enumerate(np.linspace(0, len(clip) - 1, frames).astype(int)):
            ax = figure.add_subplot(len(clips), frames, row * frames + column + 1)
            title = f"t = {t}" if row == 0 else ""
            draw_image(ax, clip.video[t], title)
            if column == 0:
                ax.set_ylabel(clip.name, fontsize=8, color=INK)
    return figure


def overview(clip: Clip, tracks: Tracks, columns: int = 4) -> Figure:
    """The picture of a result: frames with tracks above, their depth below."""
    height, width = clip.size
    check_drawable(clip, tracks)
    figure = _figure(2.6 * columns + 0.6, 2 * 2.6 * height / width + 0.3)
    axes = figure.subplots(2, columns, squeeze=False)
    limits = np.quantile(clip.depths[clip.depths > 0], [0, 0.99])
    for (above, below), t in zip(axes.T, np.linspace(0, len(clip) - 1, columns).astype(int), strict=True):
        frame_with_tracks(clip, tracks, t, ax=above)
        image = _depth(below, clip.depths[t], limits)
        _bare(below, "")
    _depth_bar(figure, image, list(axes[1]))
    return figure


def _depth(ax: Axes, depth: np.ndarray, limits: Sequence[float]) -> AxesImage:
    cmap = matplotlib.colormaps["viridis_r"].with_extremes(bad="#b8b8b8")
    return ax.imshow(np.ma.masked_equal(depth, 0), cmap=cmap, vmin=limits[0], vmax=limits[1])


def _depth_bar(figure: Figure, image: AxesImage, axes: list[Axes]) -> None:
    bar = figure.colorbar(image, ax=axes, fraction=0.046, pad=0.02, extend="max")
    bar.set_label("z-depth (scene units)", fontsize=8)
    bar.ax.tick_params(labelsize=7)


def _figure(width: float, height: float) -> Figure:
    return Figure(figsize=(width, height), layout="constrained")


def _axes(clip: Clip, side: float = 3.4, extra: float = 0.0) -> Axes:
    height, width = clip.size
    return _figure(side + extra, side * height / width + 0.25).add_subplot()


def draw_image(ax: Axes, image: np.ndarray, title: str) -> None:
    """Draw an image (H, W, ...) with pixel centres at whole numbers and limits that stay when points are added."""
    ax.imshow(image)
    height, width = image.shape[:2]
    ax.set_xlim(-0.5, width - 0.5)
    ax.set_ylim(height - 0.5, -0.5)
    ax.set_autoscale_on(False)
    _bare(ax, title)


def _bare(ax: Axes, title: str) -> None:
    ax.set_xticks([])
    ax.set_yticks([])
    ax.set_title(title, fontsize=8, color=INK)
    for side in ax.spines.values():
        side.set_visible(False)


def label_axes(ax: Axes, vertical: str, horizontal: str) -> None:
    """Give axes their labels and the look that all curves share."""
    ax.set_ylabel(vertical, fontsize=8)
    ax.set_xlabel(horizontal, fontsize=8)
    ax.tick_params(labelsize=7)
    ax.spines[["top", "right"]].set_visible(False)
    ax.grid(alpha=0.25, lw=0.5)
