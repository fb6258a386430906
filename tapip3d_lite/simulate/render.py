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

from tapip3d_lite.simulate.bodies import HIDDEN_GROUP, SimulatedScene

SUN_DISTANCE = 30.0
SUN_RADIUS = 0.8  # metres at that distance: penumbras about as wide as on a lightly clouded day
BACKDROP_GLOW = 0.8  # the backdrop is not lit by the sun: real horizons are not lit by one lamp
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


def pixel_rays(intrinsics: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Camera-frame unit rays (len(v) * len(u), 3), row-major, through the pixels of columns u and rows v."""
    columns, rows = np.meshgrid((u - intrinsics[0, 2]) / intrinsics[0, 0], (v - intrinsics[1, 2]) / intrinsics[1, 1])
    rays = np.stack([columns.ravel(), rows.ravel(), np.ones(columns.size)], -1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def camera_center(extrinsics: np.ndarray) -> np.ndarray:
    """The camera's position (3,) in the world."""
    return -extrinsics[:3, :3].T @ extrinsics[:3, 3]


def render_depth(
    scene: SimulatedScene, data: mujoco.MjData, rays: np.ndarray, extrinsics: np.ndarray
) -> tuple[np.ndarray, Hits]:
    """z-depths (R,) along camera-frame rays (R, 3), 0 where the sky is, and the hits."""
    hits = cast(scene.model, data, camera_center(extrinsics), rays @ extrinsics[:3, :3])
    return np.where(hits.geom < 0, 0, hits.distance * rays[:, 2]), hits


def render_color(
    scene: SimulatedScene,
    data: mujoco.MjData,
    rays: np.ndarray,
    extrinsics: np.ndarray,
    size: tuple[int, int],
    pixel: float,
) -> np.ndarray:
    """Linear RGB (H, W, 3) float32.

    Args:
        rays: ((H + 1) * (W + 1), 3) camera-frame unit rays through the pixels' corners.
        extrinsics: (4, 4).
        size: (H, W).
        pixel: size of a pixel at distance 1.
    """
    shape = size[0] + 1, size[1] + 1
    origin, rays = camera_center(extrinsics), rays @ extrinsics[:3, :3]
    hits = cast(scene.model, data, origin, rays)
    points = origin + rays * np.where(hits.geom < 0, 1, hits.distance)[:, None]
    steepness = np.einsum("rc,rc->r", hits.normal, rays)
    normal = hits.normal * -np.sign(steepness)[:, None]  # the backdrop is seen from inside
    sunlight = np.maximum(normal @ scene.sun, 0).astype(np.float32)
    sunlight[(hits.geom < 0) | scene.is_backdrop(hits.geom)] = 0
    footprint = pixel * hits.distance / np.maximum(np.abs(steepness), 0.2)
    sunlight *= _sunlit(scene, data, points, hits.geom, sunlight > 0, shape)
    color = _shade(scene, data, points, normal, rays, hits.geom, sunlight, footprint).reshape(*shape, 3)
    rows = color[1:] + color[:-1]
    return (rows[:, 1:] + rows[:, :-1]) / 4


def to_bytes(linear: np.ndarray) -> np.ndarray:
    """Linear RGB in [0, 1] to display values uint8."""
    return _TONES[np.clip(linear * 4095 + 0.5, 0, 4095).astype(np.int16)]


def _shade(
    scene: SimulatedScene,
    data: mujoco.MjData,
    points: np.ndarray,
    normal: np.ndarray,
    rays: np.ndarray,
    geom: np.ndarray,
    sunlight: np.ndarray,
    footprint: np.ndarray,
) -> np.ndarray:
    """Linear RGB (R, 3): texture times (ambient, brighter from above, + sun), and a faint highlight on bodies."""
    color = np.empty((len(points), 3), np.float32)
    order = np.argsort(geom.astype(np.int16), kind="stable")  # 16 bits: a radix sort
    starts = np.searchsorted(geom[order], np.arange(-1, scene.model.ngeom + 1))
    for index in range(-1, scene.model.ngeom):
        at = order[starts[index + 1] : starts[index + 2]]
        if not len(at):
            continue
        if index < 0:
            color[at] = scene.sky.color(rays[at])
            continue
        local = (points[at] - data.geom_xpos[index]) @ data.geom_xmat[index].reshape(3, 3)
        paint = scene.textures[index].color(local)
        if scene.is_backdrop(index):
            color[at] = BACKDROP_GLOW * paint
            continue
        if index == 0:  # where a pixel covers more floor than the pattern's features, only its mean is left
            fade = np.clip((footprint[at] - 0.15) / 0.4, 0, 1).astype(np.float32)
            paint += fade[:, None] * (scene.floor_mean - paint)
        upward = (0.7 + 0.3 * normal[at, 2:]).astype(np.float32)
        paint *= upward * scene.ambient + sunlight[at, None] * scene.sun_color
        if index:
            halfway = scene.sun - rays[at]
            shine = np.einsum("rc,rc->r", normal[at], halfway) / np.linalg.norm(halfway, axis=-1)
            paint += (0.18 * (sunlight[at] > 0) * np.maximum(shine, 0) ** 32).astype(np.float32)[:, None]
        color[at] = paint
    return color


def _sunlit(
    scene: SimulatedScene,
    data: mujoco.MjData,
    points: np.ndarray,
    geom: np.ndarray,
    asked: np.ndarray,
    shape: tuple[int, int],
) -> np.ndarray:
    """The visible share of the sun (R,) float32 at points on a grid of `shape`; only where `asked`, else 1."""
    rows, columns = np.indices(shape).reshape(2, -1)
    # Numbered along the diagonals, so that each 2x2 block of the checkerboard's fields looks at all four points.
    index = (rows + columns) // 2 % 2 * 2 + (rows - columns) // 2 % 2
    fields = (rows + columns) % 2 == 0
    lit = np.ones(len(points), np.float32)
    for number, position in enumerate(_sun_points(scene.sun)):
        chosen = np.flatnonzero((index == number) & fields & asked)
        towards = points[chosen] - position
        distance = np.sqrt(np.einsum("rc,rc->r", towards, towards))
        towards /= distance[:, None]
        near = _may_hit(scene, data, position, towards)
        hits = cast(scene.model, data, position, towards[near], shadow=True)
        lit[chosen[near]] = hits.distance > distance[near] - 0.01
    return _mean_same_geom(lit.reshape(shape), geom.reshape(shape), fields.reshape(shape)).ravel()


def _may_hit(scene: SimulatedScene, data: mujoco.MjData, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Which rays (R,) bool pass through any body's bounding sphere; most do not, and need no casting."""
    center = data.geom_xpos[scene.first_body :] - origin
    distance = np.linalg.norm(center, axis=-1)
    least = np.sqrt(np.maximum(0, 1 - (scene.model.geom_rbound[scene.first_body :] / distance) ** 2))
    return (rays @ (center / distance[:, None]).T > least).any(1)


def _sun_points(sun: np.ndarray) -> np.ndarray:
    """Four points (4, 3) around the sun's disc."""
    side = np.cross(sun, [0.0, 0, 1])
    side *= SUN_RADIUS / np.linalg.norm(side)
    other = np.cross(sun, side)
    return SUN_DISTANCE * sun + np.stack([side, other, -other, -side])


def _mean_same_geom(value: np.ndarray, geom: np.ndarray, known: np.ndarray) -> np.ndarray:
    """3x3 mean of the `known` values over the neighbours on the same geom; 1 where there are none."""
    value, known = np.pad(value * known, 1), np.pad(known.astype(np.float32), 1)
    same = np.pad(geom, 1, constant_values=-2)
    total, count = np.zeros(geom.shape, np.float32), np.zeros(geom.shape, np.float32)
    for row in range(3):
        for column in range(3):
            window = slice(row, row + geom.shape[0]), slice(column, column + geom.shape[1])
            match = same[window] == geom
            total += value[window] * match
            count += known[window] * match
    return np.where(count > 0, total / np.maximum(count, 1), 1)
