"""Random rigid motions of the coordinates, so that one checkpoint serves camera and world space.

Paper: appendix (training). Everything is moved to the camera frame, then by a smoothly varying random rigid motion. In
camera space the whole scene moves rigidly from frame to frame, opposite to the camera; a tracker that was trained with
all such motions, none included, works in either space. Ours also leaves a share of the examples in the world.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from tapip3d_lite.clip import Clip
from tapip3d_lite.geometry import invert
from tapip3d_lite.poses import move
from tapip3d_lite.simulate.degrade import log_uniform, pose_error
from tapip3d_lite.validate import check_range, check_types


@dataclass(frozen=True)
class MotionConfig:
    """How often and how far coordinates are moved; lengths are in scene units.

    Attributes:
        world: share of the examples that stay in the world frame.
        turned: share of the examples in a randomly rotated world frame; all others are moved to the camera frame.
        still: share of the examples in the camera frame without further motion.
        velocity, velocity_noise: greatest initial speed, and standard deviation of its changes, per frame.
        rotation, rotation_noise: the same for the rotation, in radians per frame.
        smoothing: of the changes over time, from 0 (none) to 1.
        sliding: share of the examples in which the whole world slides at constant velocity, so that nothing rests.
        slide: (least, greatest) speed per frame; drawn log-uniformly, so that creeping is as likely as flying.
        wrong: share of the examples with wrong poses: each frame's camera is turned by one random angle, and drifts.
        pose_noise: (least, greatest) standard deviation of that angle in degrees, drawn log-uniformly; the drift's
            changes per frame have a tenth of it, and shift the camera as well.

    Raises:
        ValueError: a share outside [0, 1], or a negative velocity or rotation.
    """

    world: float = 0.7
    turned: float = 0.1
    still: float = 0.5
    velocity: float = 0.03
    velocity_noise: float = 0.015
    rotation: float = 0.03
    rotation_noise: float = 0.015
    smoothing: float = 0.8
    sliding: float = 0.2
    slide: tuple[float, float] = (0.002, 0.2)
    wrong: float = 0.3
    pose_noise: tuple[float, float] = (0.05, 2.5)

    def __post_init__(self) -> None:
        check_types(self)
        check_range(self, 1e-9, math.inf, "slide", "pose_noise")
        check_range(self, 0, 1, "world", "turned", "still", "smoothing", "sliding", "wrong")
        check_range(self, 0, math.inf, "velocity", "velocity_noise", "rotation", "rotation_noise")
        if self.world + self.turned > 1:
            raise ValueError(f"MotionConfig: world + turned must be at most 1, got {self.world} + {self.turned}")


def smooth_motion(rng: np.random.Generator, frames: int, config: MotionConfig) -> np.ndarray:
    """Draw a rigid motion (T, 4, 4) that starts at the identity and whose velocity changes smoothly."""
    limits = np.array([config.velocity, config.rotation])[:, None]
    noise = np.array([config.velocity_noise, config.rotation_noise])[:, None]
    directions = rng.normal(size=(2, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    speed = directions * rng.uniform(0, 1, (2, 1)) * limits  # (translation, rotation) per frame
    change, motion = np.zeros((2, 3)), [np.eye(4)]
    for _ in range(frames - 1):
        change = config.smoothing * change + (1 - config.smoothing) * noise * rng.normal(size=(2, 3))
        speed = speed + change
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = cv2.Rodrigues(speed[1])[0], speed[0]
        motion.append(step @ motion[-1])
    return np.stack(motion)


def random_coordinates(clip: Clip, rng: np.random.Generator, config: MotionConfig) -> Clip:
    """Leave a clip in its world frame, rotate that frame, or move everything to the camera frame and then smoothly on.

    A share of the examples then gets wrong poses, and a share slides.
    """
    motion, frames = np.eye(4)[None], len(clip)
    extrinsics = clip.extrinsics.astype(np.float64)
    kind = rng.random()
    if rng.random() < config.wrong:
        error = pose_error(rng, frames, log_uniform(rng, config.pose_noise))
        motion = invert(error @ extrinsics) @ extrinsics
    if config.world <= kind < config.world + config.turned:
        turn = np.eye(4)
        turn[:3, :3] = _random_rotation(rng)
        motion = turn @ motion
    elif kind >= config.world:
        still = rng.random() < config.still
        motion = (np.eye(4) if still else smooth_motion(rng, frames, config)) @ extrinsics
    if rng.random() < config.sliding:
        motion = slide(rng, frames, log_uniform(rng, config.slide)) @ motion
    return move(clip, np.broadcast_to(motion, (frames, 4, 4)))


def slide(rng: np.random.Generator, frames: int, speed: float) -> np.ndarray:
    """A translation (T, 4, 4) of constant velocity in a random direction."""
    direction = rng.normal(size=3)
    motion = np.repeat(np.eye(4)[None], frames, 0)
    motion[:, :3, 3] = np.arange(frames)[:, None] * speed * direction / np.linalg.norm(direction)
    return motion


def _random_rotation(rng: np.random.Generator) -> np.ndarray:
    """A rotation drawn uniformly: the orthogonal factor of a matrix of normal numbers, with determinant 1."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q
