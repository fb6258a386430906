"""Trial switches of the model; a scratch branch's experiments. `apply` changes a tracker after its construction.

So all parameters that two rows share have the same initial values. Keys of `trial`:

    velocity: f      a window's new frames start at the last position plus f times the constant velocity
    match: r         first estimates start at the most similar cell within r cells (0: anywhere in the image)
    grad2: kind      gradients flow through two consecutive updates: "full", "smooth" (not through Fourier features finer
                     than GRADIENT_DEGREE nor pixels), "residual" (only along coords + delta)
    timebias: kind   relative time bias in temporal attention: "instead" of, or "beside" the absolute embedding
    scalars: b       x = a x + b x0 before every part of the updater, a = 1 and b at first
    zeroinit: where  zero output projections of the blocks: "updater" or "all"
    spread: kind     predicted spread, "one" or "mixture"; `spread_weight` is the factor of its NLL
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tapip3d_lite.geometry import pixel_grid, transform
from tapip3d_lite.model import blocks
from tapip3d_lite.model.blocks import Block
from tapip3d_lite.model.windows import Scene

GRADIENT_DEGREE = 3
_ENOUGH, _RATIO, _JUMP, _NEAR, _DEPTH = 0.3, 3.0, 1.5, 2.5, 0.05


def apply(tracker: nn.Module, trial: dict[str, Any]) -> None:
    """Switch a new tracker's trials on."""
    tracker.trial = dict(trial)
    updater, config = tracker.updater, tracker.config
    if trial.get("grad2") == "smooth":
        blocks.gradient_degree = GRADIENT_DEGREE
    if kind := trial.get("timebias"):
        for block in updater.time:
            block.attention.table = nn.Parameter(torch.zeros(config.heads, 2 * config.window - 1))
        if kind == "instead":
            tracker.time.zero_()
    if "scalars" in trial:
        parts = config.time_depth + config.space_depth
        updater.keep = nn.Parameter(torch.ones(parts))
        updater.again = nn.Parameter(torch.full((parts,), float(trial["scalars"])))
    if where := trial.get("zeroinit"):
        for block in (tracker if where == "all" else updater).modules():
            if isinstance(block, Block):
                for layer in (block.attention.to_out, block.mlp[-1]):
                    nn.init.zeros_(layer.weight)
                    nn.init.zeros_(layer.bias)
    if kind := trial.get("spread"):
        updater.spread = spread = nn.Linear(config.hidden, {"one": 1, "mixture": 2}[kind])
        nn.init.zeros_(spread.weight)
        nn.init.zeros_(spread.bias)
        with torch.no_grad():
            spread.bias[0] = 1.4  # about log 4 pixels


def extrapolate(coords: Tensor, begun: Tensor, half: int, factor: float) -> Tensor:
    """Window starts (B, S, n, 3) whose second half goes on with `factor` times the velocity of the first half's end.

    `begun` (B, n) int64 are the frames of the window from which a track exists; the velocity is over at most two frames.
    """
    back = (half - 1 - begun.clamp(0, half - 1)).clamp(max=2)  # (B, n)
    past = coords.gather(1, (half - 1 - back)[:, None, :, None].expand(-1, 1, -1, 3))  # (B, 1, n, 3)
    velocity = (coords[:, half - 1 : half] - past) / back.clamp(min=1)[:, None, :, None]
    ahead = torch.arange(coords.shape[1], device=coords.device).sub(half - 1).clamp(min=0)  # (S,)
    return coords + factor * ahead[:, None, None] * velocity


@torch.no_grad()
def match_start(scene: Scene, own: Tensor, coords: Tensor, free: Tensor, radius: float) -> Tensor:
    """Starts (B, S, n, 3) in original units, moved to the most similar cell where that is clear and farther than a cell.

    `own` (B, n, C) are the queries' features, `free` (B, S, n) bool frames whose start may change; `radius` in cells of
    the finest level around the start, 0 for the whole image.
    """
    level, frames = scene.levels[0], scene.frames
    batch, count, height, width, channels = level.features.shape
    features = F.layer_norm(level.features.float(), (channels,)).flatten(2, 3)  # (B, S, P, C), as pretraining compares
    own = F.layer_norm(own.float(), (channels,))
    scores = torch.einsum("bspc,bnc->bsnp", features, own) / channels**0.5  # (B, S, n, P)
    places = pixel_grid(height, width, like=coords).flatten(0, 1)  # (P, 2)
    cells = level.cells(scene.space.to_pixels(coords, frames.intrinsics, frames.extrinsics), frames.size)
    scores = scores.masked_fill(~level.valid.flatten(2, 3)[:, :, None], -torch.inf)
    if radius:
        apart = (places - cells[..., None, :]).square().sum(-1)  # (B, S, n, P)
        scores = scores.masked_fill(apart > radius**2, -torch.inf)
    some = scores.isfinite().any(-1)
    share = scores.masked_fill(~some[..., None], 0).softmax(-1)
    peak = share.argmax(-1)  # (B, S, n)
    points = level.points.flatten(2, 3)  # (B, S, P, 3)
    depth = (points - _centres(scene)[:, :, None]).norm(dim=-1)  # (B, S, P), distances stand for depths
    here = places[peak]  # (B, S, n, 2)
    near = (places - here[..., None, :]).square().sum(-1) <= _NEAR**2
    mass = (share * near).sum(-1)
    rest = (share * ((places - cells[..., None, :]).square().sum(-1) <= _NEAR**2)).sum(-1)  # of standing still
    own_depth = depth.gather(2, peak)[..., None]
    weight = share * (near & ((depth[:, :, None] - own_depth).abs() < _DEPTH * own_depth))
    found = weight @ points / weight.sum(-1, keepdim=True).clamp(min=1e-9)  # (B, S, n, 3)
    clear = free & some & (mass > _ENOUGH) & (mass > _RATIO * rest) & ((here - cells).norm(dim=-1) > _JUMP)
    return torch.where(clear[..., None], found, coords)


def _centres(scene: Scene) -> Tensor:
    """The cameras' centres (B, S, 3) in the world; of spaces that move with the camera, the origin."""
    extrinsics = scene.frames.extrinsics
    if scene.space.name != "world":
        return torch.zeros_like(extrinsics[..., 0, :3])
    return transform(torch.zeros_like(extrinsics[..., :1, :3]), torch.linalg.inv(extrinsics))[..., 0, :]
