"""The contexts of other systems: local 4D correlation, and summed correlations on three planes.

Paper: the baselines of table 1. CoTracker3 (and LocoTrack) compare every cell around the query with every cell around
the estimate by dot products; DELTA and SceneTracker add how the depths compare; SpatialTracker sums the correlations
of three planes. Here they are contexts like any other, so only this switch differs from TAPIP3D.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from tapip3d_lite.model.cloud import Level
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.contexts import Context
from tapip3d_lite.model.grids import splat
from tapip3d_lite.model.neighbors import Neighbors


class Correlation(Context):
    """K x K dot products / sqrt(C) between the query's window and the estimate's, then an MLP.

    With `depth_ratio` the K differences of the third coordinate follow (in uvlogd: the logs of the depth ratios).
    """

    def __init__(self, config: TrackerConfig) -> None:
        super().__init__()
        count = config.neighbors
        inputs = count * count + (count if config.depth_ratio else 0)
        self.depth_ratio, self.width = config.depth_ratio, config.token_dim
        copies = 1 if config.share_levels else config.levels
        hidden = 3 * config.token_dim // 2
        layers = (
            nn.Sequential(nn.Linear(inputs, hidden), nn.GELU(), nn.Linear(hidden, self.width)) for _ in range(copies)
        )
        self.mlps = nn.ModuleList(layers)

    def describe(self, index: int, support: Neighbors) -> Tensor:
        """The window around the query (B, N, K, C), without the row of the query itself, which is its middle."""
        return support.features[..., 1:, :]

    def forward(self, index: int, kept: Tensor, near: Neighbors) -> Tensor:
        """See `Context.forward`."""
        dots = torch.einsum("bnkc,bsnjc->bsnkj", kept, near.features) / kept.shape[-1] ** 0.5
        parts = [dots.flatten(-2)]
        if self.depth_ratio:
            parts.append(near.offsets[..., 2])
        return self.mlps[index % len(self.mlps)](torch.cat(parts, -1))


class PlaneCorrelation(Context):
    """The query's feature against a window on each of three planes, summed over the planes."""

    def __init__(self, config: TrackerConfig) -> None:
        super().__init__()
        self.width = config.neighbors
        channels = config.feature_dim
        self.smooth = nn.ModuleList(
            nn.Sequential(
                nn.Conv2d(channels, channels, 3, padding=1), nn.ReLU(), nn.Conv2d(channels, channels, 3, padding=1)
            )
            for _ in range(2)
        )

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
        """See `Context.forward`."""
        dots = torch.einsum("bnc,bsnkc->bsnk", kept, near.features) / kept.shape[-1] ** 0.5
        return dots.unflatten(-1, (3, self.width)).sum(-2)
