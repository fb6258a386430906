"""Fourier features: how a small network is told about distances from a quarter unit down to 2^-13.

Paper: section 3.3 (relative position embedding) and 3.4 (embedding of motion and pixel coordinates).
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor, nn

from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.constants import constant

DEGREES = tuple(range(-2, 14))
_SCALES = tuple(2.0**degree for degree in DEGREES)
FACTOR = 1 + 2 * len(DEGREES)  # outputs per input


def fourier(x: Tensor) -> Tensor:
    """[x | sin(2^j x) | cos(2^j x)] for j = -2..13, degree by degree.

    The cosine is taken as sin(2^j x + pi/2) in float32, as the released model does: the rounding of that sum reaches
    1e-3 at the highest degree, so another formula would not reproduce its numbers.

    Args:
        x: (..., d) float32 or float64.

    Returns:
        (..., 33 d).
    """
    scales = constant(_SCALES, x)
    angles = (x.unsqueeze(-2) * scales[:, None]).flatten(-2)  # (..., 16 d)
    return torch.cat([x, torch.sin(torch.cat([angles, angles + math.pi / 2], -1))], -1)


class OffsetEmbedding(nn.Sequential):
    """MLP on the Fourier features of a 3D offset: LayerNorm, (Linear, GELU) x layers, LayerNorm."""

    def __init__(self, config: TrackerConfig) -> None:
        widths = [3 * FACTOR, *[config.offset_dim] * (config.offset_layers - 1), config.token_dim]
        layers = [part for a, b in pairwise(widths) for part in (nn.Linear(a, b), nn.GELU())]
        super().__init__(nn.LayerNorm(widths[0]), *layers, nn.LayerNorm(widths[-1]))

    def forward(self, offsets: Tensor) -> Tensor:
        """(..., 3) normalised offsets to (..., D)."""
        return super().forward(fourier(offsets))


def time_embedding(frames: int, width: int) -> Tensor:
    """Sinusoids [sin(t w_i) | cos(t w_i)] with w_i = 10000^(-i / (width / 2)); an odd width ends in a zero column.

    Returns:
        (frames, width) float32, computed in float64.
    """
    half = width // 2
    omega = 10000.0 ** (-torch.arange(half, dtype=torch.float64) / half)
    angles = torch.arange(frames, dtype=torch.float64)[:, None] * omega
    table = torch.cat([angles.sin(), angles.cos(), torch.zeros(frames, width % 2, dtype=torch.float64)], -1)
    return table.float()
