"""The same N2N numbers with a third of the arithmetic: the context that inference and training run by default.

`model.n2n` is the definition, whose weights are read here. All savings are exact algebra:

- What depends on queries only is computed once a window (`FoldedPair`), not for every frame and iteration.
- With one head, scores (W_q x)(W_k y) = (W_k^T W_q x) y: the key projection moves into the static support queries,
  the query projection into the static support keys, and W_o W_v becomes one matrix or part of the static values.
  Terms that are equal for all keys vanish in the softmax; its rows sum to one, so constants move into the values.
- Only the pooled bag leaves a block. The pooling token is a constant, so its keys are one vector a head, and the
  MLP's second layer acts on the pooled hidden vector instead of on every token.

With several heads attention is general, and the other savings remain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tapip3d_lite.model.blocks import Attention, Block, Pool
from tapip3d_lite.model.n2n import N2N, PairAttention
from tapip3d_lite.model.neighbors import Neighbors


class FoldedN2N(N2N):
    """`N2N` with the same weights and numbers, folded anew in each window, so that training needs nothing else."""

    def describe(self, index: int, support: Neighbors) -> FoldedPair:
        """What does not depend on the estimates, computed once a window."""
        tokens = super().describe(index, support)
        with torch.autocast(tokens.device.type, enabled=False):
            return FoldedPair.fold(self, index, _precise(tokens))

    def forward(self, index: int, kept: FoldedPair, near: Neighbors) -> Tensor:
        """The support in `kept` against `near` (B, S, N, K, ...): (B, S, N, width)."""
        return kept.compare(near)


@dataclass(frozen=True)
class FoldedPair:
    """What one level of a window knows of its queries and weights; `kept` of `FoldedN2N`.

    M = K + 1. Everything but `pair`, `offsets` and `pools` starts with (B, N) and is cut by indexing.

    Attributes:
        pair: the weights.
        offsets: embeds the context's offsets.
        pools: the folded ends of the two blocks.
        support: (B, N, M, D) tokens, with one head plus the constant part of what attention adds to them.
        query: (B, N, D), the query's own feature if it is appended.
        scores: (B, N, D, 2 M), normalised context tokens to scores of both directions; None with several heads,
        bias: (B, N, 1, M), added to the scores of the second direction,
        values: (B, N, M, D), what the second direction adds to a context token,
        mixed: (D, D), normalised context tokens to what the first direction adds.
    """

    pair: PairAttention
    offsets: nn.Module
    pools: tuple[FoldedPool, FoldedPool]
    support: Tensor
    query: Tensor | None = None
    scores: Tensor | None = None
    bias: Tensor | None = None
    values: Tensor | None = None
    mixed: Tensor | None = None

    @classmethod
    def fold(cls, context: N2N, index: int, kept: Tensor) -> FoldedPair:
        """Fold the weights of level `index` with its support tokens (B, N, 1 + K (+ 1), D), from `N2N.describe`."""
        pair, offsets = (parts[index % len(parts)] for parts in (context.pairs, context.embed.offsets))
        query = None
        if context.use_features:
            kept, query = kept[..., :-1, :], kept[..., -1, :]
        first, second = _blocks(pair)
        pools = FoldedPool.of(pair.pool_support, first), FoldedPool.of(pair.pool_context, second)
        if first.attention.heads > 1:
            return cls(pair, offsets, pools, kept, query)
        gain, shift = first.norm_context.weight, first.norm_context.bias
        (to_key, _), (to_value, value_bias) = _key_and_value(first.attention)
        out = first.attention.to_out
        looks = first.attention.to_q(first.norm(kept)) @ to_key * gain / len(to_key) ** 0.5  # (B, N, M, D)
        mixed = gain[:, None] * (out.weight @ to_value).T
        constant = out(to_value @ shift + value_bias)
        keys, values = second.attention.to_kv(second.norm_context(kept)).chunk(2, -1)
        keys = keys / keys.shape[-1] ** 0.5
        to_query = second.attention.to_q
        scores = torch.cat([looks, keys @ to_query.weight], -2).transpose(-1, -2).contiguous()
        bias = (keys @ to_query.bias).unsqueeze(-2)
        return cls(pair, offsets, pools, kept + constant, query, scores, bias, second.attention.to_out(values), mixed)

    def __getitem__(self, index: tuple) -> FoldedPair:
        return self._changed(lambda part: part[index], "mixed")

    def map(self, change: Callable[[Tensor], Tensor]) -> FoldedPair:
        """The same with other tensors."""
        pools = tuple(FoldedPool(*(change(getattr(pool, f.name)) for f in fields(pool))) for pool in self.pools)
        return replace(self._changed(change), pools=pools)

    def _changed(self, change: Callable[[Tensor], Tensor], *kept: str) -> FoldedPair:
        names = [f.name for f in fields(self) if f.name not in ("pair", "offsets", "pools", *kept)]
        parts = {name: getattr(self, name) for name in names}
        return replace(self, **{name: change(part) for name, part in parts.items() if part is not None})

    def compare(self, near: Neighbors) -> Tensor:
        """Neighbourhoods (B, S, N, K, ...) to (B, S, N, width)."""
        # Tracks before frames: then each track's static matrix meets all its frames in one product.
        offsets = self.offsets(near.offsets.transpose(1, 2))
        tokens = _precise(offsets + near.features.transpose(1, 2)).contiguous()  # (B, N, S, K, D)
        bags = self._several_heads(tokens) if self.scores is None else self._one_head(tokens)
        out = sum(pool(block, bag) for pool, block, bag in zip(self.pools, _blocks(self.pair), bags, strict=True))
        out = out.unflatten(0, tokens.shape[:3]).transpose(1, 2)
        if self.query is None:
            return out
        return torch.cat([out, self.query[:, None].expand(-1, out.shape[1], -1, -1)], -1)

    def _one_head(self, tokens: Tensor) -> tuple[Tensor, Tensor]:
        batch, count, frames, near, width = tokens.shape
        first, second = _blocks(self.pair)
        normed, ratio = _normalised(tokens, first.norm_context.eps, second.norm.eps)
        rows = normed.view(batch * count, frames * near, width)
        scores = (rows @ self.scores.flatten(0, 1)).unflatten(0, (batch, count))  # (B, N, S K, 2 M)
        one, two = scores.chunk(2, -1)
        one = one.unflatten(2, (frames, near)).softmax(-2).flatten(0, 2)  # (P, K, M), over the context
        support = torch.bmm(one.transpose(1, 2), (normed @ self.mixed).flatten(0, 2))  # (P, M, D)
        support = support.view(batch, count, frames, -1, width) + self.support[:, :, None]
        two = torch.addcmul(self.bias, two, ratio.flatten(2, 3)).softmax(-1).flatten(0, 1)  # (B N, S K, M)
        context = torch.baddbmm(tokens.view_as(rows), two, self.values.flatten(0, 1))
        return support.flatten(0, 2), context.view(-1, near, width)

    def _several_heads(self, tokens: Tensor) -> tuple[Tensor, Tensor]:
        first, second = _blocks(self.pair)
        support = self.support[:, :, None]  # (B, N, 1, M, D)
        one = support + first.attention(first.norm(support), first.norm_context(tokens))
        two = tokens + second.attention(second.norm(tokens), second.norm_context(support))
        return _precise(one).flatten(0, 2), _precise(two).flatten(0, 2)


@dataclass(frozen=True)
class FoldedPool:
    """MLP and pooling of a block's bag without a second layer, keys and values of each token; H heads.

    Attributes:
        keys: (D, H) and
        hidden_keys: (hidden, H), tokens and hidden layer to scores.
        outputs: (H D, D) and
        hidden_outputs: (H hidden, D), pooled tokens and pooled hidden layer to the output.
        bias: (D,).
    """

    keys: Tensor
    hidden_keys: Tensor
    outputs: Tensor
    hidden_outputs: Tensor
    bias: Tensor

    @classmethod
    def of(cls, pool: Pool, block: Block) -> FoldedPool:
        """Fold the weights of a pooling and of the last layer before it."""
        attention, last = pool.attention, block.mlp[-1]
        heads, width = attention.heads, pool.token.shape[-1]
        (to_key, _), (to_value, _) = _key_and_value(attention)
        to_key, to_value = (x.view(heads, -1, width) for x in (to_key, to_value))
        query = attention.to_q(pool.token).view(heads, 1, -1) / to_key.shape[1] ** 0.5
        keys = (query @ to_key).squeeze(1)  # (H, D)
        to_out = attention.to_out.weight.view(width, heads, -1).permute(1, 2, 0)  # (H, head_dim, D)
        outputs = to_value.transpose(1, 2) @ to_out  # (H, D, D)
        hidden = last.weight.T @ outputs
        bias = last.bias @ outputs.sum(0) + attention.to_out.bias
        return cls(keys.T, (keys @ last.weight).T, outputs.flatten(0, 1), hidden.flatten(0, 1), bias)

    def __call__(self, block: Block, bag: Tensor) -> Tensor:
        """(P, M, D) before the block's MLP to (P, D)."""
        hidden = block.mlp[1](block.mlp[0](block.norm(bag)))
        weights = (bag @ self.keys + hidden @ self.hidden_keys).softmax(-2).transpose(-1, -2)  # (P, H, M)
        pooled = (weights @ x for x in (bag, hidden))
        bag, hidden = (x.flatten(1) for x in pooled)
        return torch.addmm(torch.addmm(self.bias, bag, self.outputs), hidden, self.hidden_outputs)


def _blocks(pair: PairAttention) -> tuple[Block, Block]:
    return pair.support_from_context, pair.context_from_support


def _key_and_value(attention: Attention) -> tuple[tuple[Tensor, Tensor | None], tuple[Tensor, Tensor | None]]:
    """(weight, bias) of the key and of the value projection."""
    weights, bias = attention.to_kv.weight.chunk(2), attention.to_kv.bias
    biases = (None, None) if bias is None else bias.chunk(2)
    return tuple(zip(weights, biases, strict=True))


def _normalised(x: Tensor, eps: float, other: float) -> tuple[Tensor, Tensor]:
    """LayerNorm without gain, and the factor (..., 1) that turns it into the one with another eps."""
    if torch.is_grad_enabled():  # the statistics of native_layer_norm carry no gradient
        variance = (x - x.mean(-1, keepdim=True)).square().mean(-1, keepdim=True)  # 4 times faster than x.var
        return F.layer_norm(x, x.shape[-1:], eps=eps), ((variance + eps) / (variance + other)).sqrt()
    normed, _, inverse = torch.native_layer_norm(x, x.shape[-1:], None, None, eps)
    return normed, (1 + inverse.square() * (other - eps)).rsqrt()


def _precise(x: Tensor) -> Tensor:
    """At least float32, also where autocast made it shorter."""
    return x.to(torch.promote_types(x.dtype, torch.float32))
