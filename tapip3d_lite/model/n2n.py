"""What a point makes of its surroundings: neighbourhood-to-neighbourhood (N2N) attention.

    token_j   = Linear(LN(f_j)) + MLP(fourier(o_j))                       of every cell j of a neighbourhood
    support'  = block(support; context)      context' = block(context; support)
    N2N       = pool(support') + pool(context')

Paper: section 3.2 describes it in words, without a numbered equation. The query's neighbourhood in its own frame
(support) and the estimate's neighbourhood in frame t (context, K tokens) attend to each other in both directions, then
each bag is pooled by a learned token. The paper's support has K tokens; the released code's has K + 1, the query itself
first, and so has ours.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from tapip3d_lite.model.blocks import Block, OffsetEmbedding, Pool
from tapip3d_lite.model.cloud import Level
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.neighbors import Neighbors


class Context(nn.Module):
    """Base of all contexts; a custom one replaces `forward` and sets `width`.

    `prepare` and `describe` run once a window, `forward` once an iteration and level.

    Attributes:
        width: channels of the output at each level.
    """

    width: int

    def prepare(self, index: int, level: Level) -> Level:
        """Transform level `index` of the (normalised) cloud before neighbourhoods are collected from it."""
        return level

    def describe(self, index: int, support: Neighbors) -> Any:
        """What to remember of the queries.

        Args:
            index: level of the cloud.
            support: (B, N, 1 + K, ...), the query itself (its feature interpolated, its offset 0), then the
                neighbourhood in its own frame; features are the encoder's, coordinates normalised.

        Returns:
            A tensor (B, N, ...), given to `forward` as `kept`; or an object of tensors that is cut by `[:, rows]` as
            a tensor is, and changed by `map(function of a tensor)`.
        """
        return support.features

    def forward(self, index: int, kept: Any, near: Neighbors) -> Tensor:
        """Compare what is around the current estimate with what was around the query.

        Args:
            index: level of the cloud.
            kept: (B, N, ...) from `describe`.
            near: (B, S, N, K, ...), neighbourhood of the estimate in every frame, collected from `prepare`'s level.

        Returns:
            (B, S, N, width).
        """
        raise NotImplementedError


class CellEmbedding(nn.Module):
    """Feature and offset of a cell to a token: Linear(LayerNorm(f)) + MLP(fourier(offset))."""

    def __init__(self, config: TrackerConfig) -> None:
        super().__init__()
        same = config.token_dim == config.feature_dim
        self.norm = nn.LayerNorm(config.feature_dim)
        self.project = nn.Identity() if same else nn.Linear(config.feature_dim, config.token_dim)
        copies = 1 if config.share_levels else config.levels
        sizes = config.offset_layers, config.offset_dim, config.token_dim
        self.offsets = nn.ModuleList(OffsetEmbedding(*sizes) for _ in range(copies))

    def features(self, features: Tensor) -> Tensor:
        """(..., C) to (..., D)."""
        return self.project(self.norm(features))

    def offset(self, index: int, offsets: Tensor) -> Tensor:
        """(..., 3) normalised offsets to (..., D), by the MLP of level `index`."""
        return self.offsets[index % len(self.offsets)](offsets)


class PairAttention(nn.Module):
    """Two bags of tokens to one vector: cross-attention both ways, pooling of each, sum."""

    def __init__(self, config: TrackerConfig) -> None:
        super().__init__()
        sizes = config.token_dim, config.context_heads, config.context_head_dim
        self.support_from_context = Block(*sizes, config.context_mlp_ratio, cross=True)
        self.context_from_support = Block(*sizes, config.context_mlp_ratio, cross=True)
        self.pool_support = Pool(*sizes)
        self.pool_context = Pool(*sizes)

    def forward(self, support: Tensor, context: Tensor) -> Tensor:
        """Support (P, K + 1, D) and context (P, K, D) of P pairs to (P, D)."""
        support, context = self.support_from_context(support, context), self.context_from_support(context, support)
        return self.pool_support(support) + self.pool_context(context)


class N2N(Context):
    """Neighbourhood-to-neighbourhood attention, with its own weights at each level unless `share_levels`."""

    def __init__(self, config: TrackerConfig) -> None:
        super().__init__()
        self.embed = CellEmbedding(config)
        copies = 1 if config.share_levels else config.levels
        self.pairs = nn.ModuleList(PairAttention(config) for _ in range(copies))
        self.use_features = config.use_features
        self.width = config.token_dim * (2 if config.use_features else 1)

    def prepare(self, index: int, level: Level) -> Level:
        """Embed each cell once, not once for every neighbourhood that contains it."""
        return replace(level, features=self.embed.features(level.features))

    def describe(self, index: int, support: Neighbors) -> Any:
        """Support tokens (B, N, 1 + K, D); with `use_features` the query's embedded feature follows as one more row."""
        features = self.embed.features(support.features)
        tokens = features + self.embed.offset(index, support.offsets)
        return torch.cat([tokens, features[..., :1, :]], -2) if self.use_features else tokens

    def forward(self, index: int, kept: Any, near: Neighbors) -> Tensor:
        """Support tokens `kept` against the tokens of `near`, for every frame and track: (B, S, N, width)."""
        context = near.features + self.embed.offset(index, near.offsets)  # (B, S, N, K, D)
        lead = context.shape[:3]
        kept = kept[:, None].expand(*lead, *kept.shape[2:])  # (B, N, K + 1, D) -> (B, S, N, K + 1, D)
        support = kept[..., : kept.shape[-2] - self.use_features, :]
        pair = self.pairs[index % len(self.pairs)]
        out = pair(support.flatten(0, 2), context.flatten(0, 2)).unflatten(0, lead)  # (P, D) -> (B, S, N, D)
        return torch.cat([out, kept[..., -1, :]], -1) if self.use_features else out
