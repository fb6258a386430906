"""Queries on pixels, and the tracks that follow them exactly: position by the body's pose, visibility by a ray."""

from __future__ import annotations

import mujoco
import numpy as np

from tapip3d_lite.clip import Tracks
from tapip3d_lite.geometry import invert, project, transform, unproject
from tapip3d_lite.simulate.bodies import SimulatedScene
from tapip3d_lite.simulate.render import Hits, camera_center, cast

MOTION = 0.05  # metres that a body's surface must leave its first place by to count as moving
SLACK = 1e-4  # of the distance: a hit this little in front of the point is the point itself


def moving_geoms(scene: SimulatedScene, poses: np.ndarray) -> np.ndarray:
    """Which geoms (G,) really move in the world, given all frames' poses (T, G, 4, 4)."""
    reach = scene.model.geom_rbound  # 0 for planes, which stay where they are
    ends = np.concatenate([np.eye(3), -np.eye(3)])[None] * reach[:, None, None]
    paths = transform(ends, poses)
    return np.linalg.norm(paths - paths[:1], axis=-1).max((0, 2)) > MOTION


def sample_pixels(
    rng: np.random.Generator, geom: np.ndarray, moving: np.ndarray, count: int, share: float
) -> np.ndarray:
    """Draw query pixels: a frame at random, then a pixel in it, on moving bodies and elsewhere separately.

    Args:
        geom: (T, H, W) geom index, -1 for the sky.
        moving: (G,).
        count: N.
        share: of the queries on moving bodies, as far as there are any pixels of either sort.

    Returns:
        (N, 3) int rows (t, v, u), in the order of t.
    """
    on_moving = moving[geom] & (geom >= 0)
    elsewhere = (geom >= 0) & ~on_moving
    wanted = round(count * share) if elsewhere.any() else count
    wanted = wanted if on_moving.any() else 0
    parts = [_sample_mask(rng, mask, n) for mask, n in ((on_moving, wanted), (elsewhere, count - wanted)) if n]
    rows = np.concatenate(parts)
    return rows[np.argsort(rows[:, 0], kind="stable")]


def _sample_mask(rng: np.random.Generator, mask: np.ndarray, count: int) -> np.ndarray:
    frames = rng.choice(np.flatnonzero(mask.any((1, 2))), count)
    rows = np.empty((count, 3), int)
    for t in np.unique(frames):
        slots = np.flatnonzero(frames == t)
        v, u = np.nonzero(mask[t])
        # Without repetition, unless the frame has fewer such pixels than queries.
        rows[slots, 0], pick = t, rng.choice(len(v), len(slots), replace=len(v) < len(slots))
        rows[slots, 1], rows[slots, 2] = v[pick], u[pick]
    return rows


def make_tracks(
    scene: SimulatedScene,
    states: np.ndarray,
    poses: np.ndarray,
    hits: list[Hits],
    depths: np.ndarray,
    intrinsics: np.ndarray,
    extrinsics: np.ndarray,
    pixels: np.ndarray,
) -> Tracks:
    """Follow the surface points under query pixels through all frames.

    Args:
        states: (T, nq) and poses: (T, G, 4, 4), float64.
        hits: T of all pixel centres; depths: (T, H, W) float64 z-depth.
        intrinsics: (3, 3), extrinsics: (T, 4, 4).
        pixels: (N, 3) rows (t, v, u).
    """
    t, v, u = pixels.T
    width = depths.shape[2]
    geom = np.array([hits[f].geom[r * width + c] for f, r, c in pixels])
    normal = np.array([hits[f].normal[r * width + c] for f, r, c in pixels])
    uv = np.stack([u, v], -1).astype(float)
    world = unproject(uv[:, None], depths[t, v, u][:, None], intrinsics, extrinsics[t])
    at_query = poses[t, geom]
    local = transform(world, invert(at_query))
    local_normal = normal[:, None] @ at_query[:, :3, :3]
    xyz = transform(local, poses[:, geom])[:, :, 0]
    normals = (local_normal @ poses[:, geom, :3, :3].swapaxes(-1, -2))[:, :, 0]
    size = depths.shape[1:]
    visible = point_visibility(scene, states, xyz, normals, geom, intrinsics, extrinsics, size)
    visible[t, np.arange(len(t))] = True  # seen there by construction; a grazing ray may differ in the last digit
    queries = np.concatenate([t[:, None], world[:, 0]], -1)
    return Tracks(xyz, visible, queries, dynamic=moving_geoms(scene, poses)[geom])


def point_visibility(
    scene: SimulatedScene,
    states: np.ndarray,
    xyz: np.ndarray,
    normals: np.ndarray,
    geom: np.ndarray,
    intrinsics: np.ndarray,
    extrinsics: np.ndarray,
    size: tuple[int, int],
) -> np.ndarray:
    """Whether surface points are seen: inside the image, facing the camera, and nothing before them on the ray.

    Args:
        states: (T, nq).
        xyz, normals: (T, N, 3), world frame, normals outward.
        geom: (N,) the geom that each point lies on.
        intrinsics: (3, 3), extrinsics: (T, 4, 4), size: (H, W).

    Returns:
        (T, N) bool.
    """
    data = mujoco.MjData(scene.model)
    uv, z = project(xyz, intrinsics, extrinsics)
    visible = (z > 0) & ((uv >= -0.5) & (uv < np.array(size[::-1]) - 0.5)).all(-1)
    sign = np.where(scene.is_backdrop(geom), -1, 1)
    for t, state in enumerate(states):
        data.qpos[:] = state
        mujoco.mj_kinematics(scene.model, data)
        origin = camera_center(extrinsics[t])
        rays = xyz[t] - origin
        distance = np.linalg.norm(rays, axis=-1)
        facing = sign * np.einsum("nc,nc->n", rays, normals[t]) < 0
        first = cast(scene.model, data, origin, rays / distance[:, None]).distance
        visible[t] &= facing & (first >= distance * (1 - SLACK))
    return visible
