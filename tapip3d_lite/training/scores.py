"""How well it goes: accuracy on the examples just seen, scores on held-out clips."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from tapip3d_lite.clip import Clip
from tapip3d_lite.evaluation.evaluate import evaluate, mean_scores
from tapip3d_lite.geometry import RASTER, transform
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.model.windows import Step
from tapip3d_lite.training.data import Batch

_THRESHOLDS = (1, 2, 4, 8, 16)  # pixels of the benchmark's raster


class Accuracy:
    """APD3D of the last update of every window, over visible points from their query on; all and dynamic ones."""

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self.totals = torch.zeros(2, 2, device=device)  # (inside, counted) x (all, dynamic)

    @torch.no_grad()
    def add(self, step: Step, batch: Batch, iterations: int) -> None:
        """Look at one update; only the last of a window counts."""
        if step.iteration != iterations - 1:
            return
        frames, truth = step.scene.frames, batch.truth
        index = torch.arange(step.start, step.start + len(frames), device=step.coords.device)
        real = index.clamp(max=truth.xyz.shape[1] - 1)
        target, seen = (x[:, real][:, :, step.columns] for x in (truth.xyz, truth.visible))
        counted = seen & (index[None, :, None] >= truth.times[:, None, step.columns]) & step.active[:, None]
        counted &= (index < truth.xyz.shape[1])[None, :, None]
        depth = transform(target, frames.extrinsics)[..., 2].clamp(min=1e-6)
        focal = (frames.intrinsics[..., 0, 0] * frames.intrinsics[..., 1, 1]).sqrt() * (RASTER / min(frames.size))
        pixels = (step.xyz - target).norm(dim=-1) / depth * focal[..., None]
        inside = torch.stack([(pixels < k).float() for k in _THRESHOLDS]).mean(0)
        masks = torch.stack([counted, counted & batch.dynamic[:, None, step.columns]])
        sums = torch.stack([inside * masks, masks.float()]).flatten(2).sum(-1)
        self.totals += sums  # read only at the end: asking a GPU for a number waits for it

    @staticmethod
    def result(totals: Tensor) -> dict[str, float | None]:
        """`apd` and `apd_dynamic` of `totals`, None where nothing was to be seen."""
        inside, counted = totals.tolist()
        names = ("apd", "apd_dynamic")
        return {name: inside[i] / counted[i] if counted[i] else None for i, name in enumerate(names)}


def validate(tracker: Tracker, clips: Sequence[Clip]) -> dict[str, float]:
    """Mean scores on held-out clips in world space, names prefixed by `val_`."""
    was_training = tracker.training
    tracker.eval()
    with torch.compiler.set_stance("force_eager"):  # held-out clips differ in shape from what parts are compiled for
        scores = mean_scores([evaluate(tracker.track(clip), clip) for clip in clips])
    tracker.train(was_training)
    names = ("AJ3D_none", "APD3D_none", "OA", "AJ3D_none_dynamic", "APD3D_none_dynamic", "APD3D_none_static")
    return {f"val_{name}": round(scores[name], 4) for name in names}
