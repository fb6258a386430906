"""Lesson 07's measurements: errors in pixels, scores by threshold, changed predictions, and what intervals promise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

import tapip3d_lite as t3d
from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.geometry import RASTER, in_image, invert, transform

Array = np.ndarray


def errors(pred: Tracks, clip: Clip) -> tuple[Array, Array, Array, Array]:
    """How far off a prediction is, as the 3D metrics see it.

    Returns:
        The error (T, N) in pixels of a raster of 256 at the true depth; truth and prediction (T, N, 3) in the camera of
        their frame; the focal length (T,) on that raster.
    """
    p, q = (transform(tracks.xyz.astype(float), clip.extrinsics) for tracks in (clip.tracks, pred))
    focal = np.sqrt(clip.intrinsics[:, 0, 0] * clip.intrinsics[:, 1, 1]).astype(float) * RASTER / min(clip.size)
    return np.linalg.norm(q - p, axis=-1) * focal[:, None] / p[..., 2], p, q, focal


def by_threshold(preds: Sequence[Tracks], clips: Sequence[Clip], score: str = "within") -> Array:
    """APD_k (`"within"`) or J_k (`"jaccard"`) of moving points for the five thresholds, mean over clips: (5,)."""
    rows = []
    for pred, clip in zip(preds, clips, strict=True):
        _, p, q, focal = errors(pred, clip)
        lens = np.zeros((len(clip), 3, 3))
        lens[:, 0, 0] = lens[:, 1, 1] = focal
        moving = clip.tracks.dynamic
        flags = clip.tracks.visible[:, moving], pred.visible[:, moving]
        found = t3d.tapvid3d_metrics(p[:, moving], flags[0], q[:, moving], flags[1], lens, scaling="none")
        rows.append([value for name, value in found.items() if name.startswith(score)])
    return np.mean(rows, axis=0)


def shuffled(pred: Tracks, seed: int = 0) -> Tracks:
    """A prediction with its tracks handed to other points: each is some point's track, and none its own."""
    shift = np.random.default_rng(seed).permutation(pred.xyz.shape[1])
    to = np.empty_like(shift)
    to[shift] = np.roll(shift, 1)  # one long circle, so no track stays
    return replace(pred, xyz=pred.xyz[:, to], visible=pred.visible[:, to], visible_logits=None)


def spoken(pred: Tracks, clip: Clip, threshold: float) -> Tracks:
    """A prediction that calls a point visible from another probability on, if it lies in the image."""
    logits = pred.visible_logits.astype(float)
    inside = in_image(pred.xyz, clip.intrinsics, clip.extrinsics, clip.size)
    return replace(pred, visible=inside & (1 / (1 + np.exp(-logits)) >= threshold))


def unscaled(clip: Clip, points: Array) -> Tracks:
    """Tracks with the truth's visibility at other places, (T, N, 3) in the camera of each frame."""
    return replace(clip.tracks, xyz=transform(points, invert(clip.extrinsics.astype(float))))


def coverage(clips: Sequence[Sequence[Array]], count: int, rounds: int = 1000, seed: int = 0) -> dict[str, float]:
    """How often a 95 % interval holds the true mean, by what it takes for independent: moments, tracks or clips.

    The world is made of these clips, so its true mean is known; each round draws `count` of them with replacement.

    Args:
        clips: for each clip its tracks, for each track its scores at the moments that count.
        count: clips that a round sees.
        rounds: how often.
        seed: of the draws.
    """
    rng = np.random.default_rng(seed)
    means = [np.array([moments.mean() for moments in tracks]) for tracks in clips]
    flat = [np.concatenate(tracks) for tracks in clips]
    units = {"moments": flat, "tracks": means, "clips": [np.array([m.mean()]) for m in means]}
    held = dict.fromkeys(units, 0)
    for _ in range(rounds):
        drawn = rng.integers(len(clips), size=count)
        for name, values in units.items():
            sample = np.concatenate([values[i] for i in drawn])
            half = 1.96 * sample.std(ddof=1) / len(sample) ** 0.5
            held[name] += abs(sample.mean() - np.concatenate(values).mean()) <= half
    return {name: hits / rounds for name, hits in held.items()}
