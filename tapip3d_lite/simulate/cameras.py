"""Camera paths: where the camera is at any instant, and its lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tapip3d_lite.geometry import look_at
from tapip3d_lite.simulate.settings import SimulationConfig


@dataclass(frozen=True)
class CameraPath:
    """A camera that looks at the action; evaluate it at any instant with `extrinsics`."""

    config: SimulationConfig
    intrinsics: np.ndarray  # (3, 3) pixels
    azimuth: np.ndarray  # (2,) radians, at the first and the last frame, of the arc around the target
    elevation: np.ndarray  # (2,) likewise
    distance: float  # metres from the target
    target: np.ndarray  # (3,) the point that it looks at
    shift: np.ndarray  # (3,) metres that it travels along a line over the clip
    # (6, 3, 3) amplitude, angular frequency (1/s), phase of three sine waves for each of the eye's and target's axes
    shake: np.ndarray

    def extrinsics(self, instants: np.ndarray) -> np.ndarray:
        """World-to-camera poses (..., 4, 4) at instants (...,) counted in frames."""
        instants = np.asarray(instants, float)
        share = instants / max(self.config.frames - 1, 1)
        azimuth, elevation = (first + share * (last - first) for first, last in (self.azimuth, self.elevation))
        flat = np.cos(elevation)
        arm = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1)  # (..., 3)
        amplitude, frequency, phase = np.moveaxis(self.shake, 1, 0)
        seconds = instants[..., None, None] / self.config.fps
        wobble = (amplitude * np.sin(frequency * seconds + phase)).sum(-1)  # (..., 6)
        eye = self.target + self.distance * arm + (share[..., None] - 0.5) * self.shift + wobble[..., :3]
        eye[..., 2] = np.maximum(eye[..., 2], 0.4)
        return look_at(eye, self.target + wobble[..., 3:], np.array([0.0, 0, 1]))


def random_path(rng: np.random.Generator, config: SimulationConfig) -> CameraPath:
    """Draw a path of the kind `config.camera`, with a random focal length and the action well inside the image."""
    height, width = config.size
    focal = rng.uniform(1.0, 1.5)  # in image sides; the distance below follows, so that framing stays alike
    pixels = focal * min(height, width)
    distance = focal * rng.uniform(4.0, 5.0)
    azimuth = np.repeat(rng.uniform(0, 2 * np.pi), 2)
    elevation = np.repeat(rng.uniform(0.12, 0.35) if config.sky else rng.uniform(0.3, 0.7), 2)
    shift, shake = np.zeros(3), np.zeros((6, 3, 3))
    sweep = np.deg2rad(rng.uniform(*config.arc)) * rng.choice([-1, 1])
    heading, travel = rng.uniform(0, 2 * np.pi), rng.uniform(1.5, 3.0)
    if config.camera == "arc":
        azimuth = azimuth + np.array([-0.5, 0.5]) * sweep
        elevation = np.clip(elevation + np.array([-0.5, 0.5]) * rng.uniform(-0.3, 0.3), 0.1, 0.8)
    if config.camera in ("linear", "handheld"):
        step = travel if config.camera == "linear" else 0.5 * config.handheld
        shift = step * np.array([np.cos(heading), np.sin(heading), rng.uniform(-0.3, 0.3)])
    if config.camera == "handheld":
        strength = config.handheld * np.array([[1.0, 0.5, 0.2]]) * np.array([[0.06]] * 3 + [[0.10]] * 3)
        shake[:, 0] = strength * rng.uniform(0.5, 1, (6, 3))
        shake[:, 1] = 2 * np.pi * np.array([0.5, 1.3, 3.1]) * rng.uniform(0.7, 1.3, (6, 3))
        shake[:, 2] = rng.uniform(0, 2 * np.pi, (6, 3))
    intrinsics = np.array([[pixels, 0, (width - 1) / 2], [0, pixels, (height - 1) / 2], [0, 0, 1]])
    target = np.array([*rng.uniform(-0.2, 0.2, 2), rng.uniform(0.4, 0.8)])
    return CameraPath(config, intrinsics, azimuth, elevation, distance, target, shift, shake)
