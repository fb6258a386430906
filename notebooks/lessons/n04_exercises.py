"""Exercises of notebook 04: Fourier features and attention with heads; those on whole bags are in `n04_bags`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from lessons.checker import Exercise, Mistake
from lessons.n04_bags import BOTH_WAYS, POOL
from lessons.n04_cost import COST
from tapip3d_lite.model.blocks import DEGREES


def waves(x: Tensor, degrees: tuple[int, ...] = DEGREES) -> Tensor:
    """Numbers (..., d) to (..., 33 d): [x | sin(2^i x) | cos(2^i x)], degree by degree."""
    angles = _angles(x, degrees)
    return torch.cat([x, angles.sin(), angles.cos()], -1)


def _angles(x: Tensor, degrees: tuple[int, ...] = DEGREES) -> Tensor:
    return torch.cat([2.0**i * x for i in degrees], -1)


def _by_axis(x: Tensor) -> Tensor:
    angles = _angles(x).unflatten(-1, (-1, x.shape[-1])).transpose(-1, -2).flatten(-2)
    return torch.cat([x, angles.sin(), angles.cos()], -1)


def _of(angles: Tensor, x: Tensor) -> Tensor:
    return torch.cat([x, angles.sin(), angles.cos()], -1)


def _offsets(rng: np.random.Generator, size: int) -> tuple[Tensor]:
    shapes = {1: (1, 3), 2: (3, 2), 3: (2, 2, 3), 4: (3, 1, 2, 3)}
    # Whole 1024ths: their multiples are exact in single precision, too, so that only real mistakes differ.
    return (torch.from_numpy(rng.integers(-3000, 3000, size=shapes[size]) / 1024.0),)


FOURIER = Exercise(
    "04.fourier",
    reference=waves,
    cases=_offsets,
    gradients=(0,),
    mistakes=(
        Mistake(
            "offset left out",
            lambda x: waves(x)[..., x.shape[-1] :],
            "the offset itself comes first, before its sines and cosines.",
        ),
        Mistake(
            "offset at the end",
            lambda x: torch.cat([_angles(x).sin(), _angles(x).cos(), x], -1),
            "the offset itself comes first, not last.",
        ),
        Mistake(
            "factor pi", lambda x: _of(torch.pi * _angles(x), x), "here the angle is 2^i x; other papers' pi is not."
        ),
        Mistake(
            "degrees from 0",
            lambda x: waves(x, tuple(range(16))),
            "the degrees are -2 to 13: the slowest wave turns four times slower than sin(x).",
        ),
        Mistake("one degree short", lambda x: waves(x, DEGREES[:-1]), "13 is included, and range(-2, 13) stops at 12."),
        Mistake(
            "degrees times two",
            lambda x: _of(torch.cat([2.0 * i * x for i in DEGREES], -1), x),
            "2 to the power of i, not 2 times i: every wave is half as long as the one before.",
        ),
        Mistake(
            "fastest first",
            lambda x: waves(x, DEGREES[::-1]),
            "the degrees rise from -2 to 13; you begin with the fastest wave.",
        ),
        Mistake(
            "axis by axis",
            _by_axis,
            "the order is degree by degree: all axes of one degree stand side by side.",
        ),
        Mistake(
            "sine and cosine in turn",
            lambda x: torch.cat([x, *(f(2.0**i * x) for i in DEGREES for f in (torch.sin, torch.cos))], -1),
            "all sines come first, then all cosines.",
        ),
        Mistake(
            "cosines first",
            lambda x: torch.cat([x, _angles(x).cos(), _angles(x).sin()], -1),
            "sines come before cosines.",
        ),
        Mistake(
            "gradient cut",
            lambda x: waves(x.detach()),
            "a network is trained through these waves: .detach(), .data or a new tensor made of x cut the gradient.",
        ),
    ),
)


def attend(queries: Tensor, keys: Tensor, values: Tensor, heads: int, **slip: object) -> Tensor:
    """What queries (..., K + 1, A d) find among keys and values (..., K, A d), every head for itself: (..., K + 1, A d).

    A `slip` makes one mistake.
    """
    q, k, v = (
        x.unflatten(-1, (heads, -1)).transpose(-2, -3) for x in (queries, keys, values)
    )  # (..., A, K + 1 or K, d)
    width = {"whole": queries.shape[-1], "none": 1, "squared": q.shape[-1] ** 2}.get(slip.get("scale"), q.shape[-1])
    weights = (q @ k.mT / width**0.5).softmax(slip.get("axis", -1))
    found = (weights.detach() if slip.get("cut") else weights) @ v
    return found.reshape(queries.shape) if slip.get("scrambled") else found.transpose(-2, -3).flatten(-2)


def _interleaved(queries: Tensor, keys: Tensor, values: Tensor, heads: int) -> Tensor:
    order = torch.arange(queries.shape[-1]).view(-1, heads).T.flatten()  # every heads-th channel belongs to one head
    return attend(*(x[..., order] for x in (queries, keys, values)), heads)[..., order.argsort()]


def _attended(rng: np.random.Generator, size: int) -> tuple[Tensor, Tensor, Tensor, int]:
    """Numbers of tokens, heads and their widths differ, so that no two axes can be taken for each other."""
    heads, width, lead = ((1, 3, ()), (2, 3, (2,)), (3, 2, (2, 2)), (2, 5, (3, 2)))[size - 1]
    shapes = ((*lead, n, heads * width) for n in (size + 1, size + 3, size + 3))
    return *(torch.from_numpy(rng.normal(size=s)) for s in shapes), heads


def _slipped(**slip: object) -> Callable[..., Tensor]:
    return lambda q, k, v, heads: attend(q, k, v, heads, **slip)


ATTEND = Exercise(
    "04.attend",
    reference=attend,
    cases=_attended,
    gradients=(0, 1, 2),
    mistakes=(
        Mistake(
            "missing scale",
            _slipped(scale="none"),
            "divide the scores by the square root of a head's width before the softmax.",
        ),
        Mistake(
            "root of all heads' width",
            _slipped(scale="whole"),
            "the scale is the root of ONE head's width d = width / heads: a head's scores sum d products, not all of them.",
        ),
        Mistake("divided by the width", _slipped(scale="squared"), "divide by the square root of d, not by d itself."),
        Mistake(
            "softmax over those who look",
            _slipped(axis=-2),
            "every token divides its own attention among those that it sees: each ROW of the weights sums to one.",
        ),
        Mistake(
            "softmax over the heads",
            _slipped(axis=-3),
            "heads do not share their attention; each has a softmax of its own, over the tokens that are seen.",
        ),
        Mistake(
            "heads forgotten",
            lambda q, k, v, heads: attend(q, k, v, 1),
            "you have one softmax for the whole width; cut it into heads first, each with weights of its own.",
        ),
        Mistake(
            "heads interleaved",
            _interleaved,
            "heads lie side by side: the first d channels are the first head's, unflatten(-1, (heads, -1)).",
        ),
        Mistake(
            "heads not put back",
            _slipped(scrambled=True),
            "bring the axis of the heads back behind that of the tokens before you join them; a reshape alone mixes tokens.",
        ),
        Mistake(
            "keys and values swapped",
            lambda q, k, v, heads: attend(q, v, k, heads),
            "the scores come from the keys, and what is mixed are the values.",
        ),
        Mistake(
            "keys mixed",
            lambda q, k, v, heads: attend(q, k, k, heads),
            "you mix the keys; they only say who is looked at. What flows are the values.",
        ),
        Mistake(
            "mean of the values",
            lambda q, k, v, heads: attend(q * 0, k, v, heads),
            "every query finds the same: the mean of the values. The weights must depend on queries and keys.",
        ),
        Mistake(
            "weights cut off",
            _slipped(cut=True),
            "queries and keys learn through the weights: leave them in the graph, without .detach() or no_grad().",
        ),
    ),
)

EXERCISES = (FOURIER, ATTEND, BOTH_WAYS, POOL, COST)
