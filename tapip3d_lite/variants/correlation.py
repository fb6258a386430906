"""The context of CoTracker3 and its kind: local 4D correlation.

    c_ij = <f_i, g_j> / sqrt(C)        every cell i around the query with every cell j around the estimate
    correlation = MLP(c, and optionally the K differences of the third coordinate)

CoTracker3 (and LocoTrack) compare windows by dot products; DELTA and SceneTracker add how the depths compare. Here it
is a context like any other, so only this switch differs from TAPIP3D.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.n2n import Context
from tapip3d_lite.model.neighbors import Neighbors


class Correlation(Context):
    """K x K dot products / sqrt(C) between the query's window and the estimate's, then an MLP.

    With `depth_ratio` the K differences of the third coordinate follow (in uvlogd: the logs of the depth ratios).
    """

    def __init__(self, config: TrackerConfig) -> None:
        super().__init__()
        inputs = config.neighbors * (config.neighbors + config.depth_ratio)
        self.depth_ratio, self.width = config.depth_ratio, config.token_dim
        copies, hidden = 1 if config.share_levels else config.levels, 3 * config.token_dim // 2
        self.mlps = nn.ModuleList(
            nn.Sequential(nn.Linear(inputs, hidden), nn.GELU(), nn.Linear(hidden, self.width)) for _ in range(copies)
        )

    def describe(self, index: int, support: Neighbors) -> Tensor:
        """The window around the query (B, N, K, C), without the row of the query itself, which is its middle."""
        return support.features[..., 1:, :]

    def forward(self, index: int, kept: Tensor, near: Neighbors) -> Tensor:
        """The query's window (B, N, K, C) against `near`'s: (B, S, N, D)."""
        dots = torch.einsum("bnkc,bsnjc->bsnkj", kept, near.features) / kept.shape[-1] ** 0.5  # (B, S, N, K, K)
        parts = [dots.flatten(-2)]  # (B, S, N, K K)
        if self.depth_ratio:
            parts.append(near.offsets[..., 2])
        return self.mlps[index % len(self.mlps)](torch.cat(parts, -1))
