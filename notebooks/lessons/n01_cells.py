"""The exercises of lesson 01 on cells: the pixel that a cell picks, and the whole feature cloud."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from lessons.checker import Exercise, Mistake

Array = np.ndarray
Pick = Callable[[int, int], Array]
Cloud = list[tuple[Tensor, Tensor]]


def nearest_cells(length: int, cells: int) -> Array:
    """Pixel nearest to the middle of each of `cells` cells over `length` pixels, of two the later one: (cells,) int."""
    return (2 * np.arange(cells) + 1) * length // (2 * cells)


def _lengths(rng: np.random.Generator, size: int) -> tuple:
    """Pixels and cells: even and odd ratios, fractions, and no case that depends on how a quotient is rounded."""
    while True:
        cells = int(rng.integers(2, 4) * size)
        pixels = cells * int(rng.integers(2, 5)) if rng.random() < 0.4 else int(rng.integers(2 * cells, 6 * cells))
        exact = (2 * np.arange(cells) + 1) * pixels % (2 * cells) == 0
        if pixels % cells == 0 or not exact.any():
            return pixels, cells


def _middles(n: int, m: int) -> Array:
    return (np.arange(m) + 0.5) * n / m


NEAREST = Exercise(
    "01.nearest_cells",
    reference=nearest_cells,
    cases=_lengths,
    mistakes=(
        Mistake(
            "left edge",
            lambda n, m: np.floor(np.arange(m) * n / m).astype(int),
            "you take the pixel at the cell's left edge; take the one at its middle, i + 1/2.",
        ),
        Mistake(
            "corners aligned",
            lambda n, m: np.rint(np.linspace(0, n - 1, m)).astype(int),
            "you aligned the corner cells with the corner pixels; every cell covers n / m pixels instead.",
        ),
        Mistake(
            "ties to the even pixel",
            lambda n, m: np.rint(_middles(n, m) - 0.5).astype(int),
            "the middle is right, the rounding is not: np.rint(0.5) is 0, but np.rint(1.5) is 2. Halfway between two "
            "pixels the later one is asked for: floor(... + 1/2).",
        ),
        Mistake(
            "ties to the earlier pixel",
            lambda n, m: np.ceil(_middles(n, m) - 1).astype(int),
            "where the middle lies halfway between two pixels, take the later one.",
        ),
        Mistake(
            "half a pixel late",
            lambda n, m: np.minimum(np.rint(_middles(n, m)), n - 1).astype(int),
            "(i + 1/2) n / m is counted from the image's edge, which lies at -1/2; as a pixel coordinate it is half less.",
        ),
        Mistake(
            "rounded down",
            lambda n, m: np.floor(_middles(n, m) - 0.5).astype(int),
            "the middle is right, but rounding down takes the pixel before it, even where the next one is nearer.",
        ),
        Mistake(
            "rounded twice",
            lambda n, m: np.arange(m) * n // m + n // m // 2,
            "half a cell was added to an edge that was rounded before; round once, at the end.",
        ),
        Mistake(
            "whole steps",
            lambda n, m: np.arange(m) * (n // m) + n // m // 2,
            "whole steps of n // m pixels lag behind where the sizes do not divide each other.",
        ),
        Mistake(
            "ratio upside down",
            lambda n, m: np.floor((np.arange(m) + 0.5) * m / n).astype(int),
            "one cell covers pixels / cells pixels; you used the inverse.",
        ),
    ),
)


# --- the whole cloud --------------------------------------------------------------------------------------------------


def cloud(features: Tensor, pixels: Tensor, levels: int, pick: Pick = nearest_cells) -> Cloud:
    """The feature cloud of one frame.

    Args:
        features: (C, h, w).
        pixels: (H, W, D), what belongs to each pixel, e.g. its point.
        levels: L.
        pick: (length, cells) to the indices (cells,) that the cells take.

    Returns:
        L pairs, finest first: features (h_l, w_l, C), averaged 2 x 2 from level to level; and (h_l, w_l, D), picked.
    """
    pairs = []
    for level in range(levels):
        features = F.avg_pool2d(features, 2) if level else features
        pairs.append((features.permute(1, 2, 0), _picked(pixels, features.shape[1:], pick)))
    return pairs


def _indices(pixels: Tensor, size: tuple[int, int], pick: Pick) -> list[Tensor]:
    return [torch.as_tensor(pick(n, m)) for n, m in zip(pixels.shape[:2], size, strict=True)]


def _picked(pixels: Tensor, size: tuple[int, int], pick: Pick) -> Tensor:
    rows, columns = _indices(pixels, size, pick)
    return pixels[rows][:, columns]


def _paired(pixels: Tensor, size: tuple[int, int], pick: Pick) -> Tensor:
    rows, columns = _indices(pixels, size, pick)
    return pixels[rows, columns]


def _averaged(pixels: Tensor, size: tuple[int, int], pick: Pick) -> Tensor:
    return F.adaptive_avg_pool2d(pixels.permute(2, 0, 1), tuple(size)).permute(1, 2, 0)


def _every_sth(pixels: Tensor, size: tuple[int, int], pick: Pick) -> Tensor:
    down, across = pixels.shape[0] // size[0], pixels.shape[1] // size[1]
    return pixels[down // 2 :: down, across // 2 :: across]


def _taking(take: Callable[[Tensor, tuple[int, int], Pick], Tensor]) -> Callable[..., Cloud]:
    """The right features with pixels that are taken otherwise."""

    def answer(features: Tensor, pixels: Tensor, levels: int, pick: Pick) -> Cloud:
        return [(f, take(pixels, f.shape[:2], pick)) for f, _ in cloud(features, pixels, levels, pick)]

    return answer


def _halving(halve: Callable[[Tensor], Tensor], first: bool = False) -> Callable[..., Cloud]:
    """The features halved otherwise, or once too often; the right pixels for cells of that size."""

    def answer(features: Tensor, pixels: Tensor, levels: int, pick: Pick) -> Cloud:
        pairs = []
        for level in range(levels):
            features = halve(features) if level or first else features
            pairs.append((features.permute(1, 2, 0), _picked(pixels, features.shape[1:], pick)))
        return pairs

    return answer


def _chained(features: Tensor, pixels: Tensor, levels: int, pick: Pick) -> Cloud:
    pairs = []
    for f, _ in cloud(features, pixels, levels, pick):
        pixels = _picked(pixels, f.shape[:2], pick)
        pairs.append((f, pixels))
    return pairs


def _halve(maps: Tensor) -> Tensor:
    return F.avg_pool2d(maps, 2)


def first_of_cell(length: int, cells: int) -> Array:
    """Another rule: the first pixel of each cell."""
    return np.arange(cells) * length // cells


def _frames(rng: np.random.Generator, size: int) -> tuple:
    """Odd sizes, images that are no multiple of their cells, and another rule now and then."""
    levels = 1 + size // 2
    h, w = (int(rng.integers(2, 4)) * 2 ** (levels - 1) + 1 for _ in range(2))
    side = np.array([h, w + 2]) * rng.uniform(2.2, 3.8, 2)
    features = torch.from_numpy(rng.normal(size=(2, h, w + 2)))
    pixels = torch.from_numpy(rng.normal(size=(*side.astype(int), 3 + size % 2)))
    return features, pixels, levels, first_of_cell if rng.random() < 0.3 else nearest_cells


CLOUD = Exercise(
    "01.cloud",
    reference=cloud,
    cases=_frames,
    gradients=(0,),
    mistakes=(
        Mistake(
            "points averaged",
            _taking(_averaged),
            "you averaged the points: the mean of a front and a back point lies on neither. Pick one pixel for each cell.",
        ),
        Mistake(
            "every s-th pixel",
            _taking(_every_sth),
            "steps of H // h pixels are right only where the sizes divide each other; let `pick` say which pixels.",
        ),
        Mistake(
            "own rule",
            _taking(lambda pixels, size, pick: _picked(pixels, size, nearest_cells)),
            "you computed the pixels yourself; use the rule that is handed over, `pick(length, cells)`.",
        ),
        Mistake(
            "rows paired with columns",
            _taking(_paired),
            "pixels[rows, columns] pairs the two lists; pixels[rows][:, columns] takes every column of every row.",
        ),
        Mistake(
            "picked from the level before",
            _chained,
            "you picked from the level before; each level picks from the full map, or its pixel drifts off the middle.",
        ),
        Mistake(
            "features picked",
            _halving(lambda maps: maps[:, : maps.shape[1] // 2 * 2 : 2, : maps.shape[2] // 2 * 2 : 2]),
            "you picked the features as well; they are averaged, 2 x 2 cells at a time.",
        ),
        Mistake(
            "largest instead of mean",
            _halving(lambda maps: F.max_pool2d(maps, 2)),
            "you kept the largest of four features; take their mean.",
        ),
        Mistake(
            "level 0 halved",
            _halving(_halve, first=True),
            "level 0 is the feature map as it is; only the levels after it are halved.",
        ),
        Mistake(
            "odd row kept",
            _halving(lambda maps: F.avg_pool2d(maps, 2, ceil_mode=True)),
            "an odd last row or column has no partner and is left out: 5 cells become 2.",
        ),
        Mistake(
            "coarsest first",
            lambda *case: cloud(*case)[::-1],
            "the finest level comes first.",
        ),
        Mistake(
            "channels first",
            lambda *case: [(f.permute(2, 0, 1), points) for f, points in cloud(*case)],
            "the features are to be returned cell by cell, (h, w, C); move the channels last.",
        ),
        Mistake(
            "gradient cut",
            lambda features, *case: cloud(features.detach(), *case),
            "the encoder learns through these features: no detach, no NumPy, no new tensor made of numbers.",
        ),
    ),
)

CELL_EXERCISES = (NEAREST, CLOUD)
