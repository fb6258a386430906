"""The 3D scene: a point cloud with tracks and a time slider (plotly), and its flat twin (matplotlib)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.figures.flat import check_drawable, track_colors
from tapip3d_lite.geometry import invert, transform, unproject

_LEVELS = 12  # colour levels per channel: a code into 1728 colours costs two bytes a point, an RGB string twenty


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
    near = _near(clip)
    tracks = _drawn(clip, tracks, near, max_tracks)
    colors = track_colors(clip, tracks)
    parts = [[_cloud(clip, t, points, near), _tails(tracks, t, tail), _heads(tracks, t)] for t in range(len(clip))]
    frames = [go.Frame(name=str(t), data=[go.Scatter3d(part) for part in now]) for t, now in enumerate(parts)]
    styles = _styles(colors)
    # A frame carries only what changes; the rest stays with the traces and the colour axes of the layout.
    figure = go.Figure(data=[go.Scatter3d(part).update(style) for part, style in zip(parts[0], styles, strict=True)])
    figure.frames = frames
    figure.update_layout(
        title=title or clip.name,
        scene=_scene(clip, tracks, near),
        coloraxis=_cloud_colors(),
        coloraxis2={"colorscale": _color_scale(colors), "cmin": 0, "cmax": max(len(colors) - 1, 1), "showscale": False},
        title_font_size=14,
        margin={"l": 0, "r": 0, "t": 34, "b": 0},
        height=560,
        showlegend=False,
        uirevision="keep",  # the reader's view survives every redraw
        updatemenus=[_play_button()],
        sliders=[_slider(len(clip))],
    )
    return figure


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
    near = _near(clip)
    tracks = _drawn(clip, tracks, near, 120)
    colors = track_colors(clip, tracks)
    figure = Figure(figsize=(3.4 * len(frames), 2.6), layout="constrained")
    upright = _upright(clip)
    limits = axis_limits(transform(np.concatenate([_cloud_points(clip, t, 800, near)[0] for t in frames]), upright))
    for i, t in enumerate(frames):
        ax = figure.add_subplot(1, len(frames), i + 1, projection="3d", computed_zorder=False)
        xyz, rgb = _cloud_points(clip, t, points, near)
        x, y, z = transform(xyz, upright).T
        ax.scatter(x, z, -y, c=rgb / 255, s=2.2, depthshade=False, linewidths=0)
        path = transform(tracks.xyz[max(0, t - 12) : t + 1], upright)
        for n in range(path.shape[1]):
            ax.plot(path[:, n, 0], path[:, n, 2], -path[:, n, 1], color=colors[n], lw=1)
        x, y, z = path[-1].T
        seen = tracks.visible[t]
        ax.scatter(x, z, -y, s=9, facecolors=np.where(seen[:, None], colors, 1), edgecolors=colors, depthshade=False)
        ax.set_xlim(limits[0])
        ax.set_ylim(limits[2])
        ax.set_zlim(-limits[1][1], -limits[1][0])
        ax.set_box_aspect([np.ptp(limits[k]) for k in (0, 2, 1)], zoom=1.6)
        ax.view_init(elev=32, azim=-75)
        ax.set_title(f"t = {t}", fontsize=8)
        ax.set(xticklabels=[], yticklabels=[], zticklabels=[])
    return figure


def _near(clip: Clip) -> float:
    """Depth beyond which nothing is drawn: a far backdrop would shrink all that moves to a speck."""
    return 1.6 * float(np.median(clip.depths[clip.depths > 0]))


def _drawn(clip: Clip, tracks: Tracks, near: float, most: int) -> Tracks:
    """At most `most` tracks, evenly picked from those whose query lies within the drawn depth."""
    t = tracks.queries[:, 0].astype(int)
    z = transform(tracks.queries[:, None, 1:], clip.extrinsics[t])[:, 0, 2]
    inside = np.flatnonzero(z <= near) if (z <= near).any() else np.arange(len(z))
    return tracks.select(inside[:: max(1, -(-len(inside) // most))])


def _cloud_points(clip: Clip, frame: int, points: int, near: float) -> tuple[np.ndarray, np.ndarray]:
    v, u = np.nonzero((clip.depths[frame] > 0) & (clip.depths[frame] <= near))
    pick = np.random.default_rng(frame).permutation(len(v))[:points]
    v, u = v[pick], u[pick]
    uv = np.stack([u, v], -1).astype(np.float32)
    world = unproject(uv, clip.depths[frame, v, u], clip.intrinsics[frame], clip.extrinsics[frame])
    return world, clip.video[frame, v, u]


def _cloud(clip: Clip, frame: int, points: int, near: float) -> dict[str, object]:
    xyz, rgb = _cloud_points(clip, frame, points, near)
    level = (rgb.astype(int) * _LEVELS) // 256
    code = (level @ [_LEVELS**2, _LEVELS, 1]).astype(np.uint16)
    x, y, z = xyz.astype(np.float32).T
    return {"x": x, "y": y, "z": z, "marker": {"color": code}}


def _tails(tracks: Tracks, frame: int, tail: int) -> dict[str, object]:
    path = tracks.xyz[max(0, frame - tail) : frame + 1]
    gap = np.full((1, path.shape[1], 3), np.nan, np.float32)  # NaN lifts the pen between tracks
    x, y, z = np.concatenate([path, gap]).transpose(2, 1, 0).reshape(3, -1)
    index = np.repeat(np.arange(path.shape[1], dtype=np.uint16), len(path) + 1)
    return {"x": x, "y": y, "z": z, "line": {"color": index}}


def _heads(tracks: Tracks, frame: int) -> dict[str, object]:
    x, y, z = tracks.xyz[frame].T
    symbols = ["circle" if seen else "circle-open" for seen in tracks.visible[frame]]
    return {"x": x, "y": y, "z": z, "marker": {"symbol": symbols}}


def _styles(colors: np.ndarray) -> list[dict[str, object]]:
    """What stays alike over time: of the cloud, the tails and the heads."""
    heads = {"size": 4, "color": [to_hex(c) for c in colors]}
    text = [f"track {n} (hollow: occluded)" for n in range(len(colors))]
    return [
        {"name": "scene", "mode": "markers", "marker": {"size": 2.6, "coloraxis": "coloraxis"}, "hoverinfo": "skip"},
        {"name": "tails", "mode": "lines", "line": {"width": 3, "coloraxis": "coloraxis2"}, "hoverinfo": "skip"},
        {"name": "points", "mode": "markers", "marker": heads, "text": text, "hoverinfo": "text"},
    ]


def _cloud_colors() -> dict[str, object]:
    """A colour axis that decodes the cloud's colour codes."""
    channel = (np.arange(_LEVELS) * 255 / (_LEVELS - 1)).round().astype(int)
    cells = np.stack(np.meshgrid(channel, channel, channel, indexing="ij"), -1).reshape(-1, 3)
    scale = [[i / (len(cells) - 1), f"rgb({r},{g},{b})"] for i, (r, g, b) in enumerate(cells)]
    return {"colorscale": scale, "cmin": 0, "cmax": len(cells) - 1, "showscale": False}


def _color_scale(colors: np.ndarray) -> list:
    last = max(len(colors) - 1, 1)
    scale = [[n / last, to_hex(c)] for n, c in enumerate(colors)] or [[0, "#888888"]]
    return scale if len(scale) > 1 else [[0, scale[0][1]], [1, scale[0][1]]]


def axis_limits(xyz: np.ndarray) -> np.ndarray:
    """Limits (3, 2) of the axes around points (P, 3), with a margin and without the few farthest; NaN is left out."""
    low, high = np.nanquantile(xyz, [0.002, 0.998], axis=0)
    return np.stack([low, high], -1) + 0.03 * (high - low).max() * np.array([-1, 1])


def _scene(clip: Clip, tracks: Tracks, near: float) -> dict[str, object]:
    steps = np.linspace(0, len(clip) - 1, min(len(clip), 6)).astype(int)
    cloud = np.concatenate([_cloud_points(clip, t, 800, near)[0] for t in steps])
    ranges = axis_limits(np.concatenate([cloud, tracks.xyz[steps].reshape(-1, 3)]))
    axis = {"showspikes": False, "title": {"font": {"size": 10}}, "tickfont": {"size": 9}, "backgroundcolor": "#f4f5f7"}
    axes = {f"{k}axis": axis | {"range": r.tolist(), "autorange": False} for k, r in zip("xyz", ranges, strict=True)}
    return axes | {"aspectmode": "data", "camera": _camera(clip, np.median(cloud, axis=0), ranges)}


def _camera(clip: Clip, target: np.ndarray, ranges: np.ndarray) -> dict[str, object]:
    """A view from behind and above the clip's first camera, in the scene's own units."""
    pose = invert(clip.extrinsics[0])
    up = _up(clip)
    back = pose[:3, 3] - target
    eye = target + 1.2 * back + 0.3 * np.linalg.norm(back) * up
    # With aspectmode "data" a scene unit is the geometric mean of the three ranges, counted from their middle.
    unit, middle = np.prod(np.ptp(ranges, axis=-1)) ** (1 / 3), ranges.mean(-1)
    vectors = {"up": up, "eye": (eye - middle) / unit, "center": (target - middle) / unit}
    return {name: {k: float(x) for k, x in zip("xyz", vector, strict=True)} for name, vector in vectors.items()}


def _up(clip: Clip) -> np.ndarray:
    """World z if all cameras stand level on it (plotly then turns the scene like a table), else the first camera's up."""
    right, up = clip.extrinsics[:, 0, 2], -clip.extrinsics[:, 1, 2]
    level = np.abs(right).mean() < 0.15 and up.min() > 0.15
    return np.array([0.0, 0.0, 1.0]) if level else -clip.extrinsics[0, 1, :3].astype(float)


def _upright(clip: Clip) -> np.ndarray:
    """A motion (4, 4) from the world to axes right, down and ahead as the first camera sees them, without its pitch."""
    down, pose = -_up(clip), np.eye(4)
    right = clip.extrinsics[0, 0, :3] - (clip.extrinsics[0, 0, :3] @ down) * down
    right = right / np.linalg.norm(right)
    pose[:3, :3] = np.stack([right, down, np.cross(right, down)])
    return pose


def animation_args(duration: int) -> dict[str, object]:
    """What a slider's step or a play button asks of plotly: show each frame for `duration` ms, redraw it, no transition."""
    return {"mode": "immediate", "frame": {"duration": duration, "redraw": True}, "transition": {"duration": 0}}


def _slider(frames: int) -> dict[str, object]:
    steps = [{"label": str(t), "method": "animate", "args": [[str(t)], animation_args(0)]} for t in range(frames)]
    return {"steps": steps, "currentvalue": {"prefix": "frame "}, "x": 0.17, "len": 0.81, "pad": {"t": 4, "b": 24}}


def _play_button() -> dict[str, object]:
    play = {"label": "play", "method": "animate", "args": [None, animation_args(120) | {"fromcurrent": True}]}
    pause = {"label": "pause", "method": "animate", "args": [[None], animation_args(0)]}
    return {
        "type": "buttons",
        "buttons": [play, pause],
        "direction": "right",
        "showactive": False,
        "x": 0.01,
        "y": 0,
        "xanchor": "left",
        "yanchor": "top",
        "pad": {"t": 18},
    }
