"""`augment`: the paper's image augmentations, each with its own probability.

Paper: appendix (training). The first change what things look like (erased boxes, colours, blur of colour and of depth),
the others where things are in the image: these change pixels, cameras and true tracks together, so that a visible point
still projects to the pixel that shows it. Playing backward and drawing points are in `data`, random motions of the
coordinates in `motion`: they also work with stored features of a frozen encoder.

All take clips with true tracks. Lengths are fractions of the image's width.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.geometry import project
from tapip3d_lite.training.data import query_rows
from tapip3d_lite.validate import check_range, check_types

SAME_SURFACE = 0.05  # neighbouring depths that differ by less are interpolated, others belong to two surfaces
GRAY = np.array([0.299, 0.587, 0.114])
_TO_YIQ = np.array([GRAY, [0.5959, -0.2746, -0.3213], [0.2115, -0.5227, 0.3112]])
_MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0]).astype(np.float32)


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
        check_types(self)
        check_range(self, 0, 1, "erase", "jitter", "jitter_strength", "blur", "depth_blur")
        check_range(self, 0, 1, "reframe", "flip_x", "flip_y")
        check_range(self, 0, math.inf, "pad", "drift")
        check_range(self, 1, math.inf, "erase_boxes")
        for name in ("erase_side", "blur_sigma", "depth_blur_sigma", "scale"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise ValueError(f"AugmentConfig.{name}: expected 0 < smallest <= greatest, got {(low, high)}")
        if len(self.jitter_strength) != 4:
            raise ValueError(f"AugmentConfig.jitter_strength: expected four strengths, got {self.jitter_strength}")


def augmentations(config: AugmentConfig) -> dict[str, tuple[float, Callable[[Clip, np.random.Generator], Clip]]]:
    """The augmentations by name, in the order in which they are applied: (share of the clips, function)."""
    boxes = {"share": config.erase, "boxes": config.erase_boxes, "side": config.erase_side}
    view = {"pad": config.pad, "scale": config.scale, "drift": config.drift}
    return {
        "erase": (float(config.erase > 0), partial(erase, **boxes)),  # draws by itself which frames it changes
        "jitter": (config.jitter, partial(jitter_colors, strength=config.jitter_strength)),
        "blur": (config.blur, partial(blur_colors, sigma=config.blur_sigma)),
        "depth_blur": (config.depth_blur, partial(blur_depth, sigma=config.depth_blur_sigma)),
        "reframe": (config.reframe, lambda clip, rng: reframe(clip, *random_view(clip, rng, **view))),
        "flip_x": (config.flip_x, lambda clip, rng: flip(clip, 0)),
        "flip_y": (config.flip_y, lambda clip, rng: flip(clip, 1)),
    }


def augment(clip: Clip, rng: np.random.Generator, config: AugmentConfig | None = None) -> Clip:
    """Change a training clip at random, by default with the paper's shares and strengths; it keeps its size and length.

    Points that leave the image or are covered become occluded. A query whose point is then hidden moves to the first
    frame in which the point is visible; a point that is visible nowhere is dropped.
    """
    for share, change in augmentations(config or AugmentConfig()).values():
        if rng.random() < share:
            clip = change(clip, rng)
    return clip


def erase(clip: Clip, rng: np.random.Generator, share: float, boxes: int, side: tuple[float, float]) -> Clip:
    """Fill boxes, one to `boxes` in a share of the frames, with their mean colour and depth; covered points are occluded.

    Sides are between the two of `side`.
    """
    video, depths, visible = clip.video.copy(), clip.depths.copy(), clip.tracks.visible.copy()
    pixels = np.rint(project(clip.tracks.xyz, clip.intrinsics, clip.extrinsics)[0])
    height, width = clip.size
    for t in np.flatnonzero(rng.random(len(clip)) < share):
        for _ in range(rng.integers(1, boxes + 1)):
            middle, half = rng.uniform(0, (width, height)), rng.uniform(*side, 2) * width / 2
            low = np.clip(np.rint(middle - half), 0, (width - 1, height - 1)).astype(int)
            high = np.clip(np.rint(middle + half), low + 1, (width, height)).astype(int)
            box = np.s_[t, low[1] : high[1], low[0] : high[0]]
            video[box] = video[box].mean((0, 1)).round()
            valid = depths[box][depths[box] > 0]
            depths[box] = valid.mean() if len(valid) else 0
            visible[t] &= ~((pixels[t] >= low) & (pixels[t] < high)).all(-1)
    tracks = requery(clip.tracks, visible)
    return replace(clip, video=video, depths=depths, tracks=tracks, queries=tracks.queries)


def jitter_colors(clip: Clip, rng: np.random.Generator, strength: tuple[float, float, float, float]) -> Clip:
    """Change brightness, contrast, saturation (factors around 1) and hue (in full turns), in each frame differently.

    All four are affine in the colour, so one 3x4 matrix does it for a frame; hue is a rotation of the chrominance (YIQ).
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
    """Blur the colours of each frame with a Gaussian of its own width, between the two of `sigma`."""
    sigmas = rng.uniform(*sigma, len(clip)) * clip.size[1]
    video = np.stack([cv2.GaussianBlur(image, (0, 0), s) for image, s in zip(clip.video, sigmas, strict=True)])
    return replace(clip, video=video)


def blur_depth(clip: Clip, rng: np.random.Generator, sigma: tuple[float, float]) -> Clip:
    """Blur all depth maps with one Gaussian, which smears edges as sensors do; invalid pixels stay invalid."""
    s = rng.uniform(*sigma) * clip.size[1]
    return replace(clip, depths=np.stack([_blur_valid(depth, s) for depth in clip.depths]))


def _blur_valid(depth: np.ndarray, sigma: float) -> np.ndarray:
    valid = (depth > 0).astype(np.float32)
    weight = cv2.GaussianBlur(valid, (0, 0), sigma)
    return np.where(valid > 0, cv2.GaussianBlur(depth, (0, 0), sigma) / np.maximum(weight, 1e-6), np.float32(0))


def _turn_hue(turn: float) -> np.ndarray:
    c, s = np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn)
    return np.linalg.inv(_TO_YIQ) @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ _TO_YIQ


def requery(tracks: Tracks, visible: np.ndarray) -> Tracks:
    """Change true tracks' visibility (T, N): drop points hidden in all frames, move queries to frames that show theirs.

    A query whose point is visible in its frame is kept, another moves to the first visible frame.
    """
    kept = replace(tracks, visible=visible).select(visible.any(0))
    queries = kept.queries.copy()
    hidden = ~kept.visible[queries[:, 0].astype(int), np.arange(len(queries))]
    queries[hidden] = query_rows(kept.xyz[:, hidden], kept.visible.argmax(0)[hidden])
    return replace(kept, queries=queries)


def random_view(
    clip: Clip, rng: np.random.Generator, pad: float, scale: tuple[float, float], drift: float
) -> tuple[float, np.ndarray]:
    """Draw padding, a scale and a moving crop of the original size: a factor and offsets (T, 2) in pixels, for `reframe`.

    The black border of each side is at most `pad`, the crop's change from one frame to the next at most `drift`, both
    fractions of the image's width; the factor is between the two of `scale`.
    """
    size = np.array(clip.size[::-1], float)
    before, after = rng.uniform(0, pad * size[0], (2, 2))
    s = float(rng.uniform(*scale))
    room = s * (size + before + after - 1) + 1 - size  # negative where the image is smaller than the crop
    low, high = np.minimum(room, 0), np.maximum(room, 0)
    place, speed, places = rng.uniform(low, high), np.zeros(2), []
    for _ in range(len(clip)):
        places.append(place)
        speed = 0.8 * speed + 0.2 * rng.uniform(-drift, drift, 2) * size[0]
        place = np.clip(place + speed, low, high)
    return s, np.stack(places) - s * before


def reframe(clip: Clip, scale: float, offsets: np.ndarray) -> Clip:
    """Resize and crop a clip to its old size: u' = scale u - offset, with offsets (T, 2) in pixels of the result.

    Depth is interpolated as inverse depth, which is linear in the image on any plane, and only within one surface;
    at an edge between two surfaces the nearest pixel's depth is taken, so that no third surface appears between them.
    A view without any valid depth is a ValueError.
    """
    camera = np.repeat(np.diag([scale, scale, 1.0])[None], len(clip), 0)
    camera[:, :2, 2] = -offsets
    shape = clip.size[::-1]
    matrices = camera[:, :2]
    video = np.stack([cv2.warpAffine(image, m, shape) for image, m in zip(clip.video, matrices, strict=True)])
    depths = np.stack([_warp_depth(depth, m, shape) for depth, m in zip(clip.depths, matrices, strict=True)])
    intrinsics = (camera @ clip.intrinsics).astype(np.float32)
    uv, _ = project(clip.tracks.xyz, intrinsics, clip.extrinsics)
    inside = ((uv >= -0.5) & (uv < np.array(shape) - 0.5)).all(-1)
    tracks = requery(clip.tracks, clip.tracks.visible & inside)
    changes = {"video": video, "depths": depths, "intrinsics": intrinsics}
    return replace(clip, **changes, tracks=tracks, queries=tracks.queries, extras={})


def flip(clip: Clip, axis: int) -> Clip:
    """Mirror left and right (axis 0), or top and bottom (axis 1).

    The world is mirrored too, in its x axis, because no rigid camera pose can mirror an image. So poses stay rigid, "up"
    stays up in worlds with a horizontal x axis, and both flips together leave the world as it was.
    """
    seen, intrinsics = np.eye(4, dtype=np.float32), clip.intrinsics.copy()
    seen[axis, axis] = -1
    intrinsics[:, axis, 2] = clip.size[1 - axis] - 1 - intrinsics[:, axis, 2]
    intrinsics[:, 0, 1] *= -1  # skew
    queries = clip.queries * np.array([1, -1, 1, 1], np.float32)
    tracks = replace(clip.tracks, xyz=clip.tracks.xyz * np.array([-1, 1, 1], np.float32), queries=queries)
    images = {name: np.flip(getattr(clip, name), 2 - axis) for name in ("video", "depths")}
    cameras = {"intrinsics": intrinsics, "extrinsics": seen @ clip.extrinsics @ _MIRROR}
    return replace(clip, **images, **cameras, queries=queries, tracks=tracks, extras={})


def _warp_depth(depth: np.ndarray, matrix: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
    smooth = cv2.warpAffine(inverse, matrix, shape)
    nearest = cv2.warpAffine(depth, matrix, shape, flags=cv2.INTER_NEAREST)
    same = np.abs(smooth * nearest - 1) < SAME_SURFACE
    return np.divide(1, smooth, out=nearest, where=same)
