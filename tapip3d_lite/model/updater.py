"""The trajectory updater: tokens of all tracks and frames go in, corrections of positions and visibility come out.

    token_t = [v_t | N2N of each level | fourier(tau_t - tau_{t+1}, tau_t - tau_{t-1}) | fourier(u, v)] + time_t     (2)
    (d tau, d v) = transformer(tokens of all tracks);  tau += d tau,  v += d v                                       (3)

Paper: section 3.2, equations 2 and 3. The paper writes the motion as tau_{t+1} - tau_t and appends the embedding of
time; the released code, and so ours, takes "self minus neighbour", adds time to the whole token, and appends the pixel
position. v is the logit of visibility. Attention among all N tracks would cost N^2; V virtual tracks read all of them,
talk among themselves and write back, which costs N V (CoTracker3).

An updater is any module with the signature of `Transformer.forward`.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from tapip3d_lite.model.blocks import FACTOR, Block, constant, fourier
from tapip3d_lite.model.config import TrackerConfig


def token_width(context_width: int, levels: int, use_uv: bool) -> int:
    """Channels of the token: 1 + levels * context_width + 6 * 33 (+ 2 * 33)."""
    return 1 + levels * context_width + 6 * FACTOR + (2 * FACTOR if use_uv else 0)


def trajectory_tokens(
    coords: Tensor, logits: Tensor, evidence: Tensor, uv: Tensor | None, size: tuple[int, int], time: Tensor
) -> Tensor:
    """Assemble tokens.

    Args:
        coords: (B, S, N, 3) normalised.
        logits: (B, S, N) visibility before the sigmoid.
        evidence: (B, S, N, levels * width), what the context found at all levels.
        uv: (B, S, N, 2) pixels, or None to leave them out.
        size: (H, W) of the image.
        time: (S, token width) embedding of time.

    Returns:
        (B, S, N, token width).
    """
    step = coords[:, :-1] - coords[:, 1:]  # (B, S - 1, N, 3), self minus next
    still = torch.zeros_like(coords[:, :1])  # (B, 1, N, 3)
    motion = torch.cat([torch.cat([step, still], 1), torch.cat([still, -step], 1)], -1)  # (B, S, N, 6)
    parts = [logits.unsqueeze(-1), evidence.to(coords.dtype), fourier(motion)]  # (B, S, N, 1 | L width | 6 * 33)
    if uv is not None:
        sides = constant((float(size[1]), float(size[0])), uv)
        # Points far outside the image would otherwise drive the Fourier features with arbitrary phases.
        parts.append(fourier(torch.minimum(torch.maximum(uv, -2 * sides), 2 * sides) / (sides - 1)))
    return torch.cat(parts, -1) + time[:, None]  # (B, S, N, token width) + (S, 1, token width)


class Transformer(nn.Module):
    """Blocks over time; after each group the virtual tracks read the points, talk among themselves and write back."""

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
        self.register_parameter("keep", None)  # trials
        self.register_parameter("again", None)
        self.spread = None
        # An untrained tracker should leave points nearly where they are.
        for head in filter(None, (self.head, self.vis_head)):
            nn.init.normal_(head.weight, std=1e-3)
            nn.init.zeros_(head.bias)

    def forward(self, tokens: Tensor, active: Tensor | None = None) -> Tensor:
        """Corrections (B, S, N, at least 4) from trajectory tokens (B, S, N, inputs).

        They are dx, dy, dz (normalised coordinates) and the change of the visibility logit. `active` (B, N) bool says
        which tracks exist, None: all; the others are seen by nobody.
        """
        points = self.input(tokens)  # (B, S, N, inputs) -> (B, S, N, U)
        batch, frames, count = points.shape[:3]
        x = torch.cat([points, self.virtual.to(points.dtype).expand(batch, frames, -1, -1)], 2)  # (B, S, N + V, U)
        first = x
        mask = None if active is None else (active | ~active.any(-1, keepdim=True))[:, None]  # (B, 1, N)
        for i, block in enumerate(self.time):
            x = self._again(x, first, i)
            x = block(x.transpose(1, 2)).transpose(1, 2)  # attention over S, for each track
            if i % self.every == 0:
                x = self._again(x, first, len(self.time) + i // self.every)
                points, virtual = x[:, :, :count], x[:, :, count:]
                j = i // self.every
                virtual = self.mix[j](self.gather[j](virtual, points, mask))  # (B, S, V, U)
                x = torch.cat([self.scatter[j](points, virtual), virtual], 2)
        points = x[:, :, :count]  # (B, S, N, U)
        out = self.head(points)
        out = out if self.vis_head is None else torch.cat([out, self.vis_head(points)], -1)
        return out if self.spread is None else torch.cat([out, self.spread(points)], -1)

    def _again(self, x: Tensor, first: Tensor, part: int) -> Tensor:
        return x if self.keep is None else self.keep[part] * x + self.again[part] * first
