"""Cameras from RGB-D alone, and a clip whose poses or depths jitter made steady: geometry, nothing learnt.

A tracker lifts pixels by depth and pose; where these jitter the world does, and points at rest seem to move. What rests
reveals the error: `bundle.py` finds the poses and depth scales that make it agree over the frames. Noise that differs
from pixel to pixel goes before that, by a median of neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from tapip3d_lite.bundle import BOTH, POSES, SCALE, Fit, Pair, Views, errors, fit, motion, small
from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.geometry import invert, transform

_ENOUGH = 12  # matches that must agree on a pose
_STILL = 0.4  # share of matches that must rest
_NOISE = 0.002  # relative difference of a typical depth to its neighbours' median, from which on it is noise
_SLACK = 1.5  # a simpler correction may leave this much more of what rests, in squares


def estimate_poses(clip: Clip) -> Clip:
    """The clip with extrinsics found from colour and depth alone; those given are ignored, but for the first frame's.

    Each pose comes first from the corners of the frame before (PnP with RANSAC), then all poses from each other. What
    moves is left out as long as more corners rest. Where the depths' scale jitters it is corrected too, to a median of
    1. Queries and tracks keep their pixels and depths. About a second for 24 frames of 128 x 128; the time grows with
    the cube of their number, so cut a clip of 1,000.

    Raises:
        ValueError: some frames, which are named, have too few corners that agree: blank or dark images, no depth,
            another scene, too little at rest.
    """
    if len(clip) == 1:
        return clip
    views, given = Views(clip), clip.extrinsics.astype(np.float64)
    start = np.repeat(_in_units(given[:1], 1 / views.unit), len(clip), 0)
    agreed, turn = np.full(len(clip), _ENOUGH), np.eye(4)
    for t in range(1, len(clip)):
        turn, agreed[t] = _step(views, t, turn)
        start[t] = turn @ start[t - 1]
    if (agreed >= _ENOUGH).all():
        for gaps in (2, 4):  # frames further apart are matched once the poses of near ones agree
            start = fit(views.pairs(start, gaps), views.k, start, BOTH).poses
        pairs = views.pairs(start)
        best = fit(pairs, views.k, start, BOTH)
        agreed = _agreed(pairs, best)
        best, _ = _simplest(pairs, views, start, best, POSES)
    if (lost := np.flatnonzero(agreed < _ENOUGH)).size:
        raise ValueError(
            f"estimate_poses: clip {clip.name!r}, frames {', '.join(map(str, lost))}: too few corners with depth agree on the "
            f"camera's motion (at least {_ENOUGH}, and {_STILL:.0%} of them, must); leave these frames out, or take poses from "
            "another tool"
        )
    poses = _in_units(best.poses, views.unit)
    return _corrected(clip, poses @ invert(poses[0]) @ given[0], best.scale - np.median(best.scale))


def steady_clip(clip: Clip) -> Clip:
    """The clip without the jitter of its poses and depth scales and the noise of its depths, or itself where none is found.

    Noisy depths become the median of their 5 x 5 neighbours; missing ones stay missing. The rest takes poses and depths as about right (to some 5 degrees, or 5 %), and changes what makes the world at rest agree over
    the frames: nothing, one depth scale a frame, the poses, or both; the first of these that explains what rests about as
    well as the last. Corrected poses differ from those given by a mean of zero, so the world stays where it is. Scales
    alone fit the camera's travel, with poses they have a median of 1. Left as they are: clips in which too little rests,
    frames that show too little of it, and changes that are slow: then the world may move.

    Where poses change, queries and tracks keep their pixels and depths, so scores are those of the clip given; where only
    depths do, they keep their places. `carry` takes tracks back into the world of the given poses. About a second for 24
    frames of 128 x 128.
    """
    clip = _smooth(clip)
    views, given = Views(clip), clip.extrinsics.astype(np.float64)
    start = _in_units(given, 1 / views.unit)
    if not (pairs := views.pairs(start)):
        return clip
    both = fit(pairs, views.k, start, BOTH)
    as_given = errors(pairs, views.k, start, np.zeros(len(clip)))
    if both.rests().mean() < _STILL or both.error(as_given) <= _SLACK * both.error(both.left):
        return clip
    pairs = views.pairs(both.poses)  # a search that begins in the right place finds more
    both = fit(pairs, views.k, start, BOTH)
    best, free = _simplest(pairs, views, start, both, SCALE, POSES)
    change = np.column_stack([[small(x) for x in best.poses @ invert(start)], best.scale])
    if both.rests().mean() < _STILL or not _jitters(change):
        return clip
    kept = _agreed(pairs, both) < _ENOUGH
    scale = np.where(kept, 0, best.scale - (0 if free == SCALE else np.median(best.scale)))
    poses = given if free == SCALE else np.where(kept[:, None, None], given, _in_units(best.poses, views.unit))
    return _corrected(clip, poses, scale)


def carry(tracks: Tracks, source: Clip, target: Clip) -> Tracks:
    """Tracks of one clip in the world of another of the same frames: in each frame's camera they stay where they are.

    For tracks of a clip that `steady_clip` or `estimate_poses` made, back to the one that was given.
    """
    if not len(source) == len(target) == len(tracks.xyz):
        lengths = f"{len(tracks.xyz)}, {len(source)} and {len(target)}"
        raise ValueError(f"carry: tracks, source and target must have the same frames, got {lengths}; cut all alike")
    change = invert(target.extrinsics.astype(np.float64)) @ source.extrinsics.astype(np.float64)
    return _carried(tracks, change)


def move(clip: Clip, change: np.ndarray) -> Clip:
    """Express a clip in other coordinates, by a rigid motion (T, 4, 4) float64.

    A point at x in frame t is then at change[t] x, and projects to the same pixel as before.
    """
    moved = replace(clip, extrinsics=clip.extrinsics.astype(np.float64) @ invert(change), queries=None, tracks=None)
    queries = None if clip.queries is None else _moved(clip.queries, change)
    return replace(moved, queries=queries, tracks=clip.tracks and _carried(clip.tracks, change))


def _carried(tracks: Tracks, change: np.ndarray) -> Tracks:
    return replace(tracks, xyz=transform(tracks.xyz.astype(np.float64), change), queries=_moved(tracks.queries, change))


def _moved(queries: np.ndarray, change: np.ndarray) -> np.ndarray:
    places = transform(queries[:, None, 1:].astype(np.float64), change[queries[:, 0].astype(int)])[:, 0]
    return np.concatenate([queries[:, :1], places], -1)


def _smooth(clip: Clip) -> Clip:
    """The clip with depths at the median of their neighbours, if a typical one differs from it."""
    some = clip.depths[clip.depths.any((1, 2))]
    some = some[:: max(1, len(some) // 8)]
    change = np.stack([_median(depth) for depth in some])[some > 0] / some[some > 0]
    if np.median(np.abs(change - 1)) < _NOISE:
        return clip
    return replace(clip, depths=np.stack([_median(depth) for depth in clip.depths]))


def _median(depth: np.ndarray, side: int = 5) -> np.ndarray:
    """The median (H, W) of those of each pixel's side x side neighbours that have depth; 0 where it has none itself."""
    known = np.pad(np.where(depth > 0, depth, np.nan), side // 2, constant_values=np.nan)
    near = np.sort(np.lib.stride_tricks.sliding_window_view(known, (side, side)).reshape(*depth.shape, -1))  # NaN last
    count = np.isfinite(near).sum(-1, keepdims=True).clip(min=1)
    middle = [np.take_along_axis(near, index, -1)[..., 0] for index in ((count - 1) // 2, count // 2)]
    return np.where(depth > 0, (middle[0] + middle[1]) / 2, 0).astype(np.float32)


def _corrected(clip: Clip, poses: np.ndarray, scale: np.ndarray) -> Clip:
    """A clip with other poses, and depths times exp(scale)."""
    clip = replace(clip, depths=clip.depths * np.exp(scale)[:, None, None]) if scale.any() else clip
    given = clip.extrinsics.astype(np.float64)
    return clip if np.array_equal(poses, given) else move(clip, invert(poses) @ given)


def _in_units(poses: np.ndarray, factor: float) -> np.ndarray:
    """Poses with their translations multiplied."""
    return poses * np.array([[1, 1, 1, factor]] * 3 + [[1, 1, 1, 1]])


def _step(views: Views, t: int, turn: np.ndarray) -> tuple[np.ndarray, int]:
    """The motion (4, 4) from camera t - 1 to t on which the most corners agree, and their number."""
    best = turn, 0
    for guess in (turn, np.eye(4)):  # as before, or at rest
        pair = views.match(t - 1, t, guess)
        if len(pair.z) >= 6:
            found = cv2.solvePnPRansac(pair.x, pair.uv, views.k[t], None, None, None, False, 300, 1.0, 0.999)
            if found[0] and found[3] is not None and len(found[3]) > best[1]:
                best = motion(np.concatenate([found[2][:, 0], found[1][:, 0]])), len(found[3])
    return best


def _simplest(pairs: Sequence[Pair], views: Views, start: np.ndarray, both: Fit, *fewer: slice) -> tuple[Fit, slice]:
    """The first fit of fewer unknowns that explains what rests about as well as `both` does, and those unknowns."""
    for free in fewer:
        simple = fit(pairs, views.k, start, free)
        if both.error(simple.left) <= _SLACK * both.error(both.left):
            return simple, free
    return both, BOTH


def _agreed(pairs: Sequence[Pair], best: Fit) -> np.ndarray:
    """How many matches of each frame (T,) belong to the world at rest; 0 where too many do not."""
    frames = np.concatenate([np.full((len(pair.z), 2), (pair.a, pair.b)) for pair in pairs])
    every, rests = (np.bincount(x.ravel(), minlength=len(best.poses)) for x in (frames, frames[best.rests()]))
    return np.where(rests < _STILL * every, 0, rests)


def _jitters(change: np.ndarray) -> bool:
    """Whether corrections (T, 7) differ from frame to frame as much as over all frames: jitter, not a slow motion."""
    rough = (np.diff(change, 2, axis=0) ** 2).sum() / 6 / max(len(change) - 2, 1)
    return rough > 0.1 * change.var(0).sum()
