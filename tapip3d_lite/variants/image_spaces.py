"""Image spaces of the paper's ablation: pixels with depth, with log depth, or alone (how 2D trackers work).

uvlogd:  (u, v, sqrt(fx fy) log z)       uvd:  (u, v, (z - near) / (far - near) W)       uv:  (u, v, 0)
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from tapip3d_lite.geometry import pixel_grid, project, unproject
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
        near, far = _depth_ranges(depths.flatten(1))
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
        z = _nearest_depth(depths.reshape(-1, *depths.shape[-2:]), uv.reshape(-1, *uv.shape[-2:]))
        return unproject(uv, z.reshape(uv.shape[:-1]), intrinsics, extrinsics)

    def _encode(self, z: Tensor, intrinsics: Tensor) -> Tensor:
        return torch.zeros_like(z)


def _focal(intrinsics: Tensor) -> Tensor:
    """(..., 1): sqrt(fx fy)."""
    return (intrinsics[..., 0, 0] * intrinsics[..., 1, 1]).sqrt().unsqueeze(-1)


def _per_clip(value: Tensor, like: Tensor) -> Tensor:
    return value.to(like).reshape(*value.shape, *[1] * (like.ndim - value.ndim))


def _depth_ranges(depths: Tensor) -> tuple[Tensor, Tensor]:
    """Nearest and farthest depth (B,) of each row (B, P), outliers (`quantile_roi`) left out; 0 and 1 without depth."""
    valid = depths > 0
    ordered, count = torch.where(valid, depths, torch.inf).double().sort(1).values, valid.sum(1, keepdim=True)
    low, high = (ordered.gather(1, ((share * count).long() - 1).clamp(min=0)) for share in (0.25, 0.75))
    inside = ordered.float() <= (high + 1.5 * (high - low)).float()
    near, far = ordered[:, 0], ordered.masked_fill(~inside, 0).amax(1)
    near, far = torch.where(valid.any(1), near, 0), torch.where(valid.any(1), far.maximum(near * 1.01), 1)
    return near.to(depths), far.to(depths)


def _nearest_depth(depths: Tensor, uv: Tensor) -> Tensor:
    """Depths (F, N) of maps (F, H, W) at the pixels nearest to uv (F, N, 2); holes take the nearest valid pixel's, if any."""
    frames, height, width = depths.shape
    column, row = uv.detach().nan_to_num().round().unbind(-1)
    place = torch.stack([row.clamp(0, height - 1), column.clamp(0, width - 1)], -1)  # (F, N, 2)
    flat = depths.flatten(1)
    z = flat.gather(1, (place[..., 0] * width + place[..., 1]).long())
    if may_wait(depths) and bool((z > 0).all()):
        return z
    pixels = F.pad(pixel_grid(height, width, depths).flip(-1).flatten(0, 1), (0, 1)).expand(frames, -1, 3)
    near = knn(F.pad(place, (0, 1)), pixels, 1, flat > 0)[..., 0]
    return torch.where(z > 0, z, flat.gather(1, near))


def may_wait(x: Tensor) -> bool:
    """Whether a number can be looked at to save work; a GPU's graph (`speed.cuda_graph`) can hold no such look."""
    return not x.is_cuda
