"""`Frames`: a batch of posed RGB-D videos as tensors, and how a clip is brought to the model's image size.

    u' = (u + 1/2) W' / W - 1/2,   depth' = resized depth / resized validity, or the nearest

Paper: section 3.2 (the input). The released code moves the camera otherwise than the image (`TrackerConfig.as_released`).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from tapip3d_lite.clip import Clip
from tapip3d_lite.geometry import resize_intrinsics

_STEP = 0.02  # relative difference of depth from which a silhouette lies between two pixels


@dataclass(frozen=True)
class Frames:
    """Posed RGB-D frames.

    Attributes:
        rgb: (B, T, 3, H, W) float in [0, 1].
        depths: (B, T, H, W) float32 z-depth, 0 = invalid.
        intrinsics: (B, T, 3, 3), pixels.
        extrinsics: (B, T, 4, 4), world to camera.
    """

    rgb: Tensor
    depths: Tensor
    intrinsics: Tensor
    extrinsics: Tensor

    def __post_init__(self) -> None:
        lead, size = self.depths.shape[:2], self.depths.shape[2:]
        expected = {"rgb": (*lead, 3, *size), "intrinsics": (*lead, 3, 3), "extrinsics": (*lead, 4, 4)}
        for name, shape in expected.items():
            if tuple(getattr(self, name).shape) != shape:
                raise ValueError(
                    f"Frames.{name}: expected {shape} to fit depths {tuple(self.depths.shape)}, got {tuple(getattr(self, name).shape)}"
                )

    def __len__(self) -> int:
        return self.depths.shape[1]

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) in pixels."""
        return self.depths.shape[2], self.depths.shape[3]

    def _map(self, change: object) -> Frames:
        return Frames(*(change(x) for x in (self.rgb, self.depths, self.intrinsics, self.extrinsics)))

    def cut(self, start: int, stop: int) -> Frames:
        """Frames [start, stop)."""
        return self._map(lambda x: x[:, start:stop])

    def flip(self) -> Frames:
        """The same frames backward in time."""
        return self._map(lambda x: x.flip(1))

    def pad(self, multiple: int) -> Frames:
        """Repeat the last frame until the number of frames is a multiple; the repeats count like any frame."""
        extra = -len(self) % multiple
        return self if extra == 0 else self._map(lambda x: torch.cat([x, x[:, -1:].expand(-1, extra, *x.shape[2:])], 1))

    def to(self, device: torch.device | str) -> Frames:
        """The frames on another device."""
        return self._map(lambda x: x.to(device))


def frames_from_clip(clip: Clip, size: tuple[int, int] | None = None, device: torch.device | str = "cpu") -> Frames:
    """Tensors with B = 1 of a clip, resized if its images have another size.

    Args:
        clip: T frames.
        size: (H, W) wanted, or None to keep the clip's.
        device: where the tensors go.
    """
    clip = clip if size is None else resize_clip(clip, size)
    rgb = _tensor(clip.video).to(device).movedim(-1, 1).float() / 255  # (T, H, W, 3) -> (T, 3, H, W)
    others = (_tensor(x).to(device).float()[None] for x in (clip.depths, clip.intrinsics, clip.extrinsics))  # B = 1
    return Frames(rgb[None], *others)  # (1, T, 3, H, W)


def _tensor(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array))  # a mirrored clip's strides are negative


def resize_clip(clip: Clip, size: tuple[int, int], corners: bool = False) -> Clip:
    """The clip's frames at another image size, without its queries and tracks.

    Colours are interpolated linearly. Depth is interpolated over valid pixels only, that is divided by the
    interpolated validity; across a silhouette it is the nearest pixel's; it is invalid where half of the weights are.

    Args:
        clip: T frames of any size.
        size: (H, W) wanted.
        corners: the intrinsics follow the released code's rule, which OpenCV's images do not.
    """
    if clip.size == tuple(size):
        return clip
    shape = size[1], size[0]  # OpenCV writes (width, height)
    video = np.stack([cv2.resize(image, shape, interpolation=cv2.INTER_LINEAR) for image in clip.video])
    depths = np.stack([_resize_depth(depth, shape) for depth in clip.depths])
    intrinsics = resize_intrinsics(clip.intrinsics, clip.size, size, corners)
    return Clip(video, depths, intrinsics, clip.extrinsics, fps=clip.fps)


def crop_clip(clip: Clip, box: tuple[int, int, int, int]) -> Clip:
    """The pixels (left, top, right, bottom) of the clip's frames, without its queries and tracks; right and bottom lie outside.

    A box without pixels, or one that leaves the image, is a ValueError.
    """
    left, top, right, bottom = box
    if not (0 <= left < right <= clip.size[1] and 0 <= top < bottom <= clip.size[0]):
        raise ValueError(f"crop: expected (left, top, right, bottom) inside {clip.size[1]}x{clip.size[0]}, got {box}")
    intrinsics = clip.intrinsics.copy()
    intrinsics[:, :2, 2] -= (left, top)
    video, depths = (x[:, top:bottom, left:right] for x in (clip.video, clip.depths))
    return Clip(video, depths, intrinsics, clip.extrinsics, fps=clip.fps)


def _resize_depth(depth: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    valid = (depth > 0).astype(np.float32)
    share, value = (cv2.resize(x, shape, interpolation=cv2.INTER_LINEAR) for x in (valid, depth))
    mean, nearest = value / np.maximum(share, 1e-6), cv2.resize(depth, shape, interpolation=cv2.INTER_NEAREST_EXACT)
    mixed = (nearest > 0) & (np.abs(mean - nearest) > _STEP * nearest)  # of front and back, a point on neither
    return np.where(share > 0.5, np.where(mixed, nearest, mean), np.float32(0))
