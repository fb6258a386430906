"""Augmentations that change where things are in the image: pad, resize and crop; mirror; play backward.

Paper: appendix (training). Each changes pixels, cameras and true tracks together, so that a visible point still projects
to the pixel that shows it.
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
    """Keep a query whose point is visible in its frame, move others to the first visible frame, drop hidden points.

    Args:
        tracks: true tracks, after their visibility was changed.
    """
    kept = tracks.select(tracks.visible.any(0))
    queries, columns = kept.queries.copy(), np.arange(kept.xyz.shape[1])
    hidden = ~kept.visible[queries[:, 0].astype(int), columns]
    first = kept.visible.argmax(0)[hidden]
    queries[hidden] = np.concatenate([first[:, None], kept.xyz[first, columns[hidden]]], -1)
    return replace(kept, queries=queries)


def with_visibility(clip: Clip, visible: np.ndarray | None, **changes: object) -> Clip:
    """Change a clip and the visibility (T, N) of its points, and move or drop queries accordingly.

    Queries of a clip without tracks are dropped, since it is unknown which of them are still visible.
    """
    tracks = None if clip.tracks is None else requery(replace(clip.tracks, visible=visible))
    return replace(clip, **changes, tracks=tracks, queries=None if tracks is None else tracks.queries)


def random_view(
    clip: Clip, rng: np.random.Generator, pad: float, scale: tuple[float, float], drift: float
) -> tuple[float, np.ndarray]:
    """Draw padding, a scale and a moving crop of the original size, combined to one map of pixels.

    Args:
        clip: T frames.
        rng: random generator.
        pad: greatest black border of each side, a fraction of the image's width.
        scale: (smallest, greatest) factor of the resizing.
        drift: greatest change of the crop's position from one frame to the next, a fraction of the image's width.

    Returns:
        The scale s and offsets (T, 2) in pixels, for `reframe`.
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
    """Resize and crop a clip to its old size: u' = scale u - offset.

    Depth is interpolated as inverse depth, which is linear in the image on any plane, and only within one surface;
    at an edge between two surfaces the nearest pixel's depth is taken, so that no third surface appears between them.

    Args:
        clip: T frames.
        scale: factor of the resizing.
        offsets: (T, 2) in pixels of the result.

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

    The world is mirrored too, in its x axis, because no rigid camera pose can mirror an image. So poses stay rigid, "up"
    stays up in worlds with a horizontal x axis, and `flip_x` followed by `flip_y` leaves the world as it was.
    """
    return _flip(clip, 0)


def flip_y(clip: Clip) -> Clip:
    """Mirror top and bottom; the world is mirrored in its x axis, as in `flip_x`."""
    return _flip(clip, 1)


def flip_time(clip: Clip) -> Clip:
    """Play backward; each query stays in the same image."""
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
    """Mirror pixels along one axis (0: u, 1: v), and cameras and world accordingly."""
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
