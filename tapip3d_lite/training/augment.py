"""`augment`: the paper's image augmentations, each with its own probability.

Paper: appendix (training). Here are those that change what things look like (erased boxes, colours, blur of colour and
of depth); `reframing` holds those that change where things are in the image. Playing backward and drawing points are in
`data`, random motions of the coordinates in `motion`: these also work with stored features of a frozen encoder.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from tapip3d_lite.clip import Clip
from tapip3d_lite.geometry import project
from tapip3d_lite.training.reframing import flip_x, flip_y, random_view, reframe, with_visibility

GRAY = np.array([0.299, 0.587, 0.114])
_TO_YIQ = np.array([GRAY, [0.5959, -0.2746, -0.3213], [0.2115, -0.5227, 0.3112]])


@dataclass(frozen=True)
class AugmentConfig:
    """The paper's augmentations. Lengths are fractions of the image's width (the paper gives pixels at a width of 512).

    Attributes:
        erase: share of the frames with erased boxes.
        erase_boxes: greatest number of boxes in a frame.
        erase_side: (smallest, greatest) side of a box.
        jitter: share of the clips with changed colours.
        jitter_strength: greatest change of brightness, contrast, saturation and hue.
        blur: share of the clips with blurred colours.
        blur_sigma: (smallest, greatest) standard deviation of the blur.
        depth_blur: share of the clips with blurred depth.
        depth_blur_sigma: as `blur_sigma`; the paper gives no strength, ours is below one pixel at a width of 128.
        reframe: share of the clips that are padded, resized and cropped to the old size.
        pad: greatest padding of each side.
        scale: (smallest, greatest) factor of the resizing.
        drift: greatest change of the crop's position from one frame to the next.
        flip_x, flip_y: shares of the clips that are mirrored.

    Raises:
        ValueError: a share outside [0, 1], or a range that is negative or not in order.
    """

    erase: float = 0.5
    erase_boxes: int = 10
    erase_side: tuple[float, float] = (2 / 512, 100 / 512)
    jitter: float = 0.25
    jitter_strength: tuple[float, float, float, float] = (0.2, 0.2, 0.2, 0.08)
    blur: float = 0.25
    blur_sigma: tuple[float, float] = (0.1 / 512, 2 / 512)
    depth_blur: float = 0.5
    depth_blur_sigma: tuple[float, float] = (0.5 / 512, 3 / 512)
    reframe: float = 1.0
    pad: float = 25 / 512
    scale: tuple[float, float] = (0.75, 1.25)
    drift: float = 15 / 512
    flip_x: float = 0.5
    flip_y: float = 0.5

    def __post_init__(self) -> None:
        for name in ("erase", "jitter", "blur", "depth_blur", "reframe", "flip_x", "flip_y"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"AugmentConfig.{name}: expected a share in [0, 1], got {getattr(self, name)}")
        for name in ("erase_side", "blur_sigma", "depth_blur_sigma", "scale", "jitter_strength"):
            object.__setattr__(self, name, tuple(getattr(self, name)))  # lists come from JSON
        for name in ("erase_side", "blur_sigma", "depth_blur_sigma", "scale"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise ValueError(f"AugmentConfig.{name}: expected 0 < smallest <= greatest, got {(low, high)}")
        if self.erase_boxes < 1 or self.pad < 0 or self.drift < 0 or not _in_range(self.jitter_strength):
            raise ValueError(
                "AugmentConfig: expected erase_boxes >= 1, pad and drift >= 0, four jitter strengths in [0, 1], got "
                f"{self.erase_boxes}, {self.pad}, {self.drift}, {self.jitter_strength}"
            )


def augmentations(config: AugmentConfig) -> dict[str, tuple[float, Callable[[Clip, np.random.Generator], Clip]]]:
    """The augmentations by name, in the order in which they are applied: (share of the clips, function)."""
    return {
        # The eraser draws by itself which frames it changes.
        "erase": (
            float(config.erase > 0),
            lambda clip, rng: erase(clip, rng, config.erase, config.erase_boxes, config.erase_side),
        ),
        "jitter": (config.jitter, lambda clip, rng: jitter_colors(clip, rng, config.jitter_strength)),
        "blur": (config.blur, lambda clip, rng: blur_colors(clip, rng, config.blur_sigma)),
        "depth_blur": (config.depth_blur, lambda clip, rng: blur_depth(clip, rng, config.depth_blur_sigma)),
        "reframe": (
            config.reframe,
            lambda clip, rng: reframe(clip, *random_view(clip, rng, config.pad, config.scale, config.drift)),
        ),
        "flip_x": (config.flip_x, lambda clip, rng: flip_x(clip)),
        "flip_y": (config.flip_y, lambda clip, rng: flip_y(clip)),
    }


def augment(clip: Clip, rng: np.random.Generator, config: AugmentConfig | None = None) -> Clip:
    """Change a training clip at random.

    Points that leave the image or are covered become occluded. A query whose point is then hidden moves to the first
    frame in which the point is visible; a point that is visible nowhere is dropped.

    Args:
        clip: T frames of any size, with true tracks (queries without tracks are dropped where visibility changes).
        rng: random generator.
        config: shares and strengths; None for the paper's.

    Returns:
        A clip of the same size and length, with the same or fewer tracks.
    """
    for share, change in augmentations(config or AugmentConfig()).values():
        if rng.random() < share:
            clip = change(clip, rng)
    return clip


def _in_range(strength: tuple[float, ...]) -> bool:
    return len(strength) == 4 and all(0 <= x <= 1 for x in strength)


def erase(clip: Clip, rng: np.random.Generator, share: float, boxes: int, side: tuple[float, float]) -> Clip:
    """Fill boxes with their mean colour and mean depth; covered points become occluded.

    Args:
        clip: T frames.
        rng: random generator.
        share: of the frames with boxes; each frame has its own.
        boxes: greatest number of boxes in a frame; the smallest is one.
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
    """Change brightness, contrast, saturation and hue, in each frame differently.

    All four are affine in the colour, so one 3x4 matrix does it for a frame; hue is a rotation of the chrominance (YIQ).

    Args:
        clip: T frames.
        rng: random generator.
        strength: greatest change of brightness, contrast and saturation (of a factor of 1), and of hue (of a full turn).
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
    """Blur the colours of each frame with a Gaussian of its own width.

    Args:
        clip: T frames.
        rng: random generator.
        sigma: (smallest, greatest) standard deviation, fractions of the image's width.
    """
    sigmas = rng.uniform(*sigma, len(clip)) * clip.size[1]
    video = np.stack([cv2.GaussianBlur(image, (0, 0), s) for image, s in zip(clip.video, sigmas, strict=True)])
    return replace(clip, video=video)


def blur_depth(clip: Clip, rng: np.random.Generator, sigma: tuple[float, float]) -> Clip:
    """Blur all depth maps with one Gaussian, which smears edges as sensors do; invalid pixels stay invalid.

    Args:
        clip: T frames.
        rng: random generator.
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
