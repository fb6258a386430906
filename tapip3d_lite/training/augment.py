"""`augment`: every change that the paper makes to a training clip's images, each with its own probability.

Paper: appendix (training). Playing backward and drawing points are `sampling`'s, moving coordinates is `motion`'s; they
also serve trainings whose features are kept, which images that change would make useless.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tapip3d_lite.clip import Clip
from tapip3d_lite.training.appearance import blur_colors, blur_depth, erase, jitter_colors
from tapip3d_lite.training.reframing import flip_x, flip_y, random_view, reframe


@dataclass(frozen=True)
class AugmentConfig:
    """The paper's augmentation; its pixels, at a width of 512, are fractions of the width here.

    Attributes:
        erase: share of the frames with erased boxes; `erase_boxes` at most, sides within `erase_side`.
        jitter: share of the clips with changed colours; by at most `jitter_strength` (brightness, contrast,
            saturation, hue).
        blur: share of the clips with blurred colours, standard deviations within `blur_sigma`.
        depth_blur: share with blurred depth, within `depth_blur_sigma` (the paper names no strength; ours
            is less than a pixel at a width of 128).
        reframe: share that is padded (each side by at most `pad`), resized (by a factor within `scale`) and cropped
            to the old size at a place that wanders by at most `drift` a frame.
        flip_x, flip_y: shares that are mirrored.

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
        if self.erase_boxes < 1 or self.pad < 0 or self.drift < 0 or not _are_changes(self.jitter_strength):
            raise ValueError(
                "AugmentConfig: expected erase_boxes >= 1, pad and drift >= 0, four jitter strengths in [0, 1], got "
                f"{self.erase_boxes}, {self.pad}, {self.drift}, {self.jitter_strength}"
            )


def augmentations(config: AugmentConfig) -> dict[str, tuple[float, Callable[[Clip, np.random.Generator], Clip]]]:
    """The augmentations in the order in which they are made: the share of the clips that get each, and what it does."""
    return {
        # The eraser's chance is taken frame by frame.
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

    Points that leave the image or are covered become occluded; queries that are no longer seen are asked for at the
    first frame that shows their point, or dropped with it.

    Args:
        clip: T frames of any size, with true tracks (queries without tracks are dropped where views change).
        rng: source of chance.
        config: shares and strengths; None for the paper's.

    Returns:
        A clip of the same size and length, with the same or fewer tracks.
    """
    for share, change in augmentations(config or AugmentConfig()).values():
        if rng.random() < share:
            clip = change(clip, rng)
    return clip


def _are_changes(strength: tuple[float, ...]) -> bool:
    return len(strength) == 4 and all(0 <= x <= 1 for x in strength)
