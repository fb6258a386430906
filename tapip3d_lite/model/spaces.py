"""Trajectory spaces: in which coordinates points, clouds and motion are expressed.

Paper: section 3.2 and table 4. In `world` the cameras' motion is cancelled and a static point has a constant
trajectory; in `camera` every frame has its own axes, so a static point moves against the camera's motion.

A space is any object with the four methods of `Space`; cameras always come per frame.
"""

from __future__ import annotations

from torch import Tensor

from tapip3d_lite.geometry import invert, point_map, project, transform


class Space:
    """World coordinates: the space that all frames share (the base of the others, whose methods they replace)."""

    name = "world"

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
