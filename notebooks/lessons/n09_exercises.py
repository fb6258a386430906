"""Exercises of notebook 09: the cells most alike, a vote of the neighbourhood, three frames mixed, misses made smooth."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from lessons.checker import Exercise, slips
from tapip3d_lite.geometry import THRESHOLDS


def most_alike(own: Tensor, features: Tensor, valid: Tensor, k: int, slip: str = "") -> Tensor:
    """Indices (F, N, k) of the cells whose features (F, P, C) are most alike to `own` (F, N, C), by their cosine."""
    unit = F.normalize(features, dim=1 if slip == "normalised over cells" else -1)
    likeness = F.normalize(own, dim=-1) @ (features if slip == "plain dots" else unit).mT
    if slip == "distance":
        likeness = -torch.cdist(own, features)
    if slip == "shared":
        likeness = likeness.mean(1, keepdim=True).expand_as(likeness)
    hidden = valid if slip == "mask turned" else ~valid
    if slip != "no mask":
        likeness = likeness.masked_fill(hidden[:, None], 0.0 if slip == "zero" else -torch.inf)
    return likeness.topk(k, dim=-1, largest=slip != "least alike").indices


def _cells(rng: np.random.Generator, size: int) -> tuple:
    """Features whose lengths differ by much; the most alike cells of each frame may not be taken."""
    g = torch.Generator().manual_seed(int(rng.integers(2**31)))
    frames, points, cells, channels = 1 + size // 2, size, 5 * size + 4, 3 + size
    own = torch.randn(frames, points, channels, generator=g)
    lengths = torch.exp(1.5 * torch.randn(frames, cells, 1, generator=g))
    features = lengths * (torch.randn(frames, cells, channels, generator=g) - 0.8 * own.mean(1, keepdim=True))
    valid = torch.rand(frames, cells, generator=g) > 0.3
    best = (F.normalize(own, dim=-1) @ F.normalize(features, dim=-1).mT).argmax(-1)
    valid[torch.arange(frames), best[:, 0]] = False
    valid[:, -size - 1 :] = True
    return own, features, valid, size + 1


_ALIKE_HINTS = {
    "plain dots": "a long feature has large dot products with everything: divide both by their lengths first.",
    "normalised over cells": "each cell's feature gets length 1: normalise over the channels, dim=-1.",
    "distance": "alike means the same direction; a distance also asks for the same length.",
    "shared": "each point has cells of its own: (F, N, P) similarities, not one list a frame.",
    "mask turned": "`valid` says which cells may be taken: fill where it is not true, ~valid.",
    "no mask": "cells without depth have no place in 3D: they may not be taken; see `valid`.",
    "zero": "0 is the cosine of two features that have nothing to do with each other, and better than a negative one; fill with -inf.",
    "least alike": "the largest cosines, not the smallest.",
}  # fmt: skip

ALIKE = Exercise("09.alike", reference=most_alike, cases=_cells, mistakes=slips(most_alike, _ALIKE_HINTS))


def vote(query: Tensor, features: Tensor, offsets: Tensor, slip: str = "") -> Tensor:
    """What K cells say about one point: (B, S, N, 5), the mean of their offsets by likeness, its spread, the likeness."""
    scores = (query[:, None, :, None] * features).sum(-1)
    if slip != "no root":
        scores = scores / (query.shape[-1] if slip == "whole width" else query.shape[-1] ** 0.5)
    shares = scores.softmax(-2 if slip == "over tracks" else -1)
    if slip == "equal":
        shares = torch.full_like(shares, 1 / shares.shape[-1])
    if slip == "hard":
        shares = F.one_hot(scores.argmax(-1), scores.shape[-1]).to(scores.dtype)
    place = (shares[..., None] * offsets).sum(-2)
    away = offsets if slip == "from the centre" else offsets - place[..., None, :]
    square = away.norm(dim=-1) if slip == "distances" else away.square().sum(-1)
    spread = (shares * square).sum(-1) if slip != "unweighted" else square.mean(-1)
    match = scores.amax(-1) if slip == "best" else (shares * scores).sum(-1)
    last = [match, spread] if slip == "order" else [spread, match]
    return torch.cat([place, *(x[..., None] for x in last)], -1)


def _bags(rng: np.random.Generator, size: int) -> tuple:
    g = torch.Generator().manual_seed(int(rng.integers(2**31)))
    lead, channels, near = (1 + size // 2, size, 1 + size), 3 + size, 2 + size
    query = torch.randn(lead[0], lead[2], channels, generator=g, dtype=torch.float64)
    features = torch.randn(*lead, near, channels, generator=g, dtype=torch.float64)
    return query, features, torch.randn(*lead, near, 3, generator=g, dtype=torch.float64) + 0.5


_VOTE_HINTS = {
    "no root": "divide the dot products by the root of C, or the softmax is all but one-hot.",
    "whole width": "divide by the root of C, not by C.",
    "over tracks": "the K cells of one neighbourhood share 1 among them: softmax over the last axis of (B, S, N, K).",
    "equal": "cells that look more like the query have more to say: weights from a softmax of the dot products.",
    "hard": "the best cell alone gives no gradient to the features; take the softmax.",
    "from the centre": "the spread is around the vote, not around the centre.",
    "distances": "squared distances: a spread of 0.1 is 0.01 here.",
    "unweighted": "the spread is weighted by the same shares.",
    "best": "the likeness is the mean by the same shares, not the best one.",
    "order": "first the three numbers of the place, then the spread, then the likeness.",
}

VOTE = Exercise(
    "09.vote", reference=vote, cases=_bags, mistakes=slips(vote, _VOTE_HINTS), tolerance=1e-6, gradients=(0, 1)
)


def mixed(x: Tensor, kernel: Tensor, slip: str = "") -> Tensor:
    """Each frame of x (B, N, S, U) with the one before and the one after it, by kernel (3, U); the ends stand in themselves."""
    axis = 1 if slip == "tracks" else 2
    before, after = x.roll(1, axis), x.roll(-1, axis)
    if slip != "round":
        first, last = x.narrow(axis, 0, 1), x.narrow(axis, x.shape[axis] - 1, 1)
        if slip == "zeros":
            first, last = 0 * first, 0 * last
        before = torch.cat([first, x.narrow(axis, 0, x.shape[axis] - 1)], axis)
        after = torch.cat([x.narrow(axis, 1, x.shape[axis] - 1), last], axis)
    if slip == "turned":
        before, after = after, before
    if slip == "one kernel":
        kernel = kernel.mean(-1, keepdim=True)
    return kernel[0] * before + kernel[1] * x + kernel[2] * after


def _signals(rng: np.random.Generator, size: int) -> tuple:
    g = torch.Generator().manual_seed(int(rng.integers(2**31)))
    shape = 1 + size // 2, size, 1 + size, 2 + size
    kernel = torch.randn(3, shape[-1], generator=g, dtype=torch.float64)
    return torch.randn(shape, generator=g, dtype=torch.float64), kernel


_MIXED_HINTS = {
    "tracks": "time is the axis S, the third one; tracks do not meet here.",
    "round": "the frame before the first is not the last one: repeat the first.",
    "zeros": "beyond the ends stands no zero but the end itself, repeated.",
    "turned": "kernel[0] belongs to the frame before, kernel[2] to the one after.",
    "one kernel": "each channel has its own three weights.",
}

MIXED = Exercise(
    "09.mixed", reference=mixed, cases=_signals, mistakes=slips(mixed, _MIXED_HINTS), tolerance=1e-6, gradients=(0, 1)
)


def soft_misses(pixels: Tensor, counted: Tensor, slip: str = "") -> Tensor:
    """The mean over thresholds k of e^2 / (e^2 + k^2) of errors (B, S, N) that count: over each clip, then over clips."""
    power = 1 if slip == "not squared" else 2
    error, k = pixels[..., None] ** power, pixels.new_tensor(THRESHOLDS) ** power
    if slip == "four alone":
        k = k[2:3]
    miss = (k / (error + k) if slip == "hits" else error / (error + k)).mean(-1)
    if slip == "hard":
        miss = (pixels[..., None] >= pixels.new_tensor(THRESHOLDS)).to(pixels.dtype).mean(-1) + 0 * pixels
    if slip == "all of them":
        counted = torch.ones_like(counted)
    if slip == "over everything":
        return (miss * counted).mean()
    if slip == "pooled":
        return (miss * counted).sum() / counted.sum().clamp(min=1)
    total = counted.flatten(1).sum(1)
    each = (miss * counted).flatten(1).sum(1) / (total if slip == "empty" else total.clamp(min=1))
    return each.sum() if slip == "sum" else each.mean()


def _errors(rng: np.random.Generator, size: int) -> tuple:
    """Errors around the thresholds; clips in which few count, and one in which none does."""
    g = torch.Generator().manual_seed(int(rng.integers(2**31)))
    shape = 2 + size, 1 + size, 2 * size
    pixels = torch.exp(1.2 + 1.3 * torch.randn(shape, generator=g, dtype=torch.float64))
    counted = torch.rand(shape, generator=g) < torch.linspace(0.9, 0.2, shape[0])[:, None, None]
    counted[0, 0, 0], counted[-1] = True, False
    return pixels, counted


_MISSES_HINTS = {
    "not squared": "both squared: e^2 / (e^2 + k^2).",
    "four alone": "all five thresholds, averaged.",
    "hits": "that is the share of hits; a loss is small where the tracker is good.",
    "hard": "a step has no slope: where it is flat, nothing is learnt; take e^2 / (e^2 + k^2).",
    "all of them": "only what is counted: leave out frames before the query, padded frames and tracks that do not exist.",
    "over everything": "divide by how many count, not by how many there are.",
    "pooled": "first the mean of each clip, then the mean over clips.",
    "empty": "a clip in which nothing counts divides by 0: clamp the count to at least 1.",
    "sum": "the mean over clips, so that the loss does not grow with the batch.",
}

MISSES = Exercise(
    "09.misses",
    reference=soft_misses,
    cases=_errors,
    mistakes=slips(soft_misses, _MISSES_HINTS),
    tolerance=1e-6,
    gradients=(0,),
)

EXERCISES = (ALIKE, VOTE, MIXED, MISSES)
