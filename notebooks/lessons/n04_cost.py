"""What N2N costs: its multiply-adds counted (the last exercise of notebook 04), and clear and fast form side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from time import perf_counter

import numpy as np
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from lessons.checker import Exercise, Mistake
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.n2n import N2N
from tapip3d_lite.model.neighbors import Neighbors
from tapip3d_lite.speed.folded_n2n import FoldedPair


def pair_cost(neighbors: int, width: int, heads: int, head_dim: int, hidden: int) -> int:
    """Multiply-adds of N2N for one point in one frame at one level."""
    return _counted()(neighbors, width, heads, head_dim, hidden)


def _counted(
    support: int = 1, ways: int = 2, inside: int = 2, seen: int = 2, layers: int = 2, own: int = 2, often: bool = False,
    pools: int = 2, heads_count: bool = True, square: bool = False, score_heads: bool = False,
) -> Callable[[int, int, int, int, int], int]:  # fmt: skip
    """The count; other numbers than these make one mistake."""

    def count(neighbors: int, width: int, heads: int, head_dim: int, hidden: int) -> int:
        bags = (neighbors + support, neighbors), (neighbors, neighbors + support)
        inner = width if square else heads * head_dim if heads_count else head_dim
        total = 0
        for looks, others in bags[:ways]:
            total += (2 * looks + seen * others) * width * inner  # queries and output; keys and values
            total += inside * looks * others * inner * (heads if score_heads else 1)  # scores, mixing
            total += layers * looks * width * hidden
        for bag, _ in bags[:pools]:
            total += 2 * bag * width * inner + 2 * bag * inner  # keys and values; scores, mixing
            total += own * width * inner * (bag if often else 1)  # the token's query and the output
        return total

    return count


def _sizes(rng: np.random.Generator, size: int) -> tuple[int, int, int, int, int]:
    """All five differ, and are larger than one."""
    return tuple(int(x) for x in rng.choice(np.arange(2, 9 + 4 * size), 5, replace=False))


COST = Exercise(
    "04.cost",
    reference=pair_cost,
    cases=_sizes,
    tolerance=1e-9,
    mistakes=(
        Mistake("one direction", _counted(ways=1, pools=1), "you counted one bag; the context looks back, and is pooled."),
        Mistake("one look", _counted(ways=1), "both bags look: K + 1 tokens at K, and K tokens at K + 1."),
        Mistake(
            "values not mixed",
            _counted(inside=1),
            "looks · seen · A d multiply-adds make the scores, and as many again mix the values.",
        ),
        Mistake(
            "three projections",
            _counted(seen=1),
            "one look needs four projections: queries and output for those who look, keys and values for the others.",
        ),
        Mistake("MLP forgotten", _counted(layers=0), "after each look comes an MLP of two layers."),
        Mistake("MLP of one layer", _counted(layers=1), "the MLP has two layers: to the hidden width and back."),
        Mistake("pooling forgotten", _counted(pools=0), "both bags still have to be pooled."),
        Mistake("one pooling", _counted(pools=1), "both bags are pooled, not one."),
        Mistake(
            "pooling without its own projections",
            _counted(own=0),
            "each pooling projects its token to a query, and what it gathered by W_o: D · A d each.",
        ),
        Mistake(
            "pooling without output",
            _counted(own=1),
            "each pooling has four projections; one of the two that act on a single token is missing.",
        ),
        Mistake(
            "pooling token projected for every cell",
            _counted(often=True),
            "one token looks when a bag is pooled: its query and its output are projected once, not for every cell.",
        ),
        Mistake(
            "twice as many",
            lambda *sizes: 2 * pair_cost(*sizes),
            "count a multiplication and its addition as one; FLOPs are twice as many.",
        ),
        Mistake("K tokens on both sides", _counted(support=0), "the support has K + 1 tokens: the query comes first."),
        Mistake(
            "one head", _counted(heads_count=False), "queries, keys and values have the width of all heads, A d."
        ),
        Mistake(
            "square projections",
            _counted(square=True),
            "the projections lead from D to A d and back, which need not be D.",
        ),
        Mistake(
            "heads counted twice",
            _counted(score_heads=True),
            "a head's scores sum d products, so all heads together sum A d; the number of heads is in there already.",
        ),
    ),
)  # fmt: skip


def counted(call: Callable[[], object]) -> int:
    """Multiply-adds by PyTorch's own count: it counts FLOPs, two for each, and overlooks fused attention on a CPU."""
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        call()
    return counter.get_total_flops() // 2


def sized(neighbors: int, width: int, heads: int = 1, seed: int = 0, frames: int = 8, tracks: int = 24) -> tuple:
    """A context with random weights, what it keeps of random queries, and random neighbourhoods."""
    sizes = {"neighbors": neighbors, "token_dim": width, "feature_dim": width, "context_mlp_ratio": 1.0}
    sizes |= {"context_heads": heads, "context_head_dim": width // heads}
    context = N2N(TrackerConfig.preset("lite", **sizes)).requires_grad_(False)
    g = torch.Generator().manual_seed(seed)
    near = Neighbors(
        *(torch.randn(1, frames, tracks, *s, generator=g) for s in ((neighbors, width), (neighbors, 3), (3,)))
    )
    support = Neighbors(
        *(torch.randn(1, tracks, *s, generator=g) for s in ((neighbors + 1, width), (neighbors + 1, 3), (3,)))
    )
    return context, context.describe(0, support), near


def clear_and_fast(neighbors: Sequence[int], width: int, rounds: int) -> dict[tuple[int, str], tuple[float, int]]:
    """(K, form) to milliseconds and multiply-adds of the library's two forms of N2N, by 8 frames and 24 tracks.

    A round runs all of them, so that whatever else the machine does falls on all; the fastest round counts.
    """
    calls = {}
    for k in neighbors:
        context, kept, near = sized(k, width)
        calls[k, "clear"] = partial(context, 0, kept, near)
        calls[k, "fast"] = partial(FoldedPair.fold(context, 0, kept).compare, near)
    times = dict.fromkeys(calls, np.inf)
    for _ in range(rounds + 1):  # the first one warms up, and cannot be the fastest
        for key, call in calls.items():
            start = perf_counter()
            call()
            times[key] = min(times[key], 1000 * (perf_counter() - start))
    return {key: (times[key], counted(call)) for key, call in calls.items()}
