"""Cameras and rigid motions: the only place where a coordinate convention is written down.

Axes follow OpenCV (x right, y down, z forward). `extrinsics` map world to camera (`cam_from_world`, 4x4). The
centre of the top-left pixel is (0, 0), so u = fx * X / Z + cx. Depth is the camera's z, not the ray's length.
Every function takes NumPy arrays or torch tensors, float32 or float64, with any number of leading batch dimensions
that broadcast against each other, and returns the same kind of array.

The paper (section 3.2) lifts a pixel to X_world = E^-1 (z K^-1 (u, v, 1)).
"""

from __future__ import annotations

from types import ModuleType

import numpy as np
import torch

Array = np.ndarray | torch.Tensor
RASTER = 256  # pixels of the shorter side of the image on which the benchmarks measure errors
THRESHOLDS = (1, 2, 4, 8, 16)  # errors in these pixels below which a point counts as found


def transform(points: Array, pose: Array) -> Array:
    """Points (..., N, 3) moved by a rigid (or affine) motion (..., 4, 4) of column vectors: x' = R x + t."""
    return points @ pose[..., :3, :3].swapaxes(-1, -2) + pose[..., None, :3, 3]


def invert(pose: Array) -> Array:
    """Invert a rigid motion (..., 4, 4): (R, t) becomes (R^T, -R^T t)."""
    xp = _library(pose)
    rotation = pose[..., :3, :3].swapaxes(-1, -2)
    translation = -(rotation @ pose[..., :3, 3:])
    return xp.concatenate([xp.concatenate([rotation, translation], -1), pose[..., 3:, :]], -2)


def unproject(uv: Array, z: Array, intrinsics: Array, extrinsics: Array | None = None) -> Array:
    """Lift pixels with known depth to 3D: X = z K^-1 (u, v, 1), then E^-1 X if extrinsics are given.

    Args:
        uv: (..., N, 2) pixel coordinates; integers are pixel centres.
        z: (..., N) z-depth in scene units.
        intrinsics: (..., 3, 3), pixels. Skew is honoured.
        extrinsics: (..., 4, 4) world to camera, or None to stay in the camera frame.

    Returns:
        (..., N, 3) in the world frame, or in the camera frame without extrinsics.
    """
    xp = _library(uv)
    fx, fy = intrinsics[..., None, 0, 0], intrinsics[..., None, 1, 1]
    cx, cy = intrinsics[..., None, 0, 2], intrinsics[..., None, 1, 2]
    y = (uv[..., 1] - cy) / fy
    x = (uv[..., 0] - cx - intrinsics[..., None, 0, 1] * y) / fx
    z = z + 0 * x  # so that z broadcasts as x does
    points = xp.stack([x * z, y * z, z], -1)
    return points if extrinsics is None else transform(points, invert(extrinsics))


def project(points: Array, intrinsics: Array, extrinsics: Array | None = None) -> tuple:
    """Project 3D points to pixels: (u, v) = (K X)_xy / z.

    Args:
        points: (..., N, 3) in the world frame, or in the camera frame without extrinsics.
        intrinsics: (..., 3, 3), pixels.
        extrinsics: (..., 4, 4) world to camera, or None.

    Returns:
        uv (..., N, 2) in pixels and z (..., N), the signed z-depth in the camera frame. Points at or behind the camera
        are divided by 1e-6, so that their uv stays finite; the sign of z reveals them.
    """
    xp = _library(points)
    camera = points if extrinsics is None else transform(points, extrinsics)
    z = camera[..., 2]
    # K X first, then the division: the order of the released model, whose numbers depend on the last bit.
    homogeneous = camera @ intrinsics.swapaxes(-1, -2)
    return homogeneous[..., :2] / xp.clip(z, 1e-6, None)[..., None], z


def in_image(points: Array, intrinsics: Array, extrinsics: Array, size: tuple[int, int]) -> Array:
    """Whether points (..., N, 3) lie before the camera and project into an image (H, W): (..., N) bool."""
    uv, z = project(points, intrinsics, extrinsics)
    return (z > 0) & (uv > -0.5).all(-1) & (uv[..., 0] < size[1] - 0.5) & (uv[..., 1] < size[0] - 0.5)


def point_map(depths: Array, intrinsics: Array, extrinsics: Array | None = None) -> Array:
    """Lift whole depth maps (..., H, W) to organised point maps (..., H, W, 3), by cameras as in `unproject`.

    A depth of 0 puts the pixel at the camera's centre, as the released model does.
    """
    height, width = depths.shape[-2:]
    flat = depths.reshape(*depths.shape[:-2], height * width)
    uv = pixel_grid(height, width, like=depths)
    points = unproject(uv.reshape(height * width, 2), flat, intrinsics, extrinsics)
    return points.reshape(*points.shape[:-2], height, width, 3)


def pixel_grid(height: int, width: int, like: Array) -> Array:
    """Pixel-centre coordinates (H, W, 2) as (u, v), in the library, dtype and device of `like`."""
    if isinstance(like, torch.Tensor):
        v = torch.arange(height, dtype=like.dtype, device=like.device)
        u = torch.arange(width, dtype=like.dtype, device=like.device)
        return torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)
    v, u = np.arange(height, dtype=like.dtype), np.arange(width, dtype=like.dtype)
    return np.stack(np.meshgrid(u, v, indexing="xy"), -1)


def resize_intrinsics(
    intrinsics: Array, old_size: tuple[int, int], new_size: tuple[int, int], corners: bool = False
) -> Array:
    """Intrinsics (..., 3, 3) of an image resized from (H, W) to (H', W').

    u' = (u + 1/2) W' / W - 1/2, v' likewise, because images begin at -1/2; with `corners` u' = u (W' - 1) / (W - 1):
    corner centres stay corner centres, as in the released code.

    Raises:
        ValueError: a size without pixels, or for `corners` below 2.
    """
    if min(*old_size, *new_size) < 1 + corners:
        raise ValueError(f"resize_intrinsics: sizes must be at least {1 + corners}, got {old_size} -> {new_size}")
    scale_v, scale_u = ((new - corners) / (old - corners) for old, new in zip(old_size, new_size, strict=True))
    half = intrinsics[..., 2, :] * (0 if corners else 0.5)
    rows = [(intrinsics[..., 0, :] + half) * scale_u - half, (intrinsics[..., 1, :] + half) * scale_v - half]
    return _library(intrinsics).stack([*rows, intrinsics[..., 2, :]], -2)


def look_at(eye: Array, target: Array, up: Array) -> Array:
    """Extrinsics (..., 4, 4) of a camera at `eye` (..., 3) that looks at `target`, with `up` upwards in the image.

    All are in the world frame; ValueError where `eye` equals `target`, or `up` is parallel to the viewing direction.
    """
    xp = _library(eye)
    forward = target - eye
    right = xp.linalg.cross(forward, up + 0 * forward)
    lengths = (forward**2).sum(-1), (right**2).sum(-1)
    if not bool((lengths[0] > 0).all()) or not bool((lengths[1] > 1e-12 * lengths[0]).all()):
        raise ValueError("look_at: eye and target coincide, or up is parallel to the viewing direction; move one")
    forward = forward / lengths[0][..., None] ** 0.5
    right = right / lengths[1][..., None] ** 0.5
    down = xp.linalg.cross(forward, right)
    rotation = xp.stack([right, down, forward], -2)
    translation = -(rotation @ eye[..., None])
    top = xp.concatenate([rotation, translation], -1)
    bottom = xp.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1
    return xp.concatenate([top, bottom], -2)


def _library(array: Array) -> ModuleType:
    return torch if isinstance(array, torch.Tensor) else np
