"""Exercises of notebook 03: exact k-NN, the window in the image, and a search in a window that proves itself exact."""

from __future__ import annotations

import numpy as np

from lessons.checker import Exercise, Mistake
from tapip3d_lite.geometry import project, unproject

Array = np.ndarray


def nearest(query: Array, points: Array, k: int, power: float = 2.0, weights: tuple[float, ...] = (1, 1, 1)) -> Array:
    """Indices (k,) of the points (P, 3) nearest to a query (3,), nearest first, ties by index."""
    distance = (np.abs(points - query) ** power * weights).sum(-1)
    return np.argsort(distance, kind="stable")[:k]


def _scattered(rng: np.random.Generator, size: int) -> tuple:
    points = rng.normal(size=(6 + 5 * size, 3))
    if size > 1:
        points[[2, -1]] = points[[5, 4]]  # two pairs of twins: ties
    return points[3] + 0.5 * rng.normal(size=3), points, 3 + size


def _late_twins(query: Array, points: Array, k: int) -> Array:
    distance = ((points - query) ** 2).sum(-1)[::-1]
    return len(points) - 1 - np.argsort(distance, kind="stable")[:k]


KNN = Exercise(
    "03.knn",
    reference=nearest,
    cases=_scattered,
    mistakes=(
        Mistake(
            "farthest",
            lambda q, p, k: np.argsort(-((p - q) ** 2).sum(-1), kind="stable")[:k],
            "these are the farthest ones; sort in ascending order.",
        ),
        Mistake(
            "unsorted", lambda q, p, k: np.sort(nearest(q, p, k)), "the right cells in the wrong order: nearest first."
        ),
        Mistake(
            "depth ignored",
            lambda q, p, k: nearest(q, p, k, weights=(1, 1, 0)),
            "all three coordinates count; you compare x and y only, as a window in the image would.",
        ),
        Mistake(
            "depth only",
            lambda q, p, k: nearest(q, p, k, weights=(0, 0, 1)),
            "you compare the last coordinate only; sum over all three.",
        ),
        Mistake(
            "sum of absolute differences",
            lambda q, p, k: nearest(q, p, k, 1.0),
            "square the differences before you sum them; absolute differences are another distance.",
        ),
        Mistake(
            "nearest skipped",
            lambda q, p, k: nearest(q, p, k + 1)[1:],
            "the query is no cell of the cloud, so its nearest cell is a neighbour like the others; do not skip it.",
        ),
        Mistake(
            "ties to the last",
            _late_twins,
            "two cells are equally far: the one with the lower index comes first (a stable sort does that).",
        ),
        Mistake(
            "distances returned",
            lambda q, p, k: np.sort(((p - q) ** 2).sum(-1))[:k],
            "return the indices of the cells, not their distances: argsort instead of sort.",
        ),
    ),
)


def window(center: Array, side: int, shape: tuple[int, int], **slip: object) -> Array:
    """Indices (side^2,) of the cells around a centre (column, row), row by row; `slip` makes one mistake."""
    height, width = shape
    span = np.arange(side) - (0 if slip.get("corner") else (side - 1) / 2)
    place = slip.get("place", lambda x: np.floor(x + 0.5))
    columns, rows = (place(c + span).astype(int) for c in (center[::-1] if slip.get("swapped") else center))
    if not slip.get("loose"):
        columns, rows = columns.clip(0, width - 1), rows.clip(0, height - 1)
    cells = rows[:, None] * (height if slip.get("tall") else width) + columns
    return (cells.T if slip.get("by_column") else cells).ravel()


def _place(rng: np.random.Generator, size: int) -> tuple:
    height, width = int(rng.integers(4, 7)), int(rng.integers(8, 12))
    center = rng.uniform(-0.4, (width - 0.6, height - 0.6))
    return (center if size % 2 else np.rint(center)), size, (height, width)


WINDOW = Exercise(
    "03.window",
    reference=window,
    cases=_place,
    mistakes=(
        Mistake(
            "column and row swapped",
            lambda c, s, g: window(c, s, g, swapped=True),
            "the centre comes as (column, row), that is (u, v); the grid as (rows, columns).",
        ),
        Mistake(
            "height for width",
            lambda c, s, g: window(c, s, g, tall=True),
            "a row has `width` cells, so cell (row, column) has the index row * width + column.",
        ),
        Mistake(
            "rounded down",
            lambda c, s, g: window(c, s, g, place=np.floor),
            "you round down; the nearest cell is floor(x + 0.5).",
        ),
        Mistake(
            "halves to even",
            lambda c, s, g: window(c, s, g, place=np.rint),
            "NumPy rounds 2.5 down and 3.5 up, which tears a gap into windows of even side; use floor(x + 0.5).",
        ),
        Mistake(
            "beyond the border",
            lambda c, s, g: window(c, s, g, loose=True),
            "cells beyond the border do not exist; clip rows and columns, so that the border's cells repeat.",
        ),
        Mistake(
            "column by column",
            lambda c, s, g: window(c, s, g, by_column=True),
            "the right cells in another order: row by row.",
        ),
        Mistake(
            "centre in the corner",
            lambda c, s, g: window(c, s, g, corner=True),
            "your window begins at the centre; it has to reach (side - 1) / 2 cells to every side of it.",
        ),
    ),
)


def walls(query: Array, intrinsics: Array, box: Array, **slip: bool) -> Array:
    """Distances (4,) from a point inside to the planes through the camera and the sides (left, top, right, bottom)."""
    (fx, _, cx), (_, fy, cy), _ = intrinsics
    x, y, z = query
    signs = (1, 1, 1, 1) if slip.get("unsigned") else (1, 1, -1, -1)
    found = []
    sides = zip(box, (0, 1, 0, 1), signs, strict=True)
    for place, axis, sign in sides:
        f, c, a = ((fx, cx, x), (fy, cy, y))[axis]
        lean = c - place
        length = 1 if slip.get("unnormalised") else f if slip.get("sideways") else np.hypot(f, lean)
        found.append(sign * (f * a + lean * z) / length)
    return np.array(found)


def _camera(rng: np.random.Generator) -> Array:
    f, g, c, d = rng.uniform((6, 6, 4, 3), (12, 12, 6, 5))
    return np.array([[f, 0, c], [0, g, d], [0, 0, 1]])


def _boxed(rng: np.random.Generator, size: int) -> tuple:
    intrinsics, uv = _camera(rng), rng.uniform(2, 8, 2)
    query = unproject(uv[None], np.array([rng.uniform(2, 6)]), intrinsics)[0]
    return query, intrinsics, np.concatenate([np.floor(uv) - size, np.ceil(uv) + size])


def _in_pixels(query: Array, intrinsics: Array, box: Array) -> Array:
    uv = project(query[None], intrinsics)[0][0]
    return np.concatenate([uv - box[:2], box[2:] - uv])


WALLS = Exercise(
    "03.walls",
    reference=walls,
    cases=_boxed,
    mistakes=(
        Mistake(
            "missing normalisation",
            lambda q, k, b: walls(q, k, b, unnormalised=True),
            "the plane's normal (f, 0, c - u) is not of length one; divide by its length.",
        ),
        Mistake(
            "measured at equal depth",
            lambda q, k, b: walls(q, k, b, sideways=True),
            "this is the way to the plane at the query's own depth; the nearest place on a slanted plane is nearer.",
        ),
        Mistake(
            "wrong sign",
            lambda q, k, b: walls(q, k, b, unsigned=True),
            "seen from inside all four are positive: right and bottom need the opposite sign.",
        ),
        Mistake("in pixels", _in_pixels, "these are distances in the image; we need metres, in space."),
        Mistake(
            "camera's axis forgotten",
            lambda q, k, b: walls(q, k * [[1, 1, 0], [1, 1, 0], [1, 1, 1]], b),
            "the principal point is missing: the plane of column u leans by c - u, not by -u.",
        ),
        Mistake(
            "order of the sides",
            lambda q, k, b: walls(q, k, b)[[0, 2, 1, 3]],
            "the order is left, top, right, bottom.",
        ),
        Mistake(
            "pixel-centre slip",
            lambda q, k, b: walls(q, k, b + 0.5),
            "you are half a pixel off: pixel centres are whole numbers here.",
        ),
    ),
)


def search(query: Array, points: Array, intrinsics: Array, k: int, radius: int, **slip: object) -> tuple[Array, float]:
    """The k nearest cells (k,) in a window, and by how much the nearest cell outside must be farther than the last.

    Args:
        query: (3,), camera frame.
        points: (H, W, 3), camera frame, one for each pixel.
        intrinsics: (3, 3).
        k: how many.
        radius: the window reaches as many columns and rows to every side of the query's pixel, as far as there are any.
        slip: makes one mistake.
    """
    height, width = points.shape[:2]
    column, row = np.floor(project(query[None], intrinsics)[0][0] + 0.5).astype(int)
    out = radius + (0 if slip.get("visited") else 1)
    box = np.array([column - out, row - out, column + out, row + out])  # the first columns and rows outside
    inside = box * [1, 1, -1, -1] >= np.array([0, 0, 1 - width, 1 - height])
    rows = np.arange(max(row - radius, 0), min(row + radius + 1, height))
    columns = np.arange(max(column - radius, 0), min(column + radius + 1, width))
    cells = (rows[:, None] * width + columns).ravel()
    distance = np.linalg.norm(points.reshape(-1, 3)[cells] - query, axis=-1)
    order = np.argsort(distance, kind="stable")[:k]
    inside |= bool(slip.get("border"))
    bound = walls(query, intrinsics, box)[inside].min(initial=np.inf)
    last = distance[order[0 if slip.get("first") else -1]]
    return order if slip.get("local") else cells[order], bound - (last**2 if slip.get("squared") else last)


def _mapped(rng: np.random.Generator, size: int) -> tuple:
    height, width, intrinsics = 6 + size, 8 + size, _camera(rng)
    v, u = np.indices((height, width)).reshape(2, -1)
    front = u < rng.integers(3, 6)
    z = np.where(front, 3.0, 5.0) + rng.uniform(0, 0.5, height * width)
    points = unproject(np.stack([u, v], -1).astype(float), z, intrinsics).reshape(height, width, 3)
    row, column = rng.integers(1, (height - 1, width - 1))
    return points[row, column] * 1.02, points, intrinsics, 2 + size, int(rng.integers(2, 4))


def _slipped(**slip: object) -> object:
    return lambda *arguments: search(*arguments, **slip)


PROOF = Exercise(
    "03.proof",
    reference=search,
    cases=_mapped,
    mistakes=(
        Mistake(
            "indices of the window",
            _slipped(local=True),
            "your indices count the window's cells; turn them into row * W + column of the whole map.",
        ),
        Mistake(
            "border counted",
            _slipped(border=True),
            "where the window ends at the image's border nothing lies outside; leave out that side (margin inf if all are).",
        ),
        Mistake(
            "nearest instead of the last",
            _slipped(first=True),
            "all k must be proven: compare the bound with the farthest of the k, not with the nearest.",
        ),
        Mistake(
            "squared distance",
            _slipped(squared=True),
            "the bound is a length; take the root of the squared distance before you subtract.",
        ),
        Mistake(
            "last column visited",
            _slipped(visited=True),
            "safe, but too timid: the first column that was not visited is radius + 1 away, not radius.",
        ),
        Mistake(
            "sign of the margin",
            lambda *arguments: (search(*arguments)[0], -search(*arguments)[1]),
            "bound minus distance: positive means proven.",
        ),
    ),
)

EXERCISES = (KNN, WINDOW, WALLS, PROOF)
