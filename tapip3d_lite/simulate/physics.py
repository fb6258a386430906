"""Rigid-body physics: the state of every body of a scene at every rendered instant."""

from __future__ import annotations

import mujoco
import numpy as np

from tapip3d_lite.simulate.bodies import SimulatedScene

STEP = 1 / 240  # seconds, at most
SETTLING = 1.0  # seconds that resting bodies get to come to rest before the first frame
MAX_SPEED = 40.0  # metres per second; faster only when a contact has exploded


class UnstableSceneError(Exception):
    """This draw of a scene cannot be used; draw another."""


def roll_out(scene: SimulatedScene, frames: int, fps: float, offsets: np.ndarray) -> np.ndarray:
    """Simulate the bodies; their positions (T, S, nq), MuJoCo's `qpos`, at S `offsets` in [-0.25, 0.25] of a frame.

    NaN, or a speed that only an exploding contact can give, raises `UnstableSceneError`.
    """
    steps = int(np.ceil(1 / (fps * STEP) / 4) * 4)  # a multiple of 4, so that a quarter of a frame is a whole step
    model, data = scene.model, mujoco.MjData(scene.model)
    model.opt.timestep = 1 / (fps * steps)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # a NaN must show, not be reset away
    _settle(scene, data)
    before = steps // 4  # with or without motion blur, so that both show the same motion
    total = before + (frames - 1) * steps + int(offsets.max() * steps) + 1
    history = np.empty((total, model.nq))
    for index in range(total):
        history[index] = data.qpos
        if not (np.abs(data.qvel) < MAX_SPEED).all():  # also false for NaN
            raise UnstableSceneError(f"speed {np.abs(data.qvel).max():.3g} at step {index}")
        mujoco.mj_step(model, data)
    return history[before + np.arange(frames)[:, None] * steps + np.rint(offsets * steps).astype(int)]


def _settle(scene: SimulatedScene, data: mujoco.MjData) -> None:
    """Bring resting bodies to rest while the others wait far above, then put those at their start."""
    free = [body for body in scene.bodies if not body.fixed]
    moving = np.array([body.moving for body in free])
    places, speeds = data.qpos.reshape(-1, 7), data.qvel.reshape(-1, 6)  # views: a row for each free body
    start = places[moving]
    places[moving, 2] = 1000 + 10 * np.arange(len(start))
    if not moving.all():
        mujoco.mj_step(scene.model, data, int(SETTLING / scene.model.opt.timestep))
    places[moving] = start
    speeds[:] = 0
    speeds[moving] = [[*body.velocity, *body.spin] for body in free if body.moving]
