"""Solid textures: colour as a smooth function of the position in a body, so that it sticks to the body.

Every texture is a pattern with features of 0.1 to 0.4 units and soft edges (so that small pictures do not alias),
varied by a slow tint over the whole body and by faint grain. The slow part tells repeated cells apart, which makes
points of a regular pattern matchable. Colours are linear reflectances in [0, 1].
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Pattern = Callable[[np.ndarray], np.ndarray]

_SOFT = 0.03  # width of an edge, units
_TABLE = 1024  # entries of a colour table

# Each row holds colours that go together (sRGB); the first is the ground.
_TOYS = """
f4f1de e07a5f 3d405b 81b29a f2cc8f|fdfcdc 00afb9 f07167 0081a7 fed9b7|264653 2a9d8f e9c46a f4a261 e76f51
edf2f4 d90429 2b2d42 8d99ae ef233c|ffbe0b fb5607 ff006e 8338ec 3a86ff|f1faee e63946 457b9d a8dadc 1d3557
2b9348 f4d35e ee964b f95738 0d3b66|fefae0 606c38 dda15e bc6c25 283618|5f0f40 fb8b24 9a031e e36414 0f4c5c
f7f7f7 1b998b ff9b71 2d3047 fffd82|3c1642 1dd3b0 086375 affc41 b2ff9e|ef476f ffd166 06d6a0 118ab2 073b4c"""
_STONES = """
e8e4da 5b5b60 a89f91 c9bfb0|d8d2c4 7a4b3a b58f76 3e3a38|cfd8d6 32494f 7f9a97 b9c7c3
ded3e0 5a3f66 a184a8 8a6f92|efe6d0 876b3d bda26b 4f4026|3f4a4d c8cfc9 7d8b8a 1f2527"""
_WOODS = (
    "c99a63 8a5a2f e0bd8a 5f3a1d|a8703f 5c3317 c68f5b 3d200e|d9b382 a6784a ecd3ab 7d542d|8f5f45 57311f b98867 6f4632"
)


@dataclass(frozen=True)
class Texture:
    """A colour for every position of a body, made by `random_texture`.

    Attributes:
        kind: one of `KINDS`.
        pattern: maps pattern coordinates (P, 3) to colours (P, 3).
        frame: (3, 3) body to pattern coordinates, x' = x @ frame + offset.
        offset: (3,).
        slow: waves of the tint over the body, and `fine` those of the grain.
        accent: (3,) colour that the tint leans to.
    """

    kind: str
    pattern: Pattern
    frame: np.ndarray
    offset: np.ndarray
    slow: Pattern
    fine: Pattern
    accent: np.ndarray

    def color(self, points: np.ndarray) -> np.ndarray:
        """Linear reflectances (P, 3) float32 in [0, 1] at body coordinates (P, 3)."""
        points = np.asarray(points, np.float32) @ self.frame + self.offset
        color = self.pattern(points)
        tint = self.slow(points)[:, None]
        color += (self.accent - color) * (0.14 + 0.12 * tint)
        color *= (1 + 0.2 * tint) * (1 + 0.1 * self.fine(points)[:, None])
        return np.clip(color, 0.01, 0.98, out=color)


def random_texture(
    rng: np.random.Generator, kind: str | None = None, scale: float = 1.0, flat: bool = False
) -> Texture:
    """Draw a texture.

    Args:
        rng: source of all random choices.
        kind: one of `KINDS`, or None for any.
        scale: size of the features relative to those of bodies; floors and backdrops want 2 to 6.
        flat: for a surface in the plane z = 0: turn the pattern about z only and cut its cells through the middle.

    Raises:
        ValueError: unknown kind.
    """
    kind = kind or str(rng.choice(KINDS))
    if kind not in _PATTERNS:
        raise ValueError(f"kind: expected one of {', '.join(KINDS)}, got {kind!r}")
    colors = _palette(rng, {"wood": _WOODS, "marble": _STONES, "terrazzo": _STONES}.get(kind, _TOYS))
    pattern = _PATTERNS[kind](rng, colors)
    offset = rng.uniform(-2, 2, 3)
    turn = rng.uniform(0, 2 * np.pi) if flat else rng.uniform(-0.3, 0.3)
    frame = np.eye(3)
    frame[:2, :2] = [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
    if flat:
        offset[2] = 0.0
    else:
        tilt = rng.uniform(0.08, 0.35)  # so that no flat face runs along an edge of the pattern
        frame = frame @ [[1, 0, 0], [0, np.cos(tilt), np.sin(tilt)], [0, -np.sin(tilt), np.cos(tilt)]]
    return Texture(
        kind,
        pattern,
        (frame / scale).astype(np.float32),
        offset.astype(np.float32),
        _waves(rng, 6, 0.9),
        _waves(rng, 8, 0.12),
        colors[rng.integers(1, len(colors))],
    )


def _palette(rng: np.random.Generator, rows: str) -> np.ndarray:
    """Linear colours (n, 3) of a random row; all but the ground shuffled, all slightly varied."""
    row = str(rng.choice(rows.strip().replace("\n", "|").split("|"))).split()
    srgb = np.array([[int(c[i : i + 2], 16) for i in (0, 2, 4)] for c in row]) / 255
    srgb = np.clip(srgb + rng.normal(0, 0.03, srgb.shape), 0.03, 0.97)
    linear = np.where(srgb < 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4).astype(np.float32)
    return linear[np.r_[0, 1 + rng.permutation(len(linear) - 1)]]


def _waves(rng: np.random.Generator, count: int, length: float) -> Pattern:
    """A smooth random field of about unit variance: plane waves of about one length, in random directions."""
    directions = rng.normal(size=(3, count))
    directions *= 2 * np.pi / (length * rng.uniform(0.75, 1.35, count) * np.linalg.norm(directions, axis=0))
    directions = directions.astype(np.float32)
    phases = rng.uniform(0, 2 * np.pi, count).astype(np.float32)
    weights = np.full(count, np.sqrt(2 / count), np.float32)
    return lambda p: np.sin(p @ directions + phases) @ weights


def _bands(rng: np.random.Generator, colors: np.ndarray, shares: np.ndarray, soft: float) -> np.ndarray:
    """A periodic colour table (1024, 3): bands of the given shares, edges blurred by `soft` periods."""
    edges = np.cumsum(shares) / np.sum(shares)
    hard = colors[np.searchsorted(edges, (np.arange(_TABLE) + 0.5) / _TABLE)]
    blur = np.exp(-2 * (np.pi * 0.4 * soft * np.fft.rfftfreq(_TABLE, 1 / _TABLE)) ** 2)
    smooth = np.fft.irfft(np.fft.rfft(hard, axis=0) * blur[:, None], _TABLE, axis=0)
    return np.roll(smooth, rng.integers(_TABLE), axis=0).astype(np.float32)


def _lookup(table: np.ndarray, s: np.ndarray) -> np.ndarray:
    return table[np.floor(s * np.float32(_TABLE)).astype(np.int32) & (_TABLE - 1)]


def _step(distance: np.ndarray, soft: float = _SOFT) -> np.ndarray:
    """0 below zero, 1 above, smooth in between over `soft`."""
    t = np.clip(distance * np.float32(1 / soft) + np.float32(0.5), 0, 1)
    return t * t * (3 - 2 * t)


def _mix(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> np.ndarray:
    return a + (b - a) * weight[:, None]


def _cells(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Offset from the nearest integer point, and a hash of that point in [0, 256)."""
    cell = np.rint(points)
    i = cell.astype(np.int32)
    return points - cell, (i[:, 0] * 73 ^ i[:, 1] * 151 ^ i[:, 2] * 197 ^ (i[:, 0] + 3 * i[:, 1]) >> 2) & 255


def _checker(rng: np.random.Generator, colors: np.ndarray) -> Pattern:
    size = rng.uniform(0.2, 0.34)
    steep = size / (np.pi * 0.5 * _SOFT)

    def pattern(p: np.ndarray) -> np.ndarray:
        side = np.clip(np.cos(p * np.float32(np.pi / size)) * np.float32(steep), -1, 1)
        return _mix(colors[0], colors[1], 0.5 + 0.5 * side[:, 0] * side[:, 1] * side[:, 2])

    return pattern


def _stripes(rng: np.random.Generator, colors: np.ndarray) -> Pattern:
    period = rng.uniform(0.5, 0.8)
    table = _bands(rng, colors[[0, 1, 0, 2]], rng.uniform(0.5, 1.2, 4), _SOFT / period)
    along = rng.normal(size=3) * (1, 1, 0.4)
    along = (along / np.linalg.norm(along) / period).astype(np.float32)
    return lambda p: _lookup(table, p @ along)


def _waved(rng: np.random.Generator, colors: np.ndarray) -> Pattern:
    period, length, height = rng.uniform(0.4, 0.6), rng.uniform(0.4, 0.6), rng.uniform(0.07, 0.12)
    table = _bands(rng, colors[:4], rng.uniform(0.6, 1.2, 4), 1.3 * _SOFT / period)

    def pattern(p: np.ndarray) -> np.ndarray:
        wave = np.sin((p[:, 0] + p[:, 2]) * np.float32(2 * np.pi / length))
        return _lookup(table, (p[:, 1] + 0.3 * p[:, 2] + np.float32(height) * wave) * np.float32(1 / period))

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
        inside = ((0.5 - np.abs(q)) * size).min(-1) - np.float32(joint)
        return _mix(colors[0], faces[key], _step(inside, 0.8 * _SOFT))

    return pattern


def _dots(rng: np.random.Generator, colors: np.ndarray) -> Pattern:
    size = rng.uniform(0.24, 0.38)
    radius = rng.uniform(0.3, 0.42, 256)
    # Every dot lies within its own cell, so that no neighbouring cell has to be looked at.
    centres = (rng.uniform(-1, 1, (256, 3)) * (0.47 - radius[:, None]) * (1, 1, 0.5)).astype(np.float32)
    reach = (radius - 0.5 * _SOFT / size).astype(np.float32)
    paint = colors[1 + rng.integers(0, min(3, len(colors) - 1), 256)]

    def pattern(p: np.ndarray) -> np.ndarray:
        q, key = _cells(p * np.float32(1 / size))
        q -= centres[key]
        distance = (reach[key] - np.sqrt(np.einsum("pi,pi->p", q, q))) * np.float32(size)
        return _mix(colors[0], paint[key], _step(distance))

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
            q, key = _cells(p * np.float32(1 / size) + np.float32(7 * size))
            out = 1 - np.abs(np.einsum("pi,pij->pj", q, shapes[key])).max(-1)
            color = _mix(color, paint[key], _step(out * np.float32(0.2 * size), 0.7 * _SOFT))
        return color

    return pattern


def _marble(rng: np.random.Generator, colors: np.ndarray) -> Pattern:
    period = rng.uniform(0.45, 0.7)
    table = _bands(rng, colors[[0, 2, 0, 1, 0, 3]], np.array([3, 1.2, 2, 0.7, 3, 1.0]), 1.6 * _SOFT / period)
    wide, narrow = _waves(rng, 5, 0.8), _waves(rng, 6, 0.33)

    def pattern(p: np.ndarray) -> np.ndarray:
        warp = np.float32(0.2) * wide(p) + np.float32(0.05) * narrow(p)
        return _lookup(
            table, (p[:, 0] + np.float32(0.4) * p[:, 2] + warp * np.float32(period)) * np.float32(1 / period)
        )

    return pattern


def _wood(rng: np.random.Generator, colors: np.ndarray) -> Pattern:
    period = rng.uniform(0.3, 0.45)
    shares = rng.uniform(0.5, 1.5, 6)
    table = _bands(rng, colors[[0, 1, 2, 0, 3, 2]], shares, 1.5 * _SOFT / period)
    axis, warp = rng.uniform(0.15, 0.5, 2).astype(np.float32), _waves(rng, 5, 1.0)
    stretch = np.array([0.35, 1, 1], np.float32)  # the grain runs along x

    def pattern(p: np.ndarray) -> np.ndarray:
        radius = np.sqrt((p[:, 1] - axis[0]) ** 2 + (p[:, 2] - axis[1]) ** 2 + np.float32(1e-3))
        return _lookup(table, (radius + np.float32(0.06) * warp(p * stretch)) * np.float32(1 / period))

    return pattern


def _patches(rng: np.random.Generator, colors: np.ndarray) -> Pattern:
    length = rng.uniform(0.45, 0.65)
    wide, narrow = _waves(rng, 8, length), _waves(rng, 8, 0.4 * length)
    table = _bands(rng, colors[:4], np.array([1.0, 0.8, 0.9, 0.8]), 1.6 * _SOFT / length)
    return lambda p: _lookup(table, np.float32(0.25) * wide(p) + np.float32(0.07) * narrow(p))


def _speckle(rng: np.random.Generator, colors: np.ndarray) -> Pattern:
    along = (rng.normal(size=3) * (0.5, 0.5, 0.3)).astype(np.float32)
    table = _bands(rng, colors[:3], np.ones(3), 0.5)
    specks = _dots(rng, np.stack([colors[0], colors[-1], colors[0], colors[-1]]))

    def pattern(p: np.ndarray) -> np.ndarray:
        base = _lookup(table, p @ along)
        return base + np.float32(0.55) * (specks(p * np.float32(1.9)) - base) * np.float32(0.9)

    return pattern


def _plaid(rng: np.random.Generator, colors: np.ndarray) -> Pattern:
    period = rng.uniform(0.45, 0.65)
    tables = [
        _bands(rng, colors[[0, 1, 0, 2]], np.array([1.2, 0.9, 1.0, rng.uniform(0.2, 0.4)]), _SOFT / period)
        for _ in range(3)
    ]
    weights = np.array([0.42, 0.38, 0.2], np.float32)

    def pattern(p: np.ndarray) -> np.ndarray:
        q = p * np.float32(1 / period)
        return sum(_lookup(table, q[:, i]) * weights[i] for i, table in enumerate(tables))

    return pattern


_PATTERNS: dict[str, Callable[[np.random.Generator, np.ndarray], Pattern]] = {
    "checker": _checker,
    "stripes": _stripes,
    "waves": _waved,
    "bricks": _bricks,
    "dots": _dots,
    "terrazzo": _terrazzo,
    "marble": _marble,
    "wood": _wood,
    "patches": _patches,
    "speckle": _speckle,
    "plaid": _plaid,
}
KINDS = tuple(_PATTERNS)


@dataclass(frozen=True)
class Sky:
    """A soft gradient above the horizon (z is up) with clouds, and haze below, made by `random_sky`."""

    zenith: np.ndarray
    horizon: np.ndarray
    ground: np.ndarray
    clouds: Pattern
    cover: float

    def color(self, directions: np.ndarray) -> np.ndarray:
        """Linear colours (P, 3) float32 in [0, 1] of unit directions (P, 3), z up."""
        d = np.asarray(directions, np.float32)
        up = d[:, 2]
        color = _mix(self.horizon, self.zenith, np.clip(up, 0, 1) ** np.float32(0.6))
        plane = d / (np.maximum(up, 0)[:, None] + np.float32(0.3))
        cloud = _step(self.clouds(plane) + np.float32(self.cover), 1.6) * np.clip(4 * up, 0, 1)
        color = _mix(color, np.float32([0.95, 0.95, 0.97]), np.float32(0.8) * cloud)
        return np.clip(_mix(color, self.ground, _step(-up - np.float32(0.02), 0.06)), 0, 1)


def random_sky(rng: np.random.Generator) -> Sky:
    """Draw a sky: clear blue, hazy, or evening."""
    zenith, horizon = [
        ([0.10, 0.27, 0.62], [0.62, 0.76, 0.90]),
        ([0.30, 0.42, 0.58], [0.78, 0.80, 0.82]),
        ([0.13, 0.18, 0.42], [0.92, 0.60, 0.38]),
        ([0.05, 0.35, 0.66], [0.72, 0.86, 0.88]),
    ][rng.integers(4)]
    ground = np.float32(rng.uniform(0.18, 0.4)) * rng.uniform(0.8, 1.1, 3)
    return Sky(*(np.array(c, np.float32) for c in (zenith, horizon, ground)), _waves(rng, 9, 1.3), rng.uniform(-1, 0.3))


def sky(directions: np.ndarray, rng: np.random.Generator | Sky) -> np.ndarray:
    """Colours (P, 3) of unit directions (P, 3) under a `Sky`, or under a new random one."""
    return (rng if isinstance(rng, Sky) else random_sky(rng)).color(directions)
