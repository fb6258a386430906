"""Solid textures: colour as a smooth function of the position in a body, so that it sticks to the body.

Every texture is a pattern with features of 0.1 to 0.4 units and soft edges (so that small pictures do not alias),
varied by a slow tint over the whole body and by faint grain. The tint makes repeated cells differ, so that points of a
regular pattern can be matched. Colours are linear reflectances in [0, 1].
"""

from __future__ import annotations

import numpy as np

from tapip3d_lite.simulate.patterns import PATTERNS, Pattern, mix, smooth_field, smooth_step

KINDS = tuple(PATTERNS)
Texture = Pattern  # from body coordinates (P, 3) to linear reflectances (P, 3) float32 in [0, 1]

# Each row holds colours that go together (sRGB); the first is the ground.
_TOYS = """
f4f1de e07a5f 3d405b 81b29a f2cc8f|fdfcdc 00afb9 f07167 0081a7 fed9b7|264653 2a9d8f e9c46a f4a261 e76f51
edf2f4 d90429 2b2d42 8d99ae ef233c|ffbe0b fb5607 ff006e 8338ec 3a86ff|f1faee e63946 457b9d a8dadc 1d3557
2b9348 f4d35e ee964b f95738 0d3b66|fefae0 606c38 dda15e bc6c25 283618|5f0f40 fb8b24 9a031e e36414 0f4c5c
f7f7f7 1b998b ff9b71 2d3047 fffd82|3c1642 1dd3b0 086375 affc41 b2ff9e|ef476f ffd166 06d6a0 118ab2 073b4c"""
_STONES = """
e8e4da 5b5b60 a89f91 c9bfb0|d8d2c4 7a4b3a b58f76 3e3a38|cfd8d6 32494f 7f9a97 b9c7c3
ded3e0 5a3f66 a184a8 8a6f92|efe6d0 876b3d bda26b 4f4026|3f4a4d c8cfc9 7d8b8a 1f2527"""
_WOODS = """
c99a63 8a5a2f e0bd8a 5f3a1d|a8703f 5c3317 c68f5b 3d200e|d9b382 a6784a ecd3ab 7d542d|8f5f45 57311f b98867 6f4632"""


def random_texture(
    rng: np.random.Generator, kind: str | None = None, scale: float = 1.0, flat: bool = False
) -> Texture:
    """Draw a texture of one of the `KINDS`, by default any; bodies have scale 1, floors and backdrops want 2 to 6.

    A flat one, for the plane z = 0, has its pattern turned about z only and its cells cut through the middle.
    """
    kind = kind or str(rng.choice(KINDS))
    colors = _palette(rng, {"wood": _WOODS, "marble": _STONES, "terrazzo": _STONES}.get(kind, _TOYS))
    if flat:  # bodies should stand out from the ground
        colors += 0.35 * (colors.mean(0) - colors)
    pattern = PATTERNS[kind](rng, colors)
    offset = rng.uniform(-2, 2, 3)
    turn = rng.uniform(0, 2 * np.pi) if flat else rng.uniform(-0.3, 0.3)
    frame = np.eye(3)
    frame[:2, :2] = [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
    if flat:
        offset[2] = 0.0
    else:
        tilt = rng.uniform(0.08, 0.35)  # so that no flat face runs along an edge of the pattern
        frame = frame @ [[1, 0, 0], [0, np.cos(tilt), np.sin(tilt)], [0, -np.sin(tilt), np.cos(tilt)]]
    frame, offset = (frame / scale).astype(np.float32), offset.astype(np.float32)
    slow, fine = smooth_field(rng, 6, 0.9), smooth_field(rng, 8, 0.12)
    accent = colors[rng.integers(1, len(colors))]  # the tint leans to it

    def texture(points: np.ndarray) -> np.ndarray:
        # Thin matrix products now and then raise the processor's "invalid" flag from lanes that they do not use.
        with np.errstate(invalid="ignore"):
            points = np.asarray(points, np.float32) @ frame + offset
            color = pattern(points)
            tint = slow(points)[:, None]
            color += (accent - color) * (0.14 + 0.12 * tint)
            color *= (1 + 0.2 * tint) * (1 + 0.1 * fine(points)[:, None])
        return np.clip(color, 0.01, 0.98, out=color)

    return texture


def _palette(rng: np.random.Generator, rows: str) -> np.ndarray:
    """Linear colours (n, 3) of a random row; all but the ground shuffled, all slightly varied."""
    row = str(rng.choice(rows.strip().replace("\n", "|").split("|"))).split()
    srgb = np.array([[int(c[i : i + 2], 16) for i in (0, 2, 4)] for c in row]) / 255
    srgb = np.clip(srgb + rng.normal(0, 0.03, srgb.shape), 0.03, 0.97)
    linear = np.where(srgb < 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4).astype(np.float32)
    return linear[np.r_[0, 1 + rng.permutation(len(linear) - 1)]]


def random_sky(rng: np.random.Generator) -> Texture:
    """Draw a sky, clear blue, hazy, or evening: colours of unit directions (P, 3), z up, with clouds, and haze below."""
    zenith, horizon = [
        ([0.10, 0.27, 0.62], [0.62, 0.76, 0.90]),
        ([0.30, 0.42, 0.58], [0.78, 0.80, 0.82]),
        ([0.13, 0.18, 0.42], [0.92, 0.60, 0.38]),
        ([0.05, 0.35, 0.66], [0.72, 0.86, 0.88]),
    ][rng.integers(4)]
    ground = np.float32(rng.uniform(0.18, 0.4)) * rng.uniform(0.8, 1.1, 3)
    zenith, horizon, ground = (np.array(color, np.float32) for color in (zenith, horizon, ground))
    clouds, cover = smooth_field(rng, 9, 1.3), rng.uniform(-1, 0.3)

    def sky(directions: np.ndarray) -> np.ndarray:
        d = np.asarray(directions, np.float32)
        up = d[:, 2]
        color = mix(horizon, zenith, np.clip(up, 0, 1) ** 0.6)
        plane = d / (np.maximum(up, 0)[:, None] + 0.3)
        cloud = smooth_step(clouds(plane) + cover, 1.6) * np.clip(4 * up, 0, 1)
        color = mix(color, np.float32([0.95, 0.95, 0.97]), 0.8 * cloud)
        return np.clip(mix(color, ground, smooth_step(-up - 0.02, 0.06)), 0, 1)

    return sky
