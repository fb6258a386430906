"""The trajectory token: what the updater is told about one track in one frame.

Paper: section 3.4, equation 7: visibility, context of all levels, motion to the next and the previous frame, pixel
position; a sinusoidal embedding of time is added (not concatenated) to the whole token.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tapip3d_lite.model.constants import constant
from tapip3d_lite.model.fourier import FACTOR, fourier


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
        evidence: (B, S, N, levels * width) from the context.
        uv: (B, S, N, 2) pixels, or None to leave them out.
        size: (H, W) of the image.
        time: (S, token width) embedding of time.

    Returns:
        (B, S, N, token width).
    """
    step = coords[:, :-1] - coords[:, 1:]  # self minus next
    still = torch.zeros_like(coords[:, :1])
    motion = torch.cat([torch.cat([step, still], 1), torch.cat([still, -step], 1)], -1)
    parts = [logits.unsqueeze(-1), evidence.to(coords.dtype), fourier(motion)]
    if uv is not None:
        sides = constant((float(size[1]), float(size[0])), uv)
        # Points far outside the image would otherwise drive the Fourier features with arbitrary phases.
        parts.append(fourier(torch.minimum(torch.maximum(uv, -2 * sides), 2 * sides) / (sides - 1)))
    return torch.cat(parts, -1) + time[:, None]
