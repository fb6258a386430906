"""Neighbourhoods that are not 3D: a fixed window in the image, and windows on three orthogonal planes.

Paper: table 6 ("fixed neighbours in 2D") and the baselines of table 1: CoTracker3, DELTA and SceneTracker look at a
window around the projection, SpatialTracker at windows on the xy, xz and yz planes of its feature volume.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from tapip3d_lite.model.cloud import Level
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.neighbors import Neighbors, gather
from tapip3d_lite.model.support import bilinear

EXTENT = 3.0  # planes cover this many standard deviations to both sides


class Window(nn.Module):
    """The K cells around the projection, row by row; cells beyond the border repeat the border's.

    Offsets stay 3D. For the correlation context features are interpolated, so that the window moves with fractions of
    a cell; points never are (see `cloud.feature_cloud`). Where invalid cells are excluded, the valid cell nearest to
    the window's centre stands in for each.
    """

    def __init__(self, config: TrackerConfig) -> None:
        super().__init__()
        self.count, self.interpolate = config.neighbors, config.context == "correlation"
        self.exclude_invalid = config.exclude_invalid

    def forward(self, level: Level, coords: Tensor, cells: Tensor) -> Neighbors:
        """See `neighbors.KNearest.forward`."""
        batch, frames, height, width = level.features.shape[:4]
        around = cells.nan_to_num().unsqueeze(-2) + window_steps(self.count, cells)  # (B, S, N, K, 2)
        # Not round(): it takes 2.5 down and 3.5 up, and a window with an even side would have a gap.
        column, row = ((x + 0.5).floor().long() for x in around.unbind(-1))
        indices = (row.clamp(0, height - 1) * width + column.clamp(0, width - 1)).flatten(0, 1)
        if self.exclude_invalid:
            indices = self._valid_only(indices, level.valid.flatten(2).flatten(0, 1), cells)
        points = gather(level.points.flatten(2, 3).flatten(0, 1), indices)
        maps = level.features.flatten(0, 1)
        if self.interpolate:
            features = bilinear(maps, around.flatten(2, 3).flatten(0, 1)).unflatten(1, indices.shape[1:])
        else:
            features = gather(maps.flatten(1, 2), indices)
        shape = (batch, frames)
        return Neighbors(features.unflatten(0, shape), points.unflatten(0, shape), coords, indices.unflatten(0, shape))

    def _valid_only(self, indices: Tensor, valid: Tensor, like: Tensor) -> Tensor:
        order = window_steps(self.count, like).square().sum(-1).sort(stable=True).indices  # from the centre outwards
        here = gather(valid.unsqueeze(-1), indices).squeeze(-1)  # (F, N, K)
        first = here[..., order].int().argmax(-1, keepdim=True)
        return torch.where(here | ~here.any(-1, keepdim=True), indices, indices[..., order].gather(-1, first))


class Planes(nn.Module):
    """A window on each of three planes, interpolated; on a level without planes just the cell of the projection."""

    def __init__(self, config: TrackerConfig) -> None:
        super().__init__()
        self.count = config.neighbors
        self.own = Window(config)
        self.own.count = 1

    def forward(self, level: Level, coords: Tensor, cells: Tensor) -> Neighbors:
        """See `neighbors.KNearest.forward`; features (B, S, N, 3 K, C), plane by plane, and no indices."""
        if level.extra is None:
            return self.own(level, coords, cells)
        sides, depths = level.extra  # (B*S, n, n, C) each: (x, z) and (y, z)
        last = sides.shape[1] - 1
        place = (coords.nan_to_num().clamp(-10, 10) / (2 * EXTENT) + 0.5) * last  # (B, S, N, 3) in cells of the planes
        at = [cells, place[..., [0, 2]], place[..., [1, 2]]]
        steps, parts = window_steps(self.count, cells), []
        for grid, where in zip((level.features.flatten(0, 1), sides, depths), at, strict=True):
            around = (where.nan_to_num().unsqueeze(-2) + steps).flatten(0, 1)
            parts.append(bilinear(grid, around.flatten(1, 2)).unflatten(1, around.shape[1:3]))
        features = torch.cat(parts, 2).unflatten(0, coords.shape[:2])
        return Neighbors(features, coords.unsqueeze(-2).expand(*features.shape[:-1], 3), coords)


def window_steps(count: int, like: Tensor) -> Tensor:
    """Steps (K, 2) = (column, row) from a window's centre to its cells, row by row.

    The window is square; where K is no square, it is the smallest square that has K cells, without the cells farthest
    from the centre (12 are 4 x 4 without corners, 32 are 6 x 6 without corners).
    """
    side = math.ceil(count**0.5)
    span = torch.arange(side, dtype=like.dtype, device=like.device) - (side - 1) / 2
    rows, columns = torch.meshgrid(span, span, indexing="ij")
    steps = torch.stack([columns, rows], -1).flatten(0, 1)
    return steps[steps.square().sum(-1).sort(stable=True).indices[:count].sort().values]


def splat(features: Tensor, points: Tensor, valid: Tensor, axes: tuple[int, int], side: int) -> Tensor:
    """Average features onto an orthogonal plane: each cell is the mean of the cloud's cells that project into it.

    Args:
        features: (F, P, C).
        points: (F, P, 3) normalised.
        valid: (F, P) bool.
        axes: which coordinates give column and row.
        side: n.

    Returns:
        (F, n, n, C), 0 where nothing projects.
    """
    place = ((points[..., list(axes)].detach() / (2 * EXTENT) + 0.5) * (side - 1)).round()
    inside = valid & ((place >= 0) & (place <= side - 1)).all(-1)
    index = torch.where(inside, place[..., 1] * side + place[..., 0], 0).long()
    weight = inside.to(features.dtype).unsqueeze(-1)
    total = features.new_zeros(len(features), side * side, features.shape[-1])
    count = features.new_zeros(len(features), side * side, 1)
    total = total.scatter_add(1, index.unsqueeze(-1).expand_as(features), features * weight)
    count = count.scatter_add(1, index.unsqueeze(-1), weight)
    return (total / count.clamp(min=1)).unflatten(1, (side, side))
