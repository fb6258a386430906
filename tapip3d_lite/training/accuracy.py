"""`Accuracy`: APD3D on the examples of a training step, computed without waiting for the GPU."""

from __future__ import annotations

import torch
from torch import Tensor

from tapip3d_lite.geometry import RASTER, THRESHOLDS, transform
from tapip3d_lite.model.windows import Step
from tapip3d_lite.training.data import Batch


class Accuracy:
    """APD3D of the last update of every window, over visible points from their query on.

    A point counts for the share of the thresholds k that its error |x - x*| sqrt(fx fy) / d stays below, in pixels of
    the benchmark's raster, with d the true depth.

    Attributes:
        totals: (2, 2), sums over points of (this share, 1), for (all, dynamic) points.
    """

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self.totals = torch.zeros(2, 2, device=device)

    @torch.no_grad()
    def add(self, step: Step, batch: Batch, iterations: int) -> None:
        """Add one update's points to the totals if it is the last of its window."""
        if step.iteration != iterations - 1:
            return
        frames, truth = step.scene.frames, batch.truth
        index = torch.arange(step.start, step.start + len(frames), device=step.coords.device)
        real = index.clamp(max=truth.xyz.shape[1] - 1)
        target, visible = (
            x[:, real][:, :, step.columns] for x in (truth.xyz, truth.visible)
        )  # (B, S, n, 3), (B, S, n)
        counted = visible & (index[None, :, None] >= truth.times[:, None, step.columns]) & step.active[:, None]
        counted &= (index < truth.xyz.shape[1])[None, :, None]
        depth = transform(target, frames.extrinsics)[..., 2].clamp(min=1e-6)
        focal = (frames.intrinsics[..., 0, 0] * frames.intrinsics[..., 1, 1]).sqrt() * (RASTER / min(frames.size))
        pixels = (step.xyz - target).norm(dim=-1) / depth * focal[..., None]
        inside = torch.stack([(pixels < k).float() for k in THRESHOLDS]).mean(0)
        masks = torch.stack([counted, counted & batch.dynamic[:, None, step.columns]])  # (2, B, S, n)
        self.totals += torch.stack([inside * masks, masks.float()]).flatten(2).sum(-1)

    @staticmethod
    def result(totals: Tensor) -> dict[str, float | None]:
        """`apd` and `apd_dynamic` from `totals`, None where no point was visible; this waits for the GPU."""
        inside, counted = totals.tolist()
        names = ("apd", "apd_dynamic")
        return {name: inside[i] / counted[i] if counted[i] else None for i, name in enumerate(names)}
