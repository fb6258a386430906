"""The training loss and the accuracy of one update; the loss in the paper's form and in the released code's.

Paper, equation (4): L = sum_m gamma^(M - m) [ sum (1/d) |x - x*| + alpha BCE(v, v*) ], with d the true depth,
gamma = 0.8, alpha = 3. The released code takes means instead of sums, and multiplies the position term by the focal
length, so that it is an error in pixels; the weight of visibility beside position is then smaller by that factor. Ours
always takes means, over the frames from the query on. The options `soften` and `within` are ours, and off by default.

A loss is any callable like `LossConfig`, with the contract of `LossConfig.__call__`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from tapip3d_lite.geometry import RASTER, THRESHOLDS, transform
from tapip3d_lite.model.windows import Step
from tapip3d_lite.validate import check_range, check_types

FORMS = ("paper", "pixels")


@dataclass(frozen=True)
class Truth:
    """The true tracks of a batch.

    Attributes:
        xyz: (B, T, N, 3) positions, world; NaN where a hidden point's is unknown, which counts as no error.
        visible: (B, T, N) bool.
        times: (B, N) int64, frames of the queries; only frames from there on count.
    """

    xyz: Tensor
    visible: Tensor
    times: Tensor


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss.

    Attributes:
        form: `"paper"`: distances divided by depth; `"pixels"`: that times sqrt(fx fy), as in the released code.
        visibility: alpha, weight of the visibility term relative to the position term.
        discount: gamma, weight of an update relative to the update after it.
        scale: factor of the whole loss.
        soften: c in pixels, or 0 for the plain distance. An error of e pixels counts as c log(1 + e / c). The metrics
            count errors below 1, 2, 4, 8 and 16 pixels, which is logarithmic in the error as well.
        within: pixels, or 0. The target of visibility is true only where this update's position error is smaller than
            that, so that "visible" means "visible and well located": AJ counts a visible point in a wrong place twice.
            TAPIR and CoTracker3 learn such a confidence separately from visibility.

    Raises:
        ValueError: an unknown form, or a weight outside its range.
    """

    form: str = "pixels"
    visibility: float = 3.0
    discount: float = 0.8
    scale: float = 0.005
    soften: float = 0.0
    within: float = 0.0

    def __post_init__(self) -> None:
        check_types(self)
        if self.form not in FORMS:
            raise ValueError(f'LossConfig.form: expected "paper" or "pixels", got {self.form!r}')
        check_range(self, 0, math.inf, "visibility", "scale", "soften", "within")
        if not 0 < self.discount <= 1:
            raise ValueError(f"LossConfig.discount: expected a value in (0, 1], got {self.discount}")

    def __call__(self, step: Step, truth: Truth, iterations: int) -> tuple[Tensor, Tensor]:
        """The two terms of `step_loss`: what every loss is called for.

        Args:
            step: one update of one window, with gradient in `coords` (so in `xyz`) and `logits`.
            truth: of all frames and tracks of the batch; `step.start` and `step.columns` say which are the window's.
            iterations: M; `step.iteration` runs from 0 to M - 1.

        Returns:
            Terms of position and of visibility, two finite scalars whose sum is minimised, the mean of what each clip
            has alone. Not counted are frames before the query, padded frames (repetitions of the last one), inactive
            tracks, which only fill up the batch, and positions that are NaN. A class is called without arguments once;
            what it learnt itself would not be trained.
        """
        return step_loss(step, truth, iterations, self)


Loss = Callable[[Step, Truth, int], tuple[Tensor, Tensor]]


def step_loss(step: Step, truth: Truth, iterations: int, config: LossConfig) -> tuple[Tensor, Tensor]:
    """Position and visibility terms of one of M updates, weighted and discounted; see `LossConfig.__call__`."""
    target, visible, counted, depth, focal = compared(step, truth)
    depth = depth.clamp(min=0.1)
    pixels = (step.xyz - target).square().sum(-1).add(1e-12).sqrt() / depth * focal
    if config.within:
        visible = visible & (pixels < config.within)
    error = config.soften * torch.log1p(pixels / config.soften) if config.soften else pixels
    if config.form == "paper":
        error = error / focal
    entropy = F.binary_cross_entropy_with_logits(step.logits, visible.to(step.logits.dtype), reduction="none")
    weight = config.scale * config.discount ** (iterations - 1 - step.iteration)
    # A mean over each clip, then over clips: so the mean over processes is the mean over all their clips.
    total = counted.flatten(1).sum(1).clamp(min=1)
    position, visibility = (((x * counted).flatten(1).sum(1) / total).mean() for x in (error, entropy))
    return weight * position, weight * config.visibility * visibility


@torch.no_grad()
def step_accuracy(step: Step, truth: Truth, dynamic: Tensor) -> Tensor:
    """APD3D of one update, over visible points from their query on, without waiting for the GPU.

    A point counts for the share of the thresholds k that its error |x - x*| sqrt(fx fy) / d stays below, in pixels of
    the benchmark's raster, with d the true depth.

    Returns:
        (2, 2), sums over points of (this share, 1), for (all, dynamic) points, of which `dynamic` (B, N) is the mask.
    """
    target, visible, counted, depth, focal = compared(step, truth)
    counted = counted & visible
    raster = RASTER / min(step.scene.frames.size)
    pixels = (step.xyz - target).norm(dim=-1) / depth.clamp(min=1e-6) * (focal * raster)
    inside = torch.stack([(pixels < k).float() for k in THRESHOLDS]).mean(0)
    masks = torch.stack([counted, counted & dynamic[:, None, step.columns]])  # (2, B, S, n)
    return torch.stack([inside * masks, masks.float()]).flatten(2).sum(-1)


def accuracy(totals: Tensor) -> dict[str, float | None]:
    """`apd` and `apd_dynamic` from sums of `step_accuracy`, None where no point was visible; this waits for the GPU."""
    names, (inside, counted) = ("apd", "apd_dynamic"), totals.tolist()
    return {name: part / count if count else None for name, part, count in zip(names, inside, counted, strict=True)}


def compared(step: Step, truth: Truth) -> tuple[Tensor, ...]:
    """True positions (B, S, n, 3) and visibility (B, S, n) of a window, which of them count, depths, focal lengths (B, S, 1)."""
    frames, last = step.scene.frames, truth.xyz.shape[1] - 1
    index = torch.arange(step.start, step.start + len(frames), device=step.coords.device)
    real = index.clamp(max=last)
    target, visible = (x[:, real][:, :, step.columns] for x in (truth.xyz, truth.visible))
    target = torch.where(target.isfinite(), target, step.xyz.detach())
    counted = (index[None, :, None] >= truth.times[:, None, step.columns]) & step.active[:, None]
    counted = counted & (index <= last)[None, :, None]
    focal = (frames.intrinsics[..., 0, 0] * frames.intrinsics[..., 1, 1]).sqrt()[..., None]
    return target, visible, counted, transform(target, frames.extrinsics)[..., 2], focal
