"""Exercises of notebook 04: Fourier features, two bags that look at each other, pooling, and what it costs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lessons.checker import Exercise, Mistake
from tapip3d_lite.model.fourier import DEGREES

Array = np.ndarray
Weights = tuple[Array, Array, Array, Array]  # W_q, W_k, W_v (E, D) and W_o (D, E), used as x @ W.T


def fourier_features(x: Array, degrees: tuple[int, ...] = DEGREES) -> Array:
    """Offsets (P, 3) to (P, 99): [x | sin(2^j x) | cos(2^j x)], degree by degree."""
    angles = _angles(x, degrees)
    return np.concatenate([x, np.sin(angles), np.cos(angles)], -1)


def _angles(x: Array, degrees: tuple[int, ...]) -> Array:
    return np.concatenate([2.0**j * x for j in degrees], -1)


def _axis_by_axis(x: Array) -> Array:
    angles = _angles(x, DEGREES).reshape(len(x), -1, x.shape[-1]).swapaxes(1, 2).reshape(len(x), -1)
    return np.concatenate([x, np.sin(angles), np.cos(angles)], -1)


def _interleaved(x: Array) -> Array:
    waves = [f(2.0**j * x) for j in DEGREES for f in (np.sin, np.cos)]
    return np.concatenate([x, *waves], -1)


FOURIER = Exercise(
    "04.fourier",
    reference=fourier_features,
    cases=lambda rng, size: (rng.normal(size=(size, 3)),),
    mistakes=(
        Mistake(
            "offset left out",
            lambda x: fourier_features(x)[:, x.shape[-1] :],
            "the offset itself comes first, before its sines and cosines.",
        ),
        Mistake(
            "factor pi",
            lambda x: np.concatenate([x, fourier_features(np.pi * x)[:, 3:]], -1),
            "here the angle is 2^j x; the pi of other papers does not appear.",
        ),
        Mistake(
            "degrees from 0",
            lambda x: fourier_features(x, tuple(range(16))),
            "the degrees are -2 to 13: the slowest wave turns four times slower than sin(x).",
        ),
        Mistake(
            "one degree short",
            lambda x: fourier_features(x, DEGREES[:-1]),
            "13 is included, and range(-2, 13) stops at 12.",
        ),
        Mistake(
            "axis by axis",
            _axis_by_axis,
            "the order is degree by degree: x, y and z of one degree stand side by side.",
        ),
        Mistake(
            "sine and cosine in turn",
            _interleaved,
            "all sines come first, then all cosines.",
        ),
    ),
)


def softmax(scores: Array, axis: int = -1) -> Array:
    """Exponentials that sum to one along an axis."""
    powers = np.exp(scores - scores.max(axis, keepdims=True))
    return powers / powers.sum(axis, keepdims=True)


def look(x: Array, context: Array, weights: Weights, **slip: object) -> Array:
    """Let x (Q, D) look at context (M, D): x + Out(softmax(q k^T / sqrt(E)) v); `slip` makes one mistake."""
    w_q, w_k, w_v, w_o = (w.T for w in weights) if slip.get("transposed") else weights
    q, k, v = x @ w_q.T, context @ w_k.T, context @ w_v.T
    scores = q @ k.T * (1 if slip.get("unscaled") else len(w_q) ** -0.5)
    seen = softmax(scores, slip.get("axis", -1)) @ v @ w_o.T
    return seen if slip.get("alone") else x + seen


def both_ways(support: Array, context: Array, first: Weights, second: Weights) -> tuple[Array, Array]:
    """Cross-attention in both directions at once: (M, D) and (K, D)."""
    return look(support, context, first), look(context, support, second)


def _weights(rng: np.random.Generator, width: int, inner: int) -> Weights:
    return tuple(rng.normal(size=s) for s in ((inner, width), (inner, width), (inner, width), (width, inner)))


def _two_bags(rng: np.random.Generator, size: int) -> tuple:
    width, inner = 2 * size, 2 * size + 1  # different, so that a transposed matrix cannot fit by chance
    inner = width if size == 1 else inner
    bags = rng.normal(size=(size + 2, width)), rng.normal(size=(size + 1, width))
    return *bags, _weights(rng, width, inner), _weights(rng, width, inner)


def _slipped(**slip: object) -> Callable[..., tuple[Array, Array]]:
    return lambda s, c, a, b: (look(s, c, a, **slip), look(c, s, b, **slip))


BOTH_WAYS = Exercise(
    "04.both_ways",
    reference=both_ways,
    cases=_two_bags,
    mistakes=(
        Mistake(
            "transposed matrix",
            _slipped(transposed=True),
            "tokens are rows, and a weight matrix maps D to E as rows of W: multiply by W.T from the right.",
        ),
        Mistake(
            "softmax over the wrong axis",
            _slipped(axis=0),
            "every token divides its own attention among the other bag: each ROW of the weights sums to one.",
        ),
        Mistake(
            "missing scale",
            _slipped(unscaled=True),
            "divide the scores by the square root of the width of q before the softmax.",
        ),
        Mistake(
            "missing residual",
            _slipped(alone=True),
            "what a token has seen is added to what it was: x + ..., or the token forgets itself.",
        ),
        Mistake(
            "one after the other",
            lambda s, c, a, b: (look(s, c, a), look(c, look(s, c, a), b)),
            "both bags look at the same time: the context must see the support as it was before.",
        ),
        Mistake(
            "looks at its own bag",
            lambda s, c, a, b: (look(s, s, a), look(c, c, b)),
            "that is self-attention; keys and values come from the other bag.",
        ),
        Mistake(
            "one set of weights",
            lambda s, c, a, b: (look(s, c, a), look(c, s, a)),
            "each direction has its own weights: the second one uses `second`.",
        ),
    ),
)


def pool(bag: Array, token: Array, weights: Weights) -> Array:
    """A learned token (D,) gathers a bag (M, D) to (D,): no residual."""
    return look(token[None], bag, weights, alone=True)[0]


def _bag(rng: np.random.Generator, size: int) -> tuple:
    width = 2 * size
    weights = _weights(rng, width, width if size == 1 else width + 1)
    return rng.normal(size=(size + 1, width)), rng.normal(size=width), weights


def _mean_pool(bag: Array, token: Array, weights: Weights) -> Array:
    return (bag @ weights[2].T @ weights[3].T).mean(0)


def _max_pool(bag: Array, token: Array, weights: Weights) -> Array:
    _, _, w_v, w_o = weights
    scores = bag @ weights[1].T @ (weights[0] @ token)
    return bag[scores.argmax()] @ w_v.T @ w_o.T


POOL = Exercise(
    "04.pool",
    reference=pool,
    cases=_bag,
    mistakes=(
        Mistake(
            "mean",
            _mean_pool,
            "this is the mean of the bag; the learned token decides who counts how much.",
        ),
        Mistake(
            "winner takes all",
            _max_pool,
            "you take the best token only; the softmax mixes all of them.",
        ),
        Mistake(
            "residual added",
            lambda bag, token, w: look(token[None], bag, w)[0],
            "the pooling has no residual: only what the token gathered leaves the bag.",
        ),
        Mistake(
            "softmax over the wrong axis",
            lambda bag, token, w: look(token[None], bag, w, alone=True, axis=0)[0],
            "your weights are all 1: the softmax runs over the M tokens of the bag, not over the single query.",
        ),
        Mistake(
            "missing scale",
            lambda bag, token, w: look(token[None], bag, w, alone=True, unscaled=True)[0],
            "divide the scores by the square root of the width of q.",
        ),
        Mistake(
            "token in the bag",
            lambda bag, token, w: look(token[None], np.concatenate([token[None], bag]), w, alone=True)[0],
            "the learned token asks; it is not itself part of the bag.",
        ),
        Mistake(
            "output matrix forgotten",
            lambda bag, token, w: look(token[None], bag, (*w[:3], np.eye(len(w[0]))), alone=True)[0],
            "the mixed values still have to pass through W_o.",
        ),
    ),
)


def pair_cost(k: int, d: int) -> int:
    """Multiply-adds of N2N for one point in one frame: K context and K + 1 support tokens of width D."""
    return sum(_block(m, n, d) + _pooled(m, d) for m, n in ((k + 1, k), (k, k + 1)))


def _block(m: int, n: int, d: int, **slip: int) -> int:
    """Let m tokens look at n tokens, then pass the MLP."""
    scores = slip.get("scores", 2) * m * n * d
    return scores + (2 * m + slip.get("context", 2) * n) * d**2 + slip.get("mlp", 2) * m * d**2


def _pooled(m: int, d: int) -> int:
    return 2 * d**2 + 2 * m * d**2 + 2 * m * d


def _counted(pools: bool = True, **slip: int) -> Callable[[int, int], int]:
    def count(k: int, d: int) -> int:
        both = ((k + 1, k), (k, k + 1))
        return sum(_block(m, n, d, **slip) + pools * _pooled(m, d) for m, n in both)

    return count


COST = Exercise(
    "04.cost",
    reference=pair_cost,
    cases=lambda rng, size: (int(rng.integers(2, 5)) * size, int(rng.integers(3, 9)) * size),
    tolerance=1e-9,
    mistakes=(
        Mistake(
            "one direction",
            lambda k, d: _block(k + 1, k, d) + _pooled(k + 1, d),
            "you counted one direction; the context looks back, and is pooled as well.",
        ),
        Mistake(
            "values forgotten",
            _counted(scores=1),
            "m n d multiply-adds make the scores, and as many again mix the values.",
        ),
        Mistake(
            "three projections",
            _counted(context=1),
            "one look needs four projections: queries and output for those who look, keys and values for the others.",
        ),
        Mistake("MLP forgotten", _counted(mlp=0), "after each look comes an MLP of two layers: 2 m d^2."),
        Mistake("pooling forgotten", _counted(pools=False), "both bags still have to be pooled."),
        Mistake(
            "twice as many",
            lambda k, d: 2 * pair_cost(k, d),
            "count a multiplication and its addition as one; FLOPs are twice as many.",
        ),
        Mistake(
            "K tokens on both sides",
            lambda k, d: 2 * (_block(k, k, d) + _pooled(k, d)),
            "the support has K + 1 tokens: the query itself comes first.",
        ),
    ),
)

EXERCISES = (FOURIER, BOTH_WAYS, POOL, COST)
