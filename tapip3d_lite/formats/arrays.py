"""Clips in npz files: the authors' and ours, results, TAPVid-3D, MegaSaM, VGGT and Depth Anything 3."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from tapip3d_lite.clip import CLIP_KEYS, OWN_KEYS, Clip, Tracks
from tapip3d_lite.depth import splat
from tapip3d_lite.files import load_npz, map_npy
from tapip3d_lite.formats.folders import matrix, numbered
from tapip3d_lite.formats.images import DEPTHS, decode_color, fit_depth, read_depth
from tapip3d_lite.geometry import invert, project, transform

_JPEG = "images_jpeg_bytes"


def load_own_clip(path: str | Path, points: bool = True) -> Clip:
    """Read a clip from the authors' input npz or from one of ours; `formats.load_clip` reads others, too.

    A single (3, 3) or (4, 4) camera is taken for all frames.

    Args:
        path: the npz file.
        points: False ignores queries and tracks, for a clip whose cameras may be wrong (`check_clip`).

    Raises:
        ValueError: the file is missing, truncated, not an npz, needs pickle, or its arrays do not fit together.
    """
    arrays, tracks = clip_arrays(path), None
    if points and "tracks" in arrays:
        require(path, arrays, "a clip with tracks", ("visible", "query_point"), "add the key or drop tracks")
        tracks = Tracks(arrays["tracks"], arrays["visible"], arrays["query_point"], None, arrays.get("dynamic"))
    return Clip(
        **{key: arrays[key] for key in CLIP_KEYS},
        queries=arrays.get("query_point") if points else None,
        tracks=tracks,
        name=str(arrays["name"]),
        fps=arrays["fps"].item() if arrays["fps"].size == 1 else arrays["fps"],
        extras={key: value for key, value in arrays.items() if key not in OWN_KEYS},
    )


def clip_arrays(path: str | Path, skip: Collection[str] = (), outline: Collection[str] = ()) -> dict[str, np.ndarray]:
    """The arrays of a clip's file, with a camera for each frame, `name` and `fps`; `skip`, `outline` as for `load_npz`."""
    arrays = load_npz(path, skip, outline)
    remedy = "for RGB-only video estimate depth and pose first (e.g. with MegaSaM)"
    require(path, arrays, "a clip", [key for key in CLIP_KEYS if key not in skip], remedy)
    frames = len(arrays["depths"]) if arrays["depths"].ndim else 0
    for key in ("intrinsics", "extrinsics"):
        if arrays[key].ndim == 2:
            arrays[key] = np.repeat(arrays[key][None], frames, axis=0)
    return {"name": np.array(Path(path).stem), "fps": np.array(12.0)} | arrays


def load_tracks(path: str | Path) -> Tracks:
    """Read tracks from a result npz (`Tracks.save`, or the authors' result file); errors as for `load_own_clip`."""
    arrays, needed = load_npz(path), ("coords", "visibs", "query_points")
    require(path, arrays, "a result", needed, "save one with Tracks.save")
    return Tracks(*(arrays[key] for key in needed), arrays.get("visib_logits"), arrays.get("dynamic"))


def require(path: str | Path, arrays: Mapping[str, np.ndarray], what: str, keys: Sequence[str], remedy: str) -> None:
    """Raise ValueError unless a file's arrays have these keys."""
    missing = [key for key in keys if key not in arrays]
    if missing:
        raise ValueError(
            f"{path}: {what} needs the keys {', '.join(keys)}; {', '.join(missing)} missing, "
            f"the file has {', '.join(sorted(map(str, arrays))) or 'none'}; {remedy}"
        )


def result(path: Path, points: bool) -> Clip:
    """The authors' result: the clip in it with its queries (`load_tracks` reads the tracks)."""
    arrays = load_npz(path)
    require(path, arrays, "a result with its clip", CLIP_KEYS, "give `save` the clip")
    video, *cameras = (arrays[key] for key in CLIP_KEYS)
    return Clip(_video(video), *cameras, arrays.get("query_points") if points else None, name=path.stem)


def megasam(path: Path, _points: bool) -> Clip:
    """MegaSaM: `images`, `depths`, one `intrinsic` (3, 3), `cam_c2w` (T, 4, 4) camera to world."""
    arrays = load_npz(path)
    require(path, arrays, "MegaSaM's output", ("images", "depths", "intrinsic", "cam_c2w"), "take its *_sgd_cvd_hr.npz")
    poses = invert(arrays["cam_c2w"].astype(np.float64))
    intrinsics = np.broadcast_to(arrays["intrinsic"], (len(poses), 3, 3))
    return Clip(_video(arrays["images"]), arrays["depths"], intrinsics, poses, name=path.stem)


def vggt(path: Path, _points: bool) -> Clip:
    """VGGT and Depth Anything 3: images as bytes or in [0, 1], depth (T, H, W) or with a last axis, extrinsics (T, 3, 4)."""
    arrays = {key.removesuffix("s"): value for key, value in load_npz(path).items()}
    keys = ("image", "depth", "intrinsic", "extrinsic")
    require(path, arrays, "such a clip", keys, "export the images and the cameras with the depth")
    batch = arrays["image"].ndim == 5  # of one clip
    images, depths, intrinsics, top = (arrays[key][0] if batch else arrays[key] for key in keys)
    depths = depths[:, 0] if depths.ndim == 4 and depths.shape[1] == 1 else depths
    intrinsics = np.broadcast_to(intrinsics, (len(top), 3, 3)) if intrinsics.ndim == 2 else intrinsics
    extrinsics = np.tile(np.eye(4), (len(top), 1, 1))
    extrinsics[:, :3] = top[:, :3]
    return Clip(_video(images), depths[..., 0] if depths.ndim == 4 else depths, intrinsics, extrinsics, name=path.stem)


def tapvid3d(path: Path, points: bool, depth: str | Path | None = None) -> Clip:
    """TAPVid-3D: JPEG images, tracks in each frame's camera, one camera matrix, poses or none; depth comes from elsewhere."""
    arrays, keys = load_npz(path, objects=(_JPEG,)), (_JPEG, "tracks_XYZ", "visibility", "queries_xyt", "fx_fy_cx_cy")
    require(path, arrays, "TAPVid-3D", keys, "take the complete file")
    if depth is None:
        raise ValueError(
            f'{path}: TAPVid-3D holds no depth; give depth="sparse" for that of its true points, or a file or folder of '
            'estimated depth: depth="depths.npy", (T, H, W) in metres'
        )
    video = np.stack([decode_color(bytes(image), f"{path}: image {t}") for t, image in enumerate(arrays[_JPEG])])
    xyz, visible = arrays["tracks_XYZ"].astype(np.float64), arrays["visibility"].astype(bool)
    intrinsics = np.tile(matrix(arrays["fx_fy_cx_cy"], f"{path}: fx_fy_cx_cy"), (len(video), 1, 1))
    extrinsics = np.broadcast_to(arrays.get("extrinsics_w2c", np.eye(4)).astype(np.float64), (len(video), 4, 4))
    size = video.shape[1:3]
    if depth == "sparse":
        each = zip(*project(xyz, intrinsics), visible, strict=True)
        depths = np.stack([splat(uv[seen], z[seen], size) for uv, z, seen in each])
    else:
        depths = np.stack([fit_depth(image, size, depth) for image in read_depths(depth)])
    world = transform(xyz, invert(extrinsics))
    times = np.rint(arrays["queries_xyt"][:, 2]).astype(int)
    if times.min(initial=0) < 0 or times.max(initial=0) >= len(video):
        raise ValueError(f"{path}: queries_xyt ask in frame {times.max()} of {len(video)}; the order is x, y, t")
    queries = np.concatenate([times[:, None], world[times, np.arange(len(times))]], 1)
    tracks = Tracks(world, visible, queries) if points else None
    return Clip(video, depths, intrinsics, extrinsics, tracks=tracks, name=path.stem, fps=30.0)


def read_depths(path: str | Path) -> np.ndarray:
    """Depth maps (T, h, w) of an npy file, of an npz file's only array or its `depths` or `depth`, or of a folder of images."""
    path = Path(path)
    if path.is_dir():
        return np.stack([read_depth(x) for x in numbered(path, DEPTHS)])
    if path.suffix == ".npz":
        arrays = load_npz(path)
        only = next(iter(arrays.values())) if len(arrays) == 1 else np.zeros(0)
        depths = arrays.get("depths", arrays.get("depth", only))
    else:
        depths = map_npy(path)
    depths = depths[..., 0] if depths.ndim == 4 else depths
    if depths.ndim != 3 or depths.dtype.kind != "f":
        raise ValueError(f"{path}: expected depth (T, H, W), floats in scene units, got {depths.shape} {depths.dtype}")
    return depths.astype(np.float32)


def _video(images: np.ndarray) -> np.ndarray:
    """(T, H, W, 3) uint8 of images with colours first or last, up to 255 or up to 1."""
    images = np.moveaxis(images, 1, -1) if images.ndim == 4 and images.shape[1] == 3 != images.shape[-1] else images
    if images.dtype.kind == "f" and images.min(initial=0) < 0:
        raise ValueError("images: expected colours in [0, 1] or [0, 255], got negative ones; undo the normalisation")
    if images.dtype.kind == "f":
        images = np.rint(np.clip(images * (255 if images.max() <= 1 else 1), 0, 255)).astype(np.uint8)
    return np.ascontiguousarray(images)
