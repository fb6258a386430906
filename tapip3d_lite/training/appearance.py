"""Augmentations that change what things look like: erased boxes, colours, blur of colour and of depth.

Paper: appendix (training). Cameras and positions stay; only erased boxes change which points are seen.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from tapip3d_lite.clip import Clip
from tapip3d_lite.geometry import project
from tapip3d_lite.training.reframing import with_visibility

GRAY = np.array([0.299, 0.587, 0.114])
_TO_YIQ = np.array([GRAY, [0.5959, -0.2746, -0.3213], [0.2115, -0.5227, 0.3112]])


def erase(clip: Clip, rng: np.random.Generator, share: float, boxes: int, side: tuple[float, float]) -> Clip:
    """Cover boxes with their mean colour and mean depth; covered points become occluded.

    Args:
        clip: T frames.
        rng: source of chance.
        share: of the frames that get boxes, new ones each.
        boxes: most boxes of a frame; at least one is drawn.
        side: (smallest, greatest) side, fractions of the image's width.
    """
    video, depths, (height, width) = clip.video.copy(), clip.depths.copy(), clip.size
    tracks, visible, pixels = clip.tracks, None, None
    if tracks is not None:
        visible = tracks.visible.copy()
        uv, _ = project(tracks.xyz, clip.intrinsics, clip.extrinsics)
        pixels = np.rint(uv)
    for t in np.flatnonzero(rng.random(len(clip)) < share):
        for _ in range(rng.integers(1, boxes + 1)):
            middle, half = rng.uniform(0, (width, height)), rng.uniform(*side, 2) * width / 2
            low = np.clip(np.rint(middle - half), 0, (width - 1, height - 1)).astype(int)
            high = np.clip(np.rint(middle + half), low + 1, (width, height)).astype(int)
            box = np.s_[t, low[1] : high[1], low[0] : high[0]]
            video[box] = video[box].mean((0, 1)).round()
            valid = depths[box][depths[box] > 0]
            depths[box] = valid.mean() if len(valid) else 0
            if visible is not None:
                visible[t] &= ~((pixels[t] >= low) & (pixels[t] < high)).all(-1)
    return with_visibility(clip, visible, video=video, depths=depths)


def jitter_colors(clip: Clip, rng: np.random.Generator, strength: tuple[float, float, float, float]) -> Clip:
    """Change brightness, contrast, saturation and hue, each frame by itself.

    All four are linear in the colour, so a frame needs one 3x4 matrix; hue is turned in the plane of chrominance.

    Args:
        clip: T frames.
        rng: source of chance.
        strength: greatest change of brightness, contrast, saturation (of a factor of 1), and hue (of a full turn).
    """
    bounds = np.array(strength)
    video = np.empty_like(clip.video)
    for t, image in enumerate(clip.video):
        brightness, contrast, saturation, hue = rng.uniform(-bounds, bounds) + (1, 1, 1, 0)
        linear = contrast * brightness * (saturation * _turn_hue(hue) + (1 - saturation) * np.ones((3, 1)) * GRAY)
        # Contrast is a factor on the distance from the frame's mean grey, which the other two leave as it is.
        shift = (1 - contrast) * brightness * float(GRAY @ cv2.mean(image)[:3])
        video[t] = cv2.transform(image, np.column_stack([linear, np.full(3, shift)]))
    return replace(clip, video=video)


def blur_colors(clip: Clip, rng: np.random.Generator, sigma: tuple[float, float]) -> Clip:
    """Blur the colours of each frame by a Gaussian of its own.

    Args:
        clip: T frames.
        rng: source of chance.
        sigma: (smallest, greatest) standard deviation, fractions of the image's width.
    """
    sigmas = rng.uniform(*sigma, len(clip)) * clip.size[1]
    video = np.stack([cv2.GaussianBlur(image, (0, 0), s) for image, s in zip(clip.video, sigmas, strict=True)])
    return replace(clip, video=video)


def blur_depth(clip: Clip, rng: np.random.Generator, sigma: tuple[float, float]) -> Clip:
    """Blur all depth maps by one Gaussian, which smears edges as sensors and estimators do; invalid pixels stay so.

    Args:
        clip: T frames.
        rng: source of chance.
        sigma: (smallest, greatest) standard deviation, fractions of the image's width.
    """
    s = rng.uniform(*sigma) * clip.size[1]
    return replace(clip, depths=np.stack([_blur_valid(depth, s) for depth in clip.depths]))


def _blur_valid(depth: np.ndarray, sigma: float) -> np.ndarray:
    valid = (depth > 0).astype(np.float32)
    weight = cv2.GaussianBlur(valid, (0, 0), sigma)
    return np.where(valid > 0, cv2.GaussianBlur(depth, (0, 0), sigma) / np.maximum(weight, 1e-6), np.float32(0))


def _turn_hue(turn: float) -> np.ndarray:
    c, s = np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn)
    return np.linalg.inv(_TO_YIQ) @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ _TO_YIQ
