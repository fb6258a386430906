"""Neighbourhoods: the K cells of a frame's cloud that lie nearest to a point in 3D.

Paper: section 3.3 ("local pair attention", k-NN in 3D) and table 6 (against windows in 2D). Two cells that touch in
the image but lie on different surfaces are far apart here, so a neighbourhood does not mix them.

A neighbourhood is any callable with the signature of `KNearest.forward`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from tapip3d_lite.model.cloud import Level, Normalizer
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.organized import INFINITE, BlockTree

_BUDGET = 2**24  # distances that exist at once: 64 MiB in float32; on a GPU 16 times as many
_FEW = 2**16  # distances that are computed sooner than a tree is searched
_RUN = 8  # neighbouring cells that are looked at together


@dataclass(frozen=True)
class Neighbors:
    """What stands around points.

    Attributes:
        features: (..., N, K, C) of the cells.
        points: (..., N, K, 3) of the cells.
        center: (..., N, 3), the points whose neighbourhood this is.
        indices: (..., N, K) into the h * w cells of the frame, or None where cells were interpolated.
    """

    features: Tensor
    points: Tensor
    center: Tensor
    indices: Tensor | None = None

    @property
    def offsets(self) -> Tensor:
        """(..., N, K, 3), cell minus centre."""
        return self.points - self.center.unsqueeze(-2)

    def pick(self, columns: Tensor) -> Neighbors:
        """Some of the N points of (B, N, ...) neighbourhoods."""
        indices = None if self.indices is None else self.indices[:, columns]
        return Neighbors(self.features[:, columns], self.points[:, columns], self.center[:, columns], indices)

    def normalized(self, norm: Normalizer) -> Neighbors:
        """The same neighbourhoods in normalised coordinates."""
        return replace(self, points=norm.normalize(self.points), center=norm.normalize(self.center))


class KNearest(nn.Module):
    """The K cells nearest in 3D, nearest first.

    Attributes:
        fast: search trees where that is sooner than comparing with every cell; the result is the same.
    """

    fast: bool = True

    def __init__(self, config: TrackerConfig) -> None:
        super().__init__()
        self.count, self.exclude_invalid = config.neighbors, config.exclude_invalid

    def forward(self, level: Level, coords: Tensor, cells: Tensor) -> Neighbors:
        """Collect neighbourhoods.

        Args:
            level: S frames of one level of the cloud.
            coords: (B, S, N, 3) in the space of `level.points`.
            cells: (B, S, N, 2), the same points projected, in units of the level's cells (column, row); may lie
                outside the grid. Not needed here; windows in 2D are centred on it.

        Returns:
            (B, S, N, K, ...) neighbours.
        """
        shape = coords.shape[:2]
        points, features = level.points.flatten(2, 3).flatten(0, 1), level.features.flatten(2, 3).flatten(0, 1)
        with torch.no_grad():
            indices = self._search(level, coords.flatten(0, 1), points)  # (B*S, N, K)
        near = (gather(x, indices).unflatten(0, shape) for x in (features, points))
        return Neighbors(*near, coords, indices.unflatten(0, shape))

    def _search(self, level: Level, queries: Tensor, points: Tensor) -> Tensor:
        valid = level.valid.flatten(0, 1) if self.exclude_invalid else None
        if self.fast and queries.device.type == "cpu" and queries.shape[:2].numel() * points.shape[1] > _FEW:
            if "tree" not in level.memory:
                level.memory["tree"] = BlockTree.build(level.points.flatten(0, 1), valid)
            if level.memory["tree"] is not None:
                return level.memory["tree"].knn(queries, self.count)
        return knn(queries, points, self.count, None if valid is None else valid.flatten(1))


def gather(values: Tensor, indices: Tensor) -> Tensor:
    """Rows of values (F, P, C) at indices (F, N, K) as (F, N, K, C)."""
    first = torch.arange(len(values), device=values.device)[:, None, None] * values.shape[1]
    rows = values.flatten(0, 1).index_select(0, (first + indices).flatten())  # its backward needs no sorting on a GPU
    return rows.view(*indices.shape, values.shape[2])


def knn(queries: Tensor, points: Tensor, count: int, valid: Tensor | None = None) -> Tensor:
    """Exact nearest neighbours by squared distance in float32; ties go to the lowest index.

    Args:
        queries: (F, N, 3), F independent clouds.
        points: (F, P, 3).
        count: K, at most P.
        valid: (F, P) bool, points that may be chosen, or None for all. If fewer than K may, the nearest one
            fills the remaining slots (index 0 where there is none at all).

    Returns:
        (F, N, K) int64, nearest first.

    Raises:
        ValueError: K exceeds P.
    """
    if count > points.shape[1]:
        raise ValueError(f"knn: asked for {count} neighbours among {points.shape[1]} points; lower neighbors or levels")
    frames, total = points.shape[:2]
    step = max(1, _BUDGET * (16 if queries.is_cuda else 1) // (frames * total))
    queries, points = queries.float(), points.float()
    chunks = [_nearest(chunk, points, count, valid) for chunk in queries.split(step, 1)]
    return torch.cat(chunks, 1) if chunks else queries.new_zeros((frames, 0, count), dtype=torch.long)


def _nearest(queries: Tensor, points: Tensor, count: int, valid: Tensor | None) -> Tensor:
    distance = squared_distances(queries, points)  # (F, N, P)
    if valid is not None:
        distance.masked_fill_(~valid[:, None], torch.inf)
    total, indices = distance.shape[-1], torch.arange(distance.shape[-1], device=distance.device)
    if total % _RUN == 0 and total > 2 * _RUN * count:
        # The K nearest lie in the K runs of cells whose nearest ones are nearest, ties included: fewer are sorted.
        runs, _ = _smallest(distance.unflatten(-1, (-1, _RUN)).amin(-1), indices[: total // _RUN], count)
        indices = (runs.unsqueeze(-1) * _RUN + indices[:_RUN]).flatten(-2)
        distance = distance.gather(-1, indices)
    indices, infinite = _smallest(distance, indices, count)
    if valid is not None:
        indices = torch.where(infinite, torch.where(infinite[..., :1], 0, indices[..., :1]), indices)
    return indices


def _smallest(distance: Tensor, indices: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The indices (F, N, K) of the smallest distances (F, N, P), lowest index first among equals; which are infinite."""
    # The bits of a non-negative float order like the float itself, so one integer holds (distance, index).
    key = (distance.view(torch.int32).long() << 32) + indices
    near = key.topk(count, dim=-1, largest=False).values
    return near & 0xFFFFFFFF, (near >> 32) == INFINITE


def squared_distances(queries: Tensor, points: Tensor) -> Tensor:
    """(F, N, P) = dx^2 + dy^2 + dz^2; never through |a|^2 + |b|^2 - 2ab, which loses the near ones to rounding."""
    total = (queries[:, :, None, 0] - points[:, None, :, 0]).square_()
    for axis in (1, 2):
        total += (queries[:, :, None, axis] - points[:, None, :, axis]).square_()
    return total
