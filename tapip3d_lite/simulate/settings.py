"""`SimulationConfig`: all settings of a simulated clip, apart from its seed."""

from __future__ import annotations

from dataclasses import dataclass

from tapip3d_lite.simulate.meshes import MESHES
from tapip3d_lite.validate import check_range, check_types

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
        check_types(self)
        check_range(self, 1, 10_000, "frames")
        check_range(self, 1, 100_000, "tracks")
        check_range(self, 8, 4096, "size")
        check_range(self, 1, 40, "moving")
        check_range(self, 0, 40, "resting")
        check_range(self, 0, 100, "handheld", "stereo_baseline")
        check_range(self, 1e-12, 100, "speed", "drop")
        check_range(self, 1, 1000, "fps")
        check_range(self, 0, 1, "share_dynamic")
        for name in ("arc", "moving", "resting"):
            low, high = getattr(self, name)
            self._require(name, low <= high, "(least, greatest)")
        self._require("resting", self.resting[1] + self.moving[1] <= 40, "at most 40 with the moving")
        self._require("camera", self.camera in CAMERAS, f"one of {', '.join(CAMERAS)}")
        known = len(self.shapes) > 0 and all(shape in SHAPES for shape in self.shapes)
        self._require("shapes", known, f"some of {', '.join(SHAPES)}")

    def _require(self, name: str, fits: bool, expected: str) -> None:
        if not fits:
            raise ValueError(f"SimulationConfig.{name}: expected {expected}, got {getattr(self, name)!r}; change it")
