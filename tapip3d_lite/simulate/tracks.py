"""Queries on pixels, and the tracks that follow them exactly: position by the body's pose, visibility by a ray."""

from __future__ import annotations

import numpy as np

from tapip3d_lite.clip import Tracks
from tapip3d_lite.geometry import in_image, invert, transform, unproject
from tapip3d_lite.simulate.render import Shots, cast

MOTION = 0.05  # metres that a body's surface must leave its first place by to count as moving
SLACK = 1e-4  # of the distance: a hit this little in front of the point is the point itself


def moving_geoms(shots: Shots) -> np.ndarray:
    """Which geoms (G,) really move in the world."""
    reach = shots.scene.model.geom_rbound  # 0 for planes, which stay where they are
    ends = np.concatenate([np.eye(3), -np.eye(3)])[None] * reach[:, None, None]
    paths = transform(ends, shots.poses)  # (T, G, 6, 3)
    return np.linalg.norm(paths - paths[:1], axis=-1).max((0, 2)) > MOTION


def sample_pixels(
    rng: np.random.Generator, geom: np.ndarray, moving: np.ndarray, count: int, share: float
) -> np.ndarray:
    """Draw query pixels (N, 3), rows (t, v, u) in the order of t: a frame at random, then a pixel in it.

    Of geom indices (T, H, W), a `share` of the queries falls on those that are moving (G,), as far as there are any
    pixels of either sort; none falls on the sky.
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
        pixels = np.argwhere(mask[t])
        # Without repetition, unless the frame has fewer such pixels than queries.
        pick = rng.choice(len(pixels), len(slots), replace=len(pixels) < len(slots))
        rows[slots, 0], rows[slots, 1:] = t, pixels[pick]
    return rows


def make_tracks(shots: Shots, pixels: np.ndarray) -> Tracks:
    """Follow the surface points under query pixels (N, 3), rows (t, v, u), through all frames."""
    t, v, u = pixels.T
    geom = shots.geom[t, v, u]
    uv = np.stack([u, v], -1).astype(float)
    world = unproject(uv[:, None], shots.depths[t, v, u][:, None], shots.intrinsics, shots.extrinsics[t])  # (N, 1, 3)
    at_query, poses = shots.poses[t, geom], shots.poses[:, geom]  # (N, 4, 4), (T, N, 4, 4)
    xyz = transform(transform(world, invert(at_query)), poses)[:, :, 0]
    local_normal = shots.normal[t, v, u][:, None] @ at_query[:, :3, :3]
    normals = (local_normal @ poses[..., :3, :3].swapaxes(-1, -2))[:, :, 0]
    visible = point_visibility(shots, xyz, normals)
    visible[t, np.arange(len(t))] = True  # seen there by construction; a grazing ray may differ in the last digit
    queries = np.concatenate([t[:, None], world[:, 0]], -1)
    return Tracks(xyz, visible, queries, dynamic=moving_geoms(shots)[geom])


def point_visibility(shots: Shots, xyz: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Whether surface points are seen (T, N): inside the image, facing the camera, and nothing before them on the ray.

    `xyz` and the normals of the seen side are (T, N, 3), world frame.
    """
    visible = in_image(xyz, shots.intrinsics, shots.extrinsics, shots.depths.shape[1:])
    for t, data in enumerate(shots.scene.posed(shots.states)):
        origin = invert(shots.extrinsics[t])[:3, 3]
        rays = xyz[t] - origin
        distance = np.linalg.norm(rays, axis=-1)
        first = cast(data, origin, rays / distance[:, None]).distance
        visible[t] &= (np.einsum("nc,nc->n", rays, normals[t]) < 0) & (first >= distance * (1 - SLACK))
    return visible
