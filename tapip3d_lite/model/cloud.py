"""The multi-scale feature cloud: at every level a grid of cells, each with a feature and a 3D point; and its scale.

    F_{l+1} = 2 x 2 average of F_l,   P_l(cell) = point of the full-resolution pixel nearest to the cell's centre
    x_norm  = (x - mean) / std * scale,  over the valid points of a window

Paper: section 3.2 (multi-scale feature clouds); the normalisation is the released code's.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor


@dataclass(frozen=True)
class Level:
    """One level of the feature cloud of B x T frames.

    Attributes:
        features: (B, T, h, w, C).
        points: (B, T, h, w, 3) in the trajectory's space.
        valid: (B, T, h, w) bool, whether the cell's depth is known.
        extra: anything that a context's `prepare` adds for its neighbourhood, e.g. feature planes; tensors with gradient
            in it stand in lists, tuples or dicts, where the memory-saving backward finds them.
        memory: what neighbourhoods made of the points, e.g. bounding boxes; copies with other points start empty.
    """

    features: Tensor
    points: Tensor
    valid: Tensor
    extra: Any = None
    memory: dict[Any, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def cells(self, uv: Tensor, size: tuple[int, int]) -> Tensor:
        """Pixels (..., 2) of images (H, W) in units of cells, (u w / W, v h / H): the features' convention."""
        height, width = self.points.shape[2:4]
        return torch.stack([uv[..., 0] * width / size[1], uv[..., 1] * height / size[0]], -1)  # (..., 2)

    def cut(self, start: int, stop: int) -> Level:
        """Frames [start, stop)."""
        features, points, valid = (x[:, start:stop] for x in (self.features, self.points, self.valid))
        return replace(self, features=features, points=points, valid=valid)


def feature_cloud(features: Tensor, points: Tensor, valid: Tensor, levels: int) -> list[Level]:
    """L levels, finest first, of features (B, T, C, h, w) with points (B, T, H, W, 3), valid (B, T, H, W) or not.

    Features are averaged 2 x 2 from level to level. Points are never averaged, since the mean of a front and a back
    point lies on neither: each cell takes the point of the full-resolution pixel nearest to its centre.
    """
    batch, count = features.shape[:2]
    maps, cloud = features.flatten(0, 1), []  # (B T, C, h, w)
    for level in range(levels):
        maps = F.avg_pool2d(maps, 2) if level else maps  # (B T, C, h, w)
        rows = nearest_exact(points.shape[2], maps.shape[-2], points.device)
        columns = nearest_exact(points.shape[3], maps.shape[-1], points.device)
        cells = maps.movedim(1, -1).unflatten(0, (batch, count))  # (B, T, h, w, C)
        cloud.append(Level(cells, points[:, :, rows][:, :, :, columns], valid[:, :, rows][:, :, :, columns]))
    return cloud


def nearest_exact(source: int, target: int, device: torch.device) -> Tensor:
    """Indices (target,) of the source pixels nearest to the centres of target cells, rounded as torch's float32 does."""
    scale = float(np.float32(source / target))
    index = ((torch.arange(target, dtype=torch.float32, device=device) + 0.5) * scale).floor().long()
    return index.clamp(max=source - 1)


@dataclass(frozen=True)
class Normalizer:
    """x_norm = (x - mean) / std * scale, of one window.

    Attributes:
        mean: (B, 1, 1, 3).
        std: (B, 1, 1, 1) isotropic, or (B, 1, 1, 3).
        scale: standard deviation of the normalised cloud.
    """

    mean: Tensor
    std: Tensor
    scale: float

    @classmethod
    def fit(
        cls, points: Tensor, valid: Tensor, mode: str = "isotropic", scale: float = 1.0, check: bool = True
    ) -> Normalizer:
        """Statistics of the valid points of a window.

        Args:
            points: (B, S, H, W, 3), in the trajectory's space.
            valid: (B, S, H, W) bool: depth known and inside the region of interest.
            mode: `"isotropic"`: one std over points and axes; `"anisotropy"`: one an axis; `"none"`: identity.
            scale: wanted standard deviation.
            check: for a valid point, which a GPU has to be waited for.

        Raises:
            ValueError: no valid point in a window.
        """
        batch = len(points)
        if mode == "none":
            return cls(points.new_zeros(batch, 1, 1, 3), points.new_ones(batch, 1, 1, 1), 1.0)
        weight = valid.flatten(1).unsqueeze(-1)  # (B, P, 1)
        count = weight.sum(1, keepdim=True)
        if check and not bool((count > 0).all()):
            raise ValueError("depths: a window has no valid point in depth_roi, so there is no scale; widen depth_roi")
        flat = points.flatten(1, 3)  # (B, P, 3)
        mean = torch.where(weight, flat, 0).sum(1, keepdim=True) / count
        square = torch.where(weight, flat - mean, 0).square()
        axes = (1, 2) if mode == "isotropic" else 1
        total = count * 3 if mode == "isotropic" else count
        std = (square.sum(axes, keepdim=True) / total).sqrt()
        return cls(mean[:, None], std[:, None].clamp(min=1e-12), scale)  # (B, 1, 1, 3 or 1)

    def normalize(self, x: Tensor) -> Tensor:
        """(B, ..., 3) to normalised coordinates."""
        mean, std = self._like(x)
        return (x - mean) / std * self.scale

    def restore(self, x: Tensor) -> Tensor:
        """The inverse of `normalize`."""
        mean, std = self._like(x)
        return x / self.scale * std + mean

    def _like(self, x: Tensor) -> tuple[Tensor, Tensor]:
        shape = (len(x), *[1] * (x.ndim - 2))
        return self.mean.reshape(*shape, 3), self.std.reshape(*shape, -1)


def quantile_roi(depths: Tensor) -> tuple[float, float]:
    """Depths (any shape) to a region of interest (near, far) = (1e-7, q75 + 1.5 (q75 - q25)), without outliers.

    Quantiles are the k-th smallest valid depth with k = int(0.25 n), int(0.75 n), counted from one.
    """
    valid = depths[depths > 0].numpy(force=True)
    places = [max(int(share * len(valid)), 1) - 1 for share in (0.25, 0.75)]
    low, high = np.partition(valid, places)[places].tolist()  # no sorting: a long clip has many depths
    return 1e-7, high + 1.5 * (high - low)
