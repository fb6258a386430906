"""Lesson 04's measurements on whole clips: how often the right cell wins, and how much attention a partner gets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from lessons.n04_votes import Bags, similarity_attention, votes
from tapip3d_lite.clip import Clip
from tapip3d_lite.model.cloud import Level, feature_cloud
from tapip3d_lite.model.frames import frames_from_clip
from tapip3d_lite.model.registry import make_space
from tapip3d_lite.recorder import StepRecord


def cloud_of(clip: Clip, features: Tensor | None = None, stride: int = 2) -> Level:
    """Level 0 of a clip's cloud in the world, with given features (1, T, C, h, w) or with colours."""
    frames = frames_from_clip(clip)
    points = make_space("world").lift(frames.depths, frames.intrinsics, frames.extrinsics)
    if features is None:
        features = torch.nn.functional.avg_pool2d(frames.rgb[0], stride)[None]
    return feature_cloud(features, points, frames.depths > 0, 1)[0]


def tiles(points: Tensor, side: float = 0.15) -> Tensor:
    """Which tile of the world, three whole numbers, a place (..., 3) in metres lies in."""
    return torch.floor(points / side + 0.01).long()


def coin(points: Tensor) -> Tensor:
    """A coin for every tile, always the same: 0 or 1, (..., 1)."""
    x, y, z = tiles(points).unbind(-1)
    mixed = (x * 73856093) ^ (y * 19349663) ^ (z * 83492791)
    return (((mixed * 2654435761) >> 7) % 2)[..., None].float()


def paint(level: Level, colors: Tensor) -> Level:
    """A level whose cells show something else."""
    return replace(level, features=colors)


def hits(bags: Bags, rng: np.random.Generator) -> dict[str, float]:
    """Share of points whose right cell wins: N2N, N2N with shuffled offsets, P2N, and shape without features."""
    attention = similarity_attention(bags.support, bags.context)  # (P, 1 + K, K)
    count, near, _ = bags.context.shape
    order = torch.from_numpy(rng.random((count, near)).argsort(1))[..., None].expand(-1, -1, 3)
    shuffled = torch.cat([bags.support_offsets[:, :1], bags.support_offsets[:, 1:].gather(1, order)], 1)
    ways = {
        "N2N": (attention, bags.support_offsets),
        "N2N, offsets shuffled": (attention, shuffled),
        "P2N": (attention[:, :1], bags.support_offsets[:, :1]),
        "shape alone": (torch.full_like(attention, 2 / near), bags.support_offsets),
    }
    won = {name: votes(*way, bags.context_offsets).argmax(-1) == bags.truth for name, way in ways.items()}
    return {name: float(right.float().mean()) for name, right in won.items()}


def up_to_a_period(bags: Bags, side: float = 0.15, tolerance: float = 0.06) -> tuple[float, float]:
    """Share of N2N's winners, and of all cells, that miss the truth by a whole period of a checkerboard, or not at all."""
    attention = similarity_attention(bags.support, bags.context)
    winner = votes(attention, bags.support_offsets, bags.context_offsets).argmax(-1)
    points = torch.arange(len(winner))
    x, y = (bags.context_offsets - bags.context_offsets[points, bags.truth][:, None])[..., :2].unbind(-1)
    u, v = ((x + y) / (2 * side)).round(), ((x - y) / (2 * side)).round()  # the nearest whole period
    close = torch.hypot(x - (u + v) * side, y - (u - v) * side) < tolerance
    return float(close[points, winner].float().mean()), float(close.float().mean())


def last_updates(steps: Sequence[StepRecord]) -> list[StepRecord]:
    """The last update of every window."""
    return [
        step for step, after in zip(steps, [*steps[1:], None], strict=True) if not after or after.start != step.start
    ]


def partner_attention(steps: Sequence[StepRecord], clip: Clip, tracks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Attention on a support token's partner times K, at level 0, a mean a track; and likeness of tokens in its place.

    The partner is the context cell nearest to where the point's true motion carries the support token. Pairs count
    where the point is seen and the partner is in the bag: nearer than the usual distance of neighbouring cells.

    Args:
        steps: of the recorder; the last update of every window counts.
        clip: with true tracks.
        tracks: (n,) which of them were tracked.

    Returns:
        Two (n,), in units of chance.
    """
    found: list[tuple[Tensor, Tensor]] = []
    for step in last_updates(steps):
        level, scale = step.levels[0], metres_per_unit(step)
        frames = np.arange(step.start, min(step.start + len(step.xyz), len(clip)))  # without those that fill a window
        near, xyz = level.near.offsets[: len(frames)], step.xyz[: len(frames)]
        attention, context = level.support_from_context[: len(frames)], level.context_tokens[: len(frames)]
        alike = similarity_attention(level.support_tokens.expand(len(frames), -1, -1, -1), context)
        # Where the point truly is, in the window's coordinates: the estimate before the update plus its error.
        before = xyz - scale * step.moved[: len(frames)]
        error = (torch.from_numpy(clip.tracks.xyz[frames][:, tracks]) - before) / scale
        goal = level.support.offsets[None] + error[:, :, None]  # (S, n, K + 1, 3)
        distance, partner = torch.cdist(goal, near).min(-1)  # (S, n, K + 1)
        spacing = torch.cdist(near, near).topk(2, largest=False).values[..., 1].mean(-1)
        counts = (distance < spacing[..., None]) & torch.from_numpy(clip.tracks.visible[frames][:, tracks])[..., None]
        chosen = (weights.gather(-1, partner[..., None])[..., 0] for weights in (attention, alike))
        found.append(tuple((near.shape[-2] * x).masked_fill(~counts, torch.nan) for x in chosen))
    trained, likeness = (torch.cat(parts).nanmean((0, 2)).numpy() for parts in zip(*found, strict=True))
    return trained, likeness


def metres_per_unit(step: StepRecord) -> float:
    """Metres in one unit of a window's normalised coordinates."""
    normalised = (step.coords + step.moved).diff(dim=0)
    return float(step.xyz.diff(dim=0).norm() / normalised.norm())


def mean_and_error(values: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """Mean and half the width of its 95 % interval, NaN left out."""
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    return float(values.mean()), float(1.96 * values.std(ddof=1) / len(values) ** 0.5)
