"""The patterns of solid textures: functions from pattern coordinates to colours, band-limited by construction.

A builder draws a pattern's sizes and returns the function. Features measure 0.1 to 0.5 units and edges are soft over
about 0.03, so that a small picture does not alias. Cell-based patterns keep what they paint inside its cell and
need no neighbours; all are continuous.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

Pattern = Callable[[np.ndarray], np.ndarray]

_SOFT = 0.03  # width of an edge, units
_TABLE = 1024  # entries of a colour table


def smooth_field(rng: np.random.Generator, count: int, length: float) -> Pattern:
    """A random field (P,) of about unit variance: plane waves of about one length, in random directions."""
    directions = rng.normal(size=(3, count))
    directions *= 2 * np.pi / (length * rng.uniform(0.75, 1.35, count) * np.linalg.norm(directions, axis=0))
    directions = directions.astype(np.float32)
    phases = rng.uniform(0, 2 * np.pi, count).astype(np.float32)
    weights = np.full(count, np.sqrt(2 / count), np.float32)
    return lambda p: np.sin(p @ directions + phases) @ weights


def _bands(rng: np.random.Generator, colors: np.ndarray, shares: ArrayLike, soft: float) -> Pattern:
    """Colours of positions (P,) along periodic bands of the given shares, edges blurred by `soft` periods."""
    edges = np.cumsum(shares) / np.sum(shares)
    hard = colors[np.searchsorted(edges, (np.arange(_TABLE) + 0.5) / _TABLE)]
    blur = np.exp(-2 * (np.pi * 0.4 * soft * np.fft.rfftfreq(_TABLE, 1 / _TABLE)) ** 2)
    smooth = np.fft.irfft(np.fft.rfft(hard, axis=0) * blur[:, None], _TABLE, axis=0)
    table = np.roll(smooth, rng.integers(_TABLE), axis=0).astype(np.float32)
    return lambda s: table[np.floor(s * _TABLE).astype(np.int32) & (_TABLE - 1)]


def smooth_step(distance: np.ndarray, soft: float = _SOFT) -> np.ndarray:
    """0 below zero, 1 above, smooth in between over `soft`."""
    t = np.clip(distance * (1 / soft) + 0.5, 0, 1)
    return t * t * (3 - 2 * t)


def mix(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """From colours `a` at weight 0 to `b` at weight 1; weight (P,)."""
    return a + (b - a) * weight[:, None]


def _cells(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Offset from the nearest integer point, and a hash of that point in [0, 256)."""
    cell = np.rint(points)
    i = cell.astype(np.int32)
    return points - cell, (i[:, 0] * 73 ^ i[:, 1] * 151 ^ i[:, 2] * 197 ^ (i[:, 0] + 3 * i[:, 1]) >> 2) & 255


def _checker(rng: np.random.Generator, colors: np.ndarray) -> Pattern:
    size = rng.uniform(0.2, 0.34)
    steep = size / (np.pi * 0.5 * _SOFT)
    return lambda p: mix(*colors[:2], 0.5 + 0.5 * np.clip(np.cos(p * (np.pi / size)) * steep, -1, 1).prod(1))


def _stripes(rng: np.random.Generator, colors: np.ndarray) -> Pattern:
    period = rng.uniform(0.5, 0.8)
    bands = _bands(rng, colors[[0, 1, 0, 2]], rng.uniform(0.5, 1.2, 4), _SOFT / period)
    along = rng.normal(size=3) * (1, 1, 0.4)
    along = (along / np.linalg.norm(along) / period).astype(np.float32)
    return lambda p: bands(p @ along)


def _waves(rng: np.random.Generator, colors: np.ndarray) -> Pattern:
    period, length, height = rng.uniform(0.4, 0.6), rng.uniform(0.4, 0.6), rng.uniform(0.07, 0.12)
    bands = _bands(rng, colors[:4], rng.uniform(0.6, 1.2, 4), 1.3 * _SOFT / period)

    def pattern(p: np.ndarray) -> np.ndarray:
        wave = np.sin((p[:, 0] + p[:, 2]) * (2 * np.pi / length))
        return bands((p[:, 1] + 0.3 * p[:, 2] + height * wave) * (1 / period))

    return pattern


def _bricks(rng: np.random.Generator, colors: np.ndarray) -> Pattern:
    size = np.array([rng.uniform(0.3, 0.45), rng.uniform(0.16, 0.24), 0.36], np.float32)
    shift = np.float32(rng.choice([0.0, 0.5]))  # tiles or bricks
    faces = colors[1 + np.r_[:256] % 2][rng.permutation(256)] * rng.uniform(0.75, 1.2, (256, 1)).astype(np.float32)
    joint = rng.uniform(0.012, 0.02)

    def pattern(p: np.ndarray) -> np.ndarray:
        q = p / size
        q[:, 0] += shift * (np.rint(q[:, 1]) + np.rint(q[:, 2]))
        q, key = _cells(q)
        inside = ((0.5 - np.abs(q)) * size).min(-1) - joint
        return mix(colors[0], faces[key], smooth_step(inside, 0.8 * _SOFT))

    return pattern


def _dots(rng: np.random.Generator, colors: np.ndarray) -> Pattern:
    size = rng.uniform(0.24, 0.38)
    radius = rng.uniform(0.3, 0.42, 256)
    # Every dot lies within its own cell, so that no neighbouring cell has to be looked at.
    centres = (rng.uniform(-1, 1, (256, 3)) * (0.47 - radius[:, None]) * (1, 1, 0.5)).astype(np.float32)
    reach = (radius - 0.5 * _SOFT / size).astype(np.float32)
    paint = colors[1 + rng.integers(0, min(3, len(colors) - 1), 256)]

    def pattern(p: np.ndarray) -> np.ndarray:
        q, key = _cells(p * (1 / size))
        q -= centres[key]
        distance = (reach[key] - np.sqrt(np.einsum("pi,pi->p", q, q))) * size
        return mix(colors[0], paint[key], smooth_step(distance))

    return pattern


def _terrazzo(rng: np.random.Generator, colors: np.ndarray) -> Pattern:
    sizes = rng.uniform(0.26, 0.34), rng.uniform(0.13, 0.17)
    turns, _ = np.linalg.qr(rng.normal(size=(256, 3, 3)))
    sides = rng.uniform(0.55, 1.0, (256, 3))  # of half the diagonal's share: a turned box still fits its cell
    shapes = (turns / (0.28 * sides[:, None, :])).astype(np.float32)
    paint = colors[1 + rng.integers(0, len(colors) - 1, 256)] * rng.uniform(0.85, 1.15, (256, 1)).astype(np.float32)

    def pattern(p: np.ndarray) -> np.ndarray:
        color = np.broadcast_to(colors[0], p.shape)
        for size in sizes:
            q, key = _cells(p * (1 / size) + 7 * size)
            out = 1 - np.abs(np.einsum("pi,pij->pj", q, shapes[key])).max(-1)
            color = mix(color, paint[key], smooth_step(out * (0.2 * size), 0.7 * _SOFT))
        return color

    return pattern


def _marble(rng: np.random.Generator, colors: np.ndarray) -> Pattern:
    period = rng.uniform(0.45, 0.7)
    bands = _bands(rng, colors[[0, 2, 0, 1, 0, 3]], [3, 1.2, 2, 0.7, 3, 1.0], 1.6 * _SOFT / period)
    wide, narrow = smooth_field(rng, 5, 0.8), smooth_field(rng, 6, 0.33)
    return lambda p: bands((p[:, 0] + 0.4 * p[:, 2] + (0.2 * wide(p) + 0.05 * narrow(p)) * period) * (1 / period))


def _wood(rng: np.random.Generator, colors: np.ndarray) -> Pattern:
    period = rng.uniform(0.3, 0.45)
    bands = _bands(rng, colors[[0, 1, 2, 0, 3, 2]], rng.uniform(0.5, 1.5, 6), 1.5 * _SOFT / period)
    axis, warp = rng.uniform(0.15, 0.5, 2).astype(np.float32), smooth_field(rng, 5, 1.0)
    stretch = np.array([0.35, 1, 1], np.float32)  # the grain runs along x

    def pattern(p: np.ndarray) -> np.ndarray:
        radius = np.sqrt((p[:, 1] - axis[0]) ** 2 + (p[:, 2] - axis[1]) ** 2 + 1e-3)
        return bands((radius + 0.06 * warp(p * stretch)) * (1 / period))

    return pattern


def _patches(rng: np.random.Generator, colors: np.ndarray) -> Pattern:
    length = rng.uniform(0.45, 0.65)
    wide, narrow = smooth_field(rng, 8, length), smooth_field(rng, 8, 0.4 * length)
    bands = _bands(rng, colors[:4], [1.0, 0.8, 0.9, 0.8], 1.6 * _SOFT / length)
    return lambda p: bands(0.25 * wide(p) + 0.07 * narrow(p))


def _speckle(rng: np.random.Generator, colors: np.ndarray) -> Pattern:
    along = (rng.normal(size=3) * (0.5, 0.5, 0.3)).astype(np.float32)
    bands = _bands(rng, colors[:3], [1, 1, 1], 0.5)
    specks = _dots(rng, colors[[0, -1, 0, -1]])

    def pattern(p: np.ndarray) -> np.ndarray:
        base = bands(p @ along)
        return base + 0.55 * (specks(p * 1.9) - base) * 0.9

    return pattern


def _plaid(rng: np.random.Generator, colors: np.ndarray) -> Pattern:
    period = rng.uniform(0.45, 0.65)
    colors = colors[[0, 1, 0, 2]]
    axes = [_bands(rng, colors, [1.2, 0.9, 1.0, rng.uniform(0.2, 0.4)], _SOFT / period) for _ in range(3)]
    weights = np.array([0.42, 0.38, 0.2], np.float32)
    return lambda p: sum(bands(p[:, i] * (1 / period)) * weights[i] for i, bands in enumerate(axes))


PATTERNS: dict[str, Callable[[np.random.Generator, np.ndarray], Pattern]] = {
    f.__name__.removeprefix("_"): f
    for f in (_checker, _stripes, _waves, _bricks, _dots, _terrazzo, _marble, _wood, _patches, _speckle, _plaid)
}
