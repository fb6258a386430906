"""Tracking one clip as a user wants it: any image size, both directions in time, helped by a grid of other points.

    forward pass  from t = 0 on;  backward pass on the reversed clip, for the frames before each query
    visible       sigmoid(v) >= threshold, inside the image, and not before a query that is only tracked forward

Paper: section 4 (protocol: a grid of support queries, a second pass backward in time); the region of interest of depth
is the released code's.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.geometry import in_image
from tapip3d_lite.measures import warn_of_misfit
from tapip3d_lite.model.cloud import quantile_roi
from tapip3d_lite.model.config import INTERCHANGEABLE, TrackerConfig
from tapip3d_lite.model.frames import Frames, crop_clip, frames_from_clip, resize_clip
from tapip3d_lite.queries import near_origin, resolve_queries, shifted, support_queries
from tapip3d_lite.validate import checked

_KEPT = 2**27  # floats of features kept for a whole clip (512 MiB); of longer clips only a window's are


@checked
@torch.no_grad()
def track(
    tracker: nn.Module,
    clip: Clip,
    queries: np.ndarray | None = None,
    space: str | None = None,
    iterations: int | None = None,
    support_grid: int | None = None,
    bidirectional: bool = True,
    depth_roi: str | tuple[float, float] | None = "auto",
    visible_threshold: float | None = None,
    size: tuple[int, int] | None = None,
    crop: tuple[int, int, int, int] | None = None,
    progress: bool = False,
) -> Tracks:
    """Track points through a clip.

    Both directions share one run of the encoder, unless the features of the whole clip would take too much memory:
    then frames are streamed, and encoded again for the way back. The numbers are the same.

    Args:
        tracker: a `Tracker`.
        clip: T frames of any image size; resized to the model's.
        queries: (N, 4) rows (t, x, y, z), world; None: the clip's own, else a grid on the first frame.
        space: `"camera"` or `"world"` in place of the config's, if that is one of the two.
        iterations: M, the config's if None.
        support_grid: side of a grid of extra queries on the first frame (on the last one for the backward pass) that
            are tracked along and dropped; 0: none; None: the config's.
        bidirectional: also track backward from queries after the first frame; otherwise frames before a query hold
            whatever the first window that contains it says.
        depth_roi: depths (near, far) that count for the scale; `"auto"`: up to q75 + 1.5 IQR of the clip; None: all.
        visible_threshold: a point inside the image is visible from this probability on; the config's if None.
        size: (H, W) to resize images to, in place of the size that the tracker was trained at.
        crop: (left, top, right, bottom), the pixels that are looked at; what lies outside is hidden. A small object
            gains from it.
        progress: show a bar.

    Returns:
        The tracks in world coordinates, in the order of the queries.

    Raises:
        ValueError: queries outside the clip, a space that the model was not made for, or a bad option.
    """
    support_grid = tracker.config.support_grid if support_grid is None else support_grid
    threshold = check_options(tracker, space, depth_roi, visible_threshold, support_grid)
    if size is not None:
        tracker = copy.copy(tracker)  # with the same weights
        tracker.config = tracker.config.replace(image_size=size)
    asked, count = resolve_queries(clip, queries), len(clip)
    clip, shift = near_origin(clip)
    queries = shifted(asked, shift)
    warn_of_misfit(clip)
    clip = _prepared(clip, tracker.config, crop)
    roi = quantile_roi(torch.from_numpy(clip.depths)) if isinstance(depth_roi, str) else depth_roi
    options = {"iterations": iterations, "space": space, "depth_roi": roi}
    ends = (0, len(clip) - 1)
    grids = [support_queries(clip, support_grid, frame) if support_grid else queries[:0] for frame in ends]
    backward = bidirectional and bool((queries[:, 0] > 0).any())
    ways, begun = _ways(tracker, clip), np.arange(len(clip))[:, None] >= queries[:, 0]  # (T, N)
    with _bar(progress, tracker, len(clip), iterations, 1 + backward) as bar:
        options["watch"] = lambda _: bar.update()
        xyz, logits = _one_way(ways[0], queries, grids[0], options)
        if backward:
            flipped = [_flip_time(rows, len(clip)) for rows in (queries, grids[1])]
            other = _one_way(ways[1], *flipped, options)
            xyz = np.where(begun[..., None], xyz, other[0][::-1])
            logits = np.where(begun, logits, other[1][::-1])
    cameras = clip.intrinsics, clip.extrinsics
    visible = visibility(logits, threshold, xyz, *cameras, bidirectional | begun, tracker.config)
    return Tracks(xyz[:count] + shift, visible[:count], asked, logits[:count])


def visibility(
    logits: np.ndarray,
    threshold: float,
    xyz: np.ndarray,
    intrinsics: np.ndarray,
    extrinsics: np.ndarray,
    tracked: np.ndarray,
    config: TrackerConfig,
) -> np.ndarray:
    """Which of the points (T, N, 3) are visible: by their logits, and unless `as_released` also in the image and `tracked`."""
    visible = 1 / (1 + np.exp(-logits.astype(np.float64))) >= threshold
    if config.as_released:
        return visible
    return visible & tracked & in_image(xyz, intrinsics, extrinsics, config.image_size)


def _prepared(clip: Clip, config: TrackerConfig, crop: tuple[int, int, int, int] | None) -> Clip:
    """The clip as the model takes it; one that is too short for a window repeats its last frame until there is one."""
    clip = resize_clip(clip if crop is None else crop_clip(clip, crop), config.image_size, config.as_released)
    if len(clip) > config.window // 2:
        return clip
    index = np.arange(config.window).clip(max=len(clip) - 1)
    return Clip(*(x[index] for x in (clip.video, clip.depths, clip.intrinsics, clip.extrinsics)))


def _ways(tracker: nn.Module, clip: Clip) -> list[Callable[..., tuple[np.ndarray, np.ndarray]]]:
    """Functions of (rows, **options) that track forward and backward in time."""
    config = tracker.config
    cells = math.prod(side // config.stride for side in config.image_size)
    if len(clip) * config.feature_dim * cells > _KEPT:
        return [partial(_streamed, tracker, clip, range(len(clip))[::step]) for step in (1, -1)]
    frames = frames_from_clip(clip, device=next(tracker.parameters()).device)
    features = tracker.encoder(frames.rgb)
    return [partial(_at_once, tracker, *pair) for pair in ((frames, features), (frames.flip(), features.flip(1)))]


def _at_once(
    tracker: nn.Module, frames: Frames, features: Tensor, rows: np.ndarray, **options: Any
) -> tuple[np.ndarray, np.ndarray]:
    queries = torch.from_numpy(rows).to(frames.depths.device)
    xyz, logits = tracker(frames, queries[None], features=features, **options)
    return xyz[0].cpu().numpy(), logits[0].cpu().numpy()


def _streamed(
    tracker: nn.Module, clip: Clip, order: range, rows: np.ndarray, **options: Any
) -> tuple[np.ndarray, np.ndarray]:
    stream = tracker.stream(rows, **options)
    for i in order:
        stream.push(clip.video[i], clip.depths[i], clip.intrinsics[i], clip.extrinsics[i])
    tracks = stream.finish()
    return tracks.xyz, tracks.visible_logits


def _one_way(way: Callable, queries: np.ndarray, grid: np.ndarray, options: dict) -> tuple[np.ndarray, np.ndarray]:
    xyz, logits = way(np.concatenate([queries, grid]).astype(np.float32), **options)
    return xyz[:, : len(queries)], logits[:, : len(queries)]


def _flip_time(rows: np.ndarray, frames: int) -> np.ndarray:
    rows = rows.copy()
    rows[:, 0] = frames - 1 - rows[:, 0]
    return rows


def _bar(show: bool, tracker: nn.Module, frames: int, iterations: int | None, passes: int) -> Any:
    from tqdm.auto import tqdm

    windows = -(-frames // (tracker.config.window // 2)) - 1
    total = windows * (iterations or tracker.config.iterations) * passes
    return tqdm(total=total, disable=not show, desc="tracking")


def check_options(tracker: nn.Module, space: Any, roi: Any, threshold: float | None, grid: int) -> float:
    """The threshold of visibility; ValueError where an option of `track` cannot be honoured."""
    own = tracker.config.space
    if space not in (None, own) and not (own in INTERCHANGEABLE and space in INTERCHANGEABLE):
        raise ValueError(
            f"space: this tracker is for {own!r}, got {space!r}; only camera, world and first are exchangeable"
        )
    if isinstance(roi, str) and roi != "auto":
        raise ValueError(f'depth_roi: expected "auto", None or (near, far), got {roi!r}')
    threshold = tracker.config.visible_threshold if threshold is None else threshold
    if not 0 <= threshold <= 1:
        raise ValueError(f"visible_threshold: expected a probability in [0, 1], got {threshold}")
    if grid < 0:
        raise ValueError(f"support_grid: expected 0 or more, got {grid}")
    return threshold
