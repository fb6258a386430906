"""Where a training starts: a random tracker, or one whose attention compares looks and hands on displacements at once.

    cell          = [P_f LN(f) | MLP(fourier(offset))]         looks and places in channels of their own
    Q = K = s P_f,   V = P_o,   Out = -P_o^T                   a cell finds those of the other bag that look like it, and
                                                               subtracts their offsets from its own: how far the bag moved
    weights of sin(2^j x), cos(2^j x)  *= 2^-max(0, j - J)     waves much finer than offsets are noise before they are learnt
    updater's blocks                   = identities            zero output projections

The paper does not say how its weights start. Only the start changes: every weight is trained, and the tracker is the
same. From random weights a small tracker does not use colour within its first thousands of steps.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from tapip3d_lite.model.blocks import DEGREES, FACTOR, Block, OffsetEmbedding
from tapip3d_lite.model.n2n import CellEmbedding
from tapip3d_lite.model.tracker import Tracker

STARTS = ("random", "aligned")
SHARPNESS = 50.0  # logits of the attention at a cosine of 1
_OFFSETS, _MOTION, _PIXELS = 3, 4, 2  # finest degrees that keep their weights


def begin(tracker: Tracker, start: str, head: float) -> None:
    """Let a random tracker start as one of `STARTS`, with `head` as the standard deviation of the output layer's weights."""
    if isinstance(last := getattr(tracker.updater, "head", None), nn.Linear):
        nn.init.normal_(last.weight, std=head)
    if start == "aligned":
        align(tracker)


@torch.no_grad()
def align(tracker: Tracker) -> None:
    """Change a random tracker into one that starts aligned; parts of other kinds than the library's stay as they are."""
    for part in tracker.modules():
        if isinstance(part, OffsetEmbedding):
            _fade(part[1].weight, 3, _OFFSETS)
    context, updater = (x if isinstance(x, nn.Module) else nn.Module() for x in (tracker.context, tracker.updater))
    looks = tracker.config.feature_dim
    for embed in (part for part in context.modules() if isinstance(part, CellEmbedding)):
        if tracker.config.token_dim > looks:
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
    if isinstance(first := getattr(updater, "input", None), nn.Linear) and first.in_features == tracker.time.shape[1]:
        pixels = first.in_features - (2 * FACTOR if tracker.config.use_uv else 0)
        _fade(first.weight[:, pixels - 6 * FACTOR : pixels], 6, _MOTION)
        _fade(first.weight[:, pixels:], 2, _PIXELS)


def _fade(weight: Tensor, axes: int, degree: int) -> None:
    """Let columns for `fourier` of so many axes fade above a degree; their mean square stays."""
    if weight.shape[1]:
        waves = torch.tensor([2.0 ** min(0, degree - j) for j in DEGREES]).repeat_interleave(axes)
        factors = torch.cat([torch.ones(axes), waves, waves]).to(weight)
        weight *= factors / factors.square().mean().sqrt()


def _compare(block: Block, looks: int) -> None:
    """Attention that compares the first channels, `looks`, and takes the others; all for both where there are no others."""
    attention, width = block.attention, block.attention.to_q.in_features
    inner = attention.to_q.out_features
    size, split = inner // attention.heads, looks if width > looks else 0
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
