"""`simulate_clip`: a clip with exact ground truth from a seed and a configuration."""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np

from tapip3d_lite.clip import Clip
from tapip3d_lite.simulate.bodies import SimulatedScene, random_scene
from tapip3d_lite.simulate.cameras import random_path
from tapip3d_lite.simulate.physics import UnstableSceneError, geom_poses, roll_out
from tapip3d_lite.simulate.render import Hits, pixel_rays, render_color, render_depth, to_bytes
from tapip3d_lite.simulate.rollout import Rollout
from tapip3d_lite.simulate.settings import SimulationConfig
from tapip3d_lite.simulate.tracks import make_tracks, moving_geoms, sample_pixels

ATTEMPTS = 30
MIN_SEEN = 0.005  # of the image: a frame that shows less of moving bodies shows nothing to track
MIN_DEPTH = 0.5  # metres: nearer than this the camera may stand inside a body
MAX_SHARE = 0.5  # of the image: more of one body hides everything else


def simulate_clip(seed: int = 0, config: SimulationConfig | None = None, **overrides: object) -> Clip:
    """Throw and drop rigid bodies, film them, and return the clip with exact depth, cameras, tracks and visibility.

    The same seed and configuration give the same clip, bit for bit, on one machine. A draw that turns out unusable
    (unstable physics, moving bodies out of view, the camera inside a body) is drawn again, never returned.

    Args:
        seed: non-negative.
        config: a `SimulationConfig`, default values if None.
        overrides: its fields by name, e.g. `camera="handheld"`, `frames=48`.

    Returns:
        A clip with `tracks`; with a stereo baseline also `extras["video_right"]` (T, H, W, 3) uint8.

    Raises:
        ValueError: bad seed, unknown or impossible setting.

    Example:
        >>> clip = simulate_clip(0, frames=2, size=(32, 32))
        >>> clip.depths.shape
        (2, 32, 32)
    """
    return _film_all(*_simulate(seed, make_config(config, **overrides)))


def simulate_rollout(seed: int = 0, config: SimulationConfig | None = None, **overrides: object) -> Rollout:
    """The rollout of `simulate_clip` with the same arguments; `render_clip` makes the same clip of it."""
    return _simulate(seed, make_config(config, **overrides))[0]


def render_clip(rollout: Rollout) -> Clip:
    """Render a rollout without computing physics, so that every machine gets the same clip.

    Raises:
        ValueError: the scene that the seed makes here has other bodies than the rollout's.
    """
    return _film_all(rollout, _shoot(_remake(rollout), rollout))


def object_maps(rollout: Rollout) -> np.ndarray:
    """What every pixel's centre sees: (T, H, W) int32, -1 the sky, 0 the room (floor and backdrop), then the bodies."""
    scene = _remake(rollout)
    geom = np.stack([hits.geom.reshape(rollout.config.size) for hits in _shoot(scene, rollout).hits])
    return np.where(geom < 0, -1, np.maximum(geom - scene.first_body + 1, 0)).astype(np.int32)


def _remake(rollout: Rollout) -> SimulatedScene:
    rng = np.random.default_rng([rollout.attempt, rollout.seed])
    scene = random_scene(rng, rollout.config, random_path(rng, rollout.config).azimuth.mean())
    if rollout.states.shape[2] != scene.model.nq:
        raise ValueError(
            f"render_clip: seed {rollout.seed} makes a scene with {scene.model.nq} positions here, the rollout has "
            f"{rollout.states.shape[2]}; it was made by another version of the simulator"
        )
    return scene


def _simulate(seed: int, config: SimulationConfig) -> tuple[Rollout, Shots]:
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"simulate_clip: seed must be a whole number of at least 0, got {seed!r}")
    failure = None
    for attempt in range(ATTEMPTS):
        try:
            return _attempt(int(seed), attempt, config)
        except UnstableSceneError as error:  # noqa: PERF203 (a failure is what the loop is for)
            failure = error
    raise ValueError(
        f"simulate_clip: seed {seed} gave no usable scene in {ATTEMPTS} draws (last: {failure}); "
        "use calmer settings (speed, drop, arc, handheld) or another seed"
    )


def make_config(config: SimulationConfig | None = None, **overrides: object) -> SimulationConfig:
    """A configuration with some fields replaced; an unknown field is a ValueError."""
    known = SimulationConfig.__dataclass_fields__
    unknown = [name for name in overrides if name not in known]
    if unknown:
        raise ValueError(f"simulate: unknown setting {', '.join(unknown)}; known are {', '.join(known)}")
    return replace(config or SimulationConfig(), **overrides)


@dataclass(frozen=True)
class Shots:
    """What rays through the pixel centres met: poses (T, G, 4, 4), depths (T, H, W) float64, T hits."""

    scene: SimulatedScene
    poses: np.ndarray
    depths: np.ndarray
    hits: list[Hits]


def _attempt(seed: int, attempt: int, config: SimulationConfig) -> tuple[Rollout, Shots]:
    rng = np.random.default_rng([attempt, seed])
    path = random_path(rng, config)
    scene = random_scene(rng, config, path.azimuth.mean())
    offsets = np.linspace(-0.25, 0.25, 5) if config.motion_blur else np.zeros(1)
    states = roll_out(scene, config.frames, config.fps, offsets)
    # Stored float32 poses are the truth: everything is rendered with exactly these.
    extrinsics = path.extrinsics(np.arange(config.frames)[:, None] + offsets).astype(np.float32)
    intrinsics = path.intrinsics.astype(np.float32)
    rollout = Rollout(seed, attempt, config, states, intrinsics, extrinsics, np.zeros((0, 3), np.int16))
    shots = _shoot(scene, rollout)
    moving = moving_geoms(scene, shots.poses)
    geom = np.stack([h.geom.reshape(config.size) for h in shots.hits])
    _check_view(scene, geom, shots.depths, moving)
    pixels = sample_pixels(rng, geom, moving, config.tracks, config.share_dynamic)
    return replace(rollout, pixels=pixels.astype(np.int16)), shots


def _shoot(scene: SimulatedScene, rollout: Rollout) -> Shots:
    center = rollout.states.shape[1] // 2
    states, extrinsics = rollout.states[:, center], rollout.extrinsics[:, center].astype(float)
    depths, hits = _measure(scene, rollout.config, states, rollout.intrinsics.astype(float), extrinsics)
    return Shots(scene, geom_poses(scene, states), depths, hits)


def _film_all(rollout: Rollout, shots: Shots) -> Clip:
    config, scene, states = rollout.config, shots.scene, rollout.states
    intrinsics, extrinsics = rollout.intrinsics.astype(float), rollout.extrinsics.astype(float)
    center = states.shape[1] // 2
    extras = {}
    if config.stereo_baseline:
        right = extrinsics.copy()
        right[..., 0, 3] -= config.stereo_baseline
        extras["video_right"] = _film(scene, config, states, intrinsics, right)
        extras["stereo_baseline"] = np.float32(config.stereo_baseline)
    cameras, pixels = (intrinsics, extrinsics[:, center]), rollout.pixels.astype(int)
    tracks = make_tracks(scene, states[:, center], shots.poses, shots.hits, shots.depths, *cameras, pixels)
    return Clip(
        video=_film(scene, config, states, intrinsics, extrinsics),
        depths=shots.depths.astype(np.float32),
        intrinsics=np.repeat(intrinsics[None], config.frames, 0),
        extrinsics=extrinsics[:, center],
        tracks=tracks,
        name=f"simulated_{rollout.seed}",
        fps=config.fps,
        extras=extras,
    )


def _measure(
    scene: SimulatedScene, config: SimulationConfig, states: np.ndarray, intrinsics: np.ndarray, extrinsics: np.ndarray
) -> tuple[np.ndarray, list[Hits]]:
    """z-depths (T, H, W) float64 and the pixel centres' hits of all frames."""
    data = mujoco.MjData(scene.model)
    depths, hits = np.empty((len(states), *config.size)), []
    rays = pixel_rays(intrinsics, np.arange(config.size[1]), np.arange(config.size[0]))
    for t, state in enumerate(states):
        data.qpos[:] = state
        mujoco.mj_kinematics(scene.model, data)
        depth, hit = render_depth(scene, data, rays, extrinsics[t])
        depths[t] = depth.reshape(config.size)
        hits.append(hit)
    return depths, hits


def _film(
    scene: SimulatedScene, config: SimulationConfig, states: np.ndarray, intrinsics: np.ndarray, extrinsics: np.ndarray
) -> np.ndarray:
    """The video (T, H, W, 3) uint8; states (T, S, nq) and extrinsics (T, S, 4, 4) are averaged over S in light."""
    data = mujoco.MjData(scene.model)
    video = np.empty((config.frames, *config.size, 3), np.uint8)
    rays = pixel_rays(intrinsics, np.arange(config.size[1] + 1) - 0.5, np.arange(config.size[0] + 1) - 0.5)
    for t in range(config.frames):
        light = np.zeros((*config.size, 3), np.float32)
        for state, pose in zip(states[t], extrinsics[t], strict=True):
            data.qpos[:] = state
            mujoco.mj_kinematics(scene.model, data)
            light += render_color(scene, data, rays, pose, config.size, 1 / intrinsics[0, 0])
        video[t] = to_bytes(light / states.shape[1])
    return video


def _check_view(scene: SimulatedScene, geom: np.ndarray, depths: np.ndarray, moving: np.ndarray) -> None:
    """Refuse clips in which there is nothing to track or the camera stands inside a body."""
    bodies = geom >= scene.first_body
    seen = (moving[geom] & bodies).mean((1, 2)) > MIN_SEEN
    if len(geom) > 1 and seen.mean() < 0.5:  # nothing moves in a single frame
        raise UnstableSceneError(f"moving bodies are in view in {seen.sum()} of {len(seen)} frames only")
    largest = max((geom == g).mean((1, 2)).max() for g in range(scene.first_body, scene.model.ngeom))
    if largest > MAX_SHARE:
        raise UnstableSceneError(f"one body fills {largest:.0%} of a frame")
    if bodies.any() and depths[bodies].min() < MIN_DEPTH:
        raise UnstableSceneError(f"a body comes as near as {depths[bodies].min():.2g} m")
