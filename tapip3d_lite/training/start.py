"""Where a training starts: a random tracker, or one whose attention compares looks and hands on displacements at once.

    cell          = [P_f LN(f) | MLP(fourier(offset))]         looks and places in channels of their own
    Q = K = s P_f,   V = P_o,   Out = -P_o^T                   a cell finds those of the other bag that look like it, and
                                                               subtracts their offsets from its own: how far the bag moved
    weights of sin(2^j x), cos(2^j x)  *= 2^-max(0, j - J)     waves much finer than offsets are noise before they are learnt
    updater's blocks                   = identities            zero output projections

The paper does not say how its weights start. Only the start changes: every weight is trained, and the tracker is the
same. From random weights a small tracker can leave colour unused for long.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor, nn

from tapip3d_lite.model.blocks import DEGREES, FACTOR, Block, OffsetEmbedding
from tapip3d_lite.model.n2n import CellEmbedding
from tapip3d_lite.model.tracker import Tracker

STARTS = ("random", "aligned")
SHARPNESS = 50.0  # logits of the attention at a cosine of 1
_FINEST = {3: 3, 6: 4, 2: 2}  # degrees that keep their weights, by axes: of offsets, motion, pixels


def begin(tracker: Tracker, start: str, head: float) -> None:
    """Let a random tracker start as one of `STARTS`, with `head` as the standard deviation of the output layer's weights."""
    if isinstance(last := getattr(tracker.updater, "head", None), nn.Linear):
        nn.init.normal_(last.weight, std=head)
    if start == "aligned":
        align(tracker)


@torch.no_grad()
def align(tracker: Tracker) -> None:
    """Change a random tracker into one that starts aligned; parts of other kinds than the library's stay as they are."""
    for weight, axes in wave_weights(tracker):
        factors = by_degree([2.0 ** min(0, _FINEST[axes] - j) for j in DEGREES], axes).to(weight)
        weight *= factors / factors.square().mean().sqrt()  # their mean square stays
    context, updater = (x if isinstance(x, nn.Module) else nn.Module() for x in (tracker.context, tracker.updater))
    looks, split = tracker.config.feature_dim, tracker.config.token_dim > tracker.config.feature_dim
    for embed in (part for part in context.modules() if split and isinstance(part, CellEmbedding)):
        nn.init.zeros_(embed.project.bias)
        nn.init.eye_(embed.project.weight)
        for offsets in embed.offsets:
            nn.init.zeros_(offsets[-1].weight[:looks])
    for block in (part for part in context.modules() if isinstance(part, Block) and part.norm_context is not None):
        _compare(block, looks)
    for block in (part for part in updater.modules() if isinstance(part, Block)):
        for layer in (block.attention.to_out, block.mlp[-1]):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)


def wave_weights(tracker: Tracker) -> Iterator[tuple[Tensor, int]]:
    """Columns of weights that read `fourier`, with the number of axes: 3 of offsets, 6 of motion, 2 of pixels."""
    for part in tracker.modules():
        if isinstance(part, OffsetEmbedding):
            yield part[1].weight, 3
    first = getattr(tracker.updater, "input", None)
    if isinstance(first, nn.Linear) and first.in_features == tracker.time.shape[1]:
        pixels = first.in_features - (2 * FACTOR if tracker.config.use_uv else 0)
        yield first.weight[:, pixels - 6 * FACTOR : pixels], 6
        if tracker.config.use_uv:
            yield first.weight[:, pixels:], 2


def by_degree(values: Sequence[float], axes: int, plain: float = 1.0) -> Tensor:
    """A number for each of the outputs of `fourier` of so many axes, from one for each degree; `plain`: of the inputs."""
    waves = torch.tensor(values).repeat_interleave(axes)
    return torch.cat([torch.full((axes,), plain, dtype=waves.dtype), waves, waves])


def _compare(block: Block, looks: int) -> None:
    """Attention that compares the first channels, `looks`, and takes the others; all for both where there are no others."""
    attention, width = block.attention, block.attention.to_q.in_features
    size, split = attention.to_q.out_features // attention.heads, looks if width > looks else 0
    look = torch.eye(size, width)
    place = torch.roll(torch.eye(size, width), split, 1)
    if split:
        look[:, split:] = 0
        place[max(0, width - split) :] = 0
    scale = math.sqrt(SHARPNESS * math.sqrt(size) / looks)
    both = (scale * look).repeat(attention.heads, 1)
    attention.to_q.weight.copy_(both)
    attention.to_kv.weight.copy_(torch.cat([both, place.repeat(attention.heads, 1)]))
    attention.to_out.weight.copy_(-place.T.repeat(1, attention.heads) / attention.heads)
    for layer in (attention.to_q, attention.to_kv, attention.to_out):
        nn.init.zeros_(layer.bias)
