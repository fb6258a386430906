"""Trajectory spaces: in which coordinates points, clouds and motion are expressed.

    camera:  x = z K^-1 (u, v, 1)^T                  world:  x = E_t^-1 (camera coordinates of frame t)

Paper: section 3.2 ("lifting") and its ablation of coordinate spaces. In `world` the cameras' motion is cancelled and a
static point has a constant trajectory; in `camera` every frame has its own axes, so a static point moves against the
camera's motion. The paper's world is the first camera's frame; here `world` is the frame in which the clip's poses are
given (as in the released code), and `first` the paper's.

A space is any object with the four methods `lift`, `from_world`, `to_world` and `to_pixels` of `Space`; cameras always
come per frame. The image spaces of the ablation are in `variants.image_spaces`.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from tapip3d_lite.geometry import invert, point_map, project, transform
from tapip3d_lite.model.frames import Frames


class Space:
    """World coordinates: the space that all frames share (the base of the others, whose methods they replace)."""

    name = "world"
    free_axes = (1.0, 1.0, 1.0)  # 1 for each axis along which a trajectory may move, else 0

    def fit(self, depths: Tensor, extrinsics: Tensor) -> Space:
        """The space for clips whose first frames have depths (B, H, W) (for `uvd`) and poses (B, 4, 4) (for `first`)."""
        return self

    def lift(self, depths: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> Tensor:
        """Depth maps (..., H, W) of cameras (..., 3, 3) and (..., 4, 4) to point maps (..., H, W, 3) in this space.

        Cells without depth lie at the camera's centre.
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
    """World coordinates expressed in the frame of the clip's first camera, as in the paper.

    The model reads offsets and motion axis by axis, so in `world` its answer depends on how the world's axes happen to
    lie. Here it does not: moving scene and cameras by any rigid motion moves the tracks by it.
    """

    name = "first"
    anchor: Tensor  # (B, 4, 4), world to first camera

    def fit(self, depths: Tensor, extrinsics: Tensor) -> Space:
        """The space of clips whose first cameras have poses (B, 4, 4)."""
        space = First()
        space.anchor = extrinsics[:, None]  # (B, 1, 4, 4)
        return space

    def lift(self, depths: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> Tensor:
        """Depth maps (..., H, W) to point maps (..., H, W, 3) in this space."""
        return point_map(depths, intrinsics, extrinsics @ invert(self.anchor))

    def from_world(self, xyz: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> Tensor:
        """World points (..., N, 3) in this space."""
        return transform(xyz, self.anchor)

    def to_world(self, coords: Tensor, intrinsics: Tensor, extrinsics: Tensor, depths: Tensor) -> Tensor:
        """Coordinates of this space (..., N, 3) in the world."""
        return transform(coords, invert(self.anchor))

    def to_pixels(self, coords: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> Tensor:
        """Pixels (..., N, 2) of coordinates (..., N, 3) of this space."""
        return project(coords, intrinsics, extrinsics @ invert(self.anchor))[0]


class Camera(Space):
    """Each frame's camera coordinates: a query is moved to the camera of its own query frame ("local" as released)."""

    name = "camera"

    def lift(self, depths: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> Tensor:
        """Depth maps (..., H, W) to point maps (..., H, W, 3) in this space."""
        return point_map(depths, intrinsics)

    def from_world(self, xyz: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> Tensor:
        """World points (..., N, 3) in this space."""
        return transform(xyz, extrinsics)

    def to_world(self, coords: Tensor, intrinsics: Tensor, extrinsics: Tensor, depths: Tensor) -> Tensor:
        """Coordinates of this space (..., N, 3) in the world."""
        return transform(coords, invert(extrinsics))

    def to_pixels(self, coords: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> Tensor:
        """Pixels (..., N, 2) of coordinates (..., N, 3) of this space."""
        return project(coords, intrinsics)[0]


def fitted(space: Any, frames: Frames) -> Any:
    """A space for the clips whose frames these are; custom spaces need no `fit`."""
    return space.fit(frames.depths[:, 0], frames.extrinsics[:, 0]) if hasattr(space, "fit") else space
