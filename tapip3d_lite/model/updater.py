"""The trajectory updater: trajectories talk over time, and to each other through a few virtual tracks.

Paper: section 3.4. Attention among all N tracks would cost N^2; V virtual tracks read all of them, talk among
themselves and write back, which costs N V.

An updater is any module with the signature of `Transformer.forward`.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from tapip3d_lite.model.attention import Block
from tapip3d_lite.model.config import TrackerConfig


class Transformer(nn.Module):
    """Blocks over time, each group followed by virtual <- points, virtual <- virtual, points <- virtual."""

    def __init__(self, config: TrackerConfig, inputs: int) -> None:
        super().__init__()
        sizes = config.hidden, config.heads, config.head_dim, config.mlp_ratio
        self.every = config.time_depth // config.space_depth
        self.input = nn.Linear(inputs, config.hidden)
        self.virtual = nn.Parameter(torch.randn(1, 1, config.virtual_tracks, config.hidden))
        self.time = nn.ModuleList(Block(*sizes) for _ in range(config.time_depth))
        self.gather = nn.ModuleList(Block(*sizes, cross=True) for _ in range(config.space_depth))
        self.mix = nn.ModuleList(Block(*sizes) for _ in range(config.space_depth))
        self.scatter = nn.ModuleList(Block(*sizes, cross=True) for _ in range(config.space_depth))
        self.head = nn.Linear(config.hidden, config.outputs - 2 if config.separate_vis_head else config.outputs)
        self.vis_head = nn.Linear(config.hidden, 2) if config.separate_vis_head else None
        # An untrained tracker should leave points nearly where they are.
        for head in filter(None, (self.head, self.vis_head)):
            nn.init.normal_(head.weight, std=1e-3)
            nn.init.zeros_(head.bias)

    def forward(self, tokens: Tensor, active: Tensor | None = None) -> Tensor:
        """Propose corrections.

        Args:
            tokens: (B, S, N, inputs) trajectory tokens.
            active: (B, N) bool, tracks that exist; the others are seen by nobody. None: all.

        Returns:
            (B, S, N, at least 4): dx, dy, dz (normalised coordinates), change of the visibility logit.
        """
        points = self.input(tokens)
        batch, frames, count = points.shape[:3]
        x = torch.cat([points, self.virtual.to(points.dtype).expand(batch, frames, -1, -1)], 2)  # (B, S, N + V, U)
        mask = None if active is None else (active | ~active.any(-1, keepdim=True))[:, None]  # (B, 1, N)
        for i, block in enumerate(self.time):
            x = block(x.transpose(1, 2)).transpose(1, 2)
            if i % self.every == 0:
                points, virtual = x[:, :, :count], x[:, :, count:]
                j = i // self.every
                virtual = self.mix[j](self.gather[j](virtual, points, mask))
                x = torch.cat([self.scatter[j](points, virtual), virtual], 2)
        points = x[:, :, :count]
        out = self.head(points)
        return out if self.vis_head is None else torch.cat([out, self.vis_head(points)], -1)


class Temporal(nn.Module):
    """The same blocks over time and no attention across tracks: each trajectory is corrected alone."""

    def __init__(self, config: TrackerConfig, inputs: int) -> None:
        super().__init__()
        self.input = nn.Linear(inputs, config.hidden)
        sizes = config.hidden, config.heads, config.head_dim, config.mlp_ratio
        self.time = nn.ModuleList(Block(*sizes) for _ in range(config.time_depth))
        self.head = nn.Linear(config.hidden, 4)
        nn.init.normal_(self.head.weight, std=1e-3)
        nn.init.zeros_(self.head.bias)

    def forward(self, tokens: Tensor, active: Tensor | None = None) -> Tensor:
        """See `Transformer.forward`; `active` has no meaning where tracks do not meet."""
        x = self.input(tokens).transpose(1, 2)
        for block in self.time:
            x = block(x)
        return self.head(x.transpose(1, 2))
