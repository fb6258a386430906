"""Figures of lesson 02: paths side by side in different spaces, one path with its fit, and the measured curves."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lessons.n02_straightness import bend, fit_windows, to_space
from tapip3d_lite.clip import Clip
from tapip3d_lite.figures.flat import INK, draw_image, label_axes

# The palette of Okabe and Ito, which colour-blind readers can tell apart; shapes and dashes say the same again.
STILL, MOVING, FIT = "#0072b2", "#d55e00", "#e69f00"
STYLES = {
    "uvd": {"color": "#e69f00", "ls": "-", "lw": 7},
    "uvlogd": {"color": "#56b4e9", "ls": "-", "lw": 3.5},
    "camera": {"color": "#d55e00", "ls": "--", "lw": 1.6, "marker": "s", "ms": 4},
    "world": {"color": "#009e73", "ls": "-", "lw": 1.6, "marker": "o", "ms": 4},
}
LABELS = {
    "uvd": ("u (px)", "v (px)", "depth (m)"),
    "uvlogd": ("u (px)", "v (px)", "f log d (px)"),
    "camera": ("x right (m)", "y down (m)", "z forward (m)"),
    "world": ("x (m)", "y (m)", "z up (m)"),
}


def paths_in_spaces(clip: Clip, still: np.ndarray, moving: np.ndarray) -> Figure:
    """The same paths in the image, from above in camera coordinates, and from above in the world.

    Args:
        clip: a clip with true tracks whose world has z up.
        still: indices of tracks to draw in blue, ending in dots.
        moving: indices of tracks to draw in orange, ending in squares.
    """
    figure = Figure(figsize=(10.2, 3.5), layout="constrained")
    axes = figure.subplots(1, 3)
    draw_image(axes[0], clip.video[-1], "")
    axes[0].set_title("image: u, v", fontsize=10, color=INK)
    views = (("uvd", (0, 1)), ("camera", (0, 2)), ("world", (0, 1)))
    groups = ((still, STILL, "o", "at rest"), (moving, MOVING, "s", "moving"))
    for ax, (space, pair) in zip(axes, views, strict=True):
        coords = to_space(clip.tracks.xyz, clip.intrinsics, clip.extrinsics, space)
        for which, color, marker, name in groups:
            for i, n in enumerate(which):
                path = coords[:, n][:, list(pair)]
                ax.plot(*path.T, color=color, lw=1.3)
                label = name if i == 0 else None
                ax.plot(*path[-1], marker, ls="none", color=color, ms=5, mec="white", mew=0.5, label=label)
        if space != "uvd":
            label_axes(ax, LABELS[space][pair[1]], LABELS[space][pair[0]])
            ax.set_aspect("equal", adjustable="datalim")
            ax.set_title(f"{space}, from above", fontsize=10, color=INK)
    axes[1].legend(fontsize=8, loc="best")
    return figure


def motion_fit(
    clip: Clip, track: int = 0, frame: int = 0, space: str = "world", window: int = 5, degree: int = 1
) -> Figure:
    """One true path in one space, coordinate by coordinate, with the best fit to the window that starts at a frame.

    Args:
        clip: a clip with true tracks.
        track: index of the track.
        frame: the window's first frame; moved back where the window would run past the end.
        space: "uvd", "uvlogd", "camera" or "world".
        window: S, frames.
        degree: of the fit: 0 rest, 1 constant velocity, 2 constant acceleration.
    """
    start = min(frame, len(clip) - window)
    xyz = clip.tracks.xyz[:, track : track + 1]
    coords = to_space(xyz, clip.intrinsics, clip.extrinsics, space)[:, 0]
    fit = fit_windows(coords[:, None], window, degree)[start, :, 0]
    error = bend(xyz, clip.intrinsics, clip.extrinsics, space, window, degree)[start, 0]
    figure = Figure(figsize=(10.6, 3.0), layout="constrained")
    axes = figure.subplots(1, 4)
    draw_image(axes[0], clip.video[start], "")
    axes[0].set_title(f"frame {start}", fontsize=9, color=INK)
    _mark(axes[0], clip, track, start)
    for i, ax in enumerate(axes[1:]):
        ax.axvspan(start, start + window - 1, color="#000", alpha=0.06, lw=0)
        ax.plot(coords[:, i], ".-", color=STILL, lw=1, ms=4, label="truth")
        ax.plot(np.arange(start, start + window), fit[:, i], "--", color=FIT, lw=2.4, label=f"fit, degree {degree}")
        label_axes(ax, LABELS[space][i], "frame")
        _widen(ax, 3.0 if "px" in LABELS[space][i] else 0.2)
    axes[1].legend(fontsize=8, frameon=False)
    axes[2].set_title(f"{space}: the fit misses the truth by {100 * error:.1f} cm (RMS)", fontsize=9, color=INK)
    return figure


def _mark(ax: Axes, clip: Clip, track: int, frame: int) -> None:
    uvd = to_space(clip.tracks.xyz[:, track : track + 1], clip.intrinsics, clip.extrinsics, "uvd")[:, 0]
    ax.plot(*uvd[:, :2].T, color="white", lw=1)
    seen = clip.tracks.visible[frame, track]
    ax.plot(*uvd[frame, :2], "o", ms=8, mec="white", mfc=MOVING if seen else "none")
    ax.set(xlim=(-0.5, clip.size[1] - 0.5), ylim=(clip.size[0] - 0.5, -0.5))


def _widen(ax: Axes, least: float) -> None:
    """Give a nearly constant curve an axis of at least this height, so that rounding does not look like motion."""
    low, high = ax.get_ylim()
    if high - low < least:
        middle = (low + high) / 2
        ax.set_ylim(middle - least / 2, middle + least / 2)


def gains(ratios: Mapping[str, np.ndarray], still: Mapping[str, np.ndarray], window: int = 5) -> Figure:
    """What the strength of the hand does: ratios of moving points, and the bend of points at rest.

    Args:
        ratios: name of a fit to (4, 3): bend in camera coordinates over bend in the world, with its interval's ends,
            for a tripod and hands of strength 1 to 3.
        still: name of a space to the mean bends (4,) in cm.
        window: frames of the windows in which those were measured.
    """
    figure = Figure(figsize=(9.4, 3.3), layout="constrained")
    left, right = figure.subplots(1, 2)
    looks = (("#0072b2", "o", "-"), ("#d55e00", "s", "--"), ("#009e73", "^", ":"))
    for (name, values), (color, marker, dashes) in zip(ratios.items(), looks, strict=False):
        mean, low, high = values.T
        style = {"marker": marker, "ls": dashes, "capsize": 3, "color": color, "label": name}
        left.errorbar(range(4), mean, [mean - low, high - mean], **style)
    left.axhline(1, color="#888", lw=0.8)
    left.set(xlabel="strength of the hand (0: tripod)", ylabel="bend: camera / world", xticks=range(4))
    left.set_title("moving points", fontsize=10)
    for name, values in still.items():  # thick below thin: three curves coincide
        right.plot(range(4), values, label=name, **STYLES[name])
    right.set(xlabel="strength of the hand (0: tripod)", ylabel="bend (cm)", xticks=range(4))
    right.set_title(f"points at rest, straight line, {window} frames", fontsize=10)
    for ax in (left, right):
        ax.legend(frameon=False, fontsize=8, handlelength=3.5)
    return figure


def gravity_peak(ball: Mapping[str, np.ndarray], bodies: Mapping[str, np.ndarray]) -> Figure:
    """Upward accelerations (m/s²) in camera and world: of a thrown ball over time, and of many points as a histogram."""
    figure = Figure(figsize=(9.4, 3.3), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name, values in ball.items():
        look = STYLES[name.split(",")[0]]
        left.plot(np.arange(1, len(values) + 1), values, label=name, **look)
    left.set(xlabel="frame", ylabel="upward acceleration (m/s²)")
    left.set_title("one thrown ball", fontsize=10)
    edges = np.arange(-20.31, -3, 1.0)  # a bin's middle lies at -9.81
    for name, values in bodies.items():
        share = 100 * np.histogram(values, edges)[0] / len(values)
        look = {key: value for key, value in STYLES[name].items() if key in ("color", "ls", "lw")}
        right.stairs(share, edges, baseline=None, label=name, **look)
    right.axvline(-9.81, color="#888", lw=0.8, ls=":", label="free fall")
    right.set(xlabel="upward acceleration (m/s²)", ylabel="points (%)", ylim=(0, None))
    right.set_title("points of moving bodies, hand 1", fontsize=10)
    for ax in (left, right):
        ax.legend(frameon=False, fontsize=8, handlelength=3)
    return figure


def noise_curves(sigmas: np.ndarray, curves: Mapping[str, tuple[np.ndarray, np.ndarray, float]]) -> Figure:
    """Bends (cm) against pose noise, with 95 % bands over clips.

    Args:
        sigmas: (M,), degrees.
        curves: title to (world (M, clips), camera (M, clips), where they cross in degrees).
    """
    figure = Figure(figsize=(10.4, 3.3), layout="constrained")
    for ax, (title, (world, camera, crossed)) in zip(figure.subplots(1, len(curves)), curves.items(), strict=True):
        for name, values in (("world", world), ("camera", camera)):
            error = 1.96 * values.std(-1, ddof=1) / np.sqrt(values.shape[-1])
            mean, look = values.mean(-1), STYLES[name]
            ax.plot(sigmas, mean, label=name, **look)
            ax.fill_between(sigmas, mean - error, mean + error, color=look["color"], alpha=0.18, lw=0)
        ax.axvline(crossed, color="#888", lw=0.9, ls=":", label=f"crossing, {crossed:.2f}°")
        top = 2.2 * camera.mean()
        ax.set(xlabel="pose noise σ (degrees)", ylabel="bend (cm)", ylim=(0, top), xlim=(0, sigmas[-1]))
        ax.set_title(title, fontsize=9)
        ax.legend(edgecolor="none", framealpha=0.9, fontsize=8, loc="lower right")
    return figure
