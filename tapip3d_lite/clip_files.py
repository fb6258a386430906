"""Clips and tracks read from the authors' files and ours; `Clip.save` and `Tracks.save` write them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from tapip3d_lite.clip import CLIP_KEYS, OWN_KEYS, Clip, Tracks
from tapip3d_lite.files import load_npz


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
    """Read tracks from a result npz (`Tracks.save`, or the authors' result file).

    Raises:
        ValueError: as for `load_own_clip`.
    """
    arrays = load_npz(path)
    needed = ("coords", "visibs", "query_points")
    require(path, arrays, "a result", needed, "save one with Tracks.save")
    return Tracks(*(arrays[key] for key in needed), arrays.get("visib_logits"), arrays.get("dynamic"))


def require(path: str | Path, arrays: Mapping[str, np.ndarray], what: str, keys: Sequence[str], remedy: str) -> None:
    """Raise ValueError unless a file's arrays have these keys."""
    missing = [key for key in keys if key not in arrays]
    if missing:
        raise ValueError(
            f"{path}: {what} needs the keys {', '.join(keys)}; {', '.join(missing)} missing, "
            f"the file has {', '.join(sorted(arrays)) or 'none'}; {remedy}"
        )
