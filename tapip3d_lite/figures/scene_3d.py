"""The 3D scene: a point cloud with tracks and a time slider (plotly), and its flat twin (matplotlib)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import plotly.graph_objects as go
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.figures.flat import INK, PLACES, check_drawable, track_colors
from tapip3d_lite.geometry import transform, unproject
from tapip3d_lite.validate import checked

_LEVELS = 12  # colour levels per channel: a code into 1728 colours costs two bytes a point, an RGB string twenty
_CHANNEL = (np.arange(_LEVELS) * 255 / (_LEVELS - 1)).round().astype(int)
_SIGHT = float(np.tan(np.pi / 8))  # plotly's lens sees 45 degrees from top to bottom
_HALF = 0.93 * _SIGHT  # within which all that is drawn lies in the opening view
_WIDE = 1.6  # width by height of the narrowest scene in which it does
_CLOUD_COLORS = [f"rgb({r},{g},{b})" for r in _CHANNEL for g in _CHANNEL for b in _CHANNEL]


@checked
def tracks_3d(
    clip: Clip, tracks: Tracks, points: int = 2500, max_tracks: int = 120, tail: int = 8, title: str | None = None
) -> go.Figure:
    """Point cloud and tracks in world coordinates with a time slider and a play button.

    The view opens from behind and above the first camera and shows all that is drawn in any frame; it stays as the
    reader turns it while the slider moves.

    Args:
        clip, tracks: what to draw.
        points: cloud points per frame (the page grows by about 19 bytes a point and frame).
        max_tracks: at most this many tracks are drawn, evenly picked.
        tail: past frames that the tails cover.
        title: above the scene.
    """
    check_drawable(clip, tracks)
    clip, tracks, clouds, limits = _drawn(clip, tracks, points, max_tracks)
    colors = [to_hex(color) for color in track_colors(clip, tracks)]
    parts = [_moving_parts(cloud, tracks, t, tail) for t, cloud in enumerate(clouds)]
    # A frame carries only what changes; the rest stays with the traces and the colour axes of the layout.
    frames = [go.Frame(name=str(t), data=[go.Scatter3d(part) for part in now]) for t, now in enumerate(parts)]
    traces = [go.Scatter3d(part).update(style) for part, style in zip(parts[0], _styles(colors), strict=True)]
    text = f"{title or clip.name} · world axes, scene units<br><sup>{_key(tail)}</sup>"
    layout = {
        "title": {"text": text, "font": {"size": 14}, "x": 0.02},
        "scene": _scene(_View.of(clip, clouds, tracks), limits),
        "coloraxis": _color_axis(_CLOUD_COLORS),
        "coloraxis2": _color_axis(colors),
        "margin": {"l": 0, "r": 0, "t": 52, "b": 0},
        "height": 600,
        "showlegend": False,
        "uirevision": "keep",  # the reader's view survives every redraw
    }
    return go.Figure(data=traces, frames=frames, layout=layout | _controls(len(clip)))


def tracks_3d_static(clip: Clip, tracks: Tracks, frames: Sequence[int] | None = None, points: int = 4000) -> Figure:
    """The matplotlib twin of `tracks_3d`: its opening view in some frames, by default the first, middle and last.

    Each panel has that many `points` of the cloud.
    """
    frames = [0, len(clip) // 2, len(clip) - 1] if frames is None else list(frames)
    for t in frames:
        check_drawable(clip, tracks, t)
    clip, tracks, clouds, _ = _drawn(clip, tracks, points, 120)
    colors, view = track_colors(clip, tracks), _View.of(clip, clouds, tracks)
    figure = Figure(figsize=(3.4 * len(frames), 3.4 / _WIDE + 0.25), layout="constrained")
    for ax, t in zip(figure.subplots(1, len(frames), squeeze=False)[0], frames, strict=True):
        xyz, rgb = clouds[t]
        flat, depth = view.project(xyz)
        order = np.argsort(-depth)  # what is near covers what is far
        ax.scatter(*flat[order].T, c=rgb[order] / 255, s=2.2, linewidths=0)
        path = view.project(tracks.xyz[max(0, t - 12) : t + 1])[0]
        for n, color in enumerate(colors):
            ax.plot(*path[:, n].T, color=color, lw=1)
        faces = np.where(tracks.visible[t][:, None], colors, 1)
        ax.scatter(*path[-1].T, s=9, facecolors=faces, edgecolors=colors, linewidths=0.8, zorder=3)
        ax.set_title(f"t = {t}", fontsize=9)
        ax.set(aspect="equal", xticks=[], yticks=[], xlim=(-_WIDE * _SIGHT, _WIDE * _SIGHT), ylim=(-_SIGHT, _SIGHT))
        ax.spines[:].set_color("#d5d8dd")
    _draw_tripod(figure.axes[0], view)
    return figure


@dataclass(frozen=True)
class _View:
    """Where a scene is looked at from: its eye (3,), what is up (3,), rows right, up and ahead (3, 3), how far its middle is."""

    eye: np.ndarray
    up: np.ndarray
    axes: np.ndarray
    distance: float

    @classmethod
    def of(cls, clip: Clip, clouds: Sequence[tuple], tracks: Tracks) -> _View:
        """From behind and above the clip's first camera, as near as all that is drawn fits into the image."""
        up = _up(clip)
        ahead = clip.extrinsics[0, 2, :3] - 0.5 * up
        right = np.cross(ahead, up)
        axes = np.stack([right, np.cross(right, ahead), ahead]).astype(float)
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        xyz = np.concatenate([*(cloud for cloud, _ in clouds), tracks.xyz.reshape(-1, 3)])
        local = xyz[np.isfinite(xyz).all(-1)] @ axes.T
        # A point is seen where |x| <= a z and |y| <= b z from the eye: four planes, which the eye moves back to touch.
        slopes = np.array([_WIDE, 1]) * _HALF
        over = (local[:, :2] - slopes * local[:, 2:]).max(0)
        under = (-local[:, :2] - slopes * local[:, 2:]).max(0)
        eye = np.append((over - under) / 2, (-(over + under) / (2 * slopes)).min())
        return cls(eye @ axes, up, axes, float(np.median(local[:, 2]) - eye[2]))

    def project(self, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places (..., 2) in the image, whose upper and lower borders are +-`_HALF` and a margin, and depths (...)."""
        local = (xyz - self.eye) @ self.axes.T
        return local[..., :2] / local[..., 2:], local[..., 2]


def _drawn(clip: Clip, tracks: Tracks, points: int, most: int) -> tuple:
    """The foreground's clip and tracks, a cloud (xyz, rgb) for each frame, and limits (3, 2) that hold all of it.

    Single far points of a cloud, and what a track that went astray does farther off than the scene is large, are left out.
    """
    clip, tracks = _foreground(clip, tracks, most)
    clouds = [_cloud_points(clip, t, points) for t in range(len(clip))]
    room = axis_limits(np.concatenate([xyz for xyz, _ in clouds]))
    size = np.ptp(room, axis=-1).max()
    astray = _outside(tracks.xyz, room + size * np.array([-1, 1]))
    tracks = replace(tracks, xyz=np.where(astray[..., None], np.float32(np.nan), tracks.xyz))
    inside = [~_outside(xyz, room) for xyz, _ in clouds]
    clouds = [(xyz[kept], rgb[kept]) for (xyz, rgb), kept in zip(clouds, inside, strict=True)]
    ends = np.concatenate([room.T, tracks.xyz.reshape(-1, 3)])
    margin = 0.02 * size * np.array([-1, 1])
    return clip, tracks, clouds, np.stack([np.nanmin(ends, axis=0), np.nanmax(ends, axis=0)], -1) + margin


def _outside(xyz: np.ndarray, limits: np.ndarray) -> np.ndarray:
    return ~((xyz >= limits[:, 0]) & (xyz <= limits[:, 1])).all(-1)


def _key(tail: int) -> str:
    """What colours and marks mean, in one line of HTML."""
    first, last = (f'<span style="color:{to_hex(color)}">■</span>' for color in PLACES)
    return (
        f"Colour of a track: where its query lies in the image, {first} top left to {last} bottom right. "
        f"Hollow: hidden. Tail: its last {tail} frames."
    )


def _draw_tripod(ax: Axes, view: _View) -> None:
    """World axes in a corner of a panel, as long as one (or ten, a tenth, …) scene units in the middle of the view."""
    length = 10.0 ** np.floor(np.log10(0.6 * view.distance * _SIGHT))
    middle = view.eye + view.distance * view.axes[2]
    corner = np.array([-0.74 * _WIDE, -0.72]) * _SIGHT
    for name, end in zip("xyz", view.project(middle + length * np.eye(3))[0], strict=True):
        arrow = {"arrowstyle": "->", "color": INK, "shrinkA": 0, "shrinkB": 0}
        ax.annotate("", corner + end, corner, arrowprops=arrow)
        far = end * (1 + 0.07 * _SIGHT / max(np.linalg.norm(end), 0.02))
        ax.text(*(corner + far), name, fontsize=8, color=INK, ha="center", va="center")
    units = "scene unit" if length == 1 else "scene units"
    ax.set_title(f"{ax.get_title()}  (arrows: world axes, {length:g} {units})", fontsize=9)


def _foreground(clip: Clip, tracks: Tracks, most: int) -> tuple[Clip, Tracks]:
    """The clip without its far depths, which would shrink all that moves to a speck, and at most `most` tracks.

    They are evenly picked from those whose query lies within the depths that are left. No body that is known to move
    is cut off, be it up to twice as far.
    """
    near = 1.6 * float(np.median(clip.depths[clip.depths > 0]))
    truth = clip.tracks
    if truth is not None and truth.dynamic is not None:
        body = transform(truth.xyz, clip.extrinsics)[..., 2][truth.visible & truth.dynamic]
        near = max(near, min(1.05 * float(body.max(initial=0)), 2 * near))
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


def _moving_parts(cloud: tuple, tracks: Tracks, frame: int, tail: int) -> list[dict[str, object]]:
    """What changes over time: of the cloud (xyz, rgb), the tails and the heads."""
    xyz, rgb = cloud
    code = (rgb.astype(int) * _LEVELS) // 256 @ [_LEVELS**2, _LEVELS, 1]
    path = tracks.xyz[max(0, frame - tail) : frame + 1]
    gap = np.full((1, path.shape[1], 3), np.nan, np.float32)  # NaN lifts the pen between tracks
    tails = np.concatenate([path, gap]).swapaxes(0, 1).reshape(-1, 3)
    index = np.repeat(np.arange(path.shape[1], dtype=np.uint16), len(path) + 1)
    symbols = ["circle" if seen else "circle-open" for seen in tracks.visible[frame]]
    return [
        _xyz(xyz.astype(np.float32)) | {"marker": {"color": code.astype(np.uint16)}},
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
    """Limits (3, 2) around points (P, 3), with a margin; single points far from all others and NaN are left out."""
    low, high = np.nanquantile(xyz, [0.002, 0.998], axis=0)
    room = 0.25 * (high - low).max()
    ends = np.maximum(np.nanmin(xyz, axis=0), low - room), np.minimum(np.nanmax(xyz, axis=0), high + room)
    return np.stack(ends, -1) + 0.02 * room * np.array([-1, 1])


def fixed_axes(limits: np.ndarray) -> dict[str, object]:
    """Axes of a plotly scene with limits (3, 2) and equal scales, which stay as they are while its frames change.

    The aspect mode "data" would scale the axes anew by the points of each frame: what rests would slide.
    """
    sizes = np.ptp(limits, axis=-1)
    axes = {f"{k}axis": {"range": r.tolist(), "autorange": False} for k, r in zip("xyz", limits, strict=True)}
    return axes | {"aspectmode": "manual", "aspectratio": _xyz(sizes / np.prod(sizes) ** (1 / 3))}


def _scene(view: _View, limits: np.ndarray) -> dict[str, object]:
    """Axes with fixed ranges, opened as the view says."""
    style = {"showspikes": False, "tickfont": {"size": 10}, "backgroundcolor": "#f4f5f7"}
    scene = fixed_axes(limits)
    for k in "xyz":
        scene[f"{k}axis"] |= style | {"title": {"text": f"{k}, world (scene units)", "font": {"size": 11}}}
    # The camera's unit is the geometric mean of the three ranges, counted from their middle.
    unit, middle = np.prod(np.ptp(limits, axis=-1)) ** (1 / 3), limits.mean(-1)
    center = view.eye + view.distance * view.axes[2]
    camera = {"up": view.up, "eye": (view.eye - middle) / unit, "center": (center - middle) / unit}
    return scene | {"camera": {name: _xyz(vector) for name, vector in camera.items()}}


def _up(clip: Clip) -> np.ndarray:
    """World z if all cameras stand level on it (plotly then turns the scene like a table), else the first camera's up."""
    right, up = clip.extrinsics[:, 0, 2], -clip.extrinsics[:, 1, 2]
    level = np.abs(right).mean() < 0.15 and up.min() > 0.15
    return np.array([0.0, 0.0, 1.0]) if level else -clip.extrinsics[0, 1, :3].astype(float)


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
