"""An updater without attention across tracks: each trajectory is corrected alone."""

from __future__ import annotations

from torch import Tensor, nn

from tapip3d_lite.model.blocks import Block
from tapip3d_lite.model.config import TrackerConfig


class Temporal(nn.Module):
    """The blocks over time of `Transformer`, and nothing else."""

    def __init__(self, config: TrackerConfig, inputs: int) -> None:
        super().__init__()
        self.input = nn.Linear(inputs, config.hidden)
        sizes = config.hidden, config.heads, config.head_dim, config.mlp_ratio
        self.time = nn.ModuleList(Block(*sizes) for _ in range(config.time_depth))
        self.head = nn.Linear(config.hidden, 4)
        nn.init.normal_(self.head.weight, std=1e-3)
        nn.init.zeros_(self.head.bias)

    def forward(self, tokens: Tensor, active: Tensor | None = None) -> Tensor:
        """As `Transformer.forward`: (B, S, N, inputs) to (B, S, N, 4); `active` has no meaning where tracks do not meet."""
        x = self.input(tokens).transpose(1, 2)  # (B, N, S, U)
        for block in self.time:
            x = block(x)
        return self.head(x.transpose(1, 2))
