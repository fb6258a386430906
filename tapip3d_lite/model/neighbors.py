"""Neighbourhoods: the K cells of a frame's cloud that lie nearest to a point in 3D.

    N_t(x) = the K cells j of frame t with the smallest |p_j - x|^2,   offsets o_j = p_j - x

Paper: section 3.2 (k-NN in 3D; its ablation compares a fixed window in 2D). Two cells that touch in the image but lie
on different surfaces are far apart here, so a neighbourhood does not mix them.

A neighbourhood is any callable with the signature of `KNearest.forward`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from tapip3d_lite.model.cloud import Level, Normalizer
from tapip3d_lite.model.config import TrackerConfig

_BUDGET = 2**24  # distances that exist at once: 64 MiB in float32; on a GPU 16 times as many
INFINITE = int(torch.tensor(torch.inf).view(torch.int32))  # bits of non-negative floats order like the floats


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
        return self.points - self.center.unsqueeze(-2)  # (..., N, 1, 3)

    def pick(self, columns: Tensor) -> Neighbors:
        """Some of the N points of (B, N, ...) neighbourhoods."""
        indices = None if self.indices is None else self.indices[:, columns]
        return Neighbors(self.features[:, columns], self.points[:, columns], self.center[:, columns], indices)

    def normalized(self, norm: Normalizer) -> Neighbors:
        """The same neighbourhoods in normalised coordinates."""
        return replace(self, points=norm.normalize(self.points), center=norm.normalize(self.center))


class KNearest(nn.Module):
    """The K cells nearest in 3D, nearest first."""

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
        frames = coords.shape[:2]
        points, features = (x.flatten(2, 3).flatten(0, 1) for x in (level.points, level.features))  # (B S, h w, ...)
        valid = level.valid.flatten(2, 3).flatten(0, 1) if self.exclude_invalid else None  # (B S, h w)
        with torch.no_grad():
            indices = self.search(level, coords.flatten(0, 1), points, valid)  # (B S, N, K)
        near = (gather(x, indices).unflatten(0, frames) for x in (features, points))  # (B, S, N, K, ...)
        return Neighbors(*near, coords, indices.unflatten(0, frames))  # (B, S, N, K)

    def search(self, level: Level, queries: Tensor, points: Tensor, valid: Tensor | None) -> Tensor:
        """Indices (F, N, K) of the cells (F, P, 3) of `level` nearest to queries (F, N, 3); valid (F, P) may be chosen."""
        return knn(queries, points, self.count, valid)


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
    points, indices, masked = points.float(), torch.arange(total, device=points.device), valid is not None
    parts = queries.float().split(step, 1)
    near = [nearest_first(squared_distances(part, points, valid), indices, count, masked) for part in parts]
    return torch.cat(near, 1)  # (F, N, K)


def nearest_first(distance: Tensor, indices: Tensor, count: int, masked: bool) -> Tensor:
    """The indices (F, N, K), of (P,) or (F, N, P) int64, with the smallest distances (F, N, P), nearest first.

    Among equals the lowest index comes first. Distances are not negative, and infinite where a point may not be chosen;
    with `masked` the slots of such points are filled, see `knn`.
    """
    # The bits of a non-negative float order like the float itself, so one integer holds (distance, index).
    key = (distance.view(torch.int32).long() << 32) + indices
    near = key.topk(count, dim=-1, largest=False).values  # (F, N, P) -> (F, N, K)
    indices, infinite = near & 0xFFFFFFFF, (near >> 32) == INFINITE
    if masked:
        indices = torch.where(infinite, torch.where(infinite[..., :1], 0, indices[..., :1]), indices)
    return indices


def squared_distances(queries: Tensor, points: Tensor, valid: Tensor | None = None) -> Tensor:
    """(F, N, P) = dx^2 + dy^2 + dz^2, infinite for points that are not valid (F, P).

    Never through |a|^2 + |b|^2 - 2ab, which loses the near ones to rounding.
    """
    total = (queries[:, :, None, 0] - points[:, None, :, 0]).square_()  # (F, N, 1) - (F, 1, P)
    for axis in (1, 2):
        total += (queries[:, :, None, axis] - points[:, None, :, axis]).square_()
    return total if valid is None else total.masked_fill_(~valid[:, None], torch.inf)  # (F, 1, P)


def gather(values: Tensor, indices: Tensor) -> Tensor:
    """Rows of values (F, P, C) at indices (F, N, K) as (F, N, K, C)."""
    first = torch.arange(len(values), device=values.device)[:, None, None] * values.shape[1]  # (F, 1, 1)
    rows = values.flatten(0, 1).index_select(0, (first + indices).flatten())  # its backward needs no sorting on a GPU
    return rows.view(*indices.shape, values.shape[2])  # (F N K, C) -> (F, N, K, C)


def bilinear(grid: Tensor, cells: Tensor) -> Tensor:
    """Interpolate a grid (B, h, w, C) at cells (B, N, 2) = (column, row), clamped to the border; (B, N, C)."""
    height, width, channels = grid.shape[1:]
    x, y = cells[..., 0].clamp(0, width - 1), cells[..., 1].clamp(0, height - 1)
    left, top = x.floor().clamp(max=max(width - 2, 0)), y.floor().clamp(max=max(height - 2, 0))
    right, bottom = (left + 1).clamp(max=width - 1), (top + 1).clamp(max=height - 1)
    a, b = (x - left).unsqueeze(-1), (y - top).unsqueeze(-1)  # (B, N) -> (B, N, 1)
    flat = grid.flatten(1, 2)  # (B, h, w, C) -> (B, h w, C)

    def at(row: Tensor, column: Tensor) -> Tensor:
        index = (row * width + column).long().unsqueeze(-1)  # (B, N, 1)
        return flat.gather(1, index.expand(-1, -1, channels))  # (B, N, C)

    upper = at(top, left) * (1 - a) + at(top, right) * a
    lower = at(bottom, left) * (1 - a) + at(bottom, right) * a
    return upper * (1 - b) + lower * b
