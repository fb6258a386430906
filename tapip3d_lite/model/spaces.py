"""Trajectory spaces: in which coordinates points, clouds and motion are expressed.

Paper: section 3.2 and table 4. In `world` the cameras' motion is cancelled and a static point has a constant
trajectory; in `camera` every frame has its own axes, so a static point moves against the camera's motion.

The image spaces of table 4 stand beside them: pixels with depth (`uvd`), with log depth (`uvlogd`), or alone (`uv`, which
is how 2D trackers work; depth then lifts their result). A space is any object with the four methods `lift`, `from_world`,
`to_world` and `to_pixels` of `Space`; cameras always come per frame.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from tapip3d_lite.geometry import invert, pixel_grid, point_map, project, transform, unproject
from tapip3d_lite.model.cloud import quantile_roi
from tapip3d_lite.model.frames import Frames
from tapip3d_lite.model.neighbors import knn


class Space:
    """World coordinates: the space that all frames share (the base of the others, whose methods they replace)."""

    name = "world"
    moves = (1.0, 1.0, 1.0)  # axes along which a trajectory may move

    def fit(self, depths: Tensor, extrinsics: Tensor) -> Space:
        """The space for clips whose first frames have depths (B, H, W) (for `uvd`) and poses (B, 4, 4) (for `first`)."""
        return self

    def lift(self, depths: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> Tensor:
        """Depth maps to point maps in this space.

        Args:
            depths: (..., H, W).
            intrinsics: (..., 3, 3).
            extrinsics: (..., 4, 4).

        Returns:
            (..., H, W, 3); cells without depth lie at the camera's centre.
        """
        return point_map(depths, intrinsics, extrinsics)

    def from_world(self, xyz: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> Tensor:
        """World points (..., N, 3), seen by the cameras (..., 3, 3) and (..., 4, 4), in this space (..., N, 3)."""
        return xyz

    def to_world(self, coords: Tensor, intrinsics: Tensor, extrinsics: Tensor, depths: Tensor) -> Tensor:
        """The inverse of `from_world`; depths (..., H, W) serve the spaces that have no third axis of their own."""
        return coords

    def to_pixels(self, coords: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> Tensor:
        """Pixels (..., N, 2) at which the cameras see coords (..., N, 3) of this space."""
        return project(coords, intrinsics, extrinsics)[0]


class World(Space):
    """World coordinates."""


class First(Space):
    """World coordinates told in the frame of the clip's first camera.

    The model reads offsets and motion axis by axis, so in `world` its answer depends on how the world's axes happen to
    lie. Here it does not: moving scene and cameras by any rigid motion moves the tracks by it.
    """

    name = "first"
    anchor: Tensor  # (B, 4, 4), world to first camera

    def fit(self, depths: Tensor, extrinsics: Tensor) -> Space:
        """See `Space.fit`."""
        space = First()
        space.anchor = extrinsics[:, None]
        return space

    def lift(self, depths: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> Tensor:
        """See `Space.lift`."""
        return point_map(depths, intrinsics, extrinsics @ invert(self.anchor))

    def from_world(self, xyz: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> Tensor:
        """See `Space.from_world`."""
        return transform(xyz, self.anchor)

    def to_world(self, coords: Tensor, intrinsics: Tensor, extrinsics: Tensor, depths: Tensor) -> Tensor:
        """See `Space.to_world`."""
        return transform(coords, invert(self.anchor))

    def to_pixels(self, coords: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> Tensor:
        """See `Space.to_pixels`."""
        return project(coords, intrinsics, extrinsics @ invert(self.anchor))[0]


class Camera(Space):
    """Each frame's camera coordinates: a query is moved to the camera of its own query frame ("local" as released)."""

    name = "camera"

    def lift(self, depths: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> Tensor:
        """See `Space.lift`."""
        return point_map(depths, intrinsics)

    def from_world(self, xyz: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> Tensor:
        """See `Space.from_world`."""
        return transform(xyz, extrinsics)

    def to_world(self, coords: Tensor, intrinsics: Tensor, extrinsics: Tensor, depths: Tensor) -> Tensor:
        """See `Space.to_world`."""
        return transform(coords, invert(extrinsics))

    def to_pixels(self, coords: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> Tensor:
        """See `Space.to_pixels`."""
        return project(coords, intrinsics)[0]


class UVLogD(Space):
    """Pixels and sqrt(fx fy) log z, which is in pixels too; the camera's motion and perspective stay in."""

    name = "uvlogd"

    def lift(self, depths: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> Tensor:
        """See `Space.lift`; cells without depth are put at a depth of 1e-3."""
        height, width = depths.shape[-2:]
        uv = pixel_grid(height, width, depths).expand(*depths.shape, 2)
        third = self._encode(depths.flatten(-2), intrinsics).unflatten(-1, (height, width))
        return torch.cat([uv, third.unsqueeze(-1)], -1)

    def from_world(self, xyz: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> Tensor:
        """See `Space.from_world`."""
        uv, z = project(xyz, intrinsics, extrinsics)
        return torch.cat([uv, self._encode(z, intrinsics).unsqueeze(-1)], -1)

    def to_world(self, coords: Tensor, intrinsics: Tensor, extrinsics: Tensor, depths: Tensor) -> Tensor:
        """See `Space.to_world`."""
        return unproject(coords[..., :2], self._decode(coords[..., 2], intrinsics), intrinsics, extrinsics)

    def to_pixels(self, coords: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> Tensor:
        """See `Space.to_pixels`."""
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
    moves = (1.0, 1.0, 0.0)

    def to_world(self, coords: Tensor, intrinsics: Tensor, extrinsics: Tensor, depths: Tensor) -> Tensor:
        """See `Space.to_world`: the depth of the nearest pixel that has one (interpolation would mix surfaces)."""
        uv = coords[..., :2]
        maps = zip(depths.reshape(-1, *depths.shape[-2:]), uv.reshape(-1, *uv.shape[-2:]), strict=True)
        z = torch.stack([_nearest_depth(*frame) for frame in maps])
        return unproject(uv, z.reshape(uv.shape[:-1]), intrinsics, extrinsics)

    def _encode(self, z: Tensor, intrinsics: Tensor) -> Tensor:
        return torch.zeros_like(z)


def _focal(intrinsics: Tensor) -> Tensor:
    """(..., 1): sqrt(fx fy)."""
    return (intrinsics[..., 0, 0] * intrinsics[..., 1, 1]).sqrt().unsqueeze(-1)


def fitted(space: Any, frames: Frames) -> Any:
    """A space for the clips whose frames these are; custom spaces need no `fit`."""
    return space.fit(frames.depths[:, 0], frames.extrinsics[:, 0]) if hasattr(space, "fit") else space


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
