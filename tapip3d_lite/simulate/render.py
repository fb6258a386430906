"""Ray casting: depth and geom at every pixel's centre, colour from sun, ambient light and soft shadows.

MuJoCo casts the rays of one origin at once. Colours are taken at the pixels' corners and averaged over each pixel's
four, which costs one ray per pixel and leaves no jagged edges. Shadows of a disc-shaped sun use interleaved sampling:
every second corner, as on a checkerboard, looks at one of four points on the sun, and a 3x3 mean over the corners on
the same body sees all four.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from tapip3d_lite.geometry import invert
from tapip3d_lite.simulate.bodies import HIDDEN_GROUP, SimulatedScene
from tapip3d_lite.simulate.rollout import Rollout

SUN_DISTANCE = 30.0
SUN_RADIUS = 0.8  # metres at that distance: penumbras about as wide as on a lightly clouded day
BACKDROP_GLOW = 0.8  # the backdrop is not lit by the sun: real horizons are not lit by one lamp
_TONES = np.rint(255 * np.linspace(0, 1, 4096) ** (1 / 2.2)).astype(np.uint8)


@dataclass(frozen=True)
class Shots:
    """A rollout at its frames' own instants, and what rays through the pixels' centres meet there."""

    scene: SimulatedScene
    states: np.ndarray  # (T, nq)
    intrinsics: np.ndarray  # (3, 3)
    extrinsics: np.ndarray  # (T, 4, 4)
    poses: np.ndarray  # (T, G, 4, 4) of all geoms, local to world
    depths: np.ndarray  # (T, H, W) z-depth, 0 for the sky
    geom: np.ndarray  # (T, H, W) geom index, -1 for the sky
    normal: np.ndarray  # (T, H, W, 3) of the side that is seen, world frame


def shoot(scene: SimulatedScene, rollout: Rollout) -> Shots:
    """Cast the rays of all pixels' centres in all frames."""
    size, center = rollout.config.size, rollout.states.shape[1] // 2
    states, intrinsics = rollout.states[:, center], rollout.intrinsics.astype(float)
    extrinsics = rollout.extrinsics[:, center].astype(float)
    rays = pixel_rays(intrinsics, np.arange(size[1]), np.arange(size[0]))
    poses = np.tile(np.eye(4), (len(states), scene.model.ngeom, 1, 1))
    depths, geom = np.empty((len(states), *size)), np.empty((len(states), *size), np.int32)
    normal = np.empty((*depths.shape, 3))
    for t, data in enumerate(scene.posed(states)):
        poses[t, :, :3, :3] = data.geom_xmat.reshape(-1, 3, 3)
        poses[t, :, :3, 3] = data.geom_xpos
        hits = cast(data, invert(extrinsics[t])[:3, 3], rays @ extrinsics[t, :3, :3])
        depths[t] = np.where(hits.geom < 0, 0, hits.distance * rays[:, 2]).reshape(size)
        geom[t], normal[t] = hits.geom.reshape(size), hits.normal.reshape(*size, 3)
    return Shots(scene, states, intrinsics, extrinsics, poses, depths, geom, normal)


def film(scene: SimulatedScene, rollout: Rollout, extrinsics: np.ndarray) -> np.ndarray:
    """The video (T, H, W, 3) uint8 of cameras (T, S, 4, 4); light is averaged over the S instants of a frame."""
    intrinsics, shape = rollout.intrinsics.astype(float), tuple(side + 1 for side in rollout.config.size)
    corners = pixel_rays(intrinsics, np.arange(shape[1]) - 0.5, np.arange(shape[0]) - 0.5)
    pixel = 1 / intrinsics[0, 0]  # its size at distance 1
    video = []
    for states, poses in zip(rollout.states, extrinsics, strict=True):
        instants = zip(scene.posed(states), poses, strict=True)
        light = sum(_color(scene, data, corners, pose, pixel, shape) for data, pose in instants)
        video.append(_TONES[np.clip(light / len(states) * 4095 + 0.5, 0, 4095).astype(np.int16)])
    return np.stack(video)


@dataclass(frozen=True)
class Hits:
    """What unit rays from one point have hit first, in the world frame."""

    rays: np.ndarray  # (R, 3)
    distance: np.ndarray  # (R,) inf for the sky
    geom: np.ndarray  # (R,) -1 for the sky
    points: np.ndarray  # (R, 3) at distance 1 for the sky
    normal: np.ndarray  # (R, 3) of the side that is seen


def cast(data: mujoco.MjData, origin: np.ndarray, rays: np.ndarray, shadow: bool = False) -> Hits:
    """First hits of unit rays (R, 3) from one origin (3,), in the world; `shadow` leaves out the backdrop."""
    count = len(rays)
    distance, geom, normal = np.empty(count), np.empty(count, np.int32), np.empty((count, 3))
    groups = np.ones(6, np.uint8)
    groups[HIDDEN_GROUP] = not shadow
    rays = np.ascontiguousarray(rays, np.float64)
    if count:
        flat, normals = rays.reshape(-1), normal.reshape(-1)
        mujoco.mj_multiRay(data.model, data, origin, flat, groups, True, -1, geom, distance, normals, count, 1e10)
    points = origin + rays * np.where(geom < 0, 1, distance)[:, None]
    inside = np.einsum("rc,rc->r", normal, rays) > 0  # the backdrop, a sphere around the camera
    normal *= np.where(inside, -1, 1)[:, None]
    return Hits(rays, np.where(geom < 0, np.inf, distance), geom, points, normal)


def pixel_rays(intrinsics: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Camera-frame unit rays (len(v) * len(u), 3), row-major, through the pixels of columns u and rows v."""
    columns, rows = np.meshgrid((u - intrinsics[0, 2]) / intrinsics[0, 0], (v - intrinsics[1, 2]) / intrinsics[1, 1])
    rays = np.stack([columns.ravel(), rows.ravel(), np.ones(columns.size)], -1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def _color(
    scene: SimulatedScene, data: mujoco.MjData, rays: np.ndarray, pose: np.ndarray, pixel: float, shape: tuple[int, int]
) -> np.ndarray:
    """Linear RGB (H, W, 3) float32 of a camera's pose (4, 4), from rays through the pixels' corners, a grid of `shape`."""
    hits = cast(data, invert(pose)[:3, 3], rays @ pose[:3, :3])
    color = _shade(scene, data, hits, _sunlight(scene, data, hits, shape), pixel).reshape(*shape, 3)
    rows = color[1:] + color[:-1]
    return (rows[:, 1:] + rows[:, :-1]) / 4


def _shade(scene: SimulatedScene, data: mujoco.MjData, hits: Hits, sunlight: np.ndarray, pixel: float) -> np.ndarray:
    """Linear RGB (R, 3): texture times (ambient, brighter from above, + sun), and a faint highlight on bodies."""
    color = np.empty((len(hits.geom), 3), np.float32)
    for index in np.unique(hits.geom):
        at = np.flatnonzero(hits.geom == index)
        if index < 0:
            color[at] = scene.sky(hits.rays[at])
            continue
        local = (hits.points[at] - data.geom_xpos[index]) @ data.geom_xmat[index].reshape(3, 3)
        paint = scene.textures[index](local)
        if scene.is_backdrop(index):
            color[at] = BACKDROP_GLOW * paint
            continue
        if index == 0:  # where a pixel covers more floor than the pattern's features, only its mean is left
            footprint = pixel * hits.distance[at] / np.maximum(np.abs(hits.rays[at, 2]), 0.2)
            fade = np.clip((footprint - 0.15) / 0.4, 0, 1).astype(np.float32)
            paint += fade[:, None] * (scene.floor_mean - paint)
        upward = (0.7 + 0.3 * hits.normal[at, 2:]).astype(np.float32)
        paint *= upward * scene.ambient + sunlight[at, None] * scene.sun_color
        if index:
            halfway = scene.sun - hits.rays[at]
            shine = np.einsum("rc,rc->r", hits.normal[at], halfway) / np.linalg.norm(halfway, axis=-1)
            paint += (0.18 * (sunlight[at] > 0) * np.maximum(shine, 0) ** 32).astype(np.float32)[:, None]
        color[at] = paint
    return color


def _sunlight(scene: SimulatedScene, data: mujoco.MjData, hits: Hits, shape: tuple[int, int]) -> np.ndarray:
    """How brightly the sun lights the hits (R,) float32, a grid of `shape`: cosine times the sun's visible share."""
    sunlight = np.maximum(hits.normal @ scene.sun, 0).astype(np.float32)
    sunlight[(hits.geom < 0) | scene.is_backdrop(hits.geom)] = 0
    rows, columns = np.indices(shape).reshape(2, -1)
    # Numbered along the diagonals, so that each 2x2 block of the checkerboard's fields looks at all four points.
    index = (rows + columns) // 2 % 2 * 2 + (rows - columns) // 2 % 2
    fields = (rows + columns) % 2 == 0
    lit = np.ones(len(sunlight), bool)
    side = np.cross(scene.sun, [0.0, 0, 1])
    side *= SUN_RADIUS / np.linalg.norm(side)
    other = np.cross(scene.sun, side)
    for number, offset in enumerate((side, other, -other, -side)):  # around the sun's disc
        position = SUN_DISTANCE * scene.sun + offset
        chosen = np.flatnonzero((index == number) & fields & (sunlight > 0))
        towards = hits.points[chosen] - position
        distance = np.sqrt(np.einsum("rc,rc->r", towards, towards))
        towards /= distance[:, None]
        near = _may_hit(scene, data, position, towards)
        shadows = cast(data, position, towards[near], shadow=True)
        lit[chosen[near]] = shadows.distance > distance[near] - 0.01
    return sunlight * _mean_same_geom(*(a.reshape(shape) for a in (lit, hits.geom, fields))).ravel()


def _may_hit(scene: SimulatedScene, data: mujoco.MjData, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Which rays (R,) bool pass through any body's bounding sphere; most do not, and need no casting."""
    center = data.geom_xpos[scene.first_body :] - origin
    distance = np.linalg.norm(center, axis=-1)
    least = np.sqrt(np.maximum(0, 1 - (scene.model.geom_rbound[scene.first_body :] / distance) ** 2))
    return (rays @ (center / distance[:, None]).T > least).any(1)


def _mean_same_geom(lit: np.ndarray, geom: np.ndarray, known: np.ndarray) -> np.ndarray:
    """3x3 mean (H, W) of `lit` over the known neighbours on the same geom; 1 where there are none."""
    lit, known, geoms = np.pad(lit & known, 1), np.pad(known, 1), np.pad(geom, 1, constant_values=-2)
    total, count = np.zeros(geom.shape, np.float32), np.zeros(geom.shape, np.float32)
    for row, column in np.ndindex(3, 3):
        window = slice(row, row + geom.shape[0]), slice(column, column + geom.shape[1])
        same = geoms[window] == geom
        total += lit[window] & same
        count += known[window] & same
    return np.where(count > 0, total / np.maximum(count, 1), 1)
