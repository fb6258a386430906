"""Toy-like closed triangle meshes, about unit radius, centred on the origin, outward oriented.

A mesh is (vertices (V, 3) float64, faces (F, 3) int32). Most are either swept along a closed ring or a disc-shaped
outline pulled to a thickness; both keep every edge shared by exactly two faces.
"""

from __future__ import annotations

import numpy as np

Mesh = tuple[np.ndarray, np.ndarray]


def torus(rng: np.random.Generator) -> Mesh:
    """A ring of random thickness."""
    tube = rng.uniform(0.2, 0.36)
    return _sweep(_circle(28) * (1 - tube), tube, 10)


def knot(rng: np.random.Generator) -> Mesh:
    """A closed pipe that winds up and down, like a crown."""
    waves, height = int(rng.integers(2, 5)), rng.uniform(0.2, 0.4)
    path = 0.75 * _circle(40)
    path[:, 2] = height * np.sin(waves * np.linspace(0, 2 * np.pi, 40, endpoint=False))
    return _sweep(path, 0.17, 7)


def gear(rng: np.random.Generator) -> Mesh:
    """A cogwheel with 6 to 11 teeth."""
    teeth, depth = int(rng.integers(6, 12)), rng.uniform(0.7, 0.82)
    step = np.pi / teeth
    angle = np.arange(2 * teeth)[:, None] * step + np.array([-0.32, 0.32]) * step
    radius = np.repeat(np.resize([1.0, depth], 2 * teeth), 2)
    return _extrude(_polar(angle.ravel(), radius), rng.uniform(0.2, 0.35))


def star(rng: np.random.Generator) -> Mesh:
    """A thick star with 4 to 7 points."""
    points = int(rng.integers(4, 8))
    angle = np.arange(2 * points) * np.pi / points
    return _extrude(_polar(angle, np.resize([1.0, rng.uniform(0.45, 0.6)], 2 * points)), 0.3)


def bracket(rng: np.random.Generator) -> Mesh:
    """An L-shaped block."""
    w = rng.uniform(0.45, 0.7)
    outline = np.array([[0, 0, 0], [1.5, 0, 0], [1.5, w, 0], [w, w, 0], [w, 1.5, 0], [0, 1.5, 0]])
    return _extrude(outline - (0.6, 0.6, 0), rng.uniform(0.25, 0.45), hub=(w / 2 - 0.6, w / 2 - 0.6))


def vase(rng: np.random.Generator) -> Mesh:
    """A solid of revolution with a random profile, like a turned chess piece."""
    height = np.linspace(-1, 1, 13)
    phase, waves = rng.uniform(0, 2 * np.pi), rng.uniform(2, 4)
    radius = 0.5 + 0.18 * np.sin(waves * height + phase) + 0.08 * np.sin(2.3 * waves * height)
    return _revolve(height, radius, 18)


def blob(rng: np.random.Generator) -> Mesh:
    """A sphere with smooth random bumps."""
    height = np.cos(np.linspace(np.pi, 0, 17)[1:-1])
    vertices, faces = _revolve(height, np.sqrt(1 - height**2), 20)
    waves, phases = rng.normal(size=(4, 3)) * 1.6, rng.uniform(0, 2 * np.pi, 4)
    bumps = 0.82 + 0.075 * np.sin(vertices @ waves.T + phases).sum(-1, keepdims=True)
    return _oriented(vertices * bumps, faces)


MESHES = {function.__name__: function for function in (torus, gear, blob, star, bracket, vase, knot)}


def _polar(angle: np.ndarray, radius: np.ndarray | float) -> np.ndarray:
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], -1)


def _circle(sides: int) -> np.ndarray:
    return _polar(np.linspace(0, 2 * np.pi, sides, endpoint=False), 1.0)


def _sweep(path: np.ndarray, radius: float, sides: int) -> Mesh:
    """A tube along a closed path (P, 3) that circles the z axis."""
    tangent = np.roll(path, -1, 0) - np.roll(path, 1, 0)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    outward = path * (1, 1, 0)
    outward -= (outward * tangent).sum(-1, keepdims=True) * tangent
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    across, along, _ = _circle(sides).T[..., None]  # (S, 1)
    rim = across * outward[:, None] + along * np.cross(tangent, outward)[:, None]  # (P, S, 3)
    return _skin(path[:, None] + radius * rim)


def _revolve(height: np.ndarray, radius: np.ndarray, sides: int) -> Mesh:
    """A profile (R,) turned around the z axis and closed by the vertices z = -1 and z = 1."""
    rings = radius[:, None, None] * _circle(sides)
    rings[..., 2] = height[:, None]
    return _skin(rings, [[0, 0, -1], [0, 0, 1]])


def _extrude(outline: np.ndarray, half: float, hub: tuple[float, float] = (0.0, 0.0)) -> Mesh:
    """An outline (P, 3) at z = 0, star-shaped around `hub`, pulled to a thickness of 2 * half."""
    rings = np.stack([outline - (0, 0, half), outline + (0, 0, half)])
    return _skin(rings, [[*hub, -half], [*hub, half]])


def _skin(rings: np.ndarray, poles: list[list[float]] | None = None) -> Mesh:
    """A mesh over rings (R, S, 3) of vertices: a whole torus, or closed by a vertex at each end."""
    index = np.arange(rings.shape[0] * rings.shape[1]).reshape(rings.shape[:2])
    beside, above = np.roll(index, -1, 1), np.roll(index, -1, 0)
    across = np.roll(above, -1, 1)
    cells = np.stack([[index, beside, across], [index, across, above]]).transpose(0, 2, 3, 1)  # (2, R, S, 3)
    vertices = rings.reshape(-1, 3)
    if poles is None:
        return _oriented(vertices, cells.reshape(-1, 3))
    low, high = (np.full(index.shape[1], index.size + end) for end in range(2))
    ends = np.stack([beside[0], index[0], low], -1), np.stack([index[-1], beside[-1], high], -1)
    sides = cells[:, :-1].reshape(-1, 3)  # nothing from the last ring to the first
    return _oriented(np.concatenate([vertices, poles]), np.concatenate([sides, *ends]))


def _oriented(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """Centre on the volume's centroid, and turn all faces outward (positive volume)."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    volumes = np.einsum("fi,fi->f", a, np.cross(b, c)) / 6
    centroid = (volumes[:, None] * (a + b + c) / 4).sum(0) / volumes.sum()
    return vertices - centroid, (faces if volumes.sum() > 0 else faces[:, ::-1]).astype(np.int32)
