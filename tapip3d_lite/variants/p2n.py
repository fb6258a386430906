"""Point-to-neighbourhood attention: the paper's ablation "without N2N".

query   = Linear(LN(f)) + MLP(fourier(0))          the query alone, without its neighbourhood
P2N     = block(query; context)                    in one direction, so nothing has to be pooled
"""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor, nn

from tapip3d_lite.model.blocks import Block
from tapip3d_lite.model.cloud import Level
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.n2n import CellEmbedding, Context
from tapip3d_lite.model.neighbors import Neighbors


class P2N(Context):
    """The query alone attends to the context, in one direction."""

    def __init__(self, config: TrackerConfig) -> None:
        super().__init__()
        self.embed = CellEmbedding(config)
        copies = 1 if config.share_levels else config.levels
        sizes = config.token_dim, config.context_heads, config.context_head_dim
        self.looks = nn.ModuleList(Block(*sizes, config.context_mlp_ratio, cross=True) for _ in range(copies))
        self.width = config.token_dim

    def prepare(self, index: int, level: Level) -> Level:
        """Embed each cell once, as `N2N` does."""
        return replace(level, features=self.embed.features(level.features))

    def describe(self, index: int, support: Neighbors) -> Tensor:
        """The query's token (B, N, D), without its neighbourhood."""
        own = self.embed.features(support.features[..., 0, :])
        return own + self.embed.offset(index, support.offsets[..., 0, :])

    def forward(self, index: int, kept: Tensor, near: Neighbors) -> Tensor:
        """The query's token (B, N, D) against the tokens of `near`: (B, S, N, D)."""
        context = near.features + self.embed.offset(index, near.offsets)  # (B, S, N, K, D)
        query = kept[:, None, :, None].expand(*context.shape[:3], 1, -1)  # (B, N, D) -> (B, S, N, 1, D)
        look = self.looks[index % len(self.looks)]
        return look(query.flatten(0, 2), context.flatten(0, 2)).squeeze(-2).unflatten(0, context.shape[:3])
