"""Building blocks: Fourier features, attention with an MLP, pooling by a learned token, the embedding of time.

    fourier(x)    = [x | sin(2^j x) | cos(2^j x)],  j = -2 … 13
    attention     = Out(softmax(q k^T / sqrt(d)) v)
    block(x; y)   = x + attention(LN(x), LN(y)),  then + MLP(LN(·))
    pool(bag)     = attention(learned token, bag)

Paper: section 3.2 (offset embedding, N2N attention and its pooling, the updating transformer). Leading dimensions
broadcast, so that what is constant over frames is projected once and not once a frame.
"""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

DEGREES = tuple(range(-2, 14))
_SCALES = tuple(2.0**degree for degree in DEGREES)
FACTOR = 1 + 2 * len(DEGREES)  # outputs per input: 33


def fourier(x: Tensor) -> Tensor:
    """[x | sin(2^j x) | cos(2^j x)] for j = -2..13, degree by degree: (..., d) to (..., 33 d).

    It tells distances from a quarter unit down to 2^-13. The cosine is taken as sin(2^j x + pi/2) in float32, as the
    released model does: the rounding of that sum reaches 1e-3 at the highest degree, so another formula would not
    reproduce its numbers.
    """
    scales = constant(_SCALES, x)
    angles = (x.unsqueeze(-2) * scales[:, None]).flatten(-2)  # (..., 16, d) -> (..., 16 d)
    return torch.cat([x, torch.sin(torch.cat([angles, angles + math.pi / 2], -1))], -1)  # (..., 33 d)


class OffsetEmbedding(nn.Sequential):
    """MLP on the Fourier features of a 3D offset: LayerNorm, (Linear, GELU) x layers, LayerNorm; D = `width`."""

    def __init__(self, layers: int, hidden: int, width: int) -> None:
        widths = [3 * FACTOR, *[hidden] * (layers - 1), width]
        parts = [part for a, b in pairwise(widths) for part in (nn.Linear(a, b), nn.GELU())]
        super().__init__(nn.LayerNorm(widths[0]), *parts, nn.LayerNorm(widths[-1]))

    def forward(self, offsets: Tensor) -> Tensor:
        """(..., 3) normalised offsets to (..., D)."""
        return super().forward(fourier(offsets))


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
        """Let x (..., Q, D) attend to context (..., M, D), whose leading dimensions broadcast against those of x.

        The bool mask (..., M) is False for tokens that must not be seen. Returns (..., Q, D).
        """
        q, k, v = self._heads(x, context)  # (..., heads, Q or M, head_dim)
        lead = torch.broadcast_shapes(q.shape[:-2], k.shape[:-2])
        q, k, v = (y.expand(*lead, *y.shape[-2:]).flatten(0, -4) for y in (q, k, v))  # (P, heads, Q or M, head_dim)
        if mask is not None:
            mask = mask[..., None, None, :].expand(*lead[:-1], 1, 1, -1).flatten(0, -4)  # (P, 1, 1, M)
        out = F.scaled_dot_product_attention(q, k, v, attn_mask=mask)  # (P, heads, Q, head_dim)
        return self.to_out(out.transpose(1, 2).flatten(2).unflatten(0, lead[:-1]))  # (..., Q, D)

    def weights(self, x: Tensor, context: Tensor) -> Tensor:
        """The softmax itself, (..., heads, Q, M), for those who want to look inside."""
        q, k, _ = self._heads(x, context)
        return (q @ k.transpose(-1, -2) / q.shape[-1] ** 0.5).softmax(-1)

    def _heads(self, x: Tensor, context: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        k, v = self.to_kv(context).chunk(2, -1)
        return tuple(y.unflatten(-1, (self.heads, -1)).transpose(-2, -3) for y in (self.to_q(x), k, v))  # heads first


class Block(nn.Module):
    """x += Attention(LN(x), LN(context)); x += MLP(LN(x)). Without `cross` the context is LN(x) itself."""

    def __init__(self, width: int, heads: int, head_dim: int, mlp_ratio: float, cross: bool = False) -> None:
        super().__init__()
        hidden = int(width * mlp_ratio)
        self.norm = nn.LayerNorm(width, eps=1e-6, elementwise_affine=False)
        self.norm_context = nn.LayerNorm(width) if cross else None
        self.attention = Attention(width, heads, head_dim)
        self.mlp = nn.Sequential(nn.Linear(width, hidden), nn.GELU(approximate="tanh"), nn.Linear(hidden, width))

    def forward(self, x: Tensor, context: Tensor | None = None, mask: Tensor | None = None) -> Tensor:
        """(..., Q, D), attending to context (..., M, D) where mask (..., M) is True; see `Attention`."""
        normed = self.norm(x)
        seen = normed if self.norm_context is None else self.norm_context(context)
        x = x + self.attention(normed, seen, mask)
        return x + self.mlp(self.norm(x))


class Pool(nn.Module):
    """One learned token gathers a bag: no norms, no residual."""

    def __init__(self, width: int, heads: int, head_dim: int) -> None:
        super().__init__()
        self.token = nn.Parameter(torch.randn(1, width) * 0.02)
        self.attention = Attention(width, heads, head_dim, bias=False)

    def forward(self, bag: Tensor) -> Tensor:
        """(..., M, D) to (..., D)."""
        token = self.token.to(bag.dtype).expand(*[1] * (bag.ndim - 2), 1, -1)  # (1, D) -> (1, ..., 1, D)
        return self.attention(token, bag).squeeze(-2)  # (..., 1, D) -> (..., D)


def time_embedding(frames: int, width: int) -> Tensor:
    """Sinusoids [sin(t w_i) | cos(t w_i)] with w_i = 10000^(-i / (width / 2)); an odd width ends in a zero column.

    They are (frames, width) float32, computed in float64.
    """
    half = width // 2
    omega = 10000.0 ** (-torch.arange(half, dtype=torch.float64) / half)
    angles = torch.arange(frames, dtype=torch.float64)[:, None] * omega  # (frames, width / 2)
    table = torch.cat([angles.sin(), angles.cos(), torch.zeros(frames, width % 2, dtype=torch.float64)], -1)
    return table.float()


def constant(values: tuple[float, ...], like: Tensor) -> Tensor:
    """A small constant tensor with the type and on the device of another one; not to be changed.

    It is made once for each device, since a GPU would have to wait for every copy from the CPU.
    """
    if torch.compiler.is_compiling():  # there it is part of the program
        return torch.tensor(values, dtype=like.dtype, device=like.device)
    return _constant(values, like.dtype, like.device)


@lru_cache(maxsize=256)
def _constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):  # trainings use it too
        return torch.tensor(values, dtype=dtype, device=device)
