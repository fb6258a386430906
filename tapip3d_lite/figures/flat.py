"""Flat figures: frames with tracks, depth, contact sheets."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.geometry import project
from tapip3d_lite.validate import checked

INK = "#30343b"
STILL, MOVING = "#2b6cb0", "#d1495b"  # points at rest, points on moving bodies
_PALETTE, _ENDS = matplotlib.colormaps["plasma"], (0.02, 0.93)  # its order is seen by the colour-blind, too
PLACES = tuple(_PALETTE(end)[:3] for end in _ENDS)  # colours of tracks that begin top left and bottom right


def track_colors(clip: Clip, tracks: Tracks) -> np.ndarray:
    """One RGB colour (N, 3) in [0, 1] for each track, by where its query lies in the image; alike in all figures."""
    t = tracks.queries[:, 0].astype(int)
    uv, _ = project(tracks.queries[:, None, 1:], clip.intrinsics[t], clip.extrinsics[t])
    height, width = clip.size
    place = (uv[:, 0, 0] / width + uv[:, 0, 1] / height) / 2
    # Most queries lie around the middle of the image: the steeper slope spends the colours on them.
    return _PALETTE(np.clip(0.5 + 1.7 * (place - 0.5), *_ENDS))[:, :3]


@checked
def check_drawable(clip: Clip, tracks: Tracks | None = None, frame: int = 0) -> None:
    """Refuse (ValueError) a frame outside the clip, or tracks of another length, before a figure fails on them."""
    if not 0 <= frame < len(clip):
        raise ValueError(f"frame: expected 0 to {len(clip) - 1} (clip {clip.name!r}), got {frame}; choose another")
    if tracks is not None and len(tracks.xyz) != len(clip):
        raise ValueError(
            f"tracks: expected {len(clip)} frames as in {clip.name!r}, got {len(tracks.xyz)}; cut both alike"
        )


@checked
def frame_with_tracks(
    clip: Clip, tracks: Tracks, frame: int, tail: int = 8, truth: Tracks | None = None, ax: Axes | None = None
) -> Figure:
    """A video frame with the tracked points: filled where visible, hollow where occluded, tails over past frames.

    With the true tracks of the same queries, `truth`, a white line joins each estimate with its place. Without `ax` the
    figure is a new one.
    """
    check_drawable(clip, tracks, frame)
    ax = ax or _axes(clip)
    draw_image(ax, clip.video[frame], f"{clip.name} · frame {frame}")
    span = slice(max(0, frame - max(tail, 0)), frame + 1)
    uv, z = project(tracks.xyz[span], clip.intrinsics[span], clip.extrinsics[span])
    uv = np.where((z > 0)[..., None], uv, np.nan)
    colors = track_colors(clip, tracks)
    for n in range(uv.shape[1]):
        ax.plot(uv[:, n, 0], uv[:, n, 1], color=colors[n], lw=1.1, alpha=0.85)
    seen, now = tracks.visible[frame], uv[-1]
    ax.scatter(*now[~seen].T, s=11, facecolors="none", edgecolors=colors[~seen], linewidths=0.8)
    ax.scatter(*now[seen].T, s=11, c=colors[seen], edgecolors="white", linewidths=0.3)
    if truth is not None:
        true_uv, _ = project(truth.xyz[frame], clip.intrinsics[frame], clip.extrinsics[frame])
        ax.plot(*np.stack([now, true_uv], 1).transpose(2, 1, 0), color="white", lw=0.8)
    return ax.figure


@checked
def depth_map(clip: Clip, frame: int, ax: Axes | None = None) -> Figure:
    """Depth of one frame with a colour bar in scene units; pixels without depth are grey."""
    check_drawable(clip, frame=frame)
    ax = ax or _axes(clip, extra=0.9)
    _draw_depth([ax], clip.depths[[frame]], clip.depths[frame])
    _bare(ax, f"{clip.name} · depth, frame {frame}")
    return ax.figure


@checked
def contact_sheet(clips: Clip | Sequence[Clip], frames: int = 6, width: float = 1.35) -> Figure:
    """Frames spread over time, one row a clip."""
    clips = [clips] if isinstance(clips, Clip) else list(clips)
    if not all(isinstance(clip, Clip) for clip in clips) or not (clips and 1 <= frames <= 1000):
        raise ValueError(f"contact_sheet: expected clips and at least one frame of each, got {len(clips)} and {frames}")
    height, wide = clips[0].size
    figure = Figure(figsize=(frames * width, len(clips) * width * height / wide + 0.25), layout="constrained")
    grid = figure.subplots(len(clips), frames, squeeze=False)
    for row, clip in enumerate(clips):
        for ax, t in zip(grid[row], np.linspace(0, len(clip) - 1, frames).astype(int), strict=True):
            draw_image(ax, clip.video[t], f"t = {t}" if row == 0 else "")
        grid[row, 0].set_ylabel(clip.name, fontsize=8, color=INK)
    return figure


def overview(clip: Clip, tracks: Tracks, columns: int = 4) -> Figure:
    """The picture of a result: frames with tracks above, their depth below."""
    check_drawable(clip, tracks)
    height, width = clip.size
    figure = Figure(figsize=(2.6 * columns + 0.6, 2 * 2.6 * height / width + 0.3), layout="constrained")
    above, below = figure.subplots(2, columns, squeeze=False)
    frames = np.linspace(0, len(clip) - 1, columns).astype(int)
    for ax, t in zip(above, frames, strict=True):
        frame_with_tracks(clip, tracks, t, ax=ax)
    _draw_depth(below, clip.depths[frames], clip.depths)
    return figure


def _draw_depth(axes: Sequence[Axes], depths: np.ndarray, span: np.ndarray) -> None:
    """Draw depths (K, H, W) into K axes, with colours and one bar that cover most of the depths in `span`."""
    cmap = matplotlib.colormaps["viridis_r"].with_extremes(bad="#b8b8b8")
    low, high = np.quantile(span[span > 0], [0, 0.99]) if span.any() else (0, 1)
    for ax, depth in zip(axes, depths, strict=True):
        image = ax.imshow(np.ma.masked_equal(depth, 0), cmap=cmap, vmin=low, vmax=high)
        _bare(ax, "")
    bar = axes[0].figure.colorbar(image, ax=list(axes), fraction=0.046, pad=0.02, extend="max")
    bar.set_label("z-depth (scene units)", fontsize=8)
    bar.ax.tick_params(labelsize=7)


def _axes(clip: Clip, extra: float = 0.0) -> Axes:
    height, width = clip.size
    return Figure(figsize=(3.4 + extra, 3.4 * height / width + 0.25), layout="constrained").add_subplot()


def draw_image(ax: Axes, image: np.ndarray, title: str) -> None:
    """Draw an image (H, W, ...) with pixel centres at whole numbers and limits that stay when points are added."""
    height, width = image.shape[:2]
    ax.imshow(image)
    ax.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), autoscale_on=False)
    _bare(ax, title)


def _bare(ax: Axes, title: str) -> None:
    ax.set(xticks=[], yticks=[])
    ax.set_title(title, fontsize=8, color=INK)
    ax.spines[:].set_visible(False)


def label_axes(ax: Axes, vertical: str, horizontal: str) -> None:
    """Give axes their labels and the look that all curves share."""
    ax.set_ylabel(vertical, fontsize=8)
    ax.set_xlabel(horizontal, fontsize=8)
    ax.tick_params(labelsize=7)
    ax.spines[["top", "right"]].set_visible(False)
    ax.grid(alpha=0.25, lw=0.5)
