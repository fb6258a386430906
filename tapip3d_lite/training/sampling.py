"""Which frames and which points of a clip an example is made of.

Paper: appendix (training): tracks that are seen in at least a fifth of the frames, asked for where they are first
seen, one in four at any frame that shows it; clips are also played backward.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.files import load_npz
from tapip3d_lite.model.frames import resize_clip


@dataclass(frozen=True)
class SamplingConfig:
    """What is drawn from a clip.

    Attributes:
        tracks: N.
        seen: least share of an example's frames that show a point.
        anywhere: share of the queries that are asked at a random frame that shows the point, not at the first one.
        backward: share of the examples that are played backward.
    """

    tracks: int = 48
    seen: float = 0.2
    anywhere: float = 0.25
    backward: float = 0.5

    def __post_init__(self) -> None:
        if self.tracks < 1 or not all(0 <= x <= 1 for x in (self.seen, self.anywhere, self.backward)):
            raise ValueError(f"SamplingConfig: tracks must be positive and shares in [0, 1], got {self}")


def draw_frames(rng: np.random.Generator, available: int, wanted: int, backward: float) -> np.ndarray:
    """Indices (wanted,) of consecutive frames, sometimes from last to first.

    Raises:
        ValueError: fewer frames are available than wanted.
    """
    if wanted > available:
        raise ValueError(f"frames: an example needs {wanted} frames, the clip has {available}; lower frames")
    start = int(rng.integers(available - wanted + 1))
    index = np.arange(start, start + wanted)
    return index[::-1].copy() if rng.random() < backward else index


def query_rows(xyz: np.ndarray, visible: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Query rows (N, 4) of tracks xyz (T, N, 3) at frames times (N,)."""
    return np.concatenate([times[:, None], xyz[times, np.arange(len(times))]], -1).astype(np.float32)


def sample_tracks(clip: Clip, rng: np.random.Generator, config: SamplingConfig) -> Clip:
    """Draw N of a clip's tracks and the frames where they are asked for.

    Args:
        clip: with tracks.
        rng: source of chance.
        config: how many, and which.

    Returns:
        The clip with exactly N tracks; if fewer are seen long enough, some of them more than once.

    Raises:
        ValueError: no track is seen long enough.
    """
    visible = clip.tracks.visible
    good = np.flatnonzero(visible.mean(0) >= max(config.seen, 1 / len(visible)))
    if not len(good):
        raise ValueError(
            f"sample_tracks: clip {clip.name!r} shows no track in {config.seen:.0%} of its frames; lower `seen`"
        )
    extra = rng.choice(good, max(config.tracks - len(good), 0))
    chosen = rng.choice(np.concatenate([good, extra]), config.tracks, replace=False)
    visible = visible[:, chosen]
    times = visible.argmax(0)
    for n in np.flatnonzero(rng.random(config.tracks) < config.anywhere):
        times[n] = rng.choice(np.flatnonzero(visible[:, n]))
    picked = clip.tracks.select(chosen)
    queries = query_rows(picked.xyz, visible, times)
    return replace(clip, queries=queries, tracks=replace(picked, queries=queries))


def load_part(
    path: str | Path, choose: Callable[[int], np.ndarray], colours: bool = True, size: tuple[int, int] | None = None
) -> Clip:
    """Some frames of a stored clip, with every track that they show, asked for at the first frame that shows it.

    Args:
        path: an npz with tracks.
        choose: from the number of frames in the file to the indices (T,) of those wanted, in any order.
        colours: False leaves the video black, and does not read it.
        size: (H, W) of the result; None: as stored.
    """
    arrays = load_npz(path, skip=() if colours else ("video",))
    index = choose(len(arrays["depths"]))
    frames = {name: arrays[name][index] for name in ("depths", "intrinsics", "extrinsics")}
    video = arrays["video"][index] if colours else np.zeros((*frames["depths"].shape, 3), np.uint8)
    xyz, visible = arrays["tracks"][index], arrays["visible"][index]
    kept = visible.any(0)
    xyz, visible = xyz[:, kept], visible[:, kept]
    queries = query_rows(xyz, visible, visible.argmax(0))
    dynamic = arrays["dynamic"][kept] if "dynamic" in arrays else None
    tracks = Tracks(xyz, visible, queries, dynamic=dynamic)
    clip = Clip(video, **frames, queries=queries, tracks=tracks, name=str(arrays["name"]), fps=float(arrays["fps"]))
    if size in (None, clip.size):
        return clip
    resized = resize_clip(clip, size)
    return replace(clip, video=resized.video, depths=resized.depths, intrinsics=resized.intrinsics, extras={})
