"""How predictable true motion is in a coordinate space: the distance between a path and its best simple fit.

Paper: section 3.2 claims that motion is smoother once the camera's is cancelled; table "coordinate spaces" shows what
it buys. Here the claim is measured on the truth itself, without any tracker. A constant-velocity path (degree 1) or a
constant-acceleration path (degree 2) is fitted to each short window *in the space's own coordinates*, carried back to
3D by the cameras, and compared with the truth there. So the residual is in scene units in every space.
"""

from __future__ import annotations

import numpy as np

from tapip3d_lite.geometry import invert, project, transform, unproject

SPACES = ("uvd", "uvlogd", "camera", "world")


def to_space(xyz: np.ndarray, intrinsics: np.ndarray, extrinsics: np.ndarray, space: str) -> np.ndarray:
    """World points in the coordinates of a space.

    Args:
        xyz: (..., N, 3), world frame.
        intrinsics: (..., 3, 3), pixels.
        extrinsics: (..., 4, 4), world to camera.
        space: "world", "camera", "uvd" (u, v in pixels, z) or "uvlogd" (u, v, sqrt(fx fy) log z).

    Returns:
        (..., N, 3).

    Raises:
        ValueError: unknown space.
    """
    _check_space(space)
    if space in ("camera", "world"):
        return xyz if space == "world" else transform(xyz, extrinsics)
    uv, z = project(xyz, intrinsics, extrinsics)
    third = z if space == "uvd" else _focal(intrinsics) * np.log(np.maximum(z, 1e-6))
    return np.concatenate([uv, third[..., None]], -1)


def from_space(coords: np.ndarray, intrinsics: np.ndarray, extrinsics: np.ndarray, space: str) -> np.ndarray:
    """The inverse of `to_space` for points in front of the camera."""
    _check_space(space)
    if space in ("camera", "world"):
        return coords if space == "world" else transform(coords, invert(extrinsics))
    third = coords[..., 2]
    z = third if space == "uvd" else np.exp(third / _focal(intrinsics))
    return unproject(coords[..., :2], z, intrinsics, extrinsics)


def windows(values: np.ndarray, window: int) -> np.ndarray:
    """All runs of S = `window` successive frames of values (T, ...), as a view (T - S + 1, S, ...)."""
    if not 1 <= window <= len(values):
        raise ValueError(f"windows: window must be in [1, {len(values)}] (the number of frames), got {window}")
    return np.moveaxis(np.lib.stride_tricks.sliding_window_view(values, window, axis=0), -1, 1)


def fit_windows(coords: np.ndarray, window: int = 5, degree: int = 1) -> np.ndarray:
    """Least-squares polynomial in time through every window of every path.

    Args:
        coords: (T, N, 3) in any space.
        window: S, frames.
        degree: 0 a resting point, 1 constant velocity, 2 constant acceleration.

    Returns:
        (T - S + 1, S, N, 3), the fits at the windows' frames.

    Raises:
        ValueError: a window too short for the degree, or longer than the clip.
    """
    if not 0 <= degree < window:
        raise ValueError(f"fit_windows: degree must be in [0, {window - 1}] for a window of {window}, got {degree}")
    powers = np.vander(np.linspace(-1, 1, window) if window > 1 else np.zeros(1), degree + 1)
    smooth = powers @ np.linalg.pinv(powers)  # (S, S), maps a window's values to those of its fit
    return np.einsum("st,wtnc->wsnc", smooth, windows(coords, window), optimize=True)


def line_through(coords: np.ndarray) -> np.ndarray:
    """The best constant-velocity motion through paths (S, N, 3) in any space, at the same S frames."""
    return fit_windows(coords, len(coords), 1)[0]


def rotations(vectors: np.ndarray) -> np.ndarray:
    """Rotation vectors (T, 3), axis times angle in radians, as poses (T, 4, 4); Rodrigues' formula."""
    angle = np.linalg.norm(vectors, axis=-1)[:, None, None] + 1e-12
    x, y, z = (vectors / angle[:, 0]).T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    poses = np.tile(np.eye(4), (len(vectors), 1, 1))
    poses[:, :3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return poses


def bend(
    xyz: np.ndarray, intrinsics: np.ndarray, extrinsics: np.ndarray, space: str, window: int = 5, degree: int = 1
) -> np.ndarray:
    """Root-mean-square distance in 3D between paths and their fits in a space, for every window of S frames.

    Args:
        xyz: (T, N, 3), world frame.
        intrinsics: (T, 3, 3).
        extrinsics: (T, 4, 4).
        space: one of `SPACES`.
        window: S, frames.
        degree: of the fit, see `fit_windows`.

    Returns:
        (T - S + 1, N) in scene units.
    """
    xyz, intrinsics, extrinsics = (np.asarray(a, np.float64) for a in (xyz, intrinsics, extrinsics))
    fits = fit_windows(to_space(xyz, intrinsics, extrinsics, space), window, degree)
    fits = from_space(fits, windows(intrinsics, window), windows(extrinsics, window), space)
    return np.sqrt(((fits - windows(xyz, window)) ** 2).sum(-1).mean(1))


def stays_in_view(
    xyz: np.ndarray, intrinsics: np.ndarray, extrinsics: np.ndarray, size: tuple[int, int], window: int = 5
) -> np.ndarray:
    """Which windows (T - S + 1, N) keep their point in front of the camera and inside the image, hidden or not."""
    uv, z = project(xyz, intrinsics, extrinsics)
    inside = (z > 0) & (uv > -0.5).all(-1) & (uv < np.array(size[::-1]) - 0.5).all(-1)
    return windows(inside, window).all(1)


def _focal(intrinsics: np.ndarray) -> np.ndarray:
    return np.sqrt(intrinsics[..., 0, 0] * intrinsics[..., 1, 1])[..., None]


def _check_space(space: str) -> None:
    if space not in SPACES:
        raise ValueError(f"space: expected one of {', '.join(SPACES)}, got {space!r}")
