"""Procedural solid textures: colour as a smooth function of the position inside a body.

A solid texture needs no unwrapping and moves with its body exactly. Patterns have features of 0.15 to 0.5 units, soft
edges no narrower than a pixel's footprint, and a faint grain, so that small renders stay sharp without aliasing and
points on one surface can be told apart.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

Array = np.ndarray


@dataclass(frozen=True)
class Texture:
    """One solid texture.

    Attributes:
        kind: a name of `KINDS`.
        palette: (4, 3) float32 linear RGB reflectances in [0, 1].
        frame: (3, 3) float32, body units to pattern units (a rotation over the pattern's period).
        waves: (12, 4) float32, directions and phases of the noise.
        seed: for the colours of single cells.
    """

    kind: str
    palette: Array
    frame: Array
    waves: Array
    seed: int
    period: float = field(default=0.4)

    def color(self, points: Array, footprint: Array | float = 0.03) -> Array:
        """Reflectance at body-frame points.

        Args:
            points: (P, 3) body frame, scene units.
            footprint: (P,) or scalar, the size of a pixel on the surface in scene units; edges are at least as soft.

        Returns:
            (P, 3) float32 linear RGB in [0, 1].
        """
        p = points.astype(np.float32) @ self.frame.T
        soft = np.maximum(np.asarray(footprint, np.float32) / np.float32(self.period), 0.06) + np.zeros(
            len(p), np.float32
        )
        base = _PATTERNS[self.kind](self, p, soft)
        grain = _noise(p * np.float32(2.2), self.waves[::-1]) * (0.3 / np.maximum(2.2 * soft / 0.3, 1))
        return np.clip(base * (1 + grain[:, None]), 0, 1).astype(np.float32)


def random_texture(rng: np.random.Generator, kind: str | None = None, scale: float = 1.0) -> Texture:
    """Draw a texture.

    Args:
        rng: source of all randomness.
        kind: a name of `KINDS`, or None for a random one.
        scale: enlarges the pattern; about 2 to 3 suits floors and walls.

    Raises:
        ValueError: unknown kind.
    """
    kind = KINDS[rng.integers(len(KINDS))] if kind is None else kind
    if kind not in _PATTERNS:
        raise ValueError(f"random_texture: unknown kind {kind!r}; choose one of {', '.join(KINDS)}")
    period = float(rng.uniform(0.3, 0.5)) * scale
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    if kind in ("bricks", "checker", "tiles"):
        rotation = np.eye(3)  # laid square on the body, as bricks and tiles are
    waves = np.concatenate([rng.normal(size=(12, 3)) * 2.0, rng.uniform(0, 2 * np.pi, (12, 1))], -1)
    frame = (rotation / period).astype(np.float32)
    return Texture(kind, _palette(rng), frame, waves.astype(np.float32), int(rng.integers(1 << 30)), period)


def sky(directions: Array, waves: Array) -> Array:
    """A soft sky with clouds.

    Args:
        directions: (P, 3) unit vectors, world frame with z up.
        waves: (12, 4) as in `Texture`, which clouds.

    Returns:
        (P, 3) float32 linear RGB.
    """
    up = np.clip(directions[:, 2:], 0, 1).astype(np.float32)
    blue = _mix(np.float32([0.72, 0.8, 0.88]), np.float32([0.18, 0.38, 0.75]), np.sqrt(up))
    flat = directions / (np.abs(directions[:, 2:]) + 0.25)
    clouds = _step(_noise(flat.astype(np.float32) * 1.3, waves) - 0.15, np.float32(0.5))
    return _mix(blue, np.float32([0.95, 0.95, 0.95]), 0.8 * clouds[:, None])


def _palette(rng: np.random.Generator) -> Array:
    """Four colours around one hue or two opposite ones, alternating dark and light for contrast."""
    hue = rng.uniform() + np.array([0, rng.choice([0.08, 0.5, 0.33]), rng.uniform(-0.06, 0.06), rng.uniform()])
    saturation = rng.uniform(0.35, 0.85, 4)
    value = np.array([rng.uniform(0.75, 0.95), rng.uniform(0.2, 0.4), rng.uniform(0.5, 0.7), rng.uniform(0.8, 1)])
    ramp = np.abs((hue[:, None] * 6 + np.array([0, 4, 2])) % 6 - 3) - 1
    rgb = value[:, None] * (1 - saturation[:, None] * (1 - np.clip(ramp, 0, 1)))
    return (rgb**1.6).astype(np.float32)  # roughly from display to linear values


def _noise(p: Array, waves: Array) -> Array:
    """Smooth noise of unit-ish features and standard deviation about 0.5: a sum of six random sinusoids."""
    return np.sin(p @ waves[:6, :3].T + waves[:6, 3]).sum(-1) * np.float32(0.29)


def _step(x: Array, soft: Array) -> Array:
    """A smooth step from 0 to 1 over the width `soft` around x = 0."""
    t = np.clip(x / soft + 0.5, 0, 1)
    return t * t * (3 - 2 * t)


def _square(x: Array, soft: Array) -> Array:
    """A soft square wave between 0 and 1 with period 2; flattens to its mean where the edge fills the period."""
    fade = np.clip(1.5 - soft, 0, 1)
    triangle = np.abs((x - 0.5) % 2 - 1) - 0.5
    return 0.5 + fade * (_step(triangle, soft) - 0.5)


def _mix(a: Array, b: Array, weight: Array) -> Array:
    return a + (b - a) * weight


def _hash(cells: Array, seed: int) -> Array:
    """A pseudo-random number in [0, 1) for each integer cell (P, 3)."""
    c = cells.astype(np.int64)
    h = (c[:, 0] * 73856093) ^ (c[:, 1] * 19349663) ^ (c[:, 2] * 83492791) ^ seed
    h = (h ^ (h >> 13)) * 1274126177
    return (((h ^ (h >> 16)) & 0xFFFF) / 65536).astype(np.float32)


def _pick(texture: Texture, cells: Array) -> Array:
    """A palette colour for each cell, with a little variation in brightness."""
    h = _hash(cells, texture.seed)
    return texture.palette[(h * 4).astype(int)] * (0.85 + 0.3 * ((h * 37) % 1))[:, None]


def _walls(p: Array, soft: Array, gap: float) -> Array:
    """0 on the walls between unit cells, 1 inside."""
    distance = 0.5 - np.abs(p % 1 - 0.5).max(-1)
    return _step(distance - gap, soft)[:, None]


def _checker(t: Texture, p: Array, soft: Array) -> Array:
    signs = [2 * _square(p[:, i] * 1.6 + 0.37, 1.6 * soft) - 1 for i in range(3)]
    return _mix(t.palette[0], t.palette[1], (0.5 + 0.5 * signs[0] * signs[1] * signs[2])[:, None])


def _stripes(t: Texture, p: Array, soft: Array) -> Array:
    x = p[:, 0] * 1.8 + 0.25 * _noise(p, t.waves)
    first = _mix(t.palette[0], t.palette[1], _square(x, 1.8 * soft)[:, None])
    return _mix(first, t.palette[3], _step(_square(x * 0.5 + 0.25, soft) - 0.5, 1)[:, None] * 0.6)


def _plaid(t: Texture, p: Array, soft: Array) -> Array:
    first = _mix(t.palette[0], t.palette[1], 0.75 * _square(p[:, 0] * 1.4, 1.4 * soft)[:, None])
    second = _mix(first, t.palette[2], 0.6 * _square(p[:, 1] * 1.4, 1.4 * soft)[:, None])
    return _mix(second, t.palette[3], 0.7 * _square(p[:, 2] * 1.4, 1.4 * soft)[:, None])


def _bricks(t: Texture, p: Array, soft: Array) -> Array:
    row = np.floor(p[:, 2] * 1.4)
    shifted = np.stack([p[:, 0] * 0.8 + 0.5 * (row % 2), p[:, 1] * 0.8 + 0.31, p[:, 2] * 1.4], -1)
    brick = t.palette[0] * (0.7 + 0.5 * _hash(np.floor(shifted), t.seed))[:, None]
    return _mix(t.palette[3] * 0.8, brick, _walls(shifted, 1.4 * soft, 0.06))


def _tiles(t: Texture, p: Array, soft: Array) -> Array:
    cells = p * 1.1 + 0.29
    return _mix(t.palette[1] * 0.5, _pick(t, np.floor(cells)), _walls(cells, 1.1 * soft, 0.05))


def _dots(t: Texture, p: Array, soft: Array) -> Array:
    cells = np.floor(p)
    h = _hash(cells, t.seed)
    centre = 0.5 + 0.15 * np.stack([np.sin(40 * h), np.sin(70 * h), np.sin(90 * h)], -1)
    distance = np.linalg.norm(p - cells - centre, axis=-1)
    return _mix(t.palette[1], _pick(t, cells + 7), _step(0.32 - distance, soft)[:, None])


def _marble(t: Texture, p: Array, soft: Array) -> Array:
    vein = np.abs(np.sin(p[:, 0] * 1.5 + 2.2 * _noise(p * 0.7, t.waves)))
    return _mix(t.palette[1], t.palette[3], (vein ** np.float32(0.7))[:, None])


def _wood(t: Texture, p: Array, soft: Array) -> Array:
    radius = np.hypot(p[:, 0] + 0.6, p[:, 1]) * 1.6 + 0.35 * _noise(p * np.float32([0.6, 0.6, 0.2]), t.waves)
    return _mix(t.palette[0], t.palette[1], (0.8 * _square(radius, 3 * soft))[:, None])


def _camouflage(t: Texture, p: Array, soft: Array) -> Array:
    n, m = _noise(p, t.waves), _noise(p, t.waves[6:])
    first = _mix(t.palette[0], t.palette[1], _step(n - 0.1, 1.5 * soft)[:, None])
    return _mix(first, t.palette[3], _step(m - 0.35, 1.5 * soft)[:, None])


def _contours(t: Texture, p: Array, soft: Array) -> Array:
    """Height lines of a smooth field: bands of alternating colour."""
    n = _noise(p * 0.8, t.waves)
    band = _mix(t.palette[2], t.palette[0], np.clip(n + 0.5, 0, 1)[:, None])
    return _mix(band, t.palette[1], (0.9 * _square(n * 2.5, 4 * soft))[:, None])


_PATTERNS: dict[str, Callable[[Texture, Array, Array], Array]] = {
    "checker": _checker,
    "stripes": _stripes,
    "plaid": _plaid,
    "bricks": _bricks,
    "tiles": _tiles,
    "dots": _dots,
    "marble": _marble,
    "wood": _wood,
    "camouflage": _camouflage,
    "contours": _contours,
}
KINDS = tuple(_PATTERNS)
