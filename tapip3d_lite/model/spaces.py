"""Trajectory spaces: in which coordinates points, clouds and motion are expressed.

Paper: section 3.2 and table 4. In `world` the cameras' motion is cancelled and a static point has a constant
trajectory; in `camera` every frame has its own axes, so a static point moves against the camera's motion.

The image spaces of table 4 stand beside them: pixels with depth (`uvd`), with log depth (`uvlogd`), or alone (`uv`, which
is how 2D trackers work; depth then lifts their result). A space is any object with the four methods of `Space`; cameras
always come per frame.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tapip3d_lite.geometry import invert, pixel_grid, point_map, project, transform, unproject


class Space:
    """World coordinates: the space that all frames share (the base of the others, whose methods they replace)."""

    name = "world"
    moves = (1.0, 1.0, 1.0)  # axes along which a trajectory may move

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
    """Pixels and z. The axes have different units, so a tracker in this space needs `norm_mode="anisotropy"`."""

    name = "uvd"

    def _encode(self, z: Tensor, intrinsics: Tensor) -> Tensor:
        return z

    def _decode(self, third: Tensor, intrinsics: Tensor) -> Tensor:
        return third


class UV(UVLogD):
    """Pixels alone (the third axis is always 0); a trajectory is lifted at the end by the depth where it ended up."""

    name = "uv"
    moves = (1.0, 1.0, 0.0)

    def to_world(self, coords: Tensor, intrinsics: Tensor, extrinsics: Tensor, depths: Tensor) -> Tensor:
        """See `Space.to_world`: the depth of the nearest pixel, or the frame's median where that is unknown."""
        height, width = depths.shape[-2:]
        u, v = coords[..., 0].round().clamp(0, width - 1), coords[..., 1].round().clamp(0, height - 1)
        flat = depths.flatten(-2)
        z = flat.gather(-1, (v * width + u).long())
        median = torch.where(flat > 0, flat, torch.nan).nanmedian(-1, keepdim=True).values.nan_to_num(1.0)
        return unproject(coords[..., :2], torch.where(z > 0, z, median), intrinsics, extrinsics)

    def _encode(self, z: Tensor, intrinsics: Tensor) -> Tensor:
        return torch.zeros_like(z)


def _focal(intrinsics: Tensor) -> Tensor:
    """(..., 1): sqrt(fx fy)."""
    return (intrinsics[..., 0, 0] * intrinsics[..., 1, 1]).sqrt().unsqueeze(-1)
