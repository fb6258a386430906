"""The layouts of folders: where each keeps a clip's frames, poses and intrinsics, and in which convention."""

from __future__ import annotations

from functools import partial
from importlib import import_module
from pathlib import Path

import numpy as np

from tapip3d_lite.clip import Tracks
from tapip3d_lite.files import load_objects, read_json, regular
from tapip3d_lite.formats.arrays import require
from tapip3d_lite.formats.folders import Parts, Settings, numbered, read_poses, rigid, table
from tapip3d_lite.formats.images import DEPTHS, PICTURES, VIDEOS, read_depth
from tapip3d_lite.geometry import in_image

_COLORS, _POSES = ("rgb", "color", "colour", "images", "frames"), ("poses.txt", "pose.txt", "poses", "pose")
# fx, fy, cx, cy of the three Kinects of TUM RGB-D, and of any.
_KINECTS = {"freiburg1": (517.3, 516.5, 318.6, 255.3), "freiburg2": (520.9, 521.0, 325.1, 249.7)}
_KINECTS |= {"freiburg3": (535.4, 539.2, 320.1, 247.6), "": (525.0, 525.0, 319.5, 239.5)}
# A Kinect's depth camera beside its colour camera; that of 7-Scenes was not calibrated, all take this one for it.
_COLOR_FROM_DEPTH = [
    [0.9999651801, 0.0026765126, -0.0079041012, -0.0255589432],
    [-0.0027409311, 0.9999630280, -0.0081504521, 0.0001010964],
    [0.0078819942, 0.0081718329, 0.9999355456, 0.0020318322],
    [0.0, 0.0, 0.0, 1.0],
]


def plain_folder(path: Path, needs_depth: bool = True) -> Parts:
    """Images in `rgb/` or a video, depth images in `depth/`, `poses.txt`, `intrinsics.txt`; `path` may be the video."""
    folder = path if path.is_dir() else path.parent
    films = [x for x in sorted(folder.iterdir()) if x.suffix.lower() in VIDEOS] if path.is_dir() else [path]
    color = next((folder / x for x in _COLORS if (folder / x).is_dir() and path.is_dir()), None)
    poses = next((folder / x for x in _POSES if (folder / x).exists()), None)
    depth = next((folder / x for x in ("depth", "depths") if (folder / x).is_dir()), None)
    wanted = {"rgb/ or one video": color or len(films) == 1, "depth/": depth or not needs_depth, "poses.txt": poses}
    if not all(wanted.values()):
        raise ValueError(
            f"{path}: not a clip in a known layout; for a plain folder {', '.join(x for x in wanted if not wanted[x])} "
            f"missing, {', '.join(sorted(x.name for x in folder.iterdir())[:8]) or 'nothing'} there. Where depth and poses "
            "are not known, estimate them first: the npz of MegaSaM, VGGT and Depth Anything 3 is read as it is"
        )
    images = numbered(color, PICTURES) if color else films[0]
    return Parts(folder, images, numbered(depth, DEPTHS) if depth else [], read_poses(poses), Settings.read(folder))


def tum(folder: Path) -> Parts:
    """TUM RGB-D: lists with time stamps. Depth within 20 ms of a colour frame is its own; poses are interpolated."""
    (color, depth), truth = map(_stamped, (folder / "rgb.txt", folder / "depth.txt")), table(folder / "groundtruth.txt")
    if not color or not depth or {len(row) for row in truth} != {8}:
        raise ValueError(f"{folder}: expected lines in rgb.txt, depth.txt, groundtruth.txt (time tx ty tz qx qy qz qw)")
    truth = np.stack(sorted(truth, key=lambda row: row[0]))
    times, partners = np.array([t for t, _ in color]), np.array([t for t, _ in depth])
    nearest = np.abs(times[:, None] - partners).argmin(1)
    known = np.abs(times[:, None] - truth[:, 0]).min(1) < 0.1
    kept = np.flatnonzero((np.abs(times - partners[nearest]) < 0.02) & known)
    if len(kept) < len(times) / 2:
        raise ValueError(
            f"{folder}: only {len(kept)} of {len(times)} colour frames have depth within 20 ms and a pose within 100 ms; "
            "the time stamps of all three files must count seconds from one start"
        )
    # q and -q are one rotation: neighbours get the same sign before they are mixed.
    turns = np.where((truth[1:, 4:] * truth[:-1, 4:]).sum(-1) < 0, -1.0, 1.0)
    truth[1:, 4:] *= np.cumprod(turns)[:, None]
    pose = np.stack([np.interp(times[kept], truth[:, 0], column) for column in truth[:, 1:].T], -1)
    kinect = next(k for name, k in _KINECTS.items() if name in str(folder.resolve()))
    fps = 1 / max(float(np.median(np.diff(times))), 1e-3) if len(times) > 1 else 30.0
    settings = Settings.read(folder, depth_scale=5000.0, intrinsics=kinect, made_for=(640, 480), fps=fps)
    images = [folder / color[i][1] for i in kept], [folder / depth[nearest[i]][1] for i in kept]
    return Parts(folder, *images, rigid(pose[:, :3], pose[:, 3:]), settings)


def _stamped(path: Path) -> list[tuple[float, str]]:
    """(seconds, file) of a list's lines."""
    lines = [x.split(maxsplit=1) for x in path.read_text(encoding="utf-8").splitlines() if x.strip() and x[0] != "#"]
    try:
        return sorted((float(seconds), name.strip()) for seconds, name in lines)
    except ValueError:
        raise ValueError(f"{path}: expected lines of a time stamp and a file: 1305031102.17 rgb/a.png") from None


def seven_scenes(folder: Path) -> Parts:
    """7-Scenes: `frame-000000.color.png`, `.depth.png` in millimetres (65535: none), `.pose.txt` of the depth camera."""
    kinds = (("color", (".png", ".jpg")), ("depth", (".png",)), ("pose", (".txt",)))
    color, depth, poses = (numbered(folder, ends, rf"^frame-\d+\.{kind}\.") for kind, ends in kinds)
    kinect = {"intrinsics": (525.0, 525.0, 320.0, 240.0), "depth_intrinsics": (585.0, 585.0, 320.0, 240.0)}
    made_for = dict.fromkeys(("made_for", "depth_made_for"), (640, 480))
    settings = Settings.read(folder, **kinect, **made_for, color_from_depth=_COLOR_FROM_DEPTH)
    return Parts(folder, color, depth, np.stack([np.stack(table(x)) for x in poses]), settings)


def record3d(folder: Path) -> Parts:
    """Record3D: `metadata` (K in columns, poses qx qy qz qw tx ty tz, ARKit's axes), `rgbd/`, or `rgb/` and `depth/`."""
    path = next(x for x in (folder / "metadata", folder / "metadata.json") if x.is_file())
    meta = read_json(path)
    require(path, meta, "Record3D", ("K", "poses", "w", "h"), "export again, or force another format")
    one = folder / "rgbd"
    homes = (one, one) if one.is_dir() else (folder / "rgb", folder / "depth")
    color = numbered(homes[0], (".jpg", ".jpeg") if one.is_dir() else PICTURES)
    depth = numbered(homes[1], (".depth", *DEPTHS))
    rows, shape = np.array(meta["poses"], np.float64), (int(meta.get("dh", 0)), int(meta.get("dw", 0)))
    each = meta.get("perFrameIntrinsicCoeffs") or []
    each = each if len(each) == len(rows) else [np.reshape(meta["K"], (3, 3)).T] * len(rows)
    settings = Settings.read(folder, axes="opengl", fps=meta.get("fps") or 30.0, made_for=(meta["w"], meta["h"]))
    read = partial(_packed, shape=shape) if depth and depth[0].suffix == ".depth" else None
    return Parts(folder, color, depth, rigid(rows[:, 4:], rows[:, :4]), settings, each, read)


def _packed(path: Path, shape: tuple[int, int]) -> np.ndarray:
    """Record3D's own depth files: float32 metres, usually packed by Apple's LZFSE."""
    data = path.read_bytes()
    if len(data) != 4 * shape[0] * shape[1]:
        try:
            data = import_module("liblzfse").decompress(data)
        except ImportError:
            raise ValueError(f"{path}: packed by LZFSE; `pip install pyliblzfse`, or export as EXR + RGB") from None
    return np.frombuffer(data, "<f4").reshape(shape)


def movi(folder: Path) -> Parts:
    """Kubric MOVi: `rgba_00000.png`, `depth_00000.tiff` (or 16-bit PNG with `data_ranges.json`), `metadata.json`."""
    about = read_json(folder / "metadata.json")
    camera, fps = about["camera"], about.get("metadata", {}).get("frame_rate", 12)
    depth, read = numbered(folder, DEPTHS, r"^depth_\d+\."), None
    if depth and depth[0].suffix == ".png":
        span = read_json(folder / "data_ranges.json")["depth"]
        read = partial(_between, low=span["min"], high=span["max"])
    quaternions = np.array(camera["quaternions"], np.float64)[:, [1, 2, 3, 0]]  # w x y z
    poses = rigid(np.array(camera["positions"]), quaternions)
    color, each = numbered(folder, PICTURES, r"^rgba?_\d+\."), [camera["K"]] * len(poses)
    return _kubric(folder, color, depth, poses, each, read, fps)


def kubric(folder: Path) -> Parts:
    """The authors' training clips: `frames/000.png`, `frames/000_depth.png`, and NAME/NAME.npy with cameras and tracks."""
    path = folder / f"{folder.resolve().name}.npy"
    with open(regular(path), "rb") as file:
        truth = load_objects(path, file)
    keys = ("depth_range", "traj_3d", "occluded", "intrinsics", "matrix_world")
    require(path, truth, "a training clip", keys, "take the complete file")
    low, high = map(float, truth["depth_range"])
    read = partial(_between, low=low, high=high)
    color, depth = (numbered(folder / "frames", (".png",), end) for end in (r"^\d+\.png$", r"^\d+_depth\.png$"))
    parts = _kubric(folder, color, depth, truth["matrix_world"], truth["intrinsics"], read)
    parts.tracks = partial(_kubric_tracks, truth)
    return parts


def _kubric(
    folder: Path, color: list, depth: list, poses: object, normalised: object, read: object, fps: float = 12.0
) -> Parts:
    """Ray lengths, Blender's axes, and K of an image of size 1 that begins at 0: ours begins at -1/2."""
    intrinsics = np.abs(np.array(normalised, np.float64))  # K's second and third columns are negative, as the axes are
    intrinsics[:, :2, 2] -= 0.5
    settings = Settings.read(folder, axes="opengl", depth_is="ray", made_for=(1, 1), fps=float(fps))
    return Parts(folder, color, depth, np.array(poses, np.float64), settings, intrinsics, read)


def _between(path: Path, low: float, high: float) -> np.ndarray:
    return (low + read_depth(path, 1.0, -1).astype(np.float64) * (high - low) / 65535).astype(np.float32)


def _kubric_tracks(truth: dict, frames: slice, *cameras: object) -> Tracks:
    """The tracks that some frame shows, asked for where they are first seen."""
    xyz = truth["traj_3d"].swapaxes(0, 1)[frames].astype(np.float32)
    visible = ~truth["occluded"].astype(bool).T[frames] & in_image(xyz, *cameras)
    seen = np.flatnonzero(visible.any(0))
    xyz, visible = xyz[:, seen], visible[:, seen]
    first = visible.argmax(0)
    queries = np.concatenate([first[:, None], xyz[first, np.arange(len(seen))]], 1)
    return Tracks(xyz, visible, queries, dynamic=np.ptp(xyz, axis=0).max(-1) > 0.01)
