"""A fixed window in the image in place of the K nearest in 3D: the paper's ablation "fixed neighbours in 2D".

    N_t(x) = the K cells around the projection of x,   offsets o_j = p_j - x still in 3D

CoTracker3, DELTA and SceneTracker look at such a window, too.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from tapip3d_lite.model.cloud import Level
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.neighbors import Neighbors, bilinear, gather


class WindowNeighborhood(nn.Module):
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
        """The cells around `cells` (B, S, N, 2), in the arguments and result of `KNearest.forward`."""
        batch, frames, height, width = level.features.shape[:4]
        around = cells.nan_to_num().unsqueeze(-2) + window_steps(self.count, cells)  # (B, S, N, K, 2)
        # Not round(): it takes 2.5 down and 3.5 up, and a window with an even side would have a gap.
        column, row = ((x + 0.5).floor().long() for x in around.unbind(-1))
        indices = (row.clamp(0, height - 1) * width + column.clamp(0, width - 1)).flatten(0, 1)  # (F, N, K)
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
