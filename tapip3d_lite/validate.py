"""Checks of the user's arrays: each error names the argument, what was expected, what was received, and a remedy."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable

import numpy as np


def video_frames(video: np.ndarray) -> np.ndarray:
    """A video (T, H, W, 3) uint8 with at least one frame, or ValueError."""
    video = np.asarray(video)
    if video.ndim != 4 or video.shape[-1] != 3 or video.dtype != np.uint8:
        raise ValueError(
            f"Clip.video: expected (T, H, W, 3) uint8 RGB, got {video.shape} {video.dtype}; move the colour axis last, drop alpha, scale [0, 1] floats by 255"
        )
    if 0 in video.shape:
        raise ValueError(f"Clip.video: zero frames or pixels in {video.shape}; give at least one frame")
    return video


def check_cameras(intrinsics: np.ndarray, extrinsics: np.ndarray) -> None:
    """Raise ValueError unless focal lengths (T, 3, 3) are positive and poses (T, 4, 4) rigid."""
    focal = intrinsics[:, [0, 1], [0, 1]]
    if not (focal > 0).all():
        raise ValueError(f"Clip.intrinsics: fx and fy must be positive, got {focal[(focal <= 0).any(-1)][0].tolist()}")
    rotation = extrinsics[:, :3, :3]
    error = np.abs(rotation @ rotation.swapaxes(-1, -2) - np.eye(3)).max((-1, -2))
    mirrored = np.linalg.det(rotation) < 0
    if (error > 1e-2).any() or mirrored.any() or np.abs(extrinsics[:, 3] - (0, 0, 0, 1)).max() > 1e-4:
        frame = int(np.argmax(error + 10 * mirrored))
        raise ValueError(
            f"Clip.extrinsics: frame {frame} is not a rigid world-to-camera motion (R R^T differs from I by {error[frame]:.2g}, "
            f"det R = {np.linalg.det(rotation[frame]):.2g}, last row {extrinsics[frame, 3].tolist()}); remove scale, use row-major [R|t; 0 0 0 1]"
        )


def floats(name: str, value: object, shape: tuple[int | None, ...], finite: bool = False, like: str = "") -> np.ndarray:
    """`value` as float32 of the given shape (None: any length), or ValueError; `finite` refuses NaN and infinity."""
    array = np.asarray(value)
    wanted = "(" + ", ".join("N" if s is None else str(s) for s in shape) + ")" + (f" to match {like}" if like else "")
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name}: expected numbers of shape {wanted}, got dtype {array.dtype}; convert to float32")
    if array.ndim != len(shape) or any(s not in (None, n) for s, n in zip(shape, array.shape, strict=True)):
        raise ValueError(f"{name}: expected shape {wanted}, got {array.shape}; reorder or resize the axes")
    array = array.astype(np.float32, copy=False)
    if finite and not np.isfinite(array).all():
        raise ValueError(
            f"{name}: expected finite numbers, got {int((~np.isfinite(array)).sum())} NaN or infinite; repair or drop those frames or rows"
        )
    return array


def bools(name: str, value: object, shape: tuple[int, ...]) -> np.ndarray:
    """`value` as booleans of the given shape (0 and 1 count), or ValueError."""
    array = np.asarray(value)
    if array.shape != shape:
        raise ValueError(f"{name}: expected shape {shape}, got {array.shape}; reorder or cut the axes")
    if array.dtype != bool and not (array.dtype.kind in "iuf" and np.isin(array, (0, 1)).all()):
        raise ValueError(f"{name}: expected booleans, got dtype {array.dtype}; threshold it first")
    return array.astype(bool, copy=False)


def check_depths(depths: np.ndarray, window: int) -> None:
    """Raise ValueError if in some window of depths (T, H, W) hardly any is known, so that coordinates have no scale."""
    known = (depths > 0).mean((1, 2))
    if np.convolve(known, np.ones(window), "valid").min() < 1e-3 * window:
        raise ValueError(f"Clip.depths: {window} consecutive frames have no valid pixel; leave those frames out")


def check_range(config: object, low: float, high: float, *names: str) -> None:
    """Raise ValueError unless these fields of a config, each a number or a tuple of numbers, are in [low, high]."""
    for name in names:
        value = getattr(config, name)
        if not (low <= np.min(value) and np.max(value) <= high):
            wanted = f"at least {low}" if high == np.inf else f"values in [{low}, {high}]"
            raise ValueError(f"{type(config).__name__}.{name}: expected {wanted}, got {value}")


def check_names(where: str, given: Iterable[str], known: Collection[str]) -> None:
    """Raise ValueError for the first name that is not known; it says which known ones are near."""
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, sorted(known), 3, 0.5)
            hint = f"did you mean {' or '.join(near)}?" if near else f"there are {', '.join(sorted(known))}"
            raise ValueError(f"{where}: no {name!r}; {hint}")
