"""Exercises of notebook 03 on neighbourhoods: exact nearest neighbours among the cells with depth, and a window in the image."""

from __future__ import annotations

import numpy as np

from lessons.checker import Exercise, Mistake
from lessons.n03_proof_exercises import PROOF, WALLS

Array = np.ndarray


def nearest(queries: Array, points: Array, count: int, valid: Array, **slip: object) -> Array:
    """Indices (N, count) of the valid points (P, 3) nearest to queries (N, 3), nearest first, ties by index.

    Args:
        queries: (N, 3).
        points: (P, 3).
        count: at most as many as are valid.
        valid: (P,) bool.
        slip: makes one mistake.
    """
    distance = (np.abs(points - queries[:, None]) ** slip.get("power", 2) * slip.get("weights", 1)).sum(-1)  # (N, P)
    if not slip.get("all"):
        distance[:, ~valid] = np.inf
    if slip.get("unstable"):
        return np.argsort(distance, axis=-1)[:, :count]
    return np.argsort(distance, axis=-1, kind="stable")[:, :count]


def _scattered(rng: np.random.Generator, size: int) -> tuple:
    # A coarse lattice: many cells are equally far, and sums of squares are exact in single precision.
    points = rng.integers(-3, 4, (9 if size == 1 else 40 * size**2, 3)) / 2
    valid = rng.random(len(points)) < 0.8
    valid[:5] = True
    return rng.integers(-6, 7, (size, 3)) / 4, points, (2, 5, 9, 17)[size - 1], valid


def _late_twins(queries: Array, points: Array, count: int, valid: Array) -> Array:
    return len(points) - 1 - nearest(queries, points[::-1], count, valid[::-1])


def _partitioned(queries: Array, points: Array, count: int, valid: Array) -> Array:
    """What argpartition may do with equals: of those at the last distance it keeps others; then sorted by a stable sort."""
    kept = np.sort(_late_twins(queries, points, count, valid), axis=-1)
    distance = ((points[kept] - queries[:, None]) ** 2).sum(-1)
    return np.take_along_axis(kept, np.argsort(distance, axis=-1, kind="stable"), -1)


def _slipped(**slip: object) -> object:
    return lambda *arguments: nearest(*arguments, **slip)


KNN = Exercise(
    "03.knn",
    reference=nearest,
    cases=_scattered,
    mistakes=(
        Mistake(
            "farthest",
            lambda q, p, k, ok: np.argsort(-((p - q[:, None]) ** 2).sum(-1), axis=-1, kind="stable")[:, :k],
            "these are the farthest ones; sort in ascending order.",
        ),
        Mistake(
            "unsorted",
            lambda *arguments: np.sort(nearest(*arguments), axis=-1),
            "the right cells in the wrong order: nearest first.",
        ),
        Mistake(
            "cells without depth chosen",
            _slipped(all=True),
            "you chose cells without depth; their points mean nothing. Set their distance to infinity.",
        ),
        Mistake(
            "indices of the valid",
            lambda q, p, k, ok: nearest(q, p[ok], k, ok[ok]),
            "your indices count the valid cells only; return those into all P cells.",
        ),
        Mistake(
            "unstable sort",
            _slipped(unstable=True),
            "several cells are equally far; NumPy's default sort and argpartition leave their order to chance. Sort stably.",
        ),
        Mistake(
            "argpartition, then sorted",
            _partitioned,
            "of the cells at the last distance argpartition keeps any; those with the lower index are wanted. Sort all, stably.",
        ),
        Mistake(
            "depth ignored",
            _slipped(weights=(1, 1, 0)),
            "all three coordinates count; you compare x and y only, as a window in the image would.",
        ),
        Mistake(
            "depth only",
            _slipped(weights=(0, 0, 1)),
            "you compare the last coordinate only; sum over all three.",
        ),
        Mistake(
            "sum of absolute differences",
            _slipped(power=1),
            "square the differences before you sum them; absolute differences are another distance.",
        ),
        Mistake(
            "nearest skipped",
            lambda q, p, k, ok: nearest(q, p, k + 1, ok)[:, 1:],
            "the query is no cell of the cloud, so its nearest cell is a neighbour like the others; do not skip it.",
        ),
        Mistake(
            "first query for all",
            lambda q, p, k, ok: np.repeat(nearest(q[:1], p, k, ok), len(q), 0),
            "every row is that of the first query; each query has neighbours of its own.",
        ),
        Mistake(
            "ties to the last",
            _late_twins,
            "two cells are equally far: the one with the lower index comes first (a stable sort does that).",
        ),
        Mistake(
            "distances returned",
            lambda q, p, k, ok: np.sort(((p - q[:, None]) ** 2).sum(-1), axis=-1)[:, :k],
            "return the indices of the cells, not their distances: argsort instead of sort.",
        ),
    ),
)


def window(center: Array, side: int, shape: tuple[int, int], **slip: object) -> Array:
    """Indices (side^2,) of the cells around a centre (column, row), row by row; `slip` makes one mistake."""
    height, width = shape
    span = np.arange(side) - slip.get("reach", (side - 1) / 2)
    place = slip.get("place", lambda x: np.floor(x + 0.5))
    columns, rows = (place(c + span).astype(int) for c in (center[::-1] if slip.get("swapped") else center))
    if slip.get("moved"):
        columns, rows = (x - max(x[-1] - n + 1, 0) for x, n in ((columns, width), (rows, height)))
        columns, rows = (x - min(x[0], 0) for x in (columns, rows))
    if slip.get("wrapped"):
        columns, rows = columns % width, rows % height
    elif not slip.get("loose"):
        columns, rows = columns.clip(0, width - 1), rows.clip(0, height - 1)
    cells = rows[:, None] * (height if slip.get("tall") else width) + columns
    return (cells.T if slip.get("by_column") else cells).ravel()


def _place(rng: np.random.Generator, size: int) -> tuple:
    """Centres in quarters of a cell, near each border, beyond it, and inside."""
    height, width = int(rng.integers(4, 7)), int(rng.integers(7, 10))
    column, row = (int(rng.choice([rng.integers(-5, 5), rng.integers(4, 4 * n - 4), 4 * n + rng.integers(-5, 4)]))
                   for n in (width, height))  # fmt: skip
    return np.array([column, row]) / 4, size, (height, width)


def _window(**slip: object) -> object:
    return lambda *arguments: window(*arguments, **slip)


WINDOW = Exercise(
    "03.window",
    reference=window,
    cases=_place,
    mistakes=(
        Mistake(
            "column and row swapped",
            _window(swapped=True),
            "the centre comes as (column, row), that is (u, v); the grid as (rows, columns).",
        ),
        Mistake(
            "height for width",
            _window(tall=True),
            "a row has `width` cells, so cell (row, column) has the index row * width + column.",
        ),
        Mistake("rounded down", _window(place=np.floor), "you round down; the nearest cell is floor(x + 0.5)."),
        Mistake(
            "halves to even",
            _window(place=np.rint),
            "NumPy rounds 2.5 down and 3.5 up, which tears a gap into windows of even side; use floor(x + 0.5).",
        ),
        Mistake(
            "whole steps to the left",
            lambda c, s, g: window(c, s, g, reach=s // 2),
            "where the side is even, the steps are ±½, ±1½ …: with s // 2 the window lies left of its centre.",
        ),
        Mistake(
            "whole steps to the right",
            lambda c, s, g: window(c, s, g, reach=(s - 1) // 2),
            "where the side is even, the steps are ±½, ±1½ …; add them before you round, for the window lies between cells.",
        ),
        Mistake(
            "beyond the border",
            _window(loose=True),
            "cells beyond the border do not exist; clip rows and columns, so that the border's cells repeat.",
        ),
        Mistake(
            "around the world",
            _window(wrapped=True),
            "what leaves the grid on one side does not come back on the other; clip rows and columns instead.",
        ),
        Mistake(
            "moved inside",
            _window(moved=True),
            "you push the whole window into the grid; it stays where it is, and the border's cells repeat.",
        ),
        Mistake("column by column", _window(by_column=True), "the right cells in another order: row by row."),
        Mistake(
            "centre in the corner",
            _window(reach=0),
            "your window begins at the centre; it has to reach (side - 1) / 2 cells to every side of it.",
        ),
    ),
)

EXERCISES = (KNN, WINDOW, WALLS, PROOF)
