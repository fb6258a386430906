"""The training loss of one update, in the paper's form and in the released code's.

Paper, section 3.5: L = sum_m gamma^(M - m) [ (1/d) |x - x*| + alpha BCE(v, v*) ], with d the true depth, gamma = 0.8,
alpha = 3. The released code multiplies the distance by the focal length, so that it is an error in pixels; then the
position term outweighs visibility about as many times as the focal length has pixels. Two options go beyond both, and
are off unless asked for: `soften` and `within`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from tapip3d_lite.geometry import transform
from tapip3d_lite.model.windows import Step


@dataclass(frozen=True)
class Truth:
    """What really happened, for a batch.

    Attributes:
        xyz: (B, T, N, 3), world.
        visible: (B, T, N) bool.
        times: (B, N) int64 query frames; only frames from there on are scored.
    """

    xyz: Tensor
    visible: Tensor
    times: Tensor


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss.

    Attributes:
        form: `"paper"`: distances divided by depth; `"pixels"`: that times sqrt(fx fy), as released.
        visibility: alpha, weight of the visibility term beside the position term.
        discount: gamma, weight of an update relative to the one after it.
        scale: multiplies everything.
        soften: c pixels, or 0 for the plain distance. An error of e pixels counts as c log(1 + e / c): the scores count
            thresholds that double (1, 2, ... 16 pixels), so they measure the logarithm of an error, too.
        within: pixels, or 0. A point is taught as visible only where this update puts it that near to the truth, so
            that "visible" means "seen and trusted": a point called visible in a wrong place costs AJ twice. TAPIR and
            CoTracker3 learn such a confidence beside the visibility.

    Raises:
        ValueError: an unknown form or a weight that cannot be.
    """

    form: str = "pixels"
    visibility: float = 3.0
    discount: float = 0.8
    scale: float = 0.005
    soften: float = 0.0
    within: float = 0.0

    def __post_init__(self) -> None:
        if self.form not in ("paper", "pixels"):
            raise ValueError(f'LossConfig.form: expected "paper" or "pixels", got {self.form!r}')
        if min(self.visibility, self.scale, self.soften, self.within) < 0:
            raise ValueError("LossConfig: visibility, scale, soften and within must not be negative")
        if not 0 < self.discount <= 1:
            raise ValueError(f"LossConfig.discount: expected a value in (0, 1], got {self.discount}")


def step_loss(step: Step, truth: Truth, iterations: int, config: LossConfig) -> tuple[Tensor, Tensor]:
    """Position and visibility terms of one update, weighted and discounted.

    Args:
        step: from `Tracker.steps`.
        truth: of all frames and tracks of the same batch.
        iterations: M.
        config: weights.

    Returns:
        Two scalars whose sum is to be minimised. Frames before the query, padded frames (repeats of the last one) and
        tracks that only fill up the batch do not count.
    """
    frames = step.scene.frames
    index = torch.arange(step.start, step.start + len(frames), device=step.coords.device)
    real = index.clamp(max=truth.xyz.shape[1] - 1)
    target, visible = truth.xyz[:, real][:, :, step.columns], truth.visible[:, real][:, :, step.columns]
    counted = (index[None, :, None] >= truth.times[:, None, step.columns]) & step.active[:, None]
    counted = counted & (index < truth.xyz.shape[1])[None, :, None]
    depth = transform(target, frames.extrinsics)[..., 2].clamp(min=0.1)
    focal = (frames.intrinsics[..., 0, 0] * frames.intrinsics[..., 1, 1]).sqrt()[..., None]
    pixels = (step.xyz - target).square().sum(-1).add(1e-12).sqrt() / depth * focal
    if config.within:
        visible = visible & (pixels < config.within)
    error = config.soften * torch.log1p(pixels / config.soften) if config.soften else pixels
    if config.form == "paper":
        error = error / focal
    entropy = F.binary_cross_entropy_with_logits(step.logits, visible.to(step.logits.dtype), reduction="none")
    weight = config.scale * config.discount ** (iterations - 1 - step.iteration)
    # A mean over each clip, then over clips: so the mean over processes is the mean over their joint batch.
    position, visibility = (
        ((x * counted).flatten(1).sum(1) / counted.flatten(1).sum(1).clamp(min=1)).mean() for x in (error, entropy)
    )
    return weight * position, weight * config.visibility * visibility
