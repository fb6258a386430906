"""`simulate_clip`: a clip with exact ground truth from a seed and a configuration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tapip3d_lite.clip import Clip
from tapip3d_lite.simulate.bodies import SimulatedScene, random_scene
from tapip3d_lite.simulate.cameras import CameraPath, random_path
from tapip3d_lite.simulate.physics import UnstableSceneError, roll_out
from tapip3d_lite.simulate.render import Shots, film, shoot
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
    return _develop(*_simulate(seed, config, overrides))


def simulate_rollout(seed: int = 0, config: SimulationConfig | None = None, **overrides: object) -> Rollout:
    """The rollout of `simulate_clip` with the same arguments; `render_clip` makes the same clip of it."""
    return _simulate(seed, config, overrides)[0]


def render_clip(rollout: Rollout) -> Clip:
    """Render a rollout without computing physics, so that every machine gets the same clip; ValueError for other bodies."""
    return _develop(rollout, shoot(_remake(rollout), rollout))


def object_maps(rollout: Rollout) -> np.ndarray:
    """What every pixel's centre sees: (T, H, W) int32, -1 the sky, 0 the room (floor and backdrop), then the bodies."""
    scene = _remake(rollout)
    geom = shoot(scene, rollout).geom
    return np.where(geom < 0, -1, np.maximum(geom - scene.first_body + 1, 0)).astype(np.int32)


def _remake(rollout: Rollout) -> SimulatedScene:
    _, _, scene = _draw(rollout.seed, rollout.attempt, rollout.config)
    if rollout.states.shape[2] != scene.model.nq:
        raise ValueError(
            f"render_clip: seed {rollout.seed} makes a scene with {scene.model.nq} positions here, the rollout has "
            f"{rollout.states.shape[2]}; it was made by another version of the simulator"
        )
    return scene


def _simulate(seed: int, config: SimulationConfig | None, overrides: dict[str, object]) -> tuple[Rollout, Shots]:
    known = SimulationConfig.__dataclass_fields__
    unknown = [name for name in overrides if name not in known]
    if unknown:
        raise ValueError(f"simulate: unknown setting {', '.join(unknown)}; known are {', '.join(known)}")
    config = replace(config or SimulationConfig(), **overrides)
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


def _draw(seed: int, attempt: int, config: SimulationConfig) -> tuple[np.random.Generator, CameraPath, SimulatedScene]:
    rng = np.random.default_rng([attempt, seed])
    path = random_path(rng, config)
    return rng, path, random_scene(rng, config, path.azimuth.mean())


def _attempt(seed: int, attempt: int, config: SimulationConfig) -> tuple[Rollout, Shots]:
    rng, path, scene = _draw(seed, attempt, config)
    offsets = np.linspace(-0.25, 0.25, 5) if config.motion_blur else np.zeros(1)
    states = roll_out(scene, config.frames, config.fps, offsets)
    # Stored float32 poses are the truth: everything is rendered with exactly these.
    extrinsics = path.extrinsics(np.arange(config.frames)[:, None] + offsets).astype(np.float32)
    intrinsics = path.intrinsics.astype(np.float32)
    rollout = Rollout(seed, attempt, config, states, intrinsics, extrinsics, np.zeros((0, 3), np.int16))
    shots = shoot(scene, rollout)
    moving = moving_geoms(shots)
    _check_view(shots, moving)
    pixels = sample_pixels(rng, shots.geom, moving, config.tracks, config.share_dynamic)
    return replace(rollout, pixels=pixels.astype(np.int16)), shots


def _check_view(shots: Shots, moving: np.ndarray) -> None:
    """Refuse clips in which there is nothing to track or the camera stands inside a body."""
    geom, first = shots.geom, shots.scene.first_body
    bodies = geom >= first
    seen = (moving[geom] & bodies).mean((1, 2)) > MIN_SEEN
    if len(geom) > 1 and seen.mean() < 0.5:  # nothing moves in a single frame
        raise UnstableSceneError(f"moving bodies are in view in {seen.sum()} of {len(seen)} frames only")
    largest = max((geom == g).mean((1, 2)).max() for g in range(first, len(moving)))
    if largest > MAX_SHARE:
        raise UnstableSceneError(f"one body fills {largest:.0%} of a frame")
    nearest = shots.depths[bodies].min(initial=np.inf)
    if nearest < MIN_DEPTH:
        raise UnstableSceneError(f"a body comes as near as {nearest:.2g} m")


def _develop(rollout: Rollout, shots: Shots) -> Clip:
    """The clip of a rollout: its videos, its tracks and what the shots measured."""
    config, scene, extrinsics = rollout.config, shots.scene, rollout.extrinsics.astype(float)
    extras = {}
    if config.stereo_baseline:
        right = extrinsics.copy()
        right[..., 0, 3] -= config.stereo_baseline
        extras = {"video_right": film(scene, rollout, right), "stereo_baseline": np.float32(config.stereo_baseline)}
    return Clip(
        video=film(scene, rollout, extrinsics),
        depths=shots.depths.astype(np.float32),
        intrinsics=np.repeat(shots.intrinsics[None], config.frames, 0),
        extrinsics=shots.extrinsics,
        tracks=make_tracks(shots, rollout.pixels.astype(int)),
        name=f"simulated_{rollout.seed}",
        fps=config.fps,
        extras=extras,
    )
