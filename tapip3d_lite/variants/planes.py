"""SpatialTracker's three planes: features averaged onto xy, xz and yz, a window on each, correlations summed.

plane_ab(i)  = mean of the features of the cloud's cells whose (a, b) coordinates fall into cell i
context(x)_k = sum over planes of <f_query, plane(place of x + step k)> / sqrt(C)
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import torch
from torch import Tensor, nn

from tapip3d_lite.model.cloud import Level
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.n2n import Context
from tapip3d_lite.model.neighbors import Neighbors, bilinear
from tapip3d_lite.variants.window2d import WindowNeighborhood, window_steps

EXTENT = 3.0  # planes cover this many standard deviations to both sides


class PlaneNeighborhood(nn.Module):
    """A window on each of three planes, interpolated; on a level without planes just the cell of the projection."""

    def __init__(self, config: TrackerConfig) -> None:
        super().__init__()
        self.count = config.neighbors
        self.own = WindowNeighborhood(config)
        self.own.count = 1

    def forward(self, level: Level, coords: Tensor, cells: Tensor) -> Neighbors:
        """Arguments as those of `KNearest.forward`; features (B, S, N, 3 K, C), plane by plane, and no indices."""
        if level.extra is None:
            return self.own(level, coords, cells)
        sides, depths = level.extra  # (B*S, n, n, C) each: (x, z) and (y, z)
        last = sides.shape[1] - 1
        place = (coords.nan_to_num().clamp(-10, 10) / (2 * EXTENT) + 0.5) * last  # (B, S, N, 3) in cells of the planes
        at = [cells, place[..., ::2], place[..., 1:]]
        steps, parts = window_steps(self.count, cells), []
        for grid, where in zip((level.features.flatten(0, 1), sides, depths), at, strict=True):
            around = (where.nan_to_num().unsqueeze(-2) + steps).flatten(0, 1)
            parts.append(bilinear(grid, around.flatten(1, 2)).unflatten(1, around.shape[1:3]))  # (F, N, K, C)
        features = torch.cat(parts, 2).unflatten(0, coords.shape[:2])  # (B, S, N, 3 K, C)
        return Neighbors(features, coords.unsqueeze(-2).expand(*features.shape[:-1], 3), coords)


class PlaneCorrelation(Context):
    """The query's feature against a window on each of three planes, summed over the planes."""

    def __init__(self, config: TrackerConfig) -> None:
        super().__init__()
        self.width = config.neighbors
        convolution = partial(nn.Conv2d, config.feature_dim, config.feature_dim, 3, padding=1)
        self.smooth = nn.ModuleList(nn.Sequential(convolution(), nn.ReLU(), convolution()) for _ in range(2))

    def prepare(self, index: int, level: Level) -> Level:
        """Splat the cloud onto the (x, z) and (y, z) planes and smooth them with two convolutions each."""
        flat = level.features.flatten(2, 3).flatten(0, 1), level.points.flatten(2, 3).flatten(0, 1)
        valid, side = level.valid.flatten(2).flatten(0, 1), max(level.features.shape[2:4])
        planes = []
        for axes, smooth in zip(((0, 2), (1, 2)), self.smooth, strict=True):
            plane = splat(*flat, valid, axes, side)
            planes.append(plane + smooth(plane.movedim(-1, 1)).movedim(1, -1))
        return replace(level, extra=tuple(planes))

    def describe(self, index: int, support: Neighbors) -> Tensor:
        """The query's own feature (B, N, C)."""
        return support.features[..., 0, :]

    def forward(self, index: int, kept: Tensor, near: Neighbors) -> Tensor:
        """The query's feature (B, N, C) against the three windows of `near`, summed: (B, S, N, K)."""
        dots = torch.einsum("bnc,bsnkc->bsnk", kept, near.features) / kept.shape[-1] ** 0.5  # (B, S, N, 3 K)
        return dots.unflatten(-1, (3, self.width)).sum(-2)


def splat(features: Tensor, points: Tensor, valid: Tensor, axes: tuple[int, int], side: int) -> Tensor:
    """Average features (F, P, C) onto a plane (F, n, n, C): each cell is the mean of the cloud's that project into it.

    It is 0 where nothing does. Normalised points (F, P, 3) count where they are valid (F, P); two of their coordinates,
    `axes`, give column and row; n is `side`.
    """
    at = torch.stack([points[..., axis] for axis in axes], -1).detach()  # a list as index would be copied to the GPU
    place = ((at / (2 * EXTENT) + 0.5) * (side - 1)).round()
    inside = valid & ((place >= 0) & (place <= side - 1)).all(-1)
    index = torch.where(inside, place[..., 1] * side + place[..., 0], 0).long()
    weight = inside.to(features.dtype).unsqueeze(-1)
    total = features.new_zeros(len(features), side * side, features.shape[-1])
    count = features.new_zeros(len(features), side * side, 1)
    total = total.scatter_add(1, index.unsqueeze(-1).expand_as(features), features * weight)
    count = count.scatter_add(1, index.unsqueeze(-1), weight)
    return (total / count.clamp(min=1)).unflatten(1, (side, side))
