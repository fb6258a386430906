"""Anyone's clips: the files and folders of data sets, apps and depth estimators, recognised and read as a `Clip`."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from tapip3d_lite.clip import Clip
from tapip3d_lite.files import atomic_path, npz_keys, regular, write_text
from tapip3d_lite.formats.arrays import load_own_clip, megasam, read_depths, result, tapvid3d, vggt
from tapip3d_lite.formats.folders import load_parts
from tapip3d_lite.formats.images import VIDEOS
from tapip3d_lite.formats.layouts import kubric, movi, plain_folder, record3d, seven_scenes, tum

_FILES = {"npz": load_own_clip, "result": result, "tapvid3d": tapvid3d, "megasam": megasam, "vggt": vggt}
_FOLDERS = {"tum": tum, "7scenes": seven_scenes, "record3d": record3d, "movi": movi, "kubric": kubric}
_FOLDERS["folder"] = plain_folder
FORMATS = ("auto", *_FILES, *_FOLDERS)


def load_clip(
    path: str | Path,
    format: str = "auto",
    depth: str | Path | None = None,
    frames: slice = slice(None),
    points: bool = True,
) -> Clip:
    """Read a clip: npz files of the authors, ours and others, folders of several layouts, a video beside its depth.

    README's table says what each format is. A `clip.json` in a folder overrides what its layout says (`Settings`).

    Args:
        path: a file or a folder.
        format: one of `FORMATS`; "auto" recognises it.
        depth: depth to take in place of the clip's own: an npy or npz file (T, H, W) in scene units, a folder of depth
            images, or for TAPVid-3D "sparse".
        frames: which frames of a folder or video to read; the others are never loaded.
        points: False ignores queries and tracks, for a clip whose cameras may be wrong (`check_clip`).

    Raises:
        ValueError: names the file, what is wrong with it, and what to do.
    """
    path = Path(path)
    if format not in FORMATS:
        raise ValueError(f"format: expected one of {', '.join(FORMATS)}, got {format!r}")
    if any((x or 0) < 0 for x in (frames.start, frames.stop, frames.step)):
        raise ValueError(f"frames: expected a slice without negative numbers, got {frames}; count from the first frame")
    if not path.is_dir():
        regular(path)
    kind = _recognised(path) if format == "auto" else format
    if (kind in _FOLDERS) != path.is_dir() and path.suffix.lower() not in VIDEOS:
        raise ValueError(f"{path}: format {kind} is that of a {'folder' if kind in _FOLDERS else 'file'}; give one")
    try:
        if kind in _FOLDERS:
            find = partial(plain_folder, needs_depth=depth is None) if kind == "folder" else _FOLDERS[kind]
            parts, own = find(path), None if depth is None else read_depths(depth)
            parts.tracks = parts.tracks if points else None
            return load_parts(parts, frames, path.resolve().stem, own)
        if frames != slice(None):
            raise ValueError("frames are chosen in folders and videos; cut this clip afterwards: clip.cut(start, stop)")
        if kind == "tapvid3d":
            return tapvid3d(path, points, depth)
        clip = _FILES[kind](path, points)
        return clip if depth is None else replace(clip, depths=read_depths(depth))
    except ValueError as error:
        raise error if str(path) in str(error) else ValueError(f"{path}: {error}") from None
    except (OSError, KeyError, TypeError, IndexError, StopIteration) as error:
        raise ValueError(f"{path}: not readable as {kind} ({type(error).__name__}: {error}); is it complete?") from None


def _recognised(path: Path) -> str:
    """The format of a file by its arrays, of a folder by its files."""
    if path.is_dir():
        names = {item.name for item in path.iterdir()}
        marks = {
            "record3d": names & {"metadata", "metadata.json"} and names & {"rgb", "rgbd"},
            "tum": names >= {"rgb.txt", "depth.txt"},
            "7scenes": any(name.startswith("frame-") and ".color." in name for name in names),
            "movi": "metadata.json" in names and any(name.startswith("rgb") for name in names),
            "kubric": f"{path.resolve().name}.npy" in names,
        }
        return next((kind for kind, found in marks.items() if found), "folder")
    if path.suffix.lower() in VIDEOS:
        return "folder"
    if path.suffix.lower() == ".r3d":
        raise ValueError(f"{path}: a packed Record3D recording; unzip it and give the folder")
    keys = npz_keys(path)
    marks = {
        "result": keys >= {"coords", "visibs", "query_points"},
        "npz": keys >= {"video", "depths"},
        "tapvid3d": "images_jpeg_bytes" in keys,
        "megasam": "cam_c2w" in keys,
        "vggt": keys & {"image", "images"} and keys & {"depth", "depths"} and keys & {"extrinsic", "extrinsics"},
    }
    return next((kind for kind, found in marks.items() if found), "npz")


def save_clip(clip: Clip, path: str | Path) -> None:
    """Write a clip as npz, with everything, or (a path without suffix) as a plain folder, without queries and tracks.

    Raises:
        ValueError: another suffix, or a folder that holds something already.
    """
    path = Path(path)
    if path.suffix == ".npz":
        clip.save(path)
        return
    if path.suffix or (path.exists() and (not path.is_dir() or any(path.iterdir()))):
        raise ValueError(f"{path}: a clip is written as NAME.npz or as a new, empty folder; choose another name")
    for t, (image, depth) in enumerate(zip(clip.video, clip.depths, strict=True)):
        for name, content in ((f"rgb/{t:06d}.png", image[..., ::-1]), (f"depth/{t:06d}.tiff", depth)):
            with atomic_path(path / name) as temporary:
                temporary.write_bytes(cv2.imencode(temporary.suffix, content)[1].tobytes())
    for name, matrices in (("poses.txt", clip.extrinsics), ("intrinsics.txt", clip.intrinsics)):
        digits = 17 if matrices.dtype == np.float64 else 9
        rows = [" ".join(f"{x:.{digits}g}" for x in matrix.ravel()) for matrix in matrices]
        write_text(path / name, "\n".join(rows) + "\n")
    write_text(path / "clip.json", json.dumps({"poses": "world_to_camera", "fps": clip.fps}) + "\n")
