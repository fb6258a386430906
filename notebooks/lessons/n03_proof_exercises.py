"""Exercises of notebook 03 on a search that proves itself exact: the walls of what was visited, and the search."""

from __future__ import annotations

import numpy as np

from lessons.checker import Answer, Exercise, Mistake
from tapip3d_lite.geometry import project, unproject

Array = np.ndarray


def walls(query: Array, intrinsics: Array, box: Array, **slip: bool) -> Array:
    """Distances (4,) to the planes through the camera and the sides (left, top, right, bottom); negative outside."""
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
    focal = rng.permutation([rng.uniform(6, 8), rng.uniform(9, 12)])
    c, d = rng.uniform((4, 3), (6, 5))
    return np.array([[focal[0], 0, c], [0, focal[1], d], [0, 0, 1]])


def _boxed(rng: np.random.Generator, size: int) -> tuple:
    """A query in the middle of its box; for larger sizes it lies beyond one side of it, or two."""
    intrinsics, middle = _camera(rng), rng.integers(2, 8, 2)
    reach = rng.integers(1, 4, 4)
    box = np.concatenate([middle - reach[:2], middle + reach[2:]])
    away = 0.4 if size == 1 else size
    uv = middle + away * rng.choice([-1, 1], 2) * rng.uniform(0.3, 1, 2)
    return unproject(uv[None], np.array([rng.uniform(2, 6)]), intrinsics)[0], intrinsics, box


def _in_pixels(query: Array, intrinsics: Array, box: Array) -> Array:
    uv = project(query[None], intrinsics)[0][0]
    return np.concatenate([uv - box[:2], box[2:] - uv])


def _one_focal_length(query: Array, intrinsics: Array, box: Array) -> Array:
    fx, fy = intrinsics[0, 0], intrinsics[1, 1]
    return walls(query, intrinsics * np.array([[1], [fx / fy], [1]]) + (1 - fx / fy) * _row_of(intrinsics), box)


def _row_of(intrinsics: Array) -> Array:
    only = np.zeros((3, 3))
    only[1, 2] = intrinsics[1, 2]
    return only


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
        Mistake(
            "all signs turned",
            lambda q, k, b: -walls(q, k, b),
            "positive means inside: turn all four signs.",
        ),
        Mistake(
            "absolute values",
            lambda q, k, b: np.abs(walls(q, k, b)),
            "beyond a wall its distance is negative; an absolute value would prove what is not true.",
        ),
        Mistake(
            "no less than 0",
            lambda q, k, b: np.maximum(walls(q, k, b), 0),
            "beyond a wall its distance is negative, and by how much counts; do not cut it off at 0.",
        ),
        Mistake("in pixels", _in_pixels, "these are distances in the image; we need metres, in space."),
        Mistake(
            "one focal length",
            _one_focal_length,
            "rows have a focal length of their own, intrinsics[1, 1].",
        ),
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


def search(
    query: Array, points: Array, intrinsics: Array, count: int, radius: int, **slip: object
) -> tuple[Array, float]:
    """The nearest cells in a window, and by how much the nearest cell outside must be farther than the last of them.

    Args:
        query: (3,), camera frame.
        points: (H, W, 3), camera frame, one for each pixel.
        intrinsics: (3, 3).
        count: how many are wanted.
        radius: the window reaches as many columns and rows to every side of the query's pixel, as far as there are any.
        slip: makes one mistake.
    """
    height, width = points.shape[:2]
    nearest_pixel = np.floor(project(query[None], intrinsics)[0][0] + slip.get("half", 0.5))
    column, row = nearest_pixel.astype(int)
    out = radius + (0 if slip.get("visited") else 1)
    box = np.array([column - out, row - out, column + out, row + out])  # the first columns and rows outside
    inside = box * [1, 1, -1, -1] >= np.array([0, 0, 1 - width, 1 - height])
    reach = max(height, width) + abs(column) + abs(row) if slip.get("all") else radius
    rows = np.arange(max(row - reach, 0), min(row + reach + 1, height))
    columns = np.arange(max(column - reach, 0), min(column + reach + 1, width))
    cells = (rows[:, None] * width + columns).ravel()
    distance = np.linalg.norm(points.reshape(-1, 3)[cells] - query, axis=-1)
    order = np.argsort(distance, kind="stable")[:count]
    inside |= bool(slip.get("border"))
    bound = walls(query, intrinsics, box)[inside].min(initial=np.inf)
    last = distance[order[0 if slip.get("first") else -1]]
    return order if slip.get("local") else cells[order], bound - (last**2 if slip.get("squared") else last)


def _mapped(rng: np.random.Generator, size: int) -> tuple:
    """A query and a map: what is special of its size comes first, the rest is drawn.

    Size 1: the first row and column are just not visited, the last ones just are. Size 2: before a flat wall, with ties.
    Size 3: off its surface, or a map that is visited whole. Size 4: off its surface, near or beyond a border.
    """
    height, width, intrinsics = 5 + 2 * size, 6 + 3 * size, _camera(rng)
    places = [[-1, height // 2], [width, 1], [2, height], [width - 4, height - 2], [width - 2, height - 4]]
    place, aside = rng.choice(places), rng.uniform(-0.4, 0.4, 2)
    if size == 1:
        height, width, place, aside = 6, 6, np.array([3, 3]), np.abs(aside)
    if size == 3 and rng.random() < 0.3:
        height, width, place = 4, 5, np.array([2, 1])
    v, u = np.indices((height, width))
    z = np.where(u + v < rng.integers(4, 9), 3.0, 5.0) + rng.uniform(0, 0.5, (height, width))
    if size == 2:
        intrinsics[:2, 2], z = rng.integers(2, 6, 2), np.full((height, width), 4.0)
    rays = [(a - intrinsics[i, 2]) / intrinsics[i, i] for i, a in enumerate((u, v))]  # exact mirror images, for ties
    points = np.stack([rays[0] * z, rays[1] * z, z], -1)
    if size == 2:
        return np.array([0, 0, 4.0 * rng.uniform(0.9, 0.99)]), points, intrinsics, 14, 3
    off = rng.choice([0.6, 0.7, 1.4]) if size > 2 else 1.01  # off its surface: there windows miss nearer cells
    depth = z[tuple(np.clip(place[::-1], 0, (height - 1, width - 1)))] * off
    return (
        unproject(place[None] + aside, np.array([depth]), intrinsics)[0],
        points,
        intrinsics,
        (13, 0, 5, 8)[size - 1],
        2,
    )


class Watched(np.ndarray):
    """Numbers, each one different, that keep which of them were read: by arithmetic, or picked by lists of indices."""

    def __array_finalize__(self, parent: Array | None) -> None:
        self.read = getattr(parent, "read", None)

    def __getitem__(self, key: object) -> object:
        part = super().__getitem__(key)
        if isinstance(part, Watched) and np.may_share_memory(part, self):
            return part  # a view; it counts when it is computed with
        self.read.update(np.ravel(part).tolist())
        return np.asarray(part)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: object, **options: object) -> object:
        for x in inputs:
            if isinstance(x, Watched):
                self.read.update(x.ravel().tolist())
        return getattr(ufunc, method)(*(np.asarray(x) if isinstance(x, Watched) else x for x in inputs), **options)


def cells_visited(answer: Answer, arguments: tuple) -> float:
    """How many cells of the map an answer looks at; to look twice costs nothing."""
    query, points, *rest = arguments
    watched = (points + 1e-9 * np.arange(points.size).reshape(points.shape)).view(
        Watched
    )  # no number stands there twice
    watched.read = set()
    answer(query, watched, *rest)
    return len(watched.read) / 3


def _slipped(**slip: object) -> object:
    return lambda *arguments: search(*arguments, **slip)


def _hidden(query: Array, points: Array, *rest: object) -> tuple[Array, float]:
    """The right answer after a look at every cell."""
    np.linalg.norm(points - query, axis=-1)
    return search(query, points, *rest)


def _margin(change: Answer) -> Answer:
    def answer(*arguments: object) -> tuple:
        found, margin = search(*arguments)
        return found, change(margin)

    return answer


PROOF = Exercise(
    "03.proof",
    reference=search,
    cases=_mapped,
    cost=cells_visited,
    cost_unit="cells visited",
    mistakes=(
        Mistake(
            "everything searched",
            _slipped(all=True),
            "you looked beyond the window: only cells within `radius` may be visited, and nearer ones outside stay unseen.",
        ),
        Mistake(
            "everything computed",
            _hidden,
            "you computed the distances of all cells and then threw most away; cut the window out of `points` first.",
        ),
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
            "all must be proven: compare the bound with the farthest of those found, not with the nearest.",
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
            "pixel rounded down",
            _slipped(half=0),
            "the query's pixel is the nearest one, floor(u + 0.5): centres are whole numbers.",
        ),
        Mistake("sign of the margin", _margin(lambda margin: -margin), "bound minus distance: positive means proven."),
        Mistake(
            "absolute margin",
            _margin(abs),
            "a negative margin says that nothing is proven; its absolute value would claim a proof.",
        ),
        Mistake(
            "margin no less than 0",
            _margin(lambda margin: max(margin, 0.0)),
            "a negative margin says by how much the proof fails, that is how far the window must grow; do not cut it off.",
        ),
    ),
)
