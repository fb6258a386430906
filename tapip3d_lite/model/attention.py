"""Attention blocks shared by the context and the updater: cross- or self-attention with an MLP, and pooling.

Paper: equation 4 (cross-attention of two neighbourhoods), 6 (pooling by a learned token), section 3.4 (updater).
Leading dimensions broadcast, so what is constant over frames is projected once and not once a frame.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

_HIDDEN = 2**21  # floats of an MLP's hidden layer that exist at once: 8 MiB, which stay near a CPU's cores


class Attention(nn.Module):
    """Multi-head attention: Out(softmax(q k^T / sqrt(head_dim)) v)."""

    def __init__(self, width: int, heads: int, head_dim: int, bias: bool = True) -> None:
        super().__init__()
        inner = heads * head_dim
        self.heads = heads
        self.to_q = nn.Linear(width, inner, bias)
        self.to_kv = nn.Linear(width, 2 * inner, bias)
        self.to_out = nn.Linear(inner, width)

    def forward(self, x: Tensor, context: Tensor, mask: Tensor | None = None) -> Tensor:
        """Let x look at context.

        Args:
            x: (..., Q, D).
            context: (..., M, D); leading dimensions broadcast against those of x.
            mask: (..., M) bool, False for tokens that must not be seen, or None.

        Returns:
            (..., Q, D).
        """
        q, k, v = self._heads(x, context)
        lead = torch.broadcast_shapes(q.shape[:-2], k.shape[:-2])
        q, k, v = (y.expand(*lead, *y.shape[-2:]).flatten(0, -4) for y in (q, k, v))
        if mask is not None:
            mask = mask[..., None, None, :].expand(*lead[:-1], 1, 1, -1).flatten(0, -4)
        out = F.scaled_dot_product_attention(q, k, v, attn_mask=mask)  # (P, heads, Q, head_dim)
        return self.to_out(out.transpose(1, 2).flatten(2).unflatten(0, lead[:-1]))

    def weights(self, x: Tensor, context: Tensor) -> Tensor:
        """The softmax itself, (..., heads, Q, M), for those who want to look inside."""
        q, k, _ = self._heads(x, context)
        return (q @ k.transpose(-1, -2) / q.shape[-1] ** 0.5).softmax(-1)

    def _heads(self, x: Tensor, context: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        k, v = self.to_kv(context).chunk(2, -1)
        return tuple(y.unflatten(-1, (self.heads, -1)).transpose(-2, -3) for y in (self.to_q(x), k, v))


class Block(nn.Module):
    """x += Attention(LN(x), context); x += MLP(LN(x)). Without cross the context is LN(x) itself."""

    def __init__(self, width: int, heads: int, head_dim: int, mlp_ratio: float, cross: bool = False) -> None:
        super().__init__()
        hidden = int(width * mlp_ratio)
        self.norm = nn.LayerNorm(width, eps=1e-6, elementwise_affine=False)
        self.norm_context = nn.LayerNorm(width) if cross else None
        self.attention = Attention(width, heads, head_dim)
        self.mlp = nn.Sequential(nn.Linear(width, hidden), nn.GELU(approximate="tanh"), nn.Linear(hidden, width))

    def forward(self, x: Tensor, context: Tensor | None = None, mask: Tensor | None = None) -> Tensor:
        """(..., Q, D), looking at context (..., M, D) where mask (..., M) is True; see `Attention`."""
        normed = self.norm(x)
        seen = normed if self.norm_context is None else self.norm_context(context)
        x = x + self.attention(normed, seen, mask)
        if torch.is_grad_enabled() or x.device.type != "cpu":
            return x + self.mlp(self.norm(x))
        rows = x.flatten(0, -2).split(max(1, _HIDDEN // self.mlp[0].out_features))  # on a CPU sooner in less memory
        return torch.cat([part + self.mlp(self.norm(part)) for part in rows]).view_as(x)


class Pool(nn.Module):
    """One learned token gathers a bag: no norms, no residual."""

    def __init__(self, width: int, heads: int, head_dim: int) -> None:
        super().__init__()
        self.token = nn.Parameter(torch.randn(1, width) * 0.02)
        self.attention = Attention(width, heads, head_dim, bias=False)

    def forward(self, bag: Tensor) -> Tensor:
        """(..., M, D) to (..., D)."""
        token = self.token.to(bag.dtype).expand(*[1] * (bag.ndim - 2), 1, -1)
        return self.attention(token, bag).squeeze(-2)
