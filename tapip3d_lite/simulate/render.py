"""Ray casting: depth and geom at every pixel's centre, colour from sun, ambient light and soft shadows.

MuJoCo casts the rays of one origin at once. Colours are taken at the pixels' corners and averaged over each pixel's
four, which costs one ray per pixel and leaves no jagged edges. Shadows of a disc-shaped sun use interleaved sampling:
each corner looks at one of nine points on the sun, and a 3x3 mean over the same body's corners sees all nine.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from tapip3d_lite.simulate.scene import HIDDEN_GROUP, Scene
from tapip3d_lite.simulate.textures import sky

SUN_DISTANCE = 30.0
SUN_RADIUS = 1.6  # metres at that distance: penumbras about as wide as on a lightly clouded day
_TONES = np.rint(255 * np.linspace(0, 1, 4096) ** (1 / 2.2)).astype(np.uint8)


@dataclass(frozen=True)
class Hits:
    """What rays have hit: distance (R,) with inf for the sky, geom (R,) with -1 for the sky, normal (R, 3) outward."""

    distance: np.ndarray
    geom: np.ndarray
    normal: np.ndarray


def cast(
    model: mujoco.MjModel, data: mujoco.MjData, origin: np.ndarray, rays: np.ndarray, shadow: bool = False
) -> Hits:
    """First hits of unit rays (R, 3) from one origin (3,), in the world; `shadow` leaves out the backdrop."""
    count = len(rays)
    distance, geom, normal = np.empty(count), np.empty(count, np.int32), np.empty(3 * count)
    groups = np.ones(6, np.uint8)
    groups[HIDDEN_GROUP] = not shadow
    rays = np.ascontiguousarray(rays, np.float64).reshape(-1)
    if count:
        mujoco.mj_multiRay(model, data, origin, rays, groups, True, -1, geom, distance, normal, count, 1e10)
    return Hits(np.where(geom < 0, np.inf, distance), geom, normal.reshape(-1, 3))


def pixel_rays(intrinsics: np.ndarray, extrinsics: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple:
    """World-frame unit rays (len(v) * len(u), 3), row-major, and the z-depth (R,) of one unit along each."""
    columns, rows = np.meshgrid((u - intrinsics[0, 2]) / intrinsics[0, 0], (v - intrinsics[1, 2]) / intrinsics[1, 1])
    rays = np.stack([columns.ravel(), rows.ravel(), np.ones(columns.size)], -1)
    z = 1 / np.sqrt(np.einsum("rc,rc->r", rays, rays))
    return (rays * z[:, None]) @ extrinsics[:3, :3], z


def camera_center(extrinsics: np.ndarray) -> np.ndarray:
    """The camera's position (3,) in the world."""
    return -extrinsics[:3, :3].T @ extrinsics[:3, 3]


def render_depth(
    scene: Scene, data: mujoco.MjData, intrinsics: np.ndarray, extrinsics: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, Hits]:
    """z-depth (H, W), 0 where the sky is, and the hits of all pixel centres, row-major."""
    rays, z = pixel_rays(intrinsics, extrinsics, np.arange(size[1]), np.arange(size[0]))
    hits = cast(scene.model, data, camera_center(extrinsics), rays)
    return np.where(hits.geom < 0, 0, hits.distance * z).reshape(size), hits


def render_color(
    scene: Scene, data: mujoco.MjData, intrinsics: np.ndarray, extrinsics: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Linear RGB (H, W, 3) float32."""
    height, width = size
    rays, _ = pixel_rays(intrinsics, extrinsics, np.arange(width + 1) - 0.5, np.arange(height + 1) - 0.5)
    origin = camera_center(extrinsics)
    hits = cast(scene.model, data, origin, rays)
    points = origin + rays * np.where(hits.geom < 0, 1, hits.distance)[:, None]
    # The backdrop is seen from inside.
    normal = hits.normal * -np.sign(np.einsum("rc,rc->r", hits.normal, rays))[:, None]
    lit = _sunlit(scene, data, points, hits.geom, (height + 1, width + 1))
    steepness = np.maximum(np.abs(np.einsum("rc,rc->r", normal, rays)), 0.2)
    footprint = hits.distance / (intrinsics[0, 0] * steepness)
    color = _shade(scene, data, points, normal, rays, hits.geom, lit, footprint).reshape(height + 1, width + 1, 3)
    rows = color[1:] + color[:-1]
    return (rows[:, 1:] + rows[:, :-1]) / 4


def to_bytes(linear: np.ndarray) -> np.ndarray:
    """Linear RGB in [0, 1] to display values uint8."""
    return _TONES[np.clip(linear * 4095 + 0.5, 0, 4095).astype(np.int16)]


def _shade(
    scene: Scene,
    data: mujoco.MjData,
    points: np.ndarray,
    normal: np.ndarray,
    rays: np.ndarray,
    geom: np.ndarray,
    lit: np.ndarray,
    footprint: np.ndarray,
) -> np.ndarray:
    """Linear RGB (R, 3): texture times (ambient, brighter from above, + sun), and a faint highlight."""
    color = np.empty((len(points), 3), np.float32)
    order = np.argsort(geom, kind="stable")
    starts = np.searchsorted(geom[order], np.arange(-1, scene.model.ngeom + 1))
    for index in range(-1, scene.model.ngeom):
        chosen = order[starts[index + 1] : starts[index + 2]]
        if not len(chosen):
            continue
        if index < 0:
            color[chosen] = sky(rays[chosen], scene.clouds)
            continue
        local = (points[chosen] - data.geom_xpos[index]) @ data.geom_xmat[index].reshape(3, 3)
        color[chosen] = scene.textures[index].color(local, footprint[chosen])
    solid = (geom >= 0).astype(np.float32)
    facing = np.maximum(normal @ scene.sun, 0).astype(np.float32)
    halfway = scene.sun - rays
    shine = np.einsum("rc,rc->r", normal, halfway) / np.sqrt(np.einsum("rc,rc->r", halfway, halfway))
    shine = 0.18 * solid * (geom >= scene.first_body) * lit * np.maximum(shine, 0).astype(np.float32) ** 32
    upward = (0.7 + 0.3 * normal[:, 2]).astype(np.float32)
    light = upward[:, None] * scene.ambient.astype(np.float32)
    light += (facing * lit)[:, None] * scene.sun_color.astype(np.float32)
    if scene.first_body > 1:  # the backdrop glows by itself: real horizons are not lit by one lamp
        light[geom == 1] = 0.8
    light[geom < 0] = 1
    return color * light + shine[:, None]


def _sunlit(
    scene: Scene, data: mujoco.MjData, points: np.ndarray, geom: np.ndarray, shape: tuple[int, int]
) -> np.ndarray:
    """The visible share of the sun (R,) float32 at points on a grid of `shape`."""
    rows, columns = np.indices(shape).reshape(2, -1)
    interleaved = (rows % 3) * 3 + columns % 3
    lit = np.ones(len(points), np.float32)
    for index, position in enumerate(_sun_points(scene.sun)):
        chosen = np.flatnonzero((interleaved == index) & (geom >= 0))
        towards = points[chosen] - position
        distance = np.sqrt(np.einsum("rc,rc->r", towards, towards))
        hits = cast(scene.model, data, position, towards / distance[:, None], shadow=True)
        lit[chosen] = hits.distance > distance - 0.01
    return _mean_same_geom(lit.reshape(shape), geom.reshape(shape)).ravel()


def _sun_points(sun: np.ndarray) -> np.ndarray:
    """Nine points (9, 3), evenly spread over the sun's disc."""
    side = np.cross(sun, [0.0, 0, 1])
    side /= np.linalg.norm(side)
    radius = SUN_RADIUS * np.sqrt((np.arange(9) + 0.5) / 9)
    angle = np.arange(9) * np.pi * (3 - np.sqrt(5))  # the golden angle
    offsets = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(sun, side)
    return SUN_DISTANCE * sun + radius[:, None] * offsets


def _mean_same_geom(value: np.ndarray, geom: np.ndarray) -> np.ndarray:
    """3x3 mean of `value` over the neighbours that lie on the same geom."""
    padded = np.pad(value, 1, mode="edge")
    same = np.pad(geom, 1, mode="constant", constant_values=-2)
    total, count = np.zeros_like(value), np.zeros_like(value)
    height, width = value.shape
    for row in range(3):
        for column in range(3):
            window = slice(row, row + height), slice(column, column + width)
            match = same[window] == geom
            total += padded[window] * match
            count += match
    return total / count
