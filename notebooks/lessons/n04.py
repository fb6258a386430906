"""Lesson 04: what it shows and measures, its exercises, and where they stand in the tracker."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor, nn

from lessons.checker import check
from lessons.guesses import reveal
from lessons.milestone import Use, milestone
from lessons.n04_bags import Look
from lessons.n04_cost import clear_and_fast, counted, sized
from lessons.n04_curves import cost_curves, floors, fourier_waves, rates
from lessons.n04_exercises import EXERCISES
from lessons.n04_figures import WAYS, AttentionPair, cell_centers, entropy, two_bags, who_looks_where
from lessons.n04_votes import paired_bags, similarity_attention, votes
from lessons.n04_world import (
    cloud_of,
    coin,
    hits,
    last_updates,
    mean_and_error,
    metres_per_unit,
    paint,
    partner_attention,
    tiles,
    up_to_a_period,
)
from lessons.pictures import pipeline, show
from lessons.progress import collect, in_use, progress, reset
from lessons.widgets import explore
from tapip3d_lite.model.blocks import Attention, Block, Pool
from tapip3d_lite.model.n2n import PairAttention

__all__ = [
    "EXERCISES",
    "WAYS",
    "AttentionPair",
    "Look",
    "cell_centers",
    "check",
    "clear_and_fast",
    "cloud_of",
    "coin",
    "collect",
    "cost_curves",
    "counted",
    "entropy",
    "explore",
    "floors",
    "fourier_waves",
    "hits",
    "in_use",
    "last_updates",
    "mean_and_error",
    "metres_per_unit",
    "milestone",
    "paint",
    "pair_by",
    "paired_bags",
    "partner_attention",
    "parts",
    "pipeline",
    "progress",
    "rates",
    "reset",
    "reveal",
    "show",
    "similarity_attention",
    "sized",
    "tiles",
    "two_bags",
    "up_to_a_period",
    "votes",
    "who_looks_where",
]

Function = Callable[..., object]


def parts(use: Use) -> dict[str, object]:
    """The learner's waves, attention, looks and pooling at their places in the tracker, for `milestone`."""
    waves, attend, both_ways, pool = (use(f"04.{name}") for name in ("fourier", "attend", "both_ways", "pool"))

    def pair(self: PairAttention, support: Tensor, context: Tensor) -> Tensor:
        return pair_by(attend, both_ways, pool)(self, support, context)

    return {"tapip3d_lite.model.blocks:fourier": waves, "tapip3d_lite.model.n2n:PairAttention.forward": pair}


def pair_by(attend: Function, both_ways: Function, pool: Function) -> Callable[[nn.Module, Tensor, Tensor], Tensor]:
    """A function (weights of a `PairAttention`, support, context) to what the point learns, made of three functions.

    The exercises' functions know no biases of projections; here the layers add them.
    """

    def found(layer: Attention, x: Tensor, y: Tensor) -> Tensor:
        keys, values = layer.to_kv(y).chunk(2, -1)
        return layer.to_out(attend(layer.to_q(x), keys, values, layer.heads))

    def look(block: Block) -> Look:
        return Look(block.norm, block.norm_context, lambda x, y: found(block.attention, x, y), block.mlp)

    def gather(layer: Pool, bag: Tensor) -> Tensor:
        inside = layer.attention
        weights = inside.to_q.weight, *inside.to_kv.weight.chunk(2), inside.to_out.weight
        return pool(bag, layer.token[0], weights, inside.heads) + inside.to_out.bias

    def pair(layers: nn.Module, support: Tensor, context: Tensor) -> Tensor:
        bags = both_ways(support, context, look(layers.support_from_context), look(layers.context_from_support))
        return gather(layers.pool_support, bags[0]) + gather(layers.pool_context, bags[1])

    return pair
