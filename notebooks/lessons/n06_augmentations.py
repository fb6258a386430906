"""Figures of what training does to a clip: every augmentation before and after, and the random rigid motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.figures.flat import INK, check_drawable, draw_image, label_axes
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
SHOWN = ("erase", "jitter", "depth_blur", "reframe", "flip_x", "flip_time")
_DOT = "#e69f00"  # orange of Okabe and Ito, with a black rim


def before_and_after(clip: Clip, seed: int = 0, frame: int = 0, config: AugmentConfig | None = None) -> Figure:
    """Six augmentations at the strong end of their range, each as a pair of one frame before and after, with tracks.

    Depth blur shows depth, the others show colour. A filled dot is visible, a ring is occluded; the tail leads over the
    six frames before.

    Args:
        clip: with true tracks.
        seed: of what is drawn.
        frame: shown before; backward in time, the same image is frame T - 1 - frame.
        config: strengths; None for the paper's.

    Raises:
        ValueError: a frame outside the clip, or a clip without true tracks.
    """
    changes = _changes(clip, frame, config)
    figure = Figure(figsize=(10.6, 2.85 * len(SHOWN) / 2), layout="constrained")
    cells = figure.subplots(len(SHOWN) // 2, 4).reshape(-1, 2)
    for pair, name in zip(cells, SHOWN, strict=True):
        _pair(pair, clip, changes[name](clip, np.random.default_rng(seed)), name, frame, name == "depth_blur")
    return figure


def augmented(clip: Clip, change: str, seed: int, frame: int) -> Figure:
    """One augmentation of any seed, large: colour above, depth below, before and after.

    Args:
        clip: with true tracks.
        change: one of the titles, e.g. `"eraser"`.
        seed: of what is drawn.
        frame: shown before.

    Raises:
        ValueError: a frame outside the clip, a clip without true tracks, or an unknown augmentation.
    """
    names = {title: name for name, title in TITLES.items()}
    if change not in names:
        raise ValueError(f"augmented: expected one of {', '.join(names)}, got {change!r}")
    name, changes = names[change], _changes(clip, frame, None)
    figure = Figure(figsize=(7.0, 7.0), layout="constrained")
    for pair, depth in zip(figure.subplots(2, 2), (False, True), strict=True):
        _pair(pair, clip, changes[name](clip, np.random.default_rng(seed)), name, frame, depth)
    return figure


def _changes(clip: Clip, frame: int, config: AugmentConfig | None) -> dict[str, Callable[..., Clip]]:
    check_drawable(clip, frame=frame)
    if clip.tracks is None:
        raise ValueError(f"before_and_after: clip {clip.name!r} has no true tracks; simulate one")
    changes = {name: change for name, (_, change) in augmentations(_strong(config or AugmentConfig())).items()}
    return changes | {"flip_time": lambda clip, rng: flip_time(clip)}  # drawn by `sampling`


def _pair(pair: Sequence[Axes], clip: Clip, changed: Clip, name: str, frame: int, depth: bool) -> None:
    """One frame of a clip beside the same frame after a change, as colour or as depth."""
    far = float(np.quantile(clip.depths[clip.depths > 0], 0.95))
    at = len(clip) - 1 - frame if name == "flip_time" else frame
    for ax, shown, t, word in ((pair[0], clip, frame, "before"), (pair[1], changed, at, "after")):
        draw_image(ax, np.ma.masked_equal(shown.depths[t], 0) if depth else shown.video[t], f"{TITLES[name]}: {word}")
        if depth:
            ax.images[0].set(cmap="viridis_r", clim=(0, far))
            ax.set_facecolor("#cccccc")  # invalid
        _points(ax, shown, t)
        if "blur" in name:
            u, v = _edge(clip.depths[frame])
            ax.set(xlim=u, ylim=v)
            if depth:
                inside = clip.depths[frame][int(v[1] + 1) : int(v[0]), int(u[0] + 1) : int(u[1])]
                ax.images[0].set_clim(*np.quantile(inside, [0.05, 0.95]))


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
    figure = Figure(figsize=(11, 7.4), layout="constrained")
    axes = figure.subplots(2, 2).ravel()
    chosen = _spread(clip.tracks, still, moving)
    for ax, (name, (shown, pair)) in zip(axes, views.items(), strict=False):
        _paths(ax, shown.tracks, chosen, pair)
        horizontal, vertical = (("x (m)", "y (m)"), ("x right (m)", "z forward (m)"))[pair == (0, 2)]
        label_axes(ax, vertical, horizontal)
        ax.set_title(f"{name}, from above", fontsize=10, color=INK)
    _equal_scale(axes[:3])
    marks = [Line2D([], [], color=color, marker=mark, label=label) for _, color, mark, label in _KINDS]
    axes[0].legend(handles=[*marks, Line2D([], [], ls="", label="mark: last frame")], fontsize=8, frameon=True)
    for motion, label, style in ((camera, "camera", "--"), (extra, "random motion on top", "-")):
        steps = motion[1:] @ invert(motion[:-1])
        cosine = (np.trace(steps[:, :3, :3], axis1=1, axis2=2) - 1) / 2
        angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        axes[3].plot(np.arange(1, len(clip)), angle, style, color=INK, lw=1.6, label=label)
    label_axes(axes[3], "degrees a frame", "frame")
    axes[3].set_ylim(bottom=0)
    axes[3].set_title("turn of the coordinates", fontsize=10, color=INK)
    axes[3].legend(fontsize=8, frameon=False)
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


def _points(ax: Axes, clip: Clip, t: int, tail: int = 6) -> None:
    span = slice(max(0, t - tail), t + 1)
    uv, z = project(clip.tracks.xyz[span], clip.intrinsics[span], clip.extrinsics[span])
    uv = np.where((z > 0)[..., None], uv, np.nan)
    ax.plot(*uv.transpose(2, 0, 1), color="white", lw=1.0, alpha=0.8)
    seen = clip.tracks.visible[t]
    ax.scatter(*uv[-1, seen].T, s=18, c=_DOT, edgecolors="black", linewidths=0.5)
    ax.scatter(*uv[-1, ~seen].T, s=18, facecolors="none", edgecolors=_DOT, linewidths=1.2)


_KINDS = ((False, "#0072b2", "o", "point at rest in the world"), (True, "#d55e00", "s", "moving point"))


def _spread(tracks: Tracks, still: int, moving: int) -> list[tuple[str, str, np.ndarray]]:
    """(colour, mark, indices) of points at rest, spread over the scene but not far off, and of those that move most."""
    path = np.linalg.norm(np.diff(tracks.xyz, axis=0), axis=-1).sum(0)
    reach = np.linalg.norm(tracks.xyz - np.median(tracks.xyz, (0, 1)), axis=-1).max(0)
    near = np.flatnonzero(~tracks.dynamic & (reach <= np.quantile(reach, 0.7)))
    picked = near[np.linspace(0, len(near) - 1, min(still, len(near))).astype(int)]
    movers = np.flatnonzero(tracks.dynamic)
    kinds = {False: picked, True: movers[np.argsort(path[movers])[::-1][:moving]]}
    return [(color, mark, kinds[kind]) for kind, color, mark, _ in _KINDS]


def _paths(ax: Axes, tracks: Tracks, chosen: list[tuple[str, str, np.ndarray]], pair: tuple[int, int]) -> None:
    for color, mark, which in chosen:
        for n in which:
            path = tracks.xyz[:, n, list(pair)]
            ax.plot(*path.T, color=color, lw=1.5)
            ax.plot(*path[-1], mark, color=color, ms=4.5, mec="white", mew=0.5)


def _equal_scale(axes: Sequence[Axes]) -> None:
    """A metre is equally long along both axes of each panel, and in all panels."""
    centres = [(np.mean(ax.get_xlim()), np.mean(ax.get_ylim())) for ax in axes]
    side = max(float(np.ptp(limits)) for ax in axes for limits in (ax.get_xlim(), ax.get_ylim())) / 2
    for ax, (x, y) in zip(axes, centres, strict=True):
        ax.set(xlim=(x - side, x + side), ylim=(y - side, y + side), aspect="equal")
