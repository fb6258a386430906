"""Clips in folders: what all layouts share. `layouts` says where each keeps its frames, poses and intrinsics.

Every layout becomes `Parts`, which one function reads. What a layout leaves open, or gets wrong, a `clip.json` beside
its frames may say: the fields of `Settings`, of which each layout has its own defaults.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.depth import register_depth
from tapip3d_lite.files import read_json
from tapip3d_lite.formats.images import decode_color, fit_depth, read_depth, read_video
from tapip3d_lite.geometry import point_map, resize_intrinsics

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # between OpenCV's axes and OpenGL's or Blender's
_CHOICES = {"depth_is": ("z", "ray"), "poses": ("camera_to_world", "world_to_camera"), "axes": ("opencv", "opengl")}


@dataclass(frozen=True)
class Settings:
    """What `clip.json` beside the frames may say.

    Attributes:
        intrinsics: fx, fy, cx, cy or a 3x3 matrix of the colour camera, in pixels; `intrinsics.txt` may hold them, too.
        made_for: (W, H) of the images that the intrinsics were made for, if others than these.
        depth_intrinsics: intrinsics of a depth camera of its own, whose poses the poses are.
        depth_made_for: (W, H) of the depth images that those were made for, if others than these.
        color_from_depth: 4x4, X_color = color_from_depth X_depth.
        depth_scale: whole numbers of depth images per scene unit; other numbers are in scene units.
        no_depth: the whole number that means unknown, beside 0.
        depth_is: "z" or "ray", the length of the ray.
        poses: "camera_to_world" or "world_to_camera".
        axes: "opencv" (x right, y down, z forward) or "opengl" (also Blender and ARKit: y up, looking along -z).
        fps: frames per second; a video file knows its own.

    Raises:
        ValueError: one of the words above is another.
    """

    intrinsics: Sequence | None = None
    made_for: Sequence[int] | None = None
    depth_intrinsics: Sequence | None = None
    depth_made_for: Sequence[int] | None = None
    color_from_depth: Sequence | None = None
    depth_scale: float = 1000.0
    no_depth: float = 65535
    depth_is: str = "z"
    poses: str = "camera_to_world"
    axes: str = "opencv"
    fps: float = 30.0

    def __post_init__(self) -> None:
        for key, allowed in _CHOICES.items():
            if getattr(self, key) not in allowed:
                raise ValueError(f"clip.json: {key} must be one of {allowed}, got {getattr(self, key)!r}")

    @classmethod
    def read(cls, folder: Path, **defaults: object) -> Settings:
        """The layout's defaults, and over them what `intrinsics.txt` and `clip.json` in the folder say."""
        given, path, known = {}, folder / "clip.json", {item.name for item in fields(cls)}
        if (folder / "intrinsics.txt").is_file():
            given["intrinsics"] = np.concatenate(table(folder / "intrinsics.txt"))
        if path.is_file():
            given |= read_json(path)
        if given.keys() - known:
            raise ValueError(f"{path}: unknown {', '.join(given.keys() - known)}; known are {', '.join(sorted(known))}")
        for key in ("", "depth_"):  # whoever gives a camera gives that of these images
            if f"{key}intrinsics" in given:
                defaults[f"{key}made_for"] = None
        return cls(**(defaults | given))


@dataclass
class Parts:
    """Where a clip's frames are, its poses (T, 4, 4), and what else the layout knows.

    `intrinsics` are (T, 3, 3), `read` reads a depth file that `read_depth` does not know, `tracks` makes the true tracks
    of the chosen frames from their cameras and the image's size.
    """

    folder: Path
    color: list[Path] | Path  # one path: a video
    depth: list[Path]
    poses: np.ndarray
    settings: Settings
    intrinsics: np.ndarray | None = None
    read: Callable[[Path], np.ndarray] | None = None
    tracks: Callable[[slice, np.ndarray, np.ndarray, tuple[int, int]], Tracks] | None = None


def load_parts(parts: Parts, frames: slice, name: str, depths: np.ndarray | None = None) -> Clip:
    """Read the chosen frames of a layout, with `depths` (T, H, W) in place of its own if given.

    Raises:
        ValueError: counts that differ, unreadable or unfit images, unknown intrinsics.
    """
    s, count, given = parts.settings, len(parts.poses), len(parts.depth if depths is None else depths)
    film = isinstance(parts.color, Path)
    video, colors, fps = read_video(parts.color, frames) if film else (None, len(parts.color), s.fps)
    if not colors == given == count:
        raise ValueError(
            f"{parts.folder}: {colors} colour frames, {given} of depth and {count} poses; each frame needs one of each: "
            "remove what has no partner"
        )
    video = video if film else _images(parts.color[frames], parts.folder)
    size, poses = video.shape[1:3], np.asarray(parts.poses, np.float64)[frames]
    lengths = np.linalg.norm(poses[:, :3, :3], axis=(1, 2))  # of a rotation: sqrt(3)
    lost = np.flatnonzero(~((lengths > 0.1) & np.isfinite(poses).all((1, 2))))
    if len(lost):
        raise ValueError(f"{parts.folder}: poses {lost[:5].tolist()} are none (tracking lost?); leave those frames out")
    intrinsics = _intrinsics(parts, size)[frames]
    extrinsics = np.linalg.inv(poses) if s.poses == "camera_to_world" else poses
    extrinsics = _FLIP @ extrinsics if s.axes == "opengl" else extrinsics
    shift = np.eye(4) if s.color_from_depth is None else np.reshape(s.color_from_depth, (4, 4))
    if depths is None:
        depths = _depths(parts, frames, intrinsics, shift, size)
    else:
        depths = np.stack([fit_depth(z, size, f"{parts.folder}: the given depth") for z in depths[frames]])
    extrinsics = shift @ extrinsics
    tracks = parts.tracks(frames, intrinsics, extrinsics, size) if parts.tracks else None
    fps = float(fps if 0 < fps < np.inf else s.fps)
    return Clip(video, depths, intrinsics, extrinsics, tracks=tracks, name=name, fps=fps)


def _depths(parts: Parts, frames: slice, intrinsics: np.ndarray, shift: np.ndarray, size: tuple) -> np.ndarray:
    """The layout's own depth as z (T, H, W) of the colour camera."""
    s, depths = parts.settings, []
    for path, k in zip(parts.depth[frames], intrinsics, strict=True):
        depth = parts.read(path) if parts.read else read_depth(path, s.depth_scale, s.no_depth)
        if s.depth_intrinsics is not None:
            own = matrix(s.depth_intrinsics, "clip.json: depth_intrinsics")
            own = own if s.depth_made_for is None else _of_size(own, s.depth_made_for, depth.shape, path)
            depth = register_depth(depth, own, k, shift, size)
        depths.append(fit_depth(depth, size, path))
    depths = np.stack(depths)
    rays = point_map(np.ones_like(depths), intrinsics) if s.depth_is == "ray" else np.ones(1)
    return depths / np.linalg.norm(rays, axis=-1)


def _images(paths: list[Path], folder: Path) -> np.ndarray:
    images = [decode_color(path.read_bytes(), path) for path in paths]
    sizes = {image.shape[1::-1] for image in images}
    if len(sizes) != 1:
        raise ValueError(
            f"{folder}: colour images of sizes {sorted(sizes) or 'none'}; expected some, all of one size, in the frames asked for"
        )
    return np.stack(images)


def _intrinsics(parts: Parts, size: tuple[int, int]) -> np.ndarray:
    """(T, 3, 3) of images (H, W): from the settings, else from the layout."""
    given, name = parts.settings.intrinsics, f"{parts.folder}: intrinsics"
    if given is None and parts.intrinsics is None:
        raise ValueError(f"{name} are not known; write fx fy cx cy, in pixels, into {parts.folder / 'intrinsics.txt'}")
    count = len(parts.poses)
    if given is not None:
        numbers = np.ravel(given)
        given = numbers.reshape(count, 9) if numbers.size == 9 * count else [numbers] * count
    each = parts.intrinsics if given is None else given
    matrices, made_for = np.stack([matrix(x, name) for x in each]), parts.settings.made_for
    return matrices if made_for is None else _of_size(matrices, made_for, size, name)


def _of_size(matrices: np.ndarray, made_for: Sequence[int], size: tuple[int, int], name: object) -> np.ndarray:
    """Intrinsics of images (W, H) for images (H, W); ValueError where those were cropped or turned."""
    width, height = made_for
    if width != height and abs(width / height * size[0] / size[1] - 1) > 0.02:
        raise ValueError(
            f"{name}: the camera is known for images of {width}x{height}, which these of {size[1]}x{size[0]} are not a "
            "smaller form of; write their fx fy cx cy into intrinsics.txt, or depth_intrinsics into clip.json"
        )
    return resize_intrinsics(matrices, (height, width), size)


def matrix(given: Sequence, name: str) -> np.ndarray:
    """(3, 3) from fx, fy, cx, cy, from nine numbers in rows, or from sixteen; ValueError unless focal lengths are positive."""
    numbers = np.ravel(np.asarray(given, np.float64))
    if numbers.size == 4:
        numbers = np.array([numbers[0], 0, numbers[2], 0, numbers[1], numbers[3], 0, 0, 1])
    if numbers.size not in (9, 16):
        raise ValueError(f"{name}: expected fx fy cx cy or a 3x3 matrix in rows, got {numbers.size} numbers")
    square = numbers.reshape(round(numbers.size**0.5), -1)[:3, :3]
    if not (square[[0, 1], [0, 1]] > 0).all():
        raise ValueError(f"{name}: focal lengths must be positive, got {square[0, 0]:g}, {square[1, 1]:g}; calibrate")
    return square


def rigid(places: np.ndarray, quaternions: np.ndarray) -> np.ndarray:
    """Motions (T, 4, 4) from translations (T, 3) and quaternions (T, 4) in the order x, y, z, w, of any length but 0."""
    length = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    if not (length > 1e-6).all():
        raise ValueError("poses: a quaternion of length 0 is no rotation; the order is x y z w")
    x, y, z, w = (quaternions / length).T
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)]
    rows += [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)]
    rows += [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = np.stack(rows, -1).reshape(-1, 3, 3), places
    return poses


def table(path: Path) -> list[np.ndarray]:
    """The lines of a text file as numbers, without comments (#)."""
    try:
        lines = [line.replace(",", " ").split() for line in path.read_text(encoding="utf-8").splitlines()]
        return [np.array(line, np.float64) for line in lines if line and not line[0].startswith("#")]
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: not a readable table of numbers ({error})") from None


def read_poses(path: Path) -> np.ndarray:
    """Poses (T, 4, 4) of a text file, or of a folder with a file for each frame.

    A line is a pose: 16 or 12 numbers (the matrix in rows), or tx ty tz qx qy qz qw, perhaps after a time stamp; or four
    lines of four numbers are.
    """
    rows = [np.concatenate(table(x)) for x in numbered(path, (".txt",))] if path.is_dir() else table(path)
    if all(len(row) == 4 for row in rows) and len(rows) % 4 == 0:
        rows = list(np.reshape(rows, (-1, 16)))
    lengths = {len(row) for row in rows}
    if len(lengths) != 1 or not lengths <= {7, 8, 12, 16}:
        raise ValueError(f"{path}: expected 16, 12, 8 or 7 (tx ty tz qx qy qz qw) a pose, got {sorted(lengths)}")
    numbers = np.stack(rows)
    if lengths <= {7, 8}:
        return rigid(numbers[:, -7:-4], numbers[:, -4:])
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses.reshape(len(rows), 16)[:, : numbers.shape[1]] = numbers
    return poses


def numbered(folder: Path, suffixes: Sequence[str], pattern: str = "") -> list[Path]:
    """The files with these suffixes, whose names match, in the order of their numbers; ValueError where some are missing."""
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder; was the export complete?")
    found = [x for x in folder.iterdir() if x.suffix.lower() in suffixes and re.search(pattern, x.name)]
    found = [x for x in found if not x.name.startswith(".")]  # macOS writes ._1.png beside 1.png
    numbers = {x: [int(n) for n in re.findall(r"\d+", x.stem)] for x in found}
    found.sort(key=lambda x: (numbers[x], x.name))
    rows = np.array([numbers[x] for x in found]) if len({len(n) for n in numbers.values()}) == 1 else np.zeros((0, 1))
    counting = rows[:, np.ptp(rows, axis=0) > 0] if len(rows) else rows
    # One number counts; large ones and those with a point are times.
    if counting.shape[1] == 1 and rows.max(initial=0) < 1e8 and not any(re.search(r"\d\.\d", x.stem) for x in found):
        steps = np.diff(counting[:, 0])
        if (steps != steps.min()).any():
            gap = found[int(np.argmax(steps != steps.min()))].name
            raise ValueError(f"{folder}: a gap after {gap}; restore what is missing, or renumber the frames")
    return found
