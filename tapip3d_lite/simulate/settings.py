"""`SimulationConfig`: all settings of a simulated clip, apart from its seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tapip3d_lite.simulate.meshes import MESHES

PRIMITIVES = ("sphere", "box", "cylinder", "capsule", "ellipsoid")
SHAPES = (*PRIMITIVES, *MESHES)
CAMERAS = ("static", "linear", "arc", "handheld")


@dataclass(frozen=True)
class SimulationConfig:
    """What a simulated clip contains. Lengths are metres, z is up in the world, the floor is z = 0.

    Attributes:
        frames: T.
        fps: frames per second of the video and of the physics' roll-out.
        size: (H, W) in pixels.
        camera: how the camera moves: "static", "linear", "arc" (around the action) or "handheld".
        handheld: strength of the hand's shaking; 1 is a careful hand, 3 a running one.
        arc: least and greatest sweep of the "arc" camera, degrees over the clip.
        moving: least and greatest number of thrown and dropped bodies.
        resting: least and greatest number of bodies that lie on the floor (until they are hit).
        shapes: which of `SHAPES` to draw from.
        speed: scale of the throwing speed.
        drop: scale of the height from which bodies are dropped.
        sky: no backdrop; the sky has invalid depth 0.
        same_texture: all bodies share one texture.
        occluder: a tall block stands between the camera and the action, so that bodies stay hidden for long.
        motion_blur: colours averaged over half the time between frames; depth stays that of the frame's own instant.
        stereo_baseline: distance in metres to a right camera (`extras["video_right"]`), or 0 for none.
        tracks: N.
        share_dynamic: share of the queries that fall on bodies which move in the world.

    Raises:
        ValueError: names the argument, the expected and the received value, and what to do.
    """

    frames: int = 24
    fps: float = 12.0
    size: tuple[int, int] = (128, 128)
    camera: str = "arc"
    handheld: float = 1.0
    arc: tuple[float, float] = (30.0, 90.0)
    moving: tuple[int, int] = (4, 12)
    resting: tuple[int, int] = (0, 8)
    shapes: tuple[str, ...] = SHAPES
    speed: float = 1.0
    drop: float = 1.0
    sky: bool = False
    same_texture: bool = False
    occluder: bool = False
    motion_blur: bool = False
    stereo_baseline: float = 0.0
    tracks: int = 256
    share_dynamic: float = 0.6

    def __post_init__(self) -> None:
        for name in ("size", "arc", "moving", "resting", "shapes"):
            value = getattr(self, name)
            _require(isinstance(value, (tuple, list)), name, "a tuple", value, "e.g. size=(128, 128)")
            object.__setattr__(self, name, tuple(value))  # lists come from JSON and from the command line
        self._check_numbers()
        for name, low in (("size", 8), ("moving", 1), ("resting", 0)):
            _check_integers(name, getattr(self, name), low)
        for name in ("arc", "moving", "resting"):
            pair = getattr(self, name)
            _require(len(pair) == 2 and pair[0] <= pair[1], name, "(least, greatest)", pair, "put the smaller first")
        _require(self.moving[1] + self.resting[1] <= 40, "moving + resting", "at most 40", self.moving, "lower them")
        _require(self.camera in CAMERAS, "camera", f"one of {', '.join(CAMERAS)}", self.camera, "choose one of them")
        unknown = [shape for shape in self.shapes if shape not in SHAPES]
        _require(self.shapes and not unknown, "shapes", f"some of {', '.join(SHAPES)}", self.shapes, f"drop {unknown}")

    def _check_numbers(self) -> None:
        _check_integers("frames", (self.frames,), 1, pair=False)
        _check_integers("tracks", (self.tracks,), 1, pair=False)
        positive = {"fps": self.fps, "speed": self.speed, "drop": self.drop}
        for name, value in positive.items():
            _require(_finite(value) and value > 0, name, "a positive number", value, "1 is the usual scale")
        for name in ("handheld", "stereo_baseline"):
            value = getattr(self, name)
            _require(_finite(value) and value >= 0, name, "a number of at least 0", value, "0 switches it off")
        fine = _finite(self.share_dynamic) and 0 <= self.share_dynamic <= 1
        _require(fine, "share_dynamic", "a fraction in [0, 1]", self.share_dynamic, "0.6 means 60 %")


def _finite(value: object) -> bool:
    return isinstance(value, (int, float, np.number)) and bool(np.isfinite(value))


def _check_integers(name: str, values: tuple, low: int, pair: bool = True) -> None:
    whole = all(isinstance(value, (int, np.integer)) and value >= low for value in values)
    wanted = "two whole numbers" if pair else "a whole number"
    _require(whole and (len(values) == 2 or not pair), name, f"{wanted} of at least {low}", values, "change it")


def _require(condition: object, name: str, expected: str, received: object, remedy: str) -> None:
    if not condition:
        raise ValueError(f"SimulationConfig.{name}: expected {expected}, got {received!r}; {remedy}")
