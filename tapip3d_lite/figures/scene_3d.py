"""The 3D scene: a point cloud with tracks and a time slider (plotly), and its flat twin (matplotlib)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import plotly.graph_objects as go
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.figures.flat import check_drawable, track_colors
from tapip3d_lite.geometry import invert, transform, unproject

_LEVELS = 12  # colour levels per channel: a code into 1728 colours costs two bytes a point, an RGB string twenty
_CHANNEL = (np.arange(_LEVELS) * 255 / (_LEVELS - 1)).round().astype(int)
_CLOUD_COLORS = [f"rgb({r},{g},{b})" for r in _CHANNEL for g in _CHANNEL for b in _CHANNEL]


def tracks_3d(
    clip: Clip, tracks: Tracks, points: int = 2500, max_tracks: int = 120, tail: int = 8, title: str | None = None
) -> go.Figure:
    """Point cloud and tracks in world coordinates with a time slider and a play button.

    The view opens where the first camera stands and stays as the reader turns it while the slider moves.

    Args:
        clip: the clip.
        tracks: what to draw, world frame.
        points: cloud points per frame (the page grows by about 19 bytes a point and frame).
        max_tracks: at most this many tracks are drawn, evenly picked.
        tail: past frames that the tails cover.
        title: above the scene.
    """
    check_drawable(clip, tracks)
    clip, tracks = _foreground(clip, tracks, max_tracks)
    colors = [to_hex(color) for color in track_colors(clip, tracks)]
    parts = [_moving_parts(clip, tracks, t, points, tail) for t in range(len(clip))]
    # A frame carries only what changes; the rest stays with the traces and the colour axes of the layout.
    frames = [go.Frame(name=str(t), data=[go.Scatter3d(part) for part in now]) for t, now in enumerate(parts)]
    traces = [go.Scatter3d(part).update(style) for part, style in zip(parts[0], _styles(colors), strict=True)]
    layout = {
        "title": {"text": title or clip.name, "font": {"size": 14}},
        "scene": _scene(clip, tracks),
        "coloraxis": _color_axis(_CLOUD_COLORS),
        "coloraxis2": _color_axis(colors),
        "margin": {"l": 0, "r": 0, "t": 34, "b": 0},
        "height": 560,
        "showlegend": False,
        "uirevision": "keep",  # the reader's view survives every redraw
    }
    return go.Figure(data=traces, frames=frames, layout=layout | _controls(len(clip)))


def tracks_3d_static(clip: Clip, tracks: Tracks, frames: Sequence[int] | None = None, points: int = 4000) -> Figure:
    """The matplotlib twin of `tracks_3d`: the scene at a few instants, from above the first camera.

    Args:
        clip: the clip.
        tracks: what to draw, world frame.
        frames: frame indices; default first, middle and last.
        points: cloud points per panel.
    """
    frames = [0, len(clip) // 2, len(clip) - 1] if frames is None else list(frames)
    for t in frames:
        check_drawable(clip, tracks, t)
    clip, tracks = _foreground(clip, tracks, 120)
    colors = track_colors(clip, tracks)
    figure = Figure(figsize=(3.4 * len(frames), 2.6), layout="constrained")
    upright = _upright(clip)
    limits = axis_limits(transform(np.concatenate([_cloud_points(clip, t, 800)[0] for t in frames]), upright))
    for i, t in enumerate(frames):
        ax = figure.add_subplot(1, len(frames), i + 1, projection="3d", computed_zorder=False)
        xyz, rgb = _cloud_points(clip, t, points)
        ax.scatter(*transform(xyz, upright).T, c=rgb / 255, s=2.2, depthshade=False, linewidths=0)
        path = transform(tracks.xyz[max(0, t - 12) : t + 1], upright)
        for n, color in enumerate(colors):
            ax.plot(*path[:, n].T, color=color, lw=1)
        faces = np.where(tracks.visible[t][:, None], colors, 1)
        ax.scatter(*path[-1].T, s=9, facecolors=faces, edgecolors=colors, depthshade=False)
        ax.set_box_aspect(np.ptp(limits, axis=-1), zoom=1.6)
        ax.view_init(elev=32, azim=-75)
        ax.set_title(f"t = {t}", fontsize=8)
        ax.set(xlim=limits[0], ylim=limits[1], zlim=limits[2], xticklabels=[], yticklabels=[], zticklabels=[])
    return figure


def _foreground(clip: Clip, tracks: Tracks, most: int) -> tuple[Clip, Tracks]:
    """The clip without its far depths, which would shrink all that moves to a speck, and at most `most` tracks.

    They are evenly picked from those whose query lies within the depths that are left.
    """
    near = 1.6 * float(np.median(clip.depths[clip.depths > 0]))
    t = tracks.queries[:, 0].astype(int)
    z = transform(tracks.queries[:, None, 1:], clip.extrinsics[t])[:, 0, 2]
    inside = np.flatnonzero(z <= near) if (z <= near).any() else np.arange(len(z))
    picked = tracks.select(inside[:: max(1, -(-len(inside) // most))])
    return replace(clip, depths=np.where(clip.depths <= near, clip.depths, 0)), picked


def _cloud_points(clip: Clip, frame: int, points: int) -> tuple[np.ndarray, np.ndarray]:
    v, u = np.nonzero(clip.depths[frame])
    pick = np.random.default_rng(frame).permutation(len(v))[:points]
    v, u = v[pick], u[pick]
    uv = np.stack([u, v], -1).astype(np.float32)
    world = unproject(uv, clip.depths[frame, v, u], clip.intrinsics[frame], clip.extrinsics[frame])
    return world, clip.video[frame, v, u]


def _moving_parts(clip: Clip, tracks: Tracks, frame: int, points: int, tail: int) -> list[dict[str, object]]:
    """What changes over time: of the cloud, the tails and the heads."""
    cloud, rgb = _cloud_points(clip, frame, points)
    code = (rgb.astype(int) * _LEVELS) // 256 @ [_LEVELS**2, _LEVELS, 1]
    path = tracks.xyz[max(0, frame - tail) : frame + 1]
    gap = np.full((1, path.shape[1], 3), np.nan, np.float32)  # NaN lifts the pen between tracks
    tails = np.concatenate([path, gap]).swapaxes(0, 1).reshape(-1, 3)
    index = np.repeat(np.arange(path.shape[1], dtype=np.uint16), len(path) + 1)
    symbols = ["circle" if seen else "circle-open" for seen in tracks.visible[frame]]
    return [
        _xyz(cloud.astype(np.float32)) | {"marker": {"color": code.astype(np.uint16)}},
        _xyz(tails) | {"line": {"color": index}},
        _xyz(tracks.xyz[frame]) | {"marker": {"symbol": symbols}},
    ]


def _xyz(vectors: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip("xyz", vectors.T, strict=True))


def _styles(colors: list[str]) -> list[dict[str, object]]:
    """What stays alike over time: of the cloud, the tails and the heads."""
    heads, text = {"size": 4, "color": colors}, [f"track {n} (hollow: occluded)" for n in range(len(colors))]
    return [
        {"name": "scene", "mode": "markers", "marker": {"size": 2.6, "coloraxis": "coloraxis"}, "hoverinfo": "skip"},
        {"name": "tails", "mode": "lines", "line": {"width": 3, "coloraxis": "coloraxis2"}, "hoverinfo": "skip"},
        {"name": "points", "mode": "markers", "marker": heads, "text": text, "hoverinfo": "text"},
    ]


def _color_axis(colors: list[str]) -> dict[str, object]:
    """A colour axis on which whole numbers stand for these colours; it needs two at least."""
    colors = [*colors, "#888888", "#888888"][: max(len(colors), 2)]
    last = len(colors) - 1
    return {"colorscale": [[n / last, c] for n, c in enumerate(colors)], "cmin": 0, "cmax": last, "showscale": False}


def axis_limits(xyz: np.ndarray) -> np.ndarray:
    """Limits (3, 2) of the axes around points (P, 3), with a margin and without the few farthest; NaN is left out."""
    low, high = np.nanquantile(xyz, [0.002, 0.998], axis=0)
    return np.stack([low, high], -1) + 0.03 * (high - low).max() * np.array([-1, 1])


def fixed_axes(limits: np.ndarray) -> dict[str, object]:
    """Axes of a plotly scene with limits (3, 2) and equal scales, which stay as they are while its frames change.

    The aspect mode "data" would scale the axes anew by the points of each frame: what rests would slide.
    """
    sizes = np.ptp(limits, axis=-1)
    axes = {f"{k}axis": {"range": r.tolist(), "autorange": False} for k, r in zip("xyz", limits, strict=True)}
    return axes | {"aspectmode": "manual", "aspectratio": _xyz(sizes / np.prod(sizes) ** (1 / 3))}


def _scene(clip: Clip, tracks: Tracks) -> dict[str, object]:
    """Axes with fixed ranges, seen from behind and above the clip's first camera."""
    steps = np.linspace(0, len(clip) - 1, min(len(clip), 6)).astype(int)
    cloud = np.concatenate([_cloud_points(clip, t, 800)[0] for t in steps])
    ranges = axis_limits(np.concatenate([cloud, tracks.xyz[steps].reshape(-1, 3)]))
    style = {"showspikes": False, "tickfont": {"size": 9}, "backgroundcolor": "#f4f5f7"}
    scene = fixed_axes(ranges)
    for k in "xyz":
        scene[f"{k}axis"] |= style | {"title": {"text": f"{k} (scene units)", "font": {"size": 10}}}
    up, target = _up(clip), np.median(cloud, axis=0)
    back = invert(clip.extrinsics[0])[:3, 3] - target
    eye = target + 1.2 * back + 0.3 * np.linalg.norm(back) * up
    # The camera's unit is the geometric mean of the three ranges, counted from their middle.
    unit, middle = np.prod(np.ptp(ranges, axis=-1)) ** (1 / 3), ranges.mean(-1)
    camera = {"up": up, "eye": (eye - middle) / unit, "center": (target - middle) / unit}
    return scene | {"camera": {name: _xyz(vector) for name, vector in camera.items()}}


def _up(clip: Clip) -> np.ndarray:
    """World z if all cameras stand level on it (plotly then turns the scene like a table), else the first camera's up."""
    right, up = clip.extrinsics[:, 0, 2], -clip.extrinsics[:, 1, 2]
    level = np.abs(right).mean() < 0.15 and up.min() > 0.15
    return np.array([0.0, 0.0, 1.0]) if level else -clip.extrinsics[0, 1, :3].astype(float)


def _upright(clip: Clip) -> np.ndarray:
    """A motion (4, 4) from the world to axes right, ahead and up as the first camera sees them, without its pitch."""
    up, pose = _up(clip), np.eye(4)
    right = clip.extrinsics[0, 0, :3] - (clip.extrinsics[0, 0, :3] @ up) * up
    right = right / np.linalg.norm(right)
    pose[:3, :3] = np.stack([right, np.cross(up, right), up])
    return pose


def animation_args(duration: int) -> dict[str, object]:
    """What a slider's step or a play button asks of plotly: show each frame for `duration` ms, redraw it, no transition."""
    return {"mode": "immediate", "frame": {"duration": duration, "redraw": True}, "transition": {"duration": 0}}


def _controls(frames: int) -> dict[str, object]:
    """A slider over time and a play button."""
    steps = [{"label": str(t), "method": "animate", "args": [[str(t)], animation_args(0)]} for t in range(frames)]
    slider = {"steps": steps, "currentvalue": {"prefix": "frame "}, "x": 0.17, "len": 0.81, "pad": {"t": 4, "b": 24}}
    play = {"label": "play", "method": "animate", "args": [None, animation_args(120) | {"fromcurrent": True}]}
    pause = {"label": "pause", "method": "animate", "args": [[None], animation_args(0)]}
    place = {"x": 0.01, "y": 0, "xanchor": "left", "yanchor": "top", "pad": {"t": 18}}
    menu = {"type": "buttons", "buttons": [play, pause], "direction": "right", "showactive": False, **place}
    return {"updatemenus": [menu], "sliders": [slider]}
