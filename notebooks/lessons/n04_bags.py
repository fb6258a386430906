"""Exercises of notebook 04 on whole bags: two that look at each other, and one that a learned token gathers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from lessons.checker import Exercise, Mistake

Layer = Callable[..., Tensor]
Weights = tuple[Tensor, Tensor, Tensor, Tensor]  # W_q, W_k, W_v (A d, D) and W_o (D, A d), used as x @ W.T


@dataclass(frozen=True, repr=False)
class Look:
    """The layers of one direction, named as in the library's `Block`.

    Attributes:
        norm: of tokens that look.
        norm_context: of tokens that are seen.
        attention: (x, y) to what x finds in y.
        mlp: of each token.
    """

    norm: Layer
    norm_context: Layer
    attention: Layer
    mlp: Layer

    def __repr__(self) -> str:
        return "Look(norm, norm_context, attention, mlp)"


def both_ways(support: Tensor, context: Tensor, first: Look, second: Look) -> tuple[Tensor, Tensor]:
    """Support (..., K + 1, D) and context (..., K, D) look at each other at once, then each token passes its MLP."""
    return _one_way(support, context, first), _one_way(context, support, second)


def _one_way(x: Tensor, y: Tensor, look: Look, *slips: str) -> Tensor:
    normed = x if "raw looks" in slips else look.norm(x)
    seen = look.norm(y) if "same norm" in slips else y if "raw seen" in slips else look.norm_context(y)
    start = look.norm(x) if "normed stream" in slips else x
    found = look.attention(normed, seen)
    after = found if "alone" in slips else start + found
    if "no MLP" in slips:
        return after
    inside = x if "early MLP" in slips else after
    mlp = look.mlp(
        inside if "raw MLP" in slips else (look.norm_context if "other norm" in slips else look.norm)(inside)
    )
    return mlp if "MLP alone" in slips else after + mlp


def _linear(rng: np.random.Generator, outputs: int, inputs: int) -> Layer:
    weight = torch.from_numpy(rng.normal(size=(outputs, inputs)) / inputs**0.5)
    bias = torch.from_numpy(rng.normal(size=outputs))
    return lambda x: F.linear(x, weight.to(x.dtype), bias.to(x.dtype))


def _norm(gain: Tensor | None = None, shift: Tensor | None = None) -> Layer:
    def norm(x: Tensor) -> Tensor:
        own = (part if part is None else part.to(x.dtype) for part in (gain, shift))
        return F.layer_norm(x, x.shape[-1:], *own, eps=1e-6 if gain is None else 1e-5)

    return norm


def _look(rng: np.random.Generator, width: int) -> Look:
    to_q, to_k, to_v, to_out, one, two = (_linear(rng, width, width) for _ in range(6))
    gain, shift = torch.from_numpy(rng.normal(size=(2, width)))

    def attention(x: Tensor, y: Tensor) -> Tensor:
        return to_out(F.scaled_dot_product_attention(to_q(x), to_k(y), to_v(y)))

    return Look(_norm(), _norm(gain, shift), attention, lambda x: two(F.gelu(one(x))))


def _two_bags(rng: np.random.Generator, size: int) -> tuple[Tensor, Tensor, Look, Look]:
    width, lead = size + 3, ((), (2,), (1, 2), (2, 2))[size - 1]
    bags = (torch.from_numpy(2 * rng.normal(size=(*lead, n, width)) + 1) for n in (size + 2, size + 1))
    return *bags, _look(rng, width), _look(rng, width)


def _slipped(*slips: str) -> Callable[..., tuple[Tensor, Tensor]]:
    return lambda s, c, a, b: (_one_way(s, c, a, *slips), _one_way(c, s, b, *slips))


BOTH_WAYS = Exercise(
    "04.both_ways",
    reference=both_ways,
    cases=_two_bags,
    gradients=(0, 1),
    mistakes=(
        Mistake(
            "one after the other",
            lambda s, c, a, b: (_one_way(s, c, a), _one_way(c, _one_way(s, c, a), b)),
            "both bags look at the same time: the context must see the support as it was before.",
        ),
        Mistake(
            "looks at its own bag",
            lambda s, c, a, b: (_one_way(s, s, a), _one_way(c, c, b)),
            "that is self-attention; what is seen comes from the other bag.",
        ),
        Mistake(
            "one set of layers",
            lambda s, c, a, b: (_one_way(s, c, a), _one_way(c, s, a)),
            "each direction has its own layers: the context uses `second`.",
        ),
        Mistake(
            "layers swapped",
            lambda s, c, a, b: (_one_way(s, c, b), _one_way(c, s, a)),
            "`first` belongs to the support, `second` to the context; you have them the other way round.",
        ),
        Mistake(
            "context left as it was",
            lambda s, c, a, b: (_one_way(s, c, a), c),
            "the context looks, too: both bags come back changed.",
        ),
        Mistake(
            "bags swapped",
            lambda s, c, a, b: (_one_way(c, s, b), _one_way(s, c, a)),
            "return the support first, then the context.",
        ),
        Mistake(
            "missing residual",
            _slipped("alone"),
            "what a token has seen is added to what it was: x + ..., or the token forgets itself.",
        ),
        Mistake(
            "MLP without residual",
            _slipped("MLP alone"),
            "the MLP's result is added to the token, it does not replace it.",
        ),
        Mistake("MLP forgotten", _slipped("no MLP"), "after its look each token passes the MLP: x + mlp(norm(x))."),
        Mistake("MLP without norm", _slipped("raw MLP"), "the MLP gets normalised tokens: mlp(norm(x))."),
        Mistake(
            "MLP before the look",
            _slipped("early MLP"),
            "the MLP works on the token after its look, not as it came in.",
        ),
        Mistake(
            "MLP with the other norm",
            _slipped("other norm"),
            "`norm_context` is for tokens of the other bag; before the MLP stands `norm`.",
        ),
        Mistake(
            "no norm of those who look", _slipped("raw looks"), "tokens that look are normalised first, by `norm`."
        ),
        Mistake(
            "no norm of those who are seen",
            _slipped("raw seen"),
            "tokens that are seen are normalised, too, by `norm_context`.",
        ),
        Mistake(
            "one norm for both",
            _slipped("same norm"),
            "those who are seen have a norm of their own, `norm_context`, with a learned gain.",
        ),
        Mistake(
            "normalised residual",
            _slipped("normed stream"),
            "the norm only stands before the attention: add what was found to x itself, not to norm(x).",
        ),
        Mistake(
            "other bag cut off",
            lambda s, c, a, b: (_one_way(s, c.detach(), a), _one_way(c, s.detach(), b)),
            "gradients flow to those who are seen, too: do not detach the other bag.",
        ),
    ),
)


def pool(bag: Tensor, token: Tensor, weights: Weights, heads: int, **slip: object) -> Tensor:
    """A learned token (D,) gathers a bag (..., K, D) to (..., D): no norm, no residual. A `slip` makes one mistake."""
    w_q, w_k, w_v, w_o = (w.to(bag.dtype) for w in weights)
    heads = 1 if slip.get("one head") else heads
    query, keys = (w_q @ token).unflatten(-1, (heads, -1)), (bag @ w_k.T).unflatten(-1, (heads, -1))
    values = (bag @ (w_k if slip.get("keys") else w_v).T).unflatten(-1, (heads, -1))
    scale = {"none": 1, "token": len(token), "whole": len(w_q)}.get(slip.get("scale"), query.shape[-1])
    share = ((keys * query).sum(-1) / scale**0.5).softmax(slip.get("axis", -2))  # (..., K, A)
    gathered = (share[..., None] * values).sum(-3).flatten(-2)
    return gathered if slip.get("no output") else gathered @ w_o.T


def _bag(rng: np.random.Generator, size: int) -> tuple[Tensor, Tensor, Weights, int]:
    """Heads times their width is the token's width only in the smallest case, and no two sizes agree."""
    width, heads, inner, lead = ((3, 1, 3, ()), (5, 2, 4, (2,)), (4, 3, 6, (3,)), (7, 2, 10, (2, 3)))[size - 1]
    shapes = ((inner, width), (inner, width), (inner, width), (width, inner))
    weights = tuple(torch.from_numpy(rng.normal(size=s)) for s in shapes)
    bag, token = (torch.from_numpy(rng.normal(size=s)) for s in ((*lead, size + 1, width), width))
    return bag, token, weights, heads


def _pooled(**slip: object) -> Callable[..., Tensor]:
    return lambda bag, token, w, heads: pool(bag, token, w, heads, **slip)


def _winner(bag: Tensor, token: Tensor, weights: Weights, heads: int) -> Tensor:
    w_q, w_k, w_v, w_o = weights
    query, keys, values = (x.unflatten(-1, (heads, -1)) for x in (w_q @ token, bag @ w_k.T, bag @ w_v.T))
    best = (keys * query).sum(-1).argmax(-2)[..., None, :, None].expand(*bag.shape[:-2], 1, heads, values.shape[-1])
    return values.gather(-3, best).squeeze(-3).flatten(-2) @ w_o.T


def _among_the_bag(bag: Tensor, token: Tensor, weights: Weights, heads: int) -> Tensor:
    return pool(torch.cat([token.expand(*bag.shape[:-2], 1, -1), bag], -2), token, weights, heads)


POOL = Exercise(
    "04.pool",
    reference=pool,
    cases=_bag,
    gradients=(0, 1),
    mistakes=(
        Mistake(
            "mean",
            lambda bag, token, w, heads: (bag @ w[2].T @ w[3].T).mean(-2),
            "this is the mean of the bag; the learned token decides who counts how much.",
        ),
        Mistake("winner takes all", _winner, "you take the best token only; the softmax mixes all of them."),
        Mistake(
            "residual added",
            lambda bag, token, w, heads: token + pool(bag, token, w, heads),
            "the pooling has no residual: only what the token gathered leaves the bag.",
        ),
        Mistake(
            "softmax over the heads",
            _pooled(axis=-1),
            "the softmax runs over the tokens of the bag; yours runs over the heads, or over the single query.",
        ),
        Mistake("missing scale", _pooled(scale="none"), "divide the scores by the square root of a head's width."),
        Mistake(
            "root of the token's width",
            _pooled(scale="token"),
            "the scale is the root of a head's width, not of the width D of a token.",
        ),
        Mistake(
            "root of all heads' width",
            _pooled(scale="whole"),
            "the scale is the root of ONE head's width, len(w_q) / heads.",
        ),
        Mistake(
            "heads forgotten",
            _pooled(**{"one head": True}),
            "each head has its own weights over the bag; you have one set for all of them.",
        ),
        Mistake(
            "token in the bag", _among_the_bag, "the learned token asks; it is not itself part of the bag."
        ),
        Mistake("keys for values", _pooled(keys=True), "what is gathered are the values, bag @ w_v.T."),
        Mistake(
            "output matrix forgotten",
            _pooled(**{"no output": True}),
            "the mixed values still have to pass through w_o.",
        ),
        Mistake(
            "transposed matrix",
            lambda bag, token, w, heads: pool(bag, token, tuple(x.T for x in w), heads),
            "tokens are rows, and a weight matrix maps D to A d as rows of W: multiply by W.T from the right.",
        ),
        Mistake(
            "token's gradient cut",
            lambda bag, token, w, heads: pool(bag, token.detach(), w, heads),
            "the token is learned: leave it in the graph.",
        ),
    ),
)  # fmt: skip
