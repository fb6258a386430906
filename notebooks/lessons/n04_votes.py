"""What a neighbourhood knows that a point does not, before any training: two bags of cells vote for where a point went.

The vote is ours. It stands for what the paper's N2N (section 3.2) can know, against a point alone (its table on N2N). If
support token i looks at context token j, then it believes in the displacement that carries i to j. A context cell j'
wins if many tokens believe in the displacement that carries the point to j'. A point alone is a bag with one token.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tapip3d_lite.clip import Clip
from tapip3d_lite.model.cloud import Level
from tapip3d_lite.model.neighbors import gather, knn

_CHUNK = 2**22  # floats of the kernel that exist at once: 16 MiB, which is faster than all in one piece


@dataclass(frozen=True)
class Bags:
    """P points, each with its cells in the query frame and cells around a wrong estimate in a later frame.

    Attributes:
        support: features (P, 1 + K, C); row 0 is the point's own cell.
        support_offsets: (P, 1 + K, 3) metres from the point's own cell.
        context: features (P, K, C).
        context_offsets: (P, K, 3) metres from the estimate.
        truth: (P,) int64, which context cell is the right one: the nearest to where the point truly is.
    """

    support: Tensor
    support_offsets: Tensor
    context: Tensor
    context_offsets: Tensor
    truth: Tensor


def paired_bags(
    clip: Clip, level: Level, neighbors: int, rng: np.random.Generator, step: int = 1, moving: bool | None = None
) -> Bags:
    """Bags of tracked points, `step` frames apart.

    The estimate is put on a random one of the K cells around the truth, so that the right cell can stand anywhere in
    the context and guessing the middle one is right in 1 / K of the cases.

    Args:
        clip: T frames with true tracks.
        level: one level of its feature cloud, (1, T, h, w, ...), world coordinates.
        neighbors: K.
        rng: chooses the estimates.
        step: frames between support and context.
        moving: only tracks that move in the world (True), only those that rest (False), or all (None).

    Returns:
        All points seen in both frames of every fourth pair, whose right cell is in the context.
    """
    tracks, parts = clip.tracks, []
    for start in range(0, len(clip) - step, 4):
        stop = start + step
        chosen = tracks.visible[start] & tracks.visible[stop]
        if moving is not None:
            chosen &= tracks.dynamic == moving
        if not chosen.any():
            continue
        before, after = (torch.from_numpy(tracks.xyz[t, chosen]) for t in (start, stop))
        support, points, _ = _around(level, start, before, neighbors + 1)
        _, near, cells = _around(level, stop, after, neighbors)
        pick = torch.from_numpy(rng.integers(neighbors, size=len(after)))
        estimate = near[torch.arange(len(after)), pick]
        context, there, found = _around(level, stop, estimate, neighbors)
        right = found == cells[:, :1]
        inside = right.any(-1)
        rows = support, points - points[:, :1], context, there - estimate[:, None], right.int().argmax(-1)
        parts.append([x[inside] for x in rows])
    return Bags(*(torch.cat(x) for x in zip(*parts, strict=True)))


def similarity_attention(support: Tensor, context: Tensor, sharpness: float = 5.0) -> Tensor:
    """How much each support token looks at each context token by likeness alone: softmax(-sharpness d^2 / median d^2).

    Args:
        support: (..., M, C) features.
        context: (..., K, C).
        sharpness: one over the temperature.

    Returns:
        (..., M, K), rows sum to 1.
    """
    distance = torch.cdist(support, context).square()
    return (-sharpness * distance / distance.median().clamp(min=1e-12)).softmax(-1)


def votes(attention: Tensor, support_offsets: Tensor, context_offsets: Tensor, width: float = 0.5) -> Tensor:
    """Votes for every context cell j': sum over i, j of (a_ij - 1/K) exp(-|d_j - d_i - d_j'|^2 / (2 sigma^2)), d offsets.

    The 1/K takes away what the bags' shapes alone would say, whatever the tokens look at.

    Args:
        attention: (P, M, K), how support tokens look at context tokens.
        support_offsets: (P, M, 3).
        context_offsets: (P, K, 3).
        width: sigma, in units of the usual distance between neighbouring cells of the context.

    Returns:
        (P, K).
    """
    count = context_offsets.shape[1]
    step = max(1, _CHUNK // (attention.shape[1] * count**2))
    parts = zip(attention.split(step), support_offsets.split(step), context_offsets.split(step), strict=True)
    return torch.cat([_votes(*part, width) for part in parts])


def _votes(attention: Tensor, support: Tensor, context: Tensor, width: float) -> Tensor:
    count = context.shape[1]
    spacing = torch.cdist(context, context) + torch.eye(count).to(context) * 1e9
    sigma = width * spacing.min(-1).values.median(-1).values[:, None, None]
    between = (context[:, None] - context[:, :, None]).flatten(1, 2)  # (P, K K, 3): d_j - d_j', j' first
    kernel = (-(torch.cdist(support, between) / sigma).square() / 2).exp()  # (P, M, K K)
    return torch.einsum("pij,pikj->pk", attention - 1 / count, kernel.unflatten(-1, (count, count)))


def _around(level: Level, frame: int, centers: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Features (P, count, C), points and cell numbers of the nearest valid cells of a frame."""
    features, points, valid = (x[0, frame].flatten(0, 1) for x in (level.features, level.points, level.valid))
    cells = knn(centers[None], points[None], count, valid[None])
    return gather(features[None], cells)[0], gather(points[None], cells)[0], cells[0]
