"""Image spaces of the paper's ablation: pixels with depth, with log depth, or alone (how 2D trackers work).

uvlogd:  (u, v, sqrt(fx fy) log z)       uvd:  (u, v, (z - near) / (far - near) W)       uv:  (u, v, 0)
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from tapip3d_lite.geometry import pixel_grid, project, unproject
from tapip3d_lite.model.cloud import quantile_roi
from tapip3d_lite.model.neighbors import knn
from tapip3d_lite.model.spaces import Space


class UVLogD(Space):
    """Pixels and sqrt(fx fy) log z, which is in pixels too; the camera's motion and perspective stay in."""

    name = "uvlogd"

    def lift(self, depths: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> Tensor:
        """Depth maps (..., H, W) to (..., H, W, 3); cells without depth are put at a depth of 1e-3."""
        height, width = depths.shape[-2:]
        uv = pixel_grid(height, width, depths).expand(*depths.shape, 2)
        third = self._encode(depths.flatten(-2), intrinsics).unflatten(-1, (height, width))
        return torch.cat([uv, third.unsqueeze(-1)], -1)

    def from_world(self, xyz: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> Tensor:
        """World points (..., N, 3) in this space."""
        uv, z = project(xyz, intrinsics, extrinsics)
        return torch.cat([uv, self._encode(z, intrinsics).unsqueeze(-1)], -1)

    def to_world(self, coords: Tensor, intrinsics: Tensor, extrinsics: Tensor, depths: Tensor) -> Tensor:
        """Coordinates of this space (..., N, 3) in the world."""
        return unproject(coords[..., :2], self._decode(coords[..., 2], intrinsics), intrinsics, extrinsics)

    def to_pixels(self, coords: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> Tensor:
        """Pixels (..., N, 2) of coordinates (..., N, 3) of this space."""
        return coords[..., :2]

    def _encode(self, z: Tensor, intrinsics: Tensor) -> Tensor:
        return _focal(intrinsics) * z.clamp(min=1e-3).log()

    def _decode(self, third: Tensor, intrinsics: Tensor) -> Tensor:
        return (third / _focal(intrinsics)).clamp(max=20).exp()


class UVD(UVLogD):
    """Pixels and (z - near) / (far - near) W as SpatialTracker's, so that the three axes are comparable.

    Args:
        near: (B,) depth whose third coordinate is 0.
        unit: (B,) pixels in one unit of depth.
    """

    name = "uvd"

    def __init__(self, near: Tensor | float = 0.0, unit: Tensor | float = 1.0) -> None:
        self.near, self.unit = torch.as_tensor(near), torch.as_tensor(unit)

    def fit(self, depths: Tensor, extrinsics: Tensor) -> UVD:
        """Near and far of each clip's first frame, outliers (sky) left out; later frames are not known to a stream."""
        ranges = [_depth_range(depth) for depth in depths]
        near, far = (torch.tensor(x, dtype=depths.dtype, device=depths.device) for x in zip(*ranges, strict=True))
        return UVD(near, depths.shape[-1] / (far - near))

    def _encode(self, z: Tensor, intrinsics: Tensor) -> Tensor:
        return (z - _per_clip(self.near, z)) * _per_clip(self.unit, z)

    def _decode(self, third: Tensor, intrinsics: Tensor) -> Tensor:
        return third / _per_clip(self.unit, third) + _per_clip(self.near, third)


class UV(UVLogD):
    """Pixels alone (the third axis is always 0); a trajectory is lifted at the end by the depth where it ended up."""

    name = "uv"
    free_axes = (1.0, 1.0, 0.0)

    def to_world(self, coords: Tensor, intrinsics: Tensor, extrinsics: Tensor, depths: Tensor) -> Tensor:
        """Pixels lifted by the depth of the nearest pixel that has one (interpolation would mix surfaces)."""
        uv = coords[..., :2]
        maps = zip(depths.reshape(-1, *depths.shape[-2:]), uv.reshape(-1, *uv.shape[-2:]), strict=True)
        z = torch.stack([_nearest_depth(*frame) for frame in maps])
        return unproject(uv, z.reshape(uv.shape[:-1]), intrinsics, extrinsics)

    def _encode(self, z: Tensor, intrinsics: Tensor) -> Tensor:
        return torch.zeros_like(z)


def _focal(intrinsics: Tensor) -> Tensor:
    """(..., 1): sqrt(fx fy)."""
    return (intrinsics[..., 0, 0] * intrinsics[..., 1, 1]).sqrt().unsqueeze(-1)


def _per_clip(value: Tensor, like: Tensor) -> Tensor:
    return value.to(like).reshape(*value.shape, *[1] * (like.ndim - value.ndim))


def _depth_range(depth: Tensor) -> tuple[float, float]:
    valid = depth[depth > 0]
    if not len(valid):
        return 0.0, 1.0
    near, far = float(valid.min()), float(valid[valid <= quantile_roi(valid)[1]].max())
    return near, max(far, near * 1.01)


def _nearest_depth(depth: Tensor, uv: Tensor) -> Tensor:
    """Depth (N,) of a map (H, W) at the pixels nearest to uv (N, 2); holes take the nearest valid pixel's, if any."""
    last = torch.tensor([depth.shape[1] - 1, depth.shape[0] - 1], dtype=uv.dtype, device=uv.device)
    column, row = uv.detach().nan_to_num().round().clamp(min=torch.zeros_like(last), max=last).long().unbind(-1)
    z, hole, valid = depth[row, column], depth[row, column] <= 0, (depth > 0).nonzero()
    if len(valid) and bool(hole.any()):
        here, there = (F.pad(x.float(), (0, 1)) for x in (torch.stack([row, column], -1)[hole], valid))
        near = valid[knn(here[None], there[None], 1)[0, :, 0]]
        z = z.masked_scatter(hole, depth[near[:, 0], near[:, 1]])
    return z
