"""Augmentations that change where things are in the image: pad, resize and crop; mirror; play backward.

Paper: appendix (training). Each changes pixels, cameras and truth together, so that a visible point still projects to
where colour and depth show it.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.geometry import project

SAME_SURFACE = 0.05  # neighbouring depths that differ by less are interpolated, others belong to two surfaces
_MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0]).astype(np.float32)


def requery(tracks: Tracks) -> Tracks:
    """Ask for points where they are seen: at their own query frame, else at the first that shows them, else drop them.

    Args:
        tracks: true tracks, whose visibility may have been reduced.
    """
    kept = tracks.select(tracks.visible.any(0))
    queries, columns = kept.queries.copy(), np.arange(kept.xyz.shape[1])
    hidden = ~kept.visible[queries[:, 0].astype(int), columns]
    first = kept.visible.argmax(0)[hidden]
    queries[hidden] = np.concatenate([first[:, None], kept.xyz[first, columns[hidden]]], -1)
    return replace(kept, queries=queries)


def with_visibility(clip: Clip, visible: np.ndarray | None, **changes: object) -> Clip:
    """A changed clip whose points are seen only where `visible` (T, N), asked for anew where they must be.

    Queries of a clip without tracks are dropped, because nobody knows which of them are still seen.
    """
    tracks = None if clip.tracks is None else requery(replace(clip.tracks, visible=visible))
    return replace(clip, **changes, tracks=tracks, queries=None if tracks is None else tracks.queries)


def random_view(
    clip: Clip, rng: np.random.Generator, pad: float, scale: tuple[float, float], drift: float
) -> tuple[float, np.ndarray]:
    """Draw padding, a scale and a crop of the original size that wanders over the frames, as one map of pixels.

    Args:
        clip: T frames.
        rng: source of chance.
        pad: greatest black border on each side.
        scale: (smallest, greatest) factor of size.
        drift: greatest change of the crop's place from frame to frame. Lengths are fractions of the image's width.

    Returns:
        The factor s and offsets (T, 2), for `reframe`.
    """
    size = np.array(clip.size[::-1], float)
    before, after = rng.uniform(0, pad * size[0], (2, 2))
    s = float(rng.uniform(*scale))
    room = s * (size + before + after - 1) + 1 - size  # negative where the image is smaller than the crop
    low, high = np.minimum(room, 0), np.maximum(room, 0)
    place, speed, places = rng.uniform(low, high), np.zeros(2), []
    for _ in range(len(clip)):
        places.append(place)
        speed = 0.8 * speed + 0.2 * rng.uniform(-drift, drift, 2) * size[0]
        place = np.clip(place + speed, low, high)
    return s, np.stack(places) - s * before


def reframe(clip: Clip, scale: float, offsets: np.ndarray) -> Clip:
    """Look at a clip through another window of the same size: u' = scale u - offset.

    Inverse depth is linear in the image on any plane, so it is what is interpolated, and only within one surface;
    across an edge the nearest pixel's depth is taken, so that no surface appears between two.

    Args:
        clip: T frames.
        scale: factor of size.
        offsets: (T, 2), pixels of the result.

    Raises:
        ValueError: a factor that is not positive, offsets of another shape, or a view without any valid depth.
    """
    offsets = np.asarray(offsets, float)
    if not scale > 0 or offsets.shape != (len(clip), 2):
        raise ValueError(
            f"reframe: expected scale > 0 and offsets ({len(clip)}, 2), got {scale} and {offsets.shape}; give a row per frame"
        )
    camera = np.repeat(np.diag([scale, scale, 1.0])[None], len(clip), 0)
    camera[:, :2, 2] = -offsets
    shape = clip.size[::-1]
    video = np.stack([_warp(image, m, shape) for image, m in zip(clip.video, camera, strict=True)])
    depths = np.stack([_warp_depth(depth, m, shape) for depth, m in zip(clip.depths, camera, strict=True)])
    if not depths.any():
        raise ValueError(f"reframe: nothing of clip {clip.name!r} is in view; choose offsets nearer to the image")
    intrinsics = (camera @ clip.intrinsics).astype(np.float32)
    visible = None
    if clip.tracks is not None:
        uv, _ = project(clip.tracks.xyz, intrinsics, clip.extrinsics)
        visible = clip.tracks.visible & ((uv >= -0.5) & (uv < np.array(shape) - 0.5)).all(-1)
    return with_visibility(clip, visible, video=video, depths=depths, intrinsics=intrinsics, extras={})


def flip_x(clip: Clip) -> Clip:
    """Mirror left and right.

    No rigid camera sees a world mirrored, so the world is mirrored too, always in its x axis: poses stay rigid, "up"
    stays up in worlds whose x is level, and `flip_x` with `flip_y` leaves the world as it was.
    """
    return _flip(clip, 0)


def flip_y(clip: Clip) -> Clip:
    """Turn upside down by mirroring; the world is mirrored in its x axis as by `flip_x`."""
    return _flip(clip, 1)


def flip_time(clip: Clip) -> Clip:
    """Play backward; every point keeps the frame in which it is asked for."""
    last, tracks, queries = len(clip) - 1, clip.tracks, clip.queries
    if queries is not None:
        queries = queries * np.array([-1, 1, 1, 1], np.float32) + np.array([last, 0, 0, 0], np.float32)
    if tracks is not None:
        logits = tracks.visible_logits
        tracks = Tracks(
            tracks.xyz[::-1], tracks.visible[::-1], queries, None if logits is None else logits[::-1], tracks.dynamic
        )
    frames = {name: getattr(clip, name)[::-1] for name in ("video", "depths", "intrinsics", "extrinsics")}
    return replace(clip, **frames, tracks=tracks, queries=queries, extras={})


def _flip(clip: Clip, axis: int) -> Clip:
    """Mirror pixels in one axis (0: u, 1: v), cameras and world to fit."""
    seen, intrinsics = np.eye(4, dtype=np.float32), clip.intrinsics.copy()
    seen[axis, axis] = -1
    intrinsics[:, axis, 2] = clip.size[1 - axis] - 1 - intrinsics[:, axis, 2]
    intrinsics[:, 0, 1] *= -1  # skew
    queries, tracks = clip.queries, clip.tracks
    if queries is not None:
        queries = queries * np.array([1, -1, 1, 1], np.float32)
    if tracks is not None:
        tracks = replace(tracks, xyz=tracks.xyz * np.array([-1, 1, 1], np.float32), queries=queries)
    return replace(
        clip,
        video=np.flip(clip.video, 2 - axis),
        depths=np.flip(clip.depths, 2 - axis),
        intrinsics=intrinsics,
        extrinsics=seen @ clip.extrinsics @ _MIRROR,
        queries=queries,
        tracks=tracks,
        extras={},
    )


def _warp(image: np.ndarray, matrix: np.ndarray, shape: tuple[int, int], flags: int = cv2.INTER_LINEAR) -> np.ndarray:
    return cv2.warpAffine(image, matrix[:2], shape, flags=flags)


def _warp_depth(depth: np.ndarray, matrix: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
    smooth, nearest = _warp(inverse, matrix, shape), _warp(depth, matrix, shape, cv2.INTER_NEAREST)
    same = np.abs(smooth * nearest - 1) < SAME_SURFACE
    return np.divide(1, smooth, out=nearest, where=same)
