"""Figures of what training does to a clip: every augmentation before and after, and the random rigid motion."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.figures.flat import INK, MOVING, STILL, check_drawable, draw_image, label_axes
from tapip3d_lite.geometry import invert, project
from tapip3d_lite.training.augment import AugmentConfig, augmentations
from tapip3d_lite.training.motion import MotionConfig, move, smooth_motion

TITLES = {
    "erase": "eraser",
    "jitter": "colour jitter",
    "blur": "blur (detail)",
    "depth_blur": "depth blur (detail)",
    "reframe": "pad, resize, crop",
    "flip_x": "mirrored in x",
    "flip_y": "mirrored in y",
    "flip_time": "backward in time",
}


def before_and_after(clip: Clip, seed: int = 0, frame: int = 0, config: AugmentConfig | None = None) -> Figure:
    """Every augmentation at the strong end of its range: colour and depth of one frame before and after, with tracks.

    A filled dot is visible, a ring is occluded; the tail leads over the four frames before.

    Args:
        clip: with true tracks.
        seed: of what is drawn.
        frame: shown before; backward in time, the same image is frame T - 1 - frame.
        config: strengths; None for the paper's.

    Raises:
        ValueError: a frame outside the clip, or a clip without true tracks.
    """
    check_drawable(clip, frame=frame)
    if clip.tracks is None:
        raise ValueError(f"before_and_after: clip {clip.name!r} has no true tracks; simulate one")
    changes = {name: change for name, (_, change) in augmentations(_strong(config or AugmentConfig())).items()}
    changes["flip_time"] = lambda clip, rng: flip_time(clip)  # drawn by `sampling`
    figure = Figure(figsize=(12.4, 0.92 * len(changes)), layout="constrained")
    cells = figure.subplots((len(changes) + 1) // 2, 8).reshape(-1, 4)
    far = float(np.quantile(clip.depths[clip.depths > 0], 0.95))
    for row, (name, change) in zip(cells, changes.items(), strict=True):
        changed = change(clip, np.random.default_rng(seed))
        at = len(clip) - 1 - frame if name == "flip_time" else frame
        detail = _edge(clip.depths[frame]) if "blur" in name else None
        for pair, shown, t, word in ((row[:2], clip, frame, "before"), (row[2:], changed, at, "after")):
            draw_image(pair[0], shown.video[t], f"{TITLES[name]}: {word}")
            draw_image(pair[1], np.ma.masked_equal(shown.depths[t], 0), "")
            pair[1].images[0].set(cmap="viridis_r", clim=(0, far))
            pair[1].set_facecolor("#cccccc")  # invalid
            for ax in pair:
                _points(ax, shown, t)
                if detail is not None:
                    ax.set(xlim=detail[0], ylim=detail[1])
    return figure


def motion_paths(
    clip: Clip, seed: int = 0, config: MotionConfig | None = None, still: int = 12, moving: int = 4
) -> Figure:
    """Paths of the same points in the world, in camera space, and in camera space moved smoothly, seen from above.

    The last panel shows how fast the coordinates move: the camera alone, and with the random motion on top.

    Args:
        clip: with true tracks in a world with z up.
        seed: of the random motion.
        config: its strength; None for the paper's.
        still, moving: how many points of either kind to draw.
    """
    if clip.tracks is None or clip.tracks.dynamic is None:
        raise ValueError(f"motion_paths: clip {clip.name!r} has no true tracks with `dynamic`; simulate one")
    extra = smooth_motion(np.random.default_rng(seed), len(clip), config or MotionConfig())
    camera = clip.extrinsics.astype(np.float64)
    views = {"world": (clip, (0, 1)), "camera": (move(clip, camera), (0, 2))}
    views["camera, moved smoothly"] = move(clip, extra @ camera), (0, 2)
    figure = Figure(figsize=(12, 3.2), layout="constrained")
    axes = figure.subplots(1, 4)
    chosen = _spread(clip.tracks, still, moving)
    for ax, (name, (shown, pair)) in zip(axes, views.items(), strict=False):
        _paths(ax, shown.tracks, chosen, pair)
        horizontal, vertical = (("x (m)", "y (m)"), ("x right (m)", "z forward (m)"))[pair == (0, 2)]
        label_axes(ax, vertical, horizontal)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_title(f"{name}, from above", fontsize=8, color=INK)
    for motion, label, style in ((camera, "camera", "--"), (extra, "random motion on top", "-")):
        steps = motion[1:] @ invert(motion[:-1])
        cosine = (np.trace(steps[:, :3, :3], axis1=1, axis2=2) - 1) / 2
        angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        axes[3].plot(np.arange(1, len(clip)), angle, style, color=INK, lw=1.3, label=label)
    label_axes(axes[3], "degrees a frame", "frame")
    axes[3].set_ylim(bottom=0)
    axes[3].set_title("turn of the coordinates", fontsize=8, color=INK)
    axes[3].legend(fontsize=7, frameon=False)
    return figure


def flip_time(clip: Clip) -> Clip:
    """Play a clip with tracks backward; each query stays in the same image."""
    queries = clip.queries * np.array([-1, 1, 1, 1], np.float32) + np.array([len(clip) - 1, 0, 0, 0], np.float32)
    tracks = Tracks(clip.tracks.xyz[::-1], clip.tracks.visible[::-1], queries, dynamic=clip.tracks.dynamic)
    frames = {name: getattr(clip, name)[::-1] for name in ("video", "depths", "intrinsics", "extrinsics")}
    return replace(clip, **frames, tracks=tracks, queries=queries, extras={})


def _strong(config: AugmentConfig) -> AugmentConfig:
    side, blur, depth = config.erase_side[1], config.blur_sigma[1], config.depth_blur_sigma[1]
    return replace(
        config, erase=1.0, erase_side=(side / 2, side), blur_sigma=(blur,) * 2, depth_blur_sigma=(depth,) * 2
    )


def _edge(depth: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Limits of u and v of a quarter of the image, around the place that holds most edges of depth."""
    height, width = depth.shape
    log = np.log(np.maximum(depth, 1e-3))
    edges = (np.abs(np.diff(log, axis=1, append=log[:, -1:])) > 0.1).astype(np.float32)
    half = np.array([width, height]) // 8
    count = cv2.boxFilter(
        edges, -1, tuple(int(x) for x in 2 * half + 1), normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    v, u = np.unravel_index(count.argmax(), count.shape)
    middle = np.clip((u, v), half, np.array([width, height]) - 1 - half)
    low, high = middle - half - 0.5, middle + half + 0.5
    return (low[0], high[0]), (high[1], low[1])


def _points(ax: Axes, clip: Clip, t: int, tail: int = 4) -> None:
    span = slice(max(0, t - tail), t + 1)
    uv, z = project(clip.tracks.xyz[span], clip.intrinsics[span], clip.extrinsics[span])
    uv = np.where((z > 0)[..., None], uv, np.nan)
    ax.plot(*uv.transpose(2, 0, 1), color="white", lw=0.6, alpha=0.7)
    seen = clip.tracks.visible[t]
    ax.scatter(*uv[-1, seen].T, s=7, c=MOVING, edgecolors="white", linewidths=0.3)
    ax.scatter(*uv[-1, ~seen].T, s=7, facecolors="none", edgecolors=MOVING, linewidths=0.6)


def _spread(tracks: Tracks, still: int, moving: int) -> list[tuple[str, np.ndarray]]:
    """(colour, indices) of points at rest, spread over the scene but not far off, and of those that move most."""
    path = np.linalg.norm(np.diff(tracks.xyz, axis=0), axis=-1).sum(0)
    reach = np.linalg.norm(tracks.xyz - np.median(tracks.xyz, (0, 1)), axis=-1).max(0)
    near = np.flatnonzero(~tracks.dynamic & (reach <= np.quantile(reach, 0.7)))
    picked = near[np.linspace(0, len(near) - 1, min(still, len(near))).astype(int)]
    movers = np.flatnonzero(tracks.dynamic)
    return [(STILL, picked), (MOVING, movers[np.argsort(path[movers])[::-1][:moving]])]


def _paths(ax: Axes, tracks: Tracks, chosen: list[tuple[str, np.ndarray]], pair: tuple[int, int]) -> None:
    for color, which in chosen:
        for n in which:
            path = tracks.xyz[:, n, list(pair)]
            ax.plot(*path.T, color=color, lw=1.3)
            ax.plot(*path[-1], "o", color=color, ms=3.5, mec="white", mew=0.4)
