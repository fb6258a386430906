"""Toy-like closed triangle meshes, about unit radius, centred on the origin, outward oriented.

A mesh is (vertices (V, 3) float64, faces (F, 3) int32). Most are either swept along a closed ring or a disc-shaped
outline pulled to a thickness; both keep every edge shared by exactly two faces.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Mesh = tuple[np.ndarray, np.ndarray]


def torus(rng: np.random.Generator) -> Mesh:
    """A ring of random thickness."""
    tube = rng.uniform(0.2, 0.36)
    angle = np.linspace(0, 2 * np.pi, 28, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    return _sweep(ring * (1 - tube), np.full(len(angle), tube), 10)


def knot(rng: np.random.Generator) -> Mesh:
    """A closed pipe that winds up and down, like a crown."""
    waves, height = int(rng.integers(2, 5)), rng.uniform(0.2, 0.4)
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    path = np.stack([0.75 * np.cos(angle), 0.75 * np.sin(angle), height * np.sin(waves * angle)], -1)
    return _sweep(path, np.full(len(angle), 0.17), 7)


def gear(rng: np.random.Generator) -> Mesh:
    """A cogwheel with 6 to 11 teeth."""
    teeth, depth = int(rng.integers(6, 12)), rng.uniform(0.7, 0.82)
    step = np.pi / teeth
    corners = np.arange(2 * teeth)[:, None] * step + np.array([-0.32, 0.32]) * step
    radius = np.where(np.arange(2 * teeth) % 2 == 0, 1.0, depth)[:, None] * np.ones(2)
    return _extrude(_polar(corners.ravel(), radius.ravel()), rng.uniform(0.2, 0.35))


def star(rng: np.random.Generator) -> Mesh:
    """A thick star with 4 to 7 points."""
    points = int(rng.integers(4, 8))
    angle = np.arange(2 * points) * np.pi / points
    return _extrude(_polar(angle, np.where(np.arange(2 * points) % 2 == 0, 1.0, rng.uniform(0.45, 0.6))), 0.3)


def bracket(rng: np.random.Generator) -> Mesh:
    """An L-shaped block."""
    w = rng.uniform(0.45, 0.7)
    outline = np.array([[0, 0], [1.5, 0], [1.5, w], [w, w], [w, 1.5], [0, 1.5]])
    return _extrude(outline - 0.6, rng.uniform(0.25, 0.45), hub=np.array([w / 2 - 0.6, w / 2 - 0.6]))


def vase(rng: np.random.Generator) -> Mesh:
    """A solid of revolution with a random profile, like a turned chess piece."""
    height = np.linspace(-1, 1, 13)
    phase, waves = rng.uniform(0, 2 * np.pi), rng.uniform(2, 4)
    radius = 0.5 + 0.18 * np.sin(waves * height + phase) + 0.08 * np.sin(2.3 * waves * height)
    return _revolve(height, radius, 18)


def blob(rng: np.random.Generator) -> Mesh:
    """A sphere with smooth random bumps."""
    height = np.cos(np.linspace(np.pi, 0, 17)[1:-1])
    vertices, faces = _revolve(height, np.sqrt(1 - height**2), 20, poles=(-1.0, 1.0))
    waves, phases = rng.normal(size=(4, 3)) * 1.6, rng.uniform(0, 2 * np.pi, 4)
    bumps = 0.82 + 0.075 * np.sin(vertices @ waves.T + phases).sum(-1, keepdims=True)
    return _oriented(vertices * bumps, faces)


MESHES: dict[str, Callable[[np.random.Generator], Mesh]] = {
    f.__name__: f for f in (torus, gear, blob, star, bracket, vase, knot)
}


def _polar(angle: np.ndarray, radius: np.ndarray) -> np.ndarray:
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)


def _rings_to_faces(rings: int, sides: int, closed: bool) -> np.ndarray:
    """Two triangles for each cell of a (rings, sides) grid of vertices that wraps around its sides."""
    i, j = np.meshgrid(np.arange(rings if closed else rings - 1), np.arange(sides), indexing="ij")
    a, b = i * sides + j, i * sides + (j + 1) % sides
    c, d = (i + 1) % rings * sides + j, (i + 1) % rings * sides + (j + 1) % sides
    return np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)]).reshape(-1, 3)


def _sweep(path: np.ndarray, radius: np.ndarray, sides: int) -> Mesh:
    """A tube along a closed path (P, 3) that circles the z axis."""
    tangent = np.roll(path, -1, 0) - np.roll(path, 1, 0)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    outward = path * (1, 1, 0)
    outward -= (outward * tangent).sum(-1, keepdims=True) * tangent
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    side = np.cross(tangent, outward)
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)[None, :, None]
    circle = np.cos(angle) * outward[:, None] + np.sin(angle) * side[:, None]
    vertices = path[:, None] + radius[:, None, None] * circle
    return _oriented(vertices.reshape(-1, 3), _rings_to_faces(len(path), sides, closed=True))


def _revolve(height: np.ndarray, radius: np.ndarray, sides: int, poles: tuple[float, float] | None = None) -> Mesh:
    """A profile turned around the z axis and closed by one vertex at each end."""
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    rings = radius[:, None, None] * circle + height[:, None, None] * np.array([0, 0, 1])
    low, high = poles or (height[0], height[-1])
    vertices = np.concatenate([rings.reshape(-1, 3), [[0, 0, low], [0, 0, high]]])
    j, last = np.arange(sides), (len(height) - 1) * sides
    bottom = np.stack([(j + 1) % sides, j, np.full(sides, len(vertices) - 2)], -1)
    top = np.stack([last + j, last + (j + 1) % sides, np.full(sides, len(vertices) - 1)], -1)
    return _oriented(vertices, np.concatenate([_rings_to_faces(len(height), sides, closed=False), bottom, top]))


def _extrude(outline: np.ndarray, half: float, hub: np.ndarray | None = None) -> Mesh:
    """An outline (P, 2), star-shaped around `hub`, pulled to a thickness of 2 * half."""
    count = len(outline)
    flat = np.concatenate([outline, outline])
    vertices = np.concatenate([flat, np.repeat([[-half], [half]], count, 0)], -1)
    centre = np.zeros(2) if hub is None else hub
    vertices = np.concatenate([vertices, [[*centre, -half], [*centre, half]]])
    j, k = np.arange(count), (np.arange(count) + 1) % count
    bottom = np.stack([k, j, np.full(count, 2 * count)], -1)
    top = np.stack([count + j, count + k, np.full(count, 2 * count + 1)], -1)
    return _oriented(vertices, np.concatenate([_rings_to_faces(2, count, closed=False), bottom, top]))


def _oriented(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """Centre on the volume's centroid, and turn all faces outward (positive volume)."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    volumes = np.einsum("fi,fi->f", a, np.cross(b, c)) / 6
    centroid = (volumes[:, None] * (a + b + c) / 4).sum(0) / volumes.sum()
    return vertices - centroid, (faces if volumes.sum() > 0 else faces[:, ::-1]).astype(np.int32)
