"""Exact nearest neighbours in organised point maps: the same indices as `model.neighbors.knn`, many times faster.

k-NN in 3D is a large part of the paper's time. On a CPU, cells that touch in a map mostly lie close in 3D, so 2 x 4
cells make a block and 4 x 4 blocks a node, each with its bounding box. For each point the nearest nodes are opened, of
their blocks the nearest, and the K nearest of their cells are sorted.

Proof: no cell of a box is nearer than the box. Where the K-th distance found is below the nearest box that was left
closed, the answer is exact; the other points are asked again with more boxes open, in the end all. This holds in
floating point too: subtracting, squaring and adding round monotonically, so a box's computed distance never exceeds
that of a cell in it, taken in the same order. No projection is needed, so it works in every space.

On a GPU all distances are computed, but only the cells of the K nearest runs of 8 cells are sorted.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from tapip3d_lite.model.cloud import Level
from tapip3d_lite.model.neighbors import INFINITE, KNearest, knn, nearest_first, squared_distances

BLOCK, NODE = (2, 4), (8, 16)  # rows and columns of cells
_LARGE = 128 * BLOCK[0] * BLOCK[1]  # cells of a map from which on its blocks are grouped to nodes
_SHORT = 256  # numbers in a row up to which sorting all is faster than finding the smallest
_BUDGET = 2**18  # distances at once: a MiB, so that temporaries stay in the cache
_WIDER = (1, 2, 6)  # times as many boxes are opened for points whose proof failed; then all
_FEW = 2**16  # distances that are computed faster than boxes are searched
_RUN = 8  # neighbouring cells that are looked at together on a GPU


class BoxKNearest(KNearest):
    """The K cells nearest in 3D, as `KNearest` finds them."""

    def search(self, level: Level, queries: Tensor, points: Tensor, valid: Tensor | None) -> Tensor:
        """Indices (F, N, K), as those of `KNearest.search`; boxes are built once for each window and level."""
        if queries.is_cuda:
            return run_knn(queries, points, self.count, valid)
        if queries.shape[:2].numel() * points.shape[1] <= _FEW:
            return knn(queries, points, self.count, valid)
        if "boxes" not in level.memory:
            mask = level.valid.flatten(0, 1) if self.exclude_invalid else None
            level.memory["boxes"] = BlockTree.build(level.points.flatten(0, 1), mask)
        boxes = level.memory["boxes"]
        return knn(queries, points, self.count, valid) if boxes is None else boxes.knn(queries, self.count)


def run_knn(queries: Tensor, points: Tensor, count: int, valid: Tensor | None = None) -> Tensor:
    """As `model.neighbors.knn`, without waiting for a GPU, and with fewer numbers to sort."""
    total = points.shape[1]
    if total % _RUN or total <= 2 * _RUN * count:
        return knn(queries, points, count, valid)
    step = max(1, 2**28 // (len(points) * total))
    parts = queries.float().split(step, 1)
    return torch.cat([_nearest_of_runs(part, points.float(), count, valid) for part in parts], 1)


def _nearest_of_runs(queries: Tensor, points: Tensor, count: int, valid: Tensor | None) -> Tensor:
    distance = squared_distances(queries, points, valid)  # (F, N, P)
    indices = torch.arange(distance.shape[-1], device=distance.device)
    # The K nearest lie in the K runs of cells whose nearest ones are nearest, ties included: fewer are sorted.
    nearest = distance.unflatten(-1, (-1, _RUN)).amin(-1)  # (F, N, P / 8)
    runs = nearest_first(nearest, indices[: nearest.shape[-1]], count, masked=False)  # (F, N, K)
    indices = (runs.unsqueeze(-1) * _RUN + indices[:_RUN]).flatten(-2)  # (F, N, 8 K)
    return nearest_first(distance.gather(-1, indices), indices, count, valid is not None)


@dataclass(frozen=True)
class Boxes:
    """Bounding boxes of the c children of each of P parents.

    Attributes:
        low, high: (3, P, c); the same tensor where the children are cells, which have no extent.
    """

    low: Tensor
    high: Tensor

    def squared_distances(self, queries: Tensor, parents: Tensor) -> Tensor:
        """From queries (R, 3) to the children of their parents (R, b): (R, b c), 0 inside."""
        total = None
        for axis in range(3):
            here, nearest = queries[:, axis, None], _rows(self.low[axis], parents)
            if self.low is not self.high:
                nearest = torch.clamp(here, nearest, _rows(self.high[axis], parents))
            square = nearest.sub_(here).square_()
            total = square if total is None else total.add_(square)
        return total


@dataclass(frozen=True)
class BlockTree:
    """Boxes of F point maps from coarse to fine.

    Attributes:
        levels: children of frames, (of nodes,) and at last of blocks, which are cells.
        cells: (blocks, 8) int32, where in its map each cell of a block is.
        total: cells of a map.
        masked: whether some of them may not be chosen.
    """

    levels: list[Boxes]
    cells: Tensor
    total: int
    masked: bool

    @classmethod
    def build(cls, points: Tensor, valid: Tensor | None = None) -> BlockTree | None:
        """Enclose the cells of maps (F, h, w, 3) that are valid (F, h, w); None if `model.neighbors.knn` must do."""
        if points.device.type != "cpu" or points.dtype != torch.float32 or bool(points.isnan().any()):
            return None
        frames, height, width = points.shape[:3]
        sizes = [NODE, BLOCK] if height * width > _LARGE else [BLOCK]
        pad = [0, -width % sizes[0][1], 0, -height % sizes[0][0]]
        maps = points.detach().movedim(-1, 0)  # (3, F, h, w)
        maps = F.pad(maps if valid is None else torch.where(valid, maps, torch.inf), pad, value=torch.inf)
        cells = torch.arange(height * width, dtype=torch.int32).view(height, width)
        cells = F.pad(cells, pad, value=2**31 - 1)
        for size in sizes:
            maps, cells = _tiles(maps, size), _tiles(cells, size)
        maps, cells = maps.flatten(-2), cells.flatten(-2)  # (3, F, (nodes,) blocks, 8), ((nodes,) blocks, 8)
        levels = [Boxes(*[maps.flatten(1, -2)] * 2)]
        low, high = maps.amin(-1), torch.where(maps == torch.inf, -torch.inf, maps).amax(-1)
        for _ in sizes:
            levels.insert(0, Boxes(low.flatten(1, -2), high.flatten(1, -2)))
            low, high = low.amin(-1), high.amax(-1)
        return cls(levels, cells.flatten(0, -2).repeat(frames, 1), height * width, valid is not None)

    def knn(self, queries: Tensor, count: int) -> Tensor:
        """What `model.neighbors.knn` gives for queries (F, N, 3) and the flattened maps: (F, N, K) int64."""
        frames, number = queries.shape[:2]
        if count > self.total:
            raise ValueError(f"knn: asked for {count} neighbours among {self.total} cells; lower neighbors or levels")
        flat, owner = queries.detach().float().reshape(-1, 3), torch.arange(frames).repeat_interleave(number)
        result, left = torch.empty(len(flat), count, dtype=torch.long), torch.arange(len(flat))
        blocks = 8 * -(-count // 16)
        for factor in (*_WIDER, self.total):
            opened = [factor * max(8, blocks // 4), factor * blocks][-len(self.levels) + 1 :]
            step, failed = max(1, _BUDGET // min(self.total, opened[-1] * 8)), []
            for rows in left.split(number if step / 4 <= number <= step else step):
                result[rows], proven = self._nearest(flat[rows], owner[rows], count, opened)
                failed.append(rows[~proven])
            left = torch.cat(failed) if failed else left
            if not len(left):
                break
        return result.view(frames, number, count)

    def _nearest(self, queries: Tensor, frames: Tensor, count: int, opened: list[int]) -> tuple[Tensor, Tensor]:
        """The K nearest (R, K) of the cells in as many boxes of each level as may be opened; whether it is proven."""
        parents, limit = frames[:, None], torch.full((len(queries),), INFINITE, dtype=torch.int32)
        for boxes, number in zip(self.levels[:-1], opened, strict=True):
            bound, size = boxes.squared_distances(queries, parents), boxes.low.shape[-1]
            first = parents * size
            if number < bound.shape[1]:
                chosen, closed = _smallest(bound, number)
                limit = torch.minimum(limit, closed)
                if first.shape[1] > 1:  # a node's 16 blocks
                    first, chosen = first.gather(1, chosen >> 4), chosen.bitwise_and_(15)
                parents = chosen.add_(first)
            else:
                parents = (first[..., None] + torch.arange(size)).flatten(1)
        distance = self.levels[-1].squared_distances(queries, parents)
        key = torch.empty(*distance.shape, 2, dtype=torch.int32)  # one integer holds (distance, index)
        key[..., 1], key[..., 0] = distance.view(torch.int32), _rows(self.cells, parents)
        key = _sorted(key.view(torch.int64).squeeze(-1), count).view(torch.int32).view(len(queries), count, 2)
        index, bits = key.unbind(-1)
        if self.masked:  # the nearest fills the slots of cells that may not be chosen
            index = torch.where(bits < INFINITE, index, torch.where(bits[:, :1] < INFINITE, index[:, :1], 0))
        return index.long(), bits[:, -1] < limit


def _tiles(maps: Tensor, size: tuple[int, int]) -> Tensor:
    """(..., h, w) as (..., tiles, *size)."""
    return maps.unflatten(-1, (-1, size[1])).unflatten(-3, (-1, size[0])).transpose(-3, -2).flatten(-4, -3)


def _rows(table: Tensor, rows: Tensor) -> Tensor:
    """Copies of rows (R, b) of a table (P, c), as (R, b c)."""
    # Two to three times faster than index_select; "wrap" spares a check.
    picked = table.numpy().take(rows.numpy().ravel(), 0, mode="wrap")
    return torch.from_numpy(picked).view(len(rows), -1)


def _smallest(bound: Tensor, number: int) -> tuple[Tensor, Tensor]:
    """Columns (R, number) of the smallest of non-negative values, and bits (R,) not above any other value's."""
    mask = (1 << (bound.shape[1] - 1).bit_length()) - 1
    key = (bound.view(torch.int32) & ~mask) | torch.arange(bound.shape[1], dtype=torch.int32)
    key.numpy().sort(-1) if key.shape[1] <= _SHORT else key.numpy().partition(number, -1)
    return (key[:, :number] & mask).long(), key[:, number] & ~mask


def _sorted(key: Tensor, count: int) -> Tensor:
    """The smallest of each row (R, P), sorted; numpy sorts short rows several times faster than torch."""
    if key.shape[1] > _SHORT:
        key.numpy().partition(count - 1, -1)
        key = key[:, :count].contiguous()
    key.numpy().sort(-1)
    return key[:, :count].contiguous()
