"""The learner's neighbourhoods at their places: in a frame's cells, in the exact search, and in the tracker."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from lessons.milestone import Use
from tapip3d_lite.geometry import project
from tapip3d_lite.model.neighbors import Neighbors, gather

Answer = Callable[..., Any]


def exact_search(
    query: np.ndarray,
    points: np.ndarray,
    intrinsics: np.ndarray,
    count: int,
    search: Answer,
    walls: Answer,
    window: Answer,
) -> tuple[np.ndarray, int, int]:
    """Exact nearest neighbours: a small window says how far they are at most, the walls how wide to search.

    More cells can only bring nearer ones, so the K-th distance in a window of at least K cells is an upper bound. A
    window whose walls are all farther than that holds every neighbour, and the search in it proves itself.

    Args:
        query: (3,), camera frame; its pixel lies in the image.
        points: (H, W, 3), camera frame, one for each pixel; at least as many rows and columns as the small window has.
        intrinsics: (3, 3).
        count: K.
        search: as `03.proof`.
        walls: as `03.walls`.
        window: as `03.window`.

    Returns:
        Indices (K,) into the H * W cells, nearest first; how many cells were visited; the radius that was enough.
    """
    # Twice as many cells as are wanted, and more: at a silhouette half of them may be far away.
    size, side = np.array(points.shape[1::-1]), 2 * math.ceil(count**0.5) - 1
    hair = 1e-5  # the library computes in single precision
    uv = project(query[None], intrinsics)[0][0]
    # Moved inside, where no cell is repeated.
    small = window(np.clip(uv, side / 2 - 0.5, size - side / 2 - 0.5), side, points.shape[:2])
    most = np.sort(np.linalg.norm(points.reshape(-1, 3)[small] - query, axis=-1))[count - 1] + hair
    pixel, radius = np.floor(uv + 0.5).astype(int), 1
    while True:
        box = np.concatenate([pixel - radius - 1, pixel + radius + 1])
        outside = np.concatenate([box[:2] >= 0, box[2:] < size])  # sides on which cells are left unvisited
        if walls(query, intrinsics, box)[outside].min(initial=np.inf) > most:
            break
        radius += 1
    found, margin = search(query, points, intrinsics, count, radius)
    if margin < 0:
        raise AssertionError(f"a window of radius {radius} was to hold all neighbours, but its margin is {margin:.4g}")
    cells = np.prod(np.minimum(pixel + radius, size - 1) - np.maximum(pixel - radius, 0) + 1)
    return found, len(small) + int(cells), radius


def filled(indices: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Indices (N, K), with the first in place of cells that are not valid (P,): what the library does if too few are."""
    return np.where(valid[indices], indices, indices[..., :1])


def stand_ins(window: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """A window's cells (K,), with the valid one (P,) nearest to its centre in place of those that are not."""
    side = round(len(window) ** 0.5)
    steps = np.indices((side, side)) - (side - 1) / 2
    outwards = np.argsort((steps**2).sum(0).ravel(), kind="stable")
    good = outwards[valid[window[outwards]]]
    return np.where(valid[window], window, window[good[0]]) if len(good) else window


def lens(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """The camera that saw a map (h, w, 3), from the map alone; None if distances there are not those of space.

    A camera is a matrix of 3 x 4 that takes each point, with a 1, to a multiple of its pixel, with a 1: linear equations.
    The tracker's normalisation only moves a space and divides it by one number, which changes no angle.

    Returns:
        Intrinsics (3, 3) in units of cells; rotation (3, 3); place (3,) of the camera: rotation @ (p - place) is seen.
    """
    height, width = points.shape[:2]
    v, u = (grid.ravel().astype(float) for grid in np.indices((height, width)))
    flat = points.reshape(-1, 3).astype(float)
    middle, spread = flat.mean(0), max(float(flat.std()), 1e-9)
    known = np.concatenate([(flat - middle) / spread, np.ones((len(flat), 1))], -1)  # (P, 4)
    pixels = np.array([[width, 0, width / 2], [0, height, height / 2], [0, 0, 1]])  # from about 1 in size
    a, b = (u - width / 2) / width, (v - height / 2) / height
    zero = np.zeros_like(known)
    rows = [[known, zero, -a[:, None] * known], [zero, known, -b[:, None] * known]]
    system = np.concatenate([np.concatenate(row, -1) for row in rows])  # (2 P, 12)
    values, vectors = np.linalg.eigh(system.T @ system / len(flat))
    if values[1] < 1e-7 or values[0] > 1e-10:
        return None  # many cameras would do, as for a plane, or none
    matrix = pixels @ vectors[:, 0].reshape(3, 4)
    matrix *= np.sign((known @ matrix[2]).mean())
    # A = K R with K upper triangular: the QR decomposition of A turned over.
    turned, upper = np.linalg.qr(matrix[::-1, :3].T)
    intrinsics, rotation = upper.T[::-1, ::-1], turned.T[::-1]
    signs = np.sign(np.diag(intrinsics))
    intrinsics, rotation = intrinsics * signs / (intrinsics[2, 2] * signs[2]), signs[:, None] * rotation
    place = middle - spread * np.linalg.solve(matrix[:, :3], matrix[:, 3])
    if abs(intrinsics[0, 1]) > 1e-4 * intrinsics[0, 0] or np.linalg.det(rotation) < 0:
        return None
    seen = (flat - place) @ rotation.T
    uv, _ = project(seen, intrinsics)
    return (intrinsics, rotation, place) if np.abs(uv - np.stack([u, v], -1)).max() < 1e-3 else None


def parts(use: Use) -> dict[str, object]:
    """The learner's searches as the tracker's k-NN, and the learner's window as its neighbourhood in the image.

    k-NN over all cells finds the support of the queries. The context of estimates is found by the search that proves
    itself where all depths are known, a camera fits and the estimate lies in the image, else by k-NN, too.
    """
    nearest, window, walls, search = (use(f"03.{name}") for name in ("knn", "window", "walls", "proof"))

    def in_map(queries: np.ndarray, points: np.ndarray, valid: np.ndarray, count: int, prove: bool) -> np.ndarray:
        """Indices (N, K) for queries (N, 3) in a map (h, w, 3); valid (h, w)."""
        flat, known, size = points.reshape(-1, 3).astype(np.float32), valid.ravel(), np.array(points.shape[1::-1])
        camera = lens(points) if prove and valid.all() else None
        if camera is None:
            return filled(nearest(queries.astype(np.float32), flat, count, known), known)
        intrinsics, rotation, place = camera
        seen, found = (points - place) @ rotation.T, []
        for query in queries:
            turned = rotation @ (query - place)
            inside = turned[2] > 0 and (np.abs(2 * project(turned[None], intrinsics)[0][0] + 1 - size) < size).all()
            if inside:
                found.append(exact_search(turned, seen, intrinsics, count, search, walls, window)[0])
            else:
                found.append(nearest(query[None].astype(np.float32), flat, count, known)[0])
        return np.stack(found)

    def in_space(self: Any, level: Any, queries: torch.Tensor, points: Any, valid: torch.Tensor | None) -> torch.Tensor:
        maps = level.points.flatten(0, 1).numpy()
        known = np.ones(maps.shape[:3], bool) if valid is None else valid.view(maps.shape[:3]).numpy()
        rows = zip(queries.numpy(), maps, known, strict=True)
        # One frame: the support of queries; several: the context of estimates.
        return torch.from_numpy(np.stack([in_map(*row, self.count, prove=len(maps) > 1) for row in rows]))

    def in_image(self: Any, level: Any, coords: torch.Tensor, cells: torch.Tensor) -> Neighbors:
        valid, side = level.valid.flatten(0, 1).flatten(1).numpy(), round(self.count**0.5)
        found = [
            [stand_ins(window(center, side, level.points.shape[2:4]), known) for center in centers]
            for centers, known in zip(cells.nan_to_num().flatten(0, 1).numpy(), valid, strict=True)
        ]
        indices = torch.from_numpy(np.array(found)).view(*cells.shape[:3], -1)
        near = (gather(x.flatten(2, 3).flatten(0, 1), indices.flatten(0, 1)) for x in (level.features, level.points))
        return Neighbors(*(x.unflatten(0, cells.shape[:2]) for x in near), coords, indices)

    return {
        "tapip3d_lite.model.neighbors:KNearest.search": in_space,
        "tapip3d_lite.variants.window2d:WindowNeighborhood.forward": in_image,
    }
