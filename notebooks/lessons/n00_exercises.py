"""Lesson 00, exercises about clips: queries on what moves, seen or hidden."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lessons.checker import Exercise, Mistake

Array = np.ndarray


def _paths(rng: np.random.Generator, size: int) -> tuple:
    """Tracks of many kinds: at rest, slowly away, there and back again, with a jump only while hidden, never seen."""
    frames, count = size + 4, 8 + 2 * size
    steps = rng.normal(size=(frames, count, 3)) * rng.choice([0.0, 0.004, 0.03, 0.12], (1, count, 1))
    xyz = rng.uniform(-3, 3, (1, count, 3)) + np.cumsum(steps, 0)
    seen, time = rng.random((frames, count)) < 0.6, np.arange(frames)
    seen[:, :7] = True
    xyz[:, 0] = np.linspace(0, 1, frames)[:, None] * [0, 0, 0.4]  # slowly: no single step is long
    seen[0, 0] = False
    xyz[:, 1] = np.sin(np.linspace(0, np.pi, frames))[:, None] * [0.5, 0, 0] + [1, 1, 1]  # ends where it began
    xyz[:, 2] = (time < 2)[:, None] * [0, 2, 0] + [1, 2, 3]  # moves before it is first seen, then rests
    seen[:2, 2] = False
    xyz[:, 3] = (time == frames - 1)[:, None] * [1, 1, 1] + [0, 1, 2]  # moves only where it is hidden
    seen[-1, 3] = False
    seen[:, 4] = False
    xyz[:, 5] = (time == frames - 1)[:, None] * [0, 0.25, 0] + [1, 1, 2]  # exactly `least` away
    xyz[:, 6] = (time == frames - 1)[:, None] * [0.2, 0.2, 0.2] + [1, 1, 1]  # far, but along no axis
    return xyz, seen, 0.25


def movers(xyz: Array, visible: Array, least: float) -> Array:
    """Queries (M, 4) of the tracks that are once seen farther than `least` from where they were first seen."""
    return _moving(xyz, visible, least, visible.argmax(0), visible)


def _moving(xyz: Array, visible: Array, least: float, first: Array, counted: Array) -> Array:
    start = xyz[first, np.arange(len(first))]
    away = np.where(counted, np.linalg.norm(xyz - start, axis=-1), 0).max(0)
    moves = visible.any(0) & (away > least)
    return np.concatenate([first[moves, None], start[moves]], -1)


def _steps(xyz: Array, visible: Array, least: float) -> Array:
    first = visible.argmax(0)
    longest = np.linalg.norm(np.diff(xyz, axis=0), axis=-1).max(0)
    moves = visible.any(0) & (longest > least)
    return np.concatenate([first[moves, None], xyz[first, np.arange(len(first))][moves]], -1)


def _ends(xyz: Array, visible: Array, least: float) -> Array:
    first, last = visible.argmax(0), len(visible) - 1 - visible[::-1].argmax(0)
    track = np.arange(len(first))
    moves = visible.any(0) & (np.linalg.norm(xyz[last, track] - xyz[first, track], axis=-1) > least)
    return np.concatenate([first[moves, None], xyz[first, track][moves]], -1)


def _along_axes(xyz: Array, visible: Array, least: float) -> Array:
    first = visible.argmax(0)
    start = xyz[first, np.arange(len(first))]
    away = np.where(visible, np.abs(xyz - start).max(-1), 0).max(0)
    moves = visible.any(0) & (away > least)
    return np.concatenate([first[moves, None], start[moves]], -1)


MOVERS = Exercise(
    "00.movers",
    reference=movers,
    cases=_paths,
    mistakes=(
        Mistake(
            "asked for in frame 0",
            lambda x, v, d: _moving(x, v, d, np.zeros(v.shape[1], int), v),
            "a query names a frame in which the point is seen: take each track's first visible frame, not frame 0.",
        ),
        Mistake(
            "frame 0 with a later place",
            lambda x, v, d: movers(x, v, d) * [0, 1, 1, 1],
            "frame and place belong together: the first number is the frame in which the point is at (x, y, z).",
        ),
        Mistake(
            "hidden frames counted",
            lambda x, v, d: _moving(x, v, d, v.argmax(0), np.ones_like(v)),
            "only what is seen counts: what a point does while it is hidden, nobody knows on a clip of your own.",
        ),
        Mistake(
            "step by step",
            _steps,
            "a slow body takes small steps and yet goes far: measure from where the point was first seen, not from the last frame.",
        ),
        Mistake(
            "first against last",
            _ends,
            "a point may come back to where it began: take its largest distance over all visible frames, not that of the last.",
        ),
        Mistake(
            "axis by axis",
            _along_axes,
            "how far is a length: use the norm of the difference, not its largest component.",
        ),
        Mistake(
            "place before frame",
            lambda *a: np.roll(movers(*a), -1, -1),
            "a row is (t, x, y, z): the frame comes first.",
        ),
        Mistake("frame left out", lambda *a: movers(*a)[:, 1:], "a query has four numbers; the first is the frame."),
    ),
)


def _projected(rng: np.random.Generator, size: int) -> tuple:
    """Points everywhere, many within half a pixel of a border, some at the surface, at z = 0, and exactly at the limit."""
    height, width, count = 5 + size, 9 + 2 * size, 24 * size
    depth = rng.integers(8, 25, (height, width)) / 8  # eighths: every way to write the rule rounds alike
    uv = rng.uniform([-3, -3], [width + 2, height + 2], (count, 2))
    border, side = rng.random(count) < 0.5, rng.integers(0, 2, count)
    last = np.array([width - 1, height - 1])
    at = np.where(rng.random(count) < 0.5, 0, last[side]) + rng.uniform(-0.9, 0.9, count)
    uv[border, side[border]] = at[border]
    column, row = np.rint(uv).astype(int).clip(0, last).T
    slack, surface = float(rng.choice([0.125, 0.25])), depth[row, column]
    kind = rng.integers(0, 6, count)
    factors = [
        np.ones(count),
        rng.uniform(0.9, 1 + slack, count),
        np.full(count, 1 + slack),
        rng.uniform(0.2, 2, count),
    ]
    z = np.choose(kind, [*(f * surface for f in factors), -rng.uniform(0, 3, count), np.zeros(count)])
    return uv, z, depth, slack


def visible(uv: Array, z: Array, depth: Array, slack: float) -> Array:
    """Which points (N,) are inside the image, in front of the camera and not behind the surface."""
    inside, surface = _surface(uv, depth)
    return inside & (z > 0) & (z <= surface * (1 + slack))


def _surface(uv: Array, depth: Array) -> tuple[Array, Array]:
    """Whether (N,) the nearest pixel is inside the image, and the depth (N,) there or at the nearest border."""
    last = np.array(depth.shape[::-1]) - 1
    nearest = np.rint(uv).astype(int)
    column, row = nearest.clip(0, last).T
    return ((nearest >= 0) & (nearest <= last)).all(-1), depth[row, column]


def _before_rounding(uv: Array, z: Array, depth: Array, slack: float, inside: Array) -> Array:
    return inside.all(-1) & (z > 0) & (z <= _surface(uv, depth)[1] * (1 + slack))


def _negative_wraps(uv: Array, z: Array, depth: Array, slack: float) -> Array:
    u, v = np.rint(uv).astype(int).T
    inside = (u < depth.shape[1]) & (v < depth.shape[0])
    surface = depth[np.where(inside, v, 0) % len(depth), np.where(inside, u, 0) % depth.shape[1]]
    return inside & (z > 0) & (z <= surface * (1 + slack))


def _with(uv: Array, z: Array, depth: Array, rule: Callable[[Array], Array]) -> Array:
    inside, surface = _surface(uv, depth)
    return inside & rule(surface)


VISIBLE = Exercise(
    "00.visible",
    reference=visible,
    cases=_projected,
    mistakes=(
        Mistake(
            "row and column swapped",
            lambda uv, z, d, s: visible(uv[:, ::-1], z, d, s),
            "uv is (column, row) and depth is indexed by (row, column): depth[v, u].",
        ),
        Mistake(
            "image border ignored",
            lambda uv, z, d, s: (z > 0) & (z <= _surface(uv, d)[1] * (1 + s)),
            "a point outside the image cannot be seen; find out which pixels are inside before you look up the depth.",
        ),
        Mistake(
            "border before rounding, to the last centre",
            lambda uv, z, d, s: _before_rounding(uv, z, d, s, (uv >= 0) & (uv <= np.array(d.shape[::-1]) - 1)),
            "a pixel reaches half a pixel beyond its centre: round first, then ask whether that pixel exists.",
        ),
        Mistake(
            "border before rounding, to the size",
            lambda uv, z, d, s: _before_rounding(uv, z, d, s, (uv >= 0) & (uv < d.shape[::-1])),
            "the image reaches from -0.5 to W - 0.5, not from 0 to W: round first, then test 0 <= u < W on whole numbers.",
        ),
        Mistake(
            "left and upper border ignored",
            _negative_wraps,
            "an index of -1 means the last pixel to NumPy: test u >= 0 and v >= 0 as well.",
        ),
        Mistake(
            "behind the camera",
            lambda uv, z, d, s: _with(uv, z, d, lambda surface: z <= surface * (1 + s)),
            "a point behind the camera projects into the image as well; ask for z > 0.",
        ),
        Mistake(
            "no slack",
            lambda uv, z, d, s: visible(uv, z, d, 0.0),
            "surface points lie on the depth map only up to rounding: allow z up to (1 + slack) times the depth.",
        ),
        Mistake(
            "slack as a length",
            lambda uv, z, d, s: _with(uv, z, d, lambda surface: (z > 0) & (z <= surface + s)),
            "the slack is relative: (1 + slack) times the depth, not depth plus slack.",
        ),
        Mistake(
            "near the surface on both sides",
            lambda uv, z, d, s: _with(uv, z, d, lambda surface: (z > 0) & (np.abs(z - surface) <= s * surface)),
            "only what lies deeper than the surface is hidden; a point well in front of it is seen.",
        ),
        Mistake(
            "cut off instead of rounded",
            lambda uv, z, d, s: visible(np.floor(uv), z, d, s),
            "pixel centres are whole numbers, so the nearest pixel comes from rounding, not from cutting off.",
        ),
        Mistake(
            "inequality reversed",
            lambda uv, z, d, s: _with(uv, z, d, lambda surface: (z > 0) & (z >= surface * (1 + s))),
            "a point is hidden when it lies deeper than the surface, so visible means z <= surface.",
        ),
    ),
)
