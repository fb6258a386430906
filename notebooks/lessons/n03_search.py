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
    radius: int = 2,
) -> tuple[np.ndarray, int, int]:
    """Exact nearest neighbours by at most two visits: the second is as wide as the first shows to be enough.

    The last cell found by the first visit is an upper bound, since more cells can only bring nearer ones. So a window
    whose walls are all farther than that holds every neighbour.

    Args:
        query: (3,), camera frame; its pixel lies in the image.
        points: (H, W, 3), camera frame, one for each pixel.
        intrinsics: (3, 3).
        count: K.
        search: as `03.proof`.
        walls: as `03.walls`.
        radius: of the first visit, at least; wider where a window in the image's corner would hold too few cells.

    Returns:
        Indices (K,) into the H * W cells, nearest first; how many cells were visited; how many visits it took.
    """
    radius, size = max(radius, math.ceil(count**0.5) - 1), np.array(points.shape[1::-1])
    pixel = np.floor(project(query[None], intrinsics)[0][0] + 0.5).astype(int)

    def visited() -> int:
        return int(np.prod(np.minimum(pixel + radius, size - 1) - np.maximum(pixel - radius, 0) + 1))

    found, margin = search(query, points, intrinsics, count, radius)
    cells, hair = visited(), 1e-5  # the library computes in single precision
    if margin > hair:
        return found, cells, 1
    last = np.linalg.norm(points.reshape(-1, 3)[found[-1]] - query)
    while True:
        radius += 1
        box = np.concatenate([pixel - radius - 1, pixel + radius + 1])
        outside = np.concatenate([box[:2] >= 0, box[2:] < size])  # sides on which cells are left unvisited
        if walls(query, intrinsics, box)[outside].min(initial=np.inf) > last + hair:
            break
    return search(query, points, intrinsics, count, radius)[0], cells + visited(), 2


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


def lens(points: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Intrinsics (3, 3), in cells, and place (3,) of the camera that saw a map (h, w, 3); None if its axes are others.

    The tracker's normalisation moves camera coordinates and divides them by one number, so that cells still lie on
    rays, but through another place o. Column u says fx (x - ox) = (u - cx) (z - oz): linear in fx, cx, oz and the rest.
    """
    v, u = (grid.ravel().astype(float) for grid in np.indices(points.shape[:2]))
    x, y, z = points.reshape(-1, 3).T
    none, one = np.zeros_like(z), np.ones_like(z)
    rows = [[x, z, one, none, none, none, u], [none, none, none, y, z, one, v]]
    system = np.concatenate([np.stack(row, -1) for row in rows])
    wanted = np.concatenate([u * z, v * z])
    found, _, rank, _ = np.linalg.lstsq(system, wanted, rcond=None)
    fx, cx, ex, fy, cy, ey, oz = found
    if rank < 7 or fx <= 0 or fy <= 0 or np.abs(system @ found - wanted).max() > 1e-4 * np.abs(wanted).max():
        return None
    place = np.array([-(ex + cx * oz) / fx, -(ey + cy * oz) / fy, oz])
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), place


def parts(use: Use) -> dict[str, object]:
    """The learner's searches as the tracker's k-NN, and the learner's window as its neighbourhood in the image.

    k-NN over all cells finds the support of the queries. The context of estimates is found by the search that proves
    itself where the space is the camera's, all depths are known and the estimate lies in the image, else by k-NN, too.
    """
    nearest, window, walls, search = (use(f"03.{name}") for name in ("knn", "window", "walls", "proof"))

    def in_map(queries: np.ndarray, points: np.ndarray, valid: np.ndarray, count: int, prove: bool) -> np.ndarray:
        """Indices (N, K) for queries (N, 3) in a map (h, w, 3); valid (h, w)."""
        flat, known, size = points.reshape(-1, 3).astype(np.float32), valid.ravel(), np.array(points.shape[1::-1])
        camera = lens(points) if prove and valid.all() else None
        if camera is None:
            return filled(nearest(queries.astype(np.float32), flat, count, known), known)
        intrinsics, place = camera
        found = []
        for query in queries:
            seen = query - place
            inside = seen[2] > 0 and (np.abs(2 * project(seen[None], intrinsics)[0][0] + 1 - size) < size).all()
            if inside:
                found.append(exact_search(seen, points - place, intrinsics, count, search, walls)[0])
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
