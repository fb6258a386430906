"""`SimulationConfig`: all settings of a simulated clip, apart from its seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

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
        tuples = "size arc moving resting shapes"
        self._require(tuples, lambda v: isinstance(v, (tuple, list)), "a tuple", "e.g. size=(128, 128)")
        for name in tuples.split():
            object.__setattr__(self, name, tuple(getattr(self, name)))  # lists come from JSON and the command line
        self._require("frames tracks", lambda v: _whole(1, v), "a whole number of at least 1", "change it")
        for name, low in (("size", 8), ("moving", 1), ("resting", 0)):
            wanted = f"two whole numbers of at least {low}"
            self._require(name, lambda v, low=low: len(v) == 2 and _whole(low, *v), wanted, "change it")
        self._require("arc moving resting", lambda v: len(v) == 2 and v[0] <= v[1], "(least, greatest)", "sort them")
        self._require("resting", lambda v: v[1] + self.moving[1] <= 40, "at most 40 with the moving", "lower both")
        self._require("fps speed drop", lambda v: _number(v) and v > 0, "a positive number", "1 is the usual scale")
        self._require("handheld stereo_baseline", lambda v: _number(v) and v >= 0, "a number of at least 0", "0 is off")
        self._require("share_dynamic", lambda v: _number(v) and 0 <= v <= 1, "a fraction in [0, 1]", "0.6 means 60 %")
        switches = "sky same_texture occluder motion_blur"
        self._require(switches, lambda v: isinstance(v, bool | np.bool_), "True or False", "change it")
        self._require("camera", lambda v: v in CAMERAS, f"one of {', '.join(CAMERAS)}", "choose one of them")
        unknown = [shape for shape in self.shapes if shape not in SHAPES]
        self._require("shapes", lambda v: v and not unknown, f"some of {', '.join(SHAPES)}", f"drop {unknown}")

    def _require(self, names: str, fits: Callable[[Any], object], expected: str, remedy: str) -> None:
        for name in names.split():
            value = getattr(self, name)
            if not fits(value):
                raise ValueError(f"SimulationConfig.{name}: expected {expected}, got {value!r}; {remedy}")


def _number(value: object) -> bool:
    return isinstance(value, (int, float, np.number)) and bool(np.isfinite(value))


def _whole(low: int, *values: object) -> bool:
    return all(isinstance(value, (int, np.integer)) and value >= low for value in values)
