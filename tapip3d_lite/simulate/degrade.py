"""Sensor-like depth, soft images and wrong poses: what reality does to a perfect clip; the true tracks stay true.

    z' = r_t z (1 + noise) + z^2 grain,  then steps of disparity, flying pixels and holes

The grain of a depth from stereo or structured light grows with the square of the distance, since disparity goes with
1 / z; at silhouettes such sensors mix front and back, and see nothing beside them or at grazing angles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from tapip3d_lite.bundle import motion
from tapip3d_lite.clip import Clip
from tapip3d_lite.geometry import invert
from tapip3d_lite.poses import move
from tapip3d_lite.validate import check_range

_EDGE = 0.08  # neighbouring depths that differ by this share belong to two surfaces


@dataclass(frozen=True)
class SensorConfig:
    """Strength of each flaw; 0 is none. `SensorConfig.draw` draws all of them for a training clip.

    Attributes:
        flicker: standard deviation of the factor by which a whole frame's depth is wrong.
        noise: standard deviation of each pixel's relative error, independent in each frame.
        grain: the same in metres at a distance of one metre; grows with the square of the distance.
        step: smallest difference of disparity that is told apart, as a share of the disparity at one metre.
        flying: share of the pixels along silhouettes that show a depth between front and back.
        shadow: width of the holes beside silhouettes, in pixels of a width of 128.
        grazing: surfaces whose ray meets them at less than this angle (degrees) have no depth.
        dropout: share of the pixels without depth, at random places.
        blur: standard deviation of the image's blur, in pixels of a width of 128.

    Raises:
        ValueError: a negative strength, or a share above 1.
    """

    flicker: float = 0.0
    noise: float = 0.0
    grain: float = 0.0
    step: float = 0.0
    flying: float = 0.0
    shadow: float = 0.0
    grazing: float = 0.0
    dropout: float = 0.0
    blur: float = 0.0

    def __post_init__(self) -> None:
        check_range(self, 0, np.inf, "flicker", "noise", "grain", "step", "shadow", "blur")
        check_range(self, 0, 1, "flying", "dropout")
        check_range(self, 0, 90, "grazing")

    @classmethod
    def draw(cls, rng: np.random.Generator, share: float = 0.5, images: bool = True) -> SensorConfig:
        """Strengths for a training clip: each flaw occurs in a share of the clips, from just noticeable to strong."""
        ranges = {
            "flicker": (0.002, 0.04),
            "noise": (0.005, 0.08),
            "grain": (0.0005, 0.006),
            "step": (0.0005, 0.004),
            "flying": (0.1, 1.0),
            "shadow": (0.5, 4.0),
            "grazing": (3.0, 15.0),
            "dropout": (0.02, 0.6),
        } | ({"blur": (0.3, 2.5)} if images else {})
        return cls(**{name: log_uniform(rng, bounds) for name, bounds in ranges.items() if rng.random() < share})


def degrade(clip: Clip, config: SensorConfig, seed: int | np.random.Generator = 0) -> Clip:
    """The clip as a sensor would give it: depths and images change, cameras, queries and true tracks do not.

    Args:
        clip: any clip.
        config: how strong each flaw is.
        seed: a number or a generator; the same seed gives the same clip.
    """
    rng, unit = np.random.default_rng(seed), clip.size[1] / 128
    depths = clip.depths
    if config.flying or config.shadow:
        square = np.ones((3, 3), np.uint8)
        near, far = (np.stack([change(x, square) for x in depths]) for change in (cv2.erode, cv2.dilate))
        edge = (far - near) > _EDGE * np.maximum(near, 1e-3)  # silhouettes: two surfaces in a neighbourhood
    shape = depths.shape
    if config.flying:
        mixed = near + rng.random(shape, np.float32) * (far - near)
        depths = np.where(edge & (rng.random(shape) < config.flying) & (depths > 0) & (near > 0), mixed, depths)
    scale = np.exp(config.flicker * rng.standard_normal((len(depths), 1, 1)))
    depths = depths * scale * (1 + config.noise * rng.standard_normal(shape, np.float32))
    depths = depths + config.grain * depths**2 * rng.standard_normal(shape, np.float32)
    if config.step:
        disparity = np.rint(np.divide(1, depths, out=np.zeros_like(depths), where=depths > 0) / config.step)
        depths = np.divide(1 / config.step, disparity, out=np.zeros_like(depths), where=disparity > 0)
    lost = rng.random(shape) < config.dropout
    if config.shadow:
        lost |= np.stack([_widened(e, config.shadow * unit) for e in edge])
    if config.grazing:
        lost |= _grazing(clip, config.grazing)
    depths = np.where(lost | (clip.depths <= 0) | (depths <= 0), 0, depths).astype(np.float32)
    if not depths.any():  # nothing would be left to track in
        depths = clip.depths
    video = clip.video
    if config.blur:
        video = np.stack([cv2.GaussianBlur(frame, (0, 0), config.blur * unit) for frame in video])
    return replace(clip, depths=depths, video=video)


def log_uniform(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    """A number between two bounds whose logarithm is drawn uniformly: each order of magnitude is as likely."""
    return float(np.exp(rng.uniform(*np.log(bounds))))


def wrong_poses(clip: Clip, degrees: float, seed: int | np.random.Generator = 0, drift: float = 0.1) -> Clip:
    """The clip with `pose_error` in its cameras. What each camera sees stays; where that is in the world moves with it."""
    extrinsics = clip.extrinsics.astype(np.float64)
    error = pose_error(np.random.default_rng(seed), len(clip), degrees, drift)
    return move(clip, invert(error @ extrinsics) @ extrinsics)


def pose_error(rng: np.random.Generator, frames: int, degrees: float, drift: float = 0.1) -> np.ndarray:
    """Rigid errors (T, 4, 4) of cameras: in each frame an angle N(0, sigma) about a random axis (as the paper's).

    In addition the cameras drift: about and along each axis by N(0, drift sigma) a frame, in radians and metres.
    """
    wander = np.cumsum(drift * np.radians(degrees) * rng.normal(size=(frames, 6)), 0)
    axes = rng.normal(size=(frames, 3))
    turns = axes / np.linalg.norm(axes, axis=-1, keepdims=True) * np.radians(degrees) * rng.normal(size=(frames, 1))
    return np.stack([motion(x) for x in np.concatenate([wander[:, 3:], turns + wander[:, :3]], 1)])


def _widened(mask: np.ndarray, width: float) -> np.ndarray:
    """A mask (H, W) grown to the right by a width in pixels: the side that one of a sensor's two eyes cannot see."""
    grown = np.zeros_like(mask)
    for shift in range(round(width)):
        grown[:, shift:] |= mask[:, : mask.shape[1] - shift]
    return grown


def _grazing(clip: Clip, angle: float) -> np.ndarray:
    """Pixels (T, H, W) where the ray meets the surface at less than an angle in degrees."""
    fx, fy = (clip.intrinsics[:, i, i, None, None] for i in (0, 1))
    depths = np.maximum(clip.depths, 1e-6)
    down, right = np.gradient(np.log(depths), axis=(1, 2))
    # A plane that the axis meets at an angle a has |d log z / d (u / f)| = 1 / tan a.
    return np.hypot(right * fx, down * fy) > 1 / np.tan(np.radians(angle))
