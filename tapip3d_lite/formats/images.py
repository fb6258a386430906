"""Frames from files: colour images, depth images (PNG, TIFF, EXR, npy), videos; depth of another size or camera."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import cv2
import numpy as np

from tapip3d_lite.files import for_opencv, map_npy

PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
DEPTHS = (".png", ".tif", ".tiff", ".exr", ".npy", ".pfm")
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")


def decode_color(data: bytes, name: object) -> np.ndarray:
    """An image file's bytes as (H, W, 3) uint8 RGB, as stored: without alpha, not turned by EXIF."""
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    if image is None:
        raise ValueError(f"{name}: not a readable image; truncated, or of an unknown kind; save it as PNG or JPEG")
    return np.ascontiguousarray(image[..., ::-1])


def read_video(path: Path, frames: slice) -> tuple[np.ndarray, int, float]:
    """The chosen frames (T, H, W, 3) uint8 RGB of a video, how many it has, and frames per second; ValueError if none."""
    video, chosen, wanted, count = cv2.VideoCapture(for_opencv(path)), [], range(*frames.indices(1 << 40)), 0
    while video.grab():
        if count in wanted:
            chosen.append(np.ascontiguousarray(video.retrieve()[1][..., ::-1]))
        count += 1
    fps = video.get(cv2.CAP_PROP_FPS)
    video.release()
    if not chosen:
        found = f"{count} frames, none of them in {frames}" if count else "no frame that OpenCV can decode"
        raise ValueError(
            f"{path}: {found}; if the codec is unknown, convert it (ffmpeg -i IN -c:v libx264 OUT.mp4) or write its frames "
            "(ffmpeg -i IN rgb/%06d.png)"
        )
    return np.stack(chosen), count, fps


def read_depth(path: Path, scale: float = 1000.0, no_depth: float = 65535) -> np.ndarray:
    """A depth image (H, W) float32: whole numbers are divided by `scale`, `no_depth` is unknown; others are as stored.

    Raises:
        ValueError: unreadable, 8-bit, or of several channels that differ.
    """
    if path.suffix.lower() in (".exr", ".npy"):
        depth = _exr(path) if path.suffix.lower() == ".exr" else map_npy(path)
    else:
        data = np.frombuffer(path.read_bytes(), np.uint8)
        depth = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if depth is None:
        raise ValueError(f"{path}: not a readable depth image; write 16-bit PNG (mm), TIFF, EXR or npy (metres)")
    depth = depth[..., 0] if depth.ndim == 3 and (depth == depth[..., :1]).all() else depth
    if depth.dtype.itemsize == 1 or depth.ndim != 2:
        raise ValueError(
            f"{path}: depth of shape {depth.shape} {depth.dtype} is a picture for the eye, with too few steps; export it "
            "as 16-bit PNG (millimetres), or as TIFF, EXR or npy in metres"
        )
    if depth.dtype.kind in "iu":
        return np.where(depth == no_depth, 0, depth).astype(np.float32) / np.float32(scale)
    return np.where(depth < 1e6, depth, 0).astype(np.float32)  # renderers write 1e10 for nothing


def fit_depth(depth: np.ndarray, size: tuple[int, int], name: object) -> np.ndarray:
    """Depth of the same camera brought to the image's size (H, W): each pixel takes the nearest, nothing is mixed."""
    if depth.shape == tuple(size):
        return depth
    if abs(depth.shape[1] / depth.shape[0] * size[0] / size[1] - 1) > 0.02:
        raise ValueError(
            f"{name}: depth of {depth.shape[1]}x{depth.shape[0]} is of another shape than the {size[1]}x{size[0]} image; "
            "turn or crop one, or give the depth camera's `depth_intrinsics` in clip.json"
        )
    return cv2.resize(depth, size[::-1], interpolation=cv2.INTER_NEAREST_EXACT)


def _exr(path: Path) -> np.ndarray:
    """The first channel (H, W) of an EXR file, which OpenCV's wheels without a display cannot read."""
    try:
        with import_module("OpenEXR").File(str(path), separate_channels=True) as file:
            return next(iter(file.channels().values())).pixels.astype(np.float32)
    except ImportError:
        raise ValueError(f"{path}: EXR needs `pip install OpenEXR`; or write it as TIFF or npy (metres)") from None
    except Exception as error:  # a damaged file fails in any way
        raise ValueError(f"{path}: not a readable EXR ({error}); write it as TIFF or npy (metres)") from None
