"""A random scene: its bodies with their starting positions and velocities, textures and light, as a MuJoCo model."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from tapip3d_lite.simulate.meshes import MESHES
from tapip3d_lite.simulate.settings import PRIMITIVES, SimulationConfig
from tapip3d_lite.simulate.textures import Texture, random_sky, random_texture

DOME_RADIUS = 11.0
HIDDEN_GROUP = 1  # the backdrop's geom group: it is seen by the camera, but throws no shadow


@dataclass(frozen=True)
class Body:
    """One body as it starts: `half` are its half extents in metres, `fixed` bodies never move."""

    shape: str
    half: np.ndarray
    position: np.ndarray
    quaternion: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray
    texture: Texture
    moving: bool
    fixed: bool = False


@dataclass(frozen=True)
class SimulatedScene:
    """A compiled MuJoCo model with what MuJoCo does not know: starting velocities, textures and light."""

    model: mujoco.MjModel  # geoms in the order floor, (backdrop,) bodies
    bodies: tuple[Body, ...]  # in the order of the model's last geoms
    textures: tuple[Texture, ...]  # one per geom
    sky: Texture  # of directions: what lies where no geom is
    floor_mean: np.ndarray  # (3,) mean colour of the floor, which its far pattern fades to
    sun: np.ndarray  # (3,) unit vector towards the sun
    sun_color: np.ndarray  # (3,) linear RGB
    ambient: np.ndarray  # (3,) linear RGB

    def posed(self, states: np.ndarray) -> Iterator[mujoco.MjData]:
        """Yield the world poses of all geoms at states (T, nq), each in the same object: use it before the next."""
        data = mujoco.MjData(self.model)
        for state in states:
            data.qpos[:] = state
            mujoco.mj_kinematics(self.model, data)
            yield data

    @property
    def first_body(self) -> int:
        """The geom index of the first body."""
        return self.model.ngeom - len(self.bodies)

    def is_backdrop(self, geom: int | np.ndarray) -> bool | np.ndarray:
        """Whether a geom index is the backdrop's, which is seen from inside."""
        return (self.first_body == 2) & (geom == 1)


def random_scene(rng: np.random.Generator, config: SimulationConfig, azimuth: float) -> SimulatedScene:
    """Draw a scene; `azimuth` (radians) is the camera's mean direction, where an occluder has to stand."""
    floor, behind = random_texture(rng, scale=2.0, flat=True), random_texture(rng, scale=5.0)
    shared = random_texture(rng) if config.same_texture else None
    resting = int(rng.integers(config.resting[0], config.resting[1] + 1))
    moving = int(rng.integers(config.moving[0], config.moving[1] + 1))
    bodies = [_occluder(rng, azimuth)] if config.occluder else []
    for index in range(resting + moving):
        bodies.append(_random_body(rng, config, index >= resting, bodies, shared))
    environment = [floor] if config.sky else [floor, behind]
    height, around = rng.uniform(0.75, 1.2), rng.uniform(0, 2 * np.pi)
    sun = np.array([np.cos(around) * np.cos(height), np.sin(around) * np.cos(height), np.sin(height)])
    warmth = rng.uniform(0, 0.12)
    return SimulatedScene(
        model=_compile(rng, config, bodies),
        bodies=tuple(bodies),
        textures=(*environment, *(body.texture for body in bodies)),
        sky=random_sky(rng),
        floor_mean=floor(rng.uniform(-5, 5, (4096, 3)) * (1, 1, 0)).mean(0),
        sun=sun,
        sun_color=np.float32(rng.uniform(0.75, 0.95) * np.array([1 + warmth, 1.0, 1 - warmth])),
        ambient=np.float32(rng.uniform(0.32, 0.45) * np.array([1 - warmth / 2, 1.0, 1 + warmth / 2])),
    )


def _random_body(
    rng: np.random.Generator, config: SimulationConfig, moving: bool, others: list[Body], shared: Texture | None
) -> Body:
    simple = [s for s in config.shapes if s in PRIMITIVES]  # half of the bodies, however many meshes there are
    kinds = simple if simple and rng.uniform() < 0.5 else config.shapes
    shape = kinds[rng.integers(len(kinds))]
    half = rng.uniform(0.28, 0.55) * (np.ones(3) if shape in MESHES else rng.uniform(0.65, 1, 3))
    for _ in range(50):
        around = rng.uniform(0, 2 * np.pi)
        distance = rng.uniform(0.4, 2.4) if moving else 2.0 * np.sqrt(rng.uniform())
        height = half.max() + rng.uniform(0.2, 2.2) * config.drop if moving else half.max() * 1.05
        position = np.array([np.cos(around) * distance, np.sin(around) * distance, height])
        reach = [np.linalg.norm(position - o.position) - 1.3 * (o.half.max() + half.max()) for o in others]
        if min(reach, default=1.0) > 0:
            break
    velocity, spin = np.zeros(3), np.zeros(3)
    if moving:
        target = rng.uniform(-0.8, 0.8, 2)
        velocity[:2] = (target - position[:2]) * rng.uniform(0.5, 1.8) * config.speed
        velocity[2] = rng.uniform(-1, 2.0) * config.speed
        spin = rng.normal(0, 3.5, 3) * config.speed
    quaternion = rng.normal(size=4)
    texture = shared or random_texture(rng)
    return Body(shape, half, position, quaternion / np.linalg.norm(quaternion), velocity, spin, texture, moving)


def _occluder(rng: np.random.Generator, azimuth: float) -> Body:
    half = np.array([0.15, rng.uniform(0.5, 0.7), rng.uniform(0.65, 0.85)])
    position = np.array([np.cos(azimuth) * 1.9, np.sin(azimuth) * 1.9, half[2]])
    turn = azimuth + rng.uniform(-0.2, 0.2)
    quaternion = np.array([np.cos(turn / 2), 0, 0, np.sin(turn / 2)])
    return Body("box", half, position, quaternion, np.zeros(3), np.zeros(3), random_texture(rng), False, fixed=True)


def _compile(rng: np.random.Generator, config: SimulationConfig, bodies: list[Body]) -> mujoco.MjModel:
    spec, kinds = mujoco.MjSpec(), mujoco.mjtGeom
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    extent = 18 if config.sky else 0  # 0 is endless; under the sky the floor must end before depths become absurd
    spec.worldbody.add_geom(type=kinds.mjGEOM_PLANE, size=[extent, extent, 1], friction=[0.7, 0.01, 0.003])
    if not config.sky:
        dome = {"type": kinds.mjGEOM_SPHERE, "size": [DOME_RADIUS] * 3, "contype": 0, "conaffinity": 0}
        spec.worldbody.add_geom(**dome, group=HIDDEN_GROUP)
    for body in bodies:
        node = spec.worldbody.add_body(pos=body.position, quat=body.quaternion)
        if not body.fixed:
            node.add_freejoint()
        solid = {"density": 400, "friction": [rng.uniform(0.3, 0.8), 0.01, 0.003]}
        # A short, underdamped contact: bodies bounce a little, as thrown toys do.
        solid["solref"] = [0.02, rng.uniform(0.25, 0.8)]
        node.add_geom(**solid, **_geometry(rng, spec, body))
    return spec.compile()


def _geometry(rng: np.random.Generator, spec: mujoco.MjSpec, body: Body) -> dict:
    if body.shape in MESHES:
        vertices, faces = MESHES[body.shape](rng)
        mesh = spec.add_mesh(name=f"mesh{len(spec.meshes)}", uservert=(vertices * body.half).ravel())
        mesh.userface = faces.ravel()
        return {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": mesh.name}
    half = body.half
    if body.shape == "capsule":  # its second size is half the straight part
        half = np.array([half.min() * 0.6, half.max() * 0.6, 0])
    return {"type": getattr(mujoco.mjtGeom, f"mjGEOM_{body.shape.upper()}"), "size": half}
