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
    """Simulate the bodies and return their generalised positions at each frame and sub-frame.

    Args:
        frames: T.
        offsets: (S,) instants relative to a frame, in frames, each within [-0.25, 0.25].

    Returns:
        (T, S, nq) positions for `mujoco.MjData.qpos`.

    Raises:
        UnstableSceneError: NaN, or a speed that only an exploding contact can give.
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
    instants = before + np.arange(frames)[:, None] * steps + np.rint(offsets * steps).astype(int)
    return history[instants]


def _settle(scene: SimulatedScene, data: mujoco.MjData) -> None:
    """Bring resting bodies to rest while the others wait far above, then put those at their start."""
    waiting = [i for i, body in enumerate(scene.bodies) if body.moving]
    start = data.qpos.copy()
    for order, index in enumerate(waiting):
        data.qpos[_slot(scene, index, 7)][2] = 1000 + 10 * order
    if len(waiting) + sum(body.fixed for body in scene.bodies) < len(scene.bodies):
        mujoco.mj_step(scene.model, data, int(SETTLING / scene.model.opt.timestep))
    data.qvel[:] = 0
    for index in waiting:
        body = scene.bodies[index]
        data.qpos[_slot(scene, index, 7)] = start[_slot(scene, index, 7)]
        data.qvel[_slot(scene, index, 6)] = [*body.velocity, *body.spin]


def _slot(scene: SimulatedScene, index: int, width: int) -> slice:
    free = index - sum(body.fixed for body in scene.bodies[:index])
    return slice(free * width, (free + 1) * width)


def geom_poses(scene: SimulatedScene, states: np.ndarray) -> np.ndarray:
    """World poses (T, G, 4, 4) of all geoms at states (T, nq)."""
    data = mujoco.MjData(scene.model)
    poses = np.tile(np.eye(4), (len(states), scene.model.ngeom, 1, 1))
    for t, state in enumerate(states):
        data.qpos[:] = state
        mujoco.mj_kinematics(scene.model, data)
        poses[t, :, :3, :3] = data.geom_xmat.reshape(-1, 3, 3)
        poses[t, :, :3, 3] = data.geom_xpos
    return poses
