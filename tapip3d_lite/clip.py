"""`Clip` and `Tracks`: the data that every function of the library takes and returns, and their files.

A clip on disk is the authors' input npz (`video`, `depths`, `intrinsics`, `extrinsics`, `query_point`) plus, where
the truth is known, `tracks`, `visible` and `dynamic`. Tracks on disk are the authors' result npz (`coords`, `visibs`,
`query_points`). So every clip of ours feeds their code and every clip of theirs feeds ours.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from tapip3d_lite.files import save_npz
from tapip3d_lite.geometry import point_map, project
from tapip3d_lite.validate import bools, check_about, check_cameras, checked, floats, known_depths, video_frames

CLIP_KEYS = ("video", "depths", "intrinsics", "extrinsics")
OWN_KEYS = (*CLIP_KEYS, "query_point", "tracks", "visible", "dynamic", "name", "fps")


@dataclass(frozen=True)
class Tracks:
    """3D trajectories of N points over T frames.

    Attributes:
        xyz: (T, N, 3) float32, world frame, scene units; float64 where the world's origin is far away.
        visible: (T, N) bool.
        queries: (N, 4) float32, rows (t, x, y, z): frame index and world position.
        visible_logits: (T, N) float32 before the sigmoid, or None where nothing was estimated.
        dynamic: (N,) bool, True for points on bodies that move in the world, or None where unknown.

    Raises:
        ValueError: shapes, dtypes or values that do not fit together.
    """

    xyz: np.ndarray
    visible: np.ndarray
    queries: np.ndarray
    visible_logits: np.ndarray | None = None
    dynamic: np.ndarray | None = None

    def __post_init__(self) -> None:
        _set(self, "xyz", floats("Tracks.xyz", self.xyz, (None, None, 3), far=True))
        frames, count = self.xyz.shape[:2]
        _set(self, "visible", bools("Tracks.visible", self.visible, (frames, count)))
        _set(self, "queries", floats("Tracks.queries", self.queries, (count, 4), True, far=True))
        if self.visible_logits is not None:
            _set(self, "visible_logits", floats("Tracks.visible_logits", self.visible_logits, (frames, count)))
        if self.dynamic is not None:
            _set(self, "dynamic", bools("Tracks.dynamic", self.dynamic, (count,)))

    def select(self, which: np.ndarray | slice) -> Tracks:
        """The tracks that an index, a slice or a boolean mask over N picks; ValueError for what picks none of them."""
        try:
            which = np.arange(len(self.queries))[which]
        except (IndexError, TypeError, OverflowError):
            wanted = f"an index, a slice or a mask over {len(self.queries)} tracks"
            raise ValueError(f"Tracks.select: expected {wanted}, got {which!r}"[:300]) from None
        logits = None if self.visible_logits is None else self.visible_logits[:, which]
        dynamic = None if self.dynamic is None else self.dynamic[which]
        return Tracks(self.xyz[:, which], self.visible[:, which], self.queries[which], logits, dynamic)

    @checked
    def save(self, path: str | Path, clip: Clip | None = None) -> None:
        """Write the authors' result npz atomically; with the clip, everything that their viewer needs."""
        arrays = {"coords": self.xyz, "visibs": self.visible, "query_points": self.queries}
        arrays |= {"visib_logits": self.visible_logits, "dynamic": self.dynamic}
        if clip is not None:
            arrays["video"] = np.moveaxis(clip.video, -1, 1).astype(np.float32) / 255
            arrays |= {key: getattr(clip, key) for key in CLIP_KEYS[1:]}
        save_npz(path, arrays)


@dataclass(frozen=True)
class Clip:
    """One posed RGB-D video, with ground-truth tracks where they are known.

    Attributes:
        video: (T, H, W, 3) uint8, RGB.
        depths: (T, H, W) float32 z-depth in scene units; 0 marks an invalid pixel (non-finite input becomes 0).
        intrinsics: (T, 3, 3) float32, pixels; the top-left pixel's centre is (0, 0).
        extrinsics: (T, 4, 4) float32, world to camera, OpenCV axes; float64 is kept where the origin is far away.
        queries: (N, 4) float32 rows (t, x, y, z) in the world frame, or None.
        tracks: the true `Tracks`, or None.
        name: for titles and tables.
        fps: frames per second.
        extras: arrays under unknown keys, kept for the round trip to disk.

    Raises:
        ValueError: names the argument, the expected and the received value, and what to do.
    """

    video: np.ndarray
    depths: np.ndarray
    intrinsics: np.ndarray
    extrinsics: np.ndarray
    queries: np.ndarray | None = None
    tracks: Tracks | None = None
    name: str = "clip"
    fps: float = 12.0
    extras: Mapping[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _set(self, "video", video_frames(self.video))
        check_about(self, OWN_KEYS)
        frames, height, width = self.video.shape[:3]
        depths = floats("Clip.depths", self.depths, (frames, height, width), like="video (T, H, W, 3)")
        _set(self, "depths", known_depths(depths))
        for key, side in (("intrinsics", 3), ("extrinsics", 4)):
            shape, like = (frames, side, side), "video (T, H, W, 3)"
            _set(self, key, floats(f"Clip.{key}", getattr(self, key), shape, True, like, key == "extrinsics"))
        _set(self, "extrinsics", check_cameras(self.intrinsics, self.extrinsics))
        if self.queries is None and self.tracks is not None:
            _set(self, "queries", self.tracks.queries)
        if self.queries is not None:
            _set(self, "queries", check_queries(self, self.queries))
        if self.tracks is not None and len(self.tracks.xyz) != frames:
            raise ValueError(f"Clip.tracks: expected {frames} frames as in the video, got {len(self.tracks.xyz)}")

    def __len__(self) -> int:
        return len(self.video)

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) in pixels."""
        return self.video.shape[1], self.video.shape[2]

    def points(self, space: str = "world") -> np.ndarray:
        """Point maps (T, H, W, 3) in `"world"` or `"camera"` coordinates; invalid pixels are NaN."""
        if space not in ("world", "camera"):
            raise ValueError(f'Clip.points: space must be "world" or "camera", got {space!r}')
        points = point_map(self.depths, self.intrinsics, self.extrinsics if space == "world" else None)
        return np.where(self.depths[..., None] > 0, points, np.float32(np.nan))

    @checked
    def cut(self, start: int, stop: int) -> Clip:
        """Frames [start, stop), with the tracks and queries whose query frame lies inside."""
        if not 0 <= start < stop <= len(self):
            raise ValueError(f"Clip.cut: expected 0 <= start < stop <= {len(self)}, got [{start}, {stop})")

        def begins(rows: np.ndarray) -> np.ndarray:
            return (rows[:, 0] >= start) & (rows[:, 0] < stop)

        frames, shift = slice(start, stop), np.array([start, 0, 0, 0], np.float32)
        queries, tracks = self.queries, self.tracks
        if tracks is not None:
            some = tracks.select(begins(tracks.queries))
            logits = None if some.visible_logits is None else some.visible_logits[frames]
            tracks = Tracks(some.xyz[frames], some.visible[frames], some.queries - shift, logits, some.dynamic)
        if queries is not None:
            queries = queries[begins(queries)] - shift
        # Only what is known to be per frame is cut along: an unknown array may be anything.
        extras = {k: v[frames] if k.endswith("_right") else v for k, v in self.extras.items()}
        images = {key: getattr(self, key)[frames] for key in CLIP_KEYS}
        return replace(self, **images, queries=queries, tracks=tracks, extras=extras)

    def save(self, path: str | Path) -> None:
        """Write the clip as a compressed npz: to a temporary file first, then renamed, so never half written."""
        arrays = dict(self.extras) | {key: getattr(self, key) for key in CLIP_KEYS} | {"query_point": self.queries}
        if self.tracks is not None:
            if not np.array_equal(self.tracks.queries, self.queries):
                raise ValueError("Clip.save: tracks.queries differ from clip.queries; a file holds one set of queries")
            arrays |= {"tracks": self.tracks.xyz, "visible": self.tracks.visible, "dynamic": self.tracks.dynamic}
        arrays |= {"name": np.array(self.name), "fps": np.array(self.fps)}
        save_npz(path, arrays)


def check_queries(clip: Clip, queries: np.ndarray) -> np.ndarray:
    """Check world-space queries (N, 4), rows (t, x, y, z), against a clip and return them as float32.

    Raises:
        ValueError: wrong shape, t not a frame of the clip, or a point outside that frame's view.
    """
    queries = floats("queries", queries, (None, 4), finite=True, far=True)
    t = query_frames(clip, queries)
    uv, z = (x[:, 0] for x in project(queries[:, None, 1:], clip.intrinsics[t], clip.extrinsics[t]))
    height, width = clip.size
    # Half a pixel is the image's border; the rest is slack for float32 and for points on a border pixel.
    outside = (z <= 0) | (np.abs(uv * 2 - (width - 1, height - 1)) > (width + 2, height + 2)).any(-1)
    if outside.any():
        first = int(np.flatnonzero(outside)[0])
        raise ValueError(
            f"queries: {int(outside.sum())} of {len(queries)} lie outside the view of their frame; row {first} = {queries[first].tolist()} "
            f"projects to (u, v) = {np.round(uv[first], 1).tolist()}, z = {z[first]:.3g} in a {width}x{height} image; "
            "give (t, x, y, z) in world coordinates, or use queries_from_pixels for pixels; if all are outside, the cameras may be "
            "wrong: run check_clip(load_clip(path, points=False))"
        )
    return queries


def query_frames(clip: Clip, rows: np.ndarray) -> np.ndarray:
    """The frame indices (N,) int of rows (t, ...); ValueError where t is not a frame of the clip."""
    t = rows[:, 0]
    wrong = (t < 0) | (t >= len(clip)) | (t != np.rint(t))
    if wrong.any():
        raise ValueError(
            f"queries: t must be a whole frame index in [0, {len(clip) - 1}], got {t[wrong][0]:g}; the order is (t, ...)"
        )
    return t.astype(int)


def _set(instance: object, name: str, value: object) -> None:
    object.__setattr__(instance, name, value)  # the dataclass is frozen; this normalises once, on construction
