"""Lesson 10: depth from elsewhere. Clips of the benchmark with a second camera, disparities both ways, errors of a depth."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from lessons.n10_exercises import STEREO
from tapip3d_lite.clip import Clip
from tapip3d_lite.depth import stereo_depth
from tapip3d_lite.evaluation.lite_splits import split_file
from tapip3d_lite.lab.conditions import under
from tapip3d_lite.simulate import render_clip
from tapip3d_lite.simulate.degrade import SensorConfig, degrade
from tapip3d_lite.simulate.rollout import Rollout, load_rollouts

BASELINE = 0.2  # metres between the two cameras
SHARE = 0.02  # of the pixels whose depth the sparse points know
SENSOR = SensorConfig(
    flicker=0.003, noise=0.01, grain=0.002, step=0.001, flying=0.5, shadow=2.0, grazing=5.0, dropout=0.05
)
depth_of = STEREO.reference  # in the milestone the learner's stands here


def filmed_twice(rollout: Rollout) -> Clip:
    """A clip filmed by a second camera `BASELINE` to the right as well."""
    return render_clip(replace(rollout, config=replace(rollout.config, stereo_baseline=BASELINE)))


def benchmark_clips(count: int, frames: int, points: int, split: str = "moving-camera") -> list[Clip]:
    """The first clips of a split of the Lite benchmark, filmed by a second camera `BASELINE` to the right as well."""
    clips = []
    for rollout, _ in load_rollouts(split_file(split))[:count]:
        clip = filmed_twice(rollout).cut(0, frames)
        few = np.linspace(0, clip.tracks.xyz.shape[1] - 1, points).astype(int)
        clips.append(replace(clip, tracks=clip.tracks.select(few), queries=None))
    return clips


def sensor(clip: Clip, seed: int) -> np.ndarray:
    """Depth as a poor sensor gives it: noise, flying pixels, a shadow beside silhouettes, holes."""
    return degrade(clip, SENSOR, seed).depths


def stereo(clip: Clip, _seed: int) -> np.ndarray:
    """Depth from the two images, holes filled."""
    return stereo_depth(clip.video, clip.extras["video_right"], clip.intrinsics, BASELINE)


def sparse(clip: Clip, seed: int) -> np.ndarray:
    """True depth of few pixels, spread to their neighbours."""
    return under(clip, {"sparse": SHARE}, seed).depths


def depth_errors(depths: np.ndarray, truth: np.ndarray) -> tuple[float, float, float]:
    """Mean relative error, share that is within 5 %, both of what is known in both; and the share that is known."""
    both = (depths > 0) & (truth > 0)
    error = np.abs(depths[both] / truth[both] - 1)
    return float(error.mean()), float((error < 0.05).mean()), float(both.sum() / (truth > 0).sum())


def disparities(left: np.ndarray, right: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """How far each pixel of two rectified grey images (H, W) uint8 moves to the other, up to `most`: two (H, W) float32.

    By semi-global matching as in the library's `stereo_depth`, before the two are compared; 0 or less is no match.
    """
    count = -(-most // 16) * 16
    matcher = cv2.StereoSGBM.create(0, count, 5, 8 * 25, 32 * 25, 1, 31, 5, 0, 0, cv2.STEREO_SGBM_MODE_HH)

    def found(one: np.ndarray, two: np.ndarray) -> np.ndarray:
        wide = [cv2.copyMakeBorder(image, 0, 0, count, count, cv2.BORDER_REPLICATE) for image in (one, two)]
        return matcher.compute(*wide)[:, count:-count] / np.float32(16)

    turned = [np.ascontiguousarray(image[:, ::-1]) for image in (right, left)]
    return found(left, right), found(*turned)[:, ::-1]


def pair(clip: Clip, t: int, times: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Frame t's two images in grey, enlarged, as matching to a 16th of a pixel is too coarse for so small ones."""
    images = (clip.video[t], clip.extras["video_right"][t])
    grey = (cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY) for image in images)
    return tuple(cv2.resize(x, None, fx=times, fy=times, interpolation=cv2.INTER_CUBIC) for x in grey)
