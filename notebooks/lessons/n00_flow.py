"""Lesson 00, why Lucas-Kanade loses points at rest: take one reason away at a time, and see who comes back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from matplotlib.figure import Figure

from tapip3d_lite.clip import Clip
from tapip3d_lite.evaluation.baselines import KltTracker
from tapip3d_lite.figures.flat import INK, draw_image, label_axes
from tapip3d_lite.geometry import point_map, project

Array = np.ndarray
REPAIRS = ("as filmed", "shape repaired", "look repaired", "both repaired")
_KLT = KltTracker()
_SAME = 0.03  # relative difference of depth up to which two frames show the same surface
_BLUE, _ORANGE, _GREY = "#0072b2", "#d55e00", "#8a919c"


@dataclass(frozen=True)
class OneFrame:
    """Points at rest, seen in truth both in their query's frame and in the next one (or the one before): n in all.

    Attributes:
        frames: (n, 2) the query's frame and the other one.
        here: (n, 2) the true pixel in the query's frame.
        there: (n, 2) the true pixel in the other frame.
        kept: each of `REPAIRS` to (n,) bool, whether the way back ends within a pixel of the start.
        mixed: (n,) bool, whether part of the window shows in one frame only: covered, uncovered, moving or cut off.
    """

    frames: Array
    here: Array
    there: Array
    kept: Mapping[str, Array]
    mixed: Array


def one_frame(clip: Clip) -> OneFrame:
    """Follow all points at rest over one frame with the tracker's own Lucas-Kanade, in four versions of the other frame.

    The search starts at the true place, where a point at rest must be. *Shape repaired*: the other frame is seen from the
    first one's camera, by the true depth, so that every window keeps its shape. *Look repaired*: the other frame's
    pixels take the first one's colours wherever both show the same surface.
    """
    truth, gray = clip.tracks, [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in clip.video]
    uv, _ = project(truth.xyz, clip.intrinsics, clip.extrinsics)
    start, parts = truth.queries[:, 0].astype(int), []
    for a in np.unique(start):
        for b in {a - 1, a + 1} & set(range(len(clip))):
            which = np.flatnonzero((start == a) & truth.visible[a] & truth.visible[b] & ~truth.dynamic)
            if len(which):
                parts.append(_pair(clip, gray, a, b, uv[a, which], uv[b, which]))
    frames, here, there, mixed, *kept = (np.concatenate(part) for part in zip(*parts, strict=True))
    return OneFrame(frames, here, there, dict(zip(REPAIRS, kept, strict=True)), mixed)


def _pair(clip: Clip, gray: list[Array], a: int, b: int, here: Array, there: Array) -> tuple[Array, ...]:
    """What `OneFrame` says of the points of one frame and its neighbour."""
    from_a, in_a = _carried(clip, b, a)  # for the pixels of b: where in a
    from_b, in_b = _carried(clip, a, b)
    painted = np.where(in_a, _sampled(gray[a], from_a), gray[b])
    turned = _sampled(gray[b], from_b)
    kept = (
        _returns(gray[a], gray[b], here, there),
        _returns(gray[a], turned, here, here),
        _returns(gray[a], painted, here, there),
        _returns(gray[a], np.where(in_b, gray[a], turned), here, here),
    )
    window = np.ones((_KLT.window, _KLT.window), np.uint8)
    whole = cv2.erode(in_b.astype(np.uint8), window, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    u, v = np.rint(here).astype(int).clip(0, np.array(clip.size[::-1]) - 1).T
    return np.tile([a, b], (len(here), 1)), here, there, whole[v, u] == 0, *kept


def _carried(clip: Clip, frame: int, other: int) -> tuple[Array, Array]:
    """Where in another frame the pixels of a frame are (H, W, 2), if all rests; and where it shows the same surface (H, W)."""
    points = point_map(clip.depths[frame], clip.intrinsics[frame], clip.extrinsics[frame])
    uv, z = project(points.reshape(-1, 3), clip.intrinsics[other], clip.extrinsics[other])
    uv, z = uv.reshape(points.shape[:2] + (2,)).astype(np.float32), z.reshape(points.shape[:2])
    nearest = {"interpolation": cv2.INTER_NEAREST, "borderMode": cv2.BORDER_CONSTANT, "borderValue": 0}
    there = cv2.remap(clip.depths[other], uv[..., 0], uv[..., 1], **nearest)
    return uv, (z > 0) & (np.abs(there - z) <= _SAME * z)


def _sampled(image: Array, uv: Array) -> Array:
    return cv2.remap(image, uv[..., 0], uv[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _returns(a: Array, b: Array, here: Array, guess: Array) -> Array:
    """Whether Lucas-Kanade from a to b and back again ends where it began, as `KltTracker` asks."""
    size, flags = (_KLT.window, _KLT.window), cv2.OPTFLOW_USE_INITIAL_FLOW
    options = {"winSize": size, "maxLevel": _KLT.levels, "flags": flags}
    here, guess = here.astype(np.float32), guess.astype(np.float32)
    there, out, _ = cv2.calcOpticalFlowPyrLK(a, b, here, guess.copy(), **options)
    back, home, _ = cv2.calcOpticalFlowPyrLK(b, a, there, here + (there - guess), **options)
    near = np.linalg.norm(back - here, axis=-1) <= _KLT.tolerance
    return near & (out[:, 0] > 0) & (home[:, 0] > 0)


def repairs_figure(one: OneFrame, control: OneFrame, names: tuple[str, str]) -> Figure:
    """Shares of points kept, for each repair, of a clip and of a control; the share as filmed is drawn on as a line."""
    figure = Figure(figsize=(7.2, 2.7), layout="constrained")
    ax = figure.subplots()
    for i, (part, name, color, hatch) in enumerate(zip((one, control), names, (_BLUE, _GREY), ("", "//"), strict=True)):
        at = np.arange(len(REPAIRS)) + (i - 0.5) * 0.4
        shares = [part.kept[repair].mean() for repair in REPAIRS]
        bars = ax.bar(at, shares, 0.37, color=color, hatch=hatch, edgecolor="white", label=name)
        ax.bar_label(bars, [f"{share:.0%}" for share in shares], fontsize=8, padding=1)
    ax.axhline(one.kept[REPAIRS[0]].mean(), color=_ORANGE, lw=1, ls="--")
    ax.set_xticks(range(len(REPAIRS)), REPAIRS)
    ax.set_ylim(0, 1.25)
    ax.set_yticks([0, 0.5, 1])
    label_axes(ax, "share of points kept", "")
    ax.tick_params(labelsize=8.5)
    ax.legend(fontsize=8, frameon=False, ncols=2, loc="upper left")
    return figure


def patches_figure(clip: Clip, one: OneFrame) -> Figure:
    """One lost point for each reason, in its query's frame (above) and in the other one (below), with the window."""
    lost = ~one.kept["as filmed"]
    shape, look, both = (one.kept[repair] for repair in REPAIRS[1:])
    groups = {
        "shape: comes back\nwith the shape alone": lost & shape & ~look & ~one.mixed,
        "look: comes back\nwith the look alone": lost & look & ~shape & ~one.mixed,
        "mixed window:\nnothing brings it back": lost & ~both & one.mixed,
    }
    figure = Figure(figsize=(6.3, 4.4), layout="constrained")
    axes, half = figure.subplots(2, 3), 18
    middle = np.array(clip.size[::-1]) / 2
    for column, (name, which) in zip(axes.T, groups.items(), strict=True):
        if not which.any():
            figure.suptitle("no example of each kind in this clip", fontsize=8)
            continue
        # The one nearest to the middle of the image, so that its surroundings can be shown.
        i = np.flatnonzero(which)[np.abs(one.here[which] - middle).max(1).argmin()]
        for ax, place, t in zip(column, (one.here[i], one.there[i]), one.frames[i], strict=True):
            draw_image(ax, clip.video[t], "")
            u, v = place
            ax.set(xlim=(u - half, u + half), ylim=(v + half, v - half))
            side = _KLT.window
            for color, width in (("black", 2.6), ("white", 1.2)):
                ax.plot(*_square(place, side), color=color, lw=width)
            ax.set_xlabel(f"frame {t}", fontsize=8, color=INK)
        column[0].set_title(name, fontsize=8.5, color=INK)
    return figure


def _square(center: Array, side: float) -> Array:
    return center[:, None] + side / 2 * np.array([[-1, 1, 1, -1, -1], [-1, -1, 1, 1, -1]])
