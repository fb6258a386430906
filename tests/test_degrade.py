"""Sensor-like depth and wrong poses: seeded, as strong as said, and true tracks stay true."""

from dataclasses import replace

import numpy as np
import pytest

import tapip3d_lite as t3d
from tapip3d_lite.geometry import project, transform
from tapip3d_lite.simulate.degrade import SensorConfig, degrade, wrong_poses


@pytest.fixture(scope="module")
def clip():
    return t3d.simulate_clip(3, frames=6, size=(64, 80), tracks=40)


def ratio(clip, config):
    """Degraded depth over true depth, where both are known."""
    new = degrade(clip, config, 1).depths
    both = (new > 0) & (clip.depths > 0)
    return np.where(both, new / np.maximum(clip.depths, 1e-6), np.nan)


def test_no_flaw_changes_nothing(clip):
    same = degrade(clip, SensorConfig())
    assert np.array_equal(same.depths, clip.depths) and np.array_equal(same.video, clip.video)


def test_the_same_seed_gives_the_same_clip(clip):
    config = SensorConfig.draw(np.random.default_rng(0), share=1.0)
    one, other, third = (degrade(clip, config, seed).depths for seed in (5, 5, 6))
    assert np.array_equal(one, other) and not np.array_equal(one, third)


def test_strengths_are_what_they_say(clip):
    assert np.nanstd(ratio(clip, SensorConfig(noise=0.05))) == pytest.approx(0.05, rel=0.05)
    frames = ratio(clip, SensorConfig(flicker=0.02))
    assert np.allclose(np.nanstd(frames, axis=(1, 2)), 0, atol=1e-5) and 0.005 < np.nanstd(frames) < 0.05
    error = (degrade(clip, SensorConfig(grain=0.01), 1).depths - clip.depths) / np.maximum(clip.depths, 1e-6) ** 2
    assert np.std(error[clip.depths > 0]) == pytest.approx(0.01, rel=0.05)
    lost = (degrade(clip, SensorConfig(dropout=0.3), 1).depths == 0) & (clip.depths > 0)
    assert lost.sum() / (clip.depths > 0).sum() == pytest.approx(0.3, abs=0.02)
    steps = 1 / degrade(clip, SensorConfig(step=0.01)).depths[clip.depths > 0] / 0.01
    assert np.allclose(steps, np.rint(steps), atol=1e-3)


def test_flaws_sit_at_silhouettes_and_grazing_surfaces(clip):
    depths = clip.depths
    jump = np.abs(np.diff(depths, axis=2, prepend=depths[:, :, :1])) / depths > 0.15
    for config in (SensorConfig(flying=1.0), SensorConfig(shadow=3)):
        changed = degrade(clip, config, 1).depths != depths
        assert 0 < changed.mean() < 0.5 and changed[jump].mean() > 2 * changed.mean()
    flying = degrade(clip, SensorConfig(flying=1.0), 1).depths
    assert flying.min() >= depths.min() - 1e-6 and flying.max() <= depths.max() + 1e-6
    floor = replace(clip, depths=np.broadcast_to(1.5 / np.linspace(0.05, 1, 64)[:, None], depths.shape))
    lost = degrade(floor, SensorConfig(grazing=20)).depths == 0
    assert lost[:, 3].all() and not lost[:, -3].any()  # far rows of a floor are seen at a grazing angle


def test_blur_changes_images_only(clip):
    soft = degrade(clip, SensorConfig(blur=2))
    assert np.array_equal(soft.depths, clip.depths)
    assert (
        np.abs(np.diff(soft.video.astype(float), axis=2)).mean()
        < 0.7 * np.abs(np.diff(clip.video.astype(float), axis=2)).mean()
    )


def test_never_without_any_depth(clip):
    assert degrade(clip, SensorConfig(dropout=1.0)).depths.any()


def test_wrong_poses_keep_what_each_camera_sees(clip):
    wrong = wrong_poses(clip, 1.0, 2)
    for one, other in ((clip, wrong), (wrong, clip)):
        assert not np.allclose(one.extrinsics, other.extrinsics)
    uv, z = project(clip.tracks.xyz, clip.intrinsics, clip.extrinsics)
    uv2, z2 = project(wrong.tracks.xyz, wrong.intrinsics, wrong.extrinsics)
    np.testing.assert_allclose(uv2, uv, atol=0.01)
    np.testing.assert_allclose(z2, z, atol=1e-3)
    turn = wrong.extrinsics[:, :3, :3] @ clip.extrinsics[:, :3, :3].swapaxes(1, 2)
    angle = np.degrees(np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert 0.1 < np.sqrt(np.mean(angle**2)) < 3
    still = clip.tracks.xyz[:, ~clip.tracks.dynamic]
    assert np.ptp(still, axis=0).max() < 1e-4 < np.ptp(wrong.tracks.xyz[:, ~clip.tracks.dynamic], axis=0).max()
    at = wrong.queries[:, 0].astype(int)
    np.testing.assert_allclose(wrong.queries[:, 1:], wrong.tracks.xyz[at, np.arange(len(at))], atol=1e-4)
    assert transform(wrong.tracks.xyz, wrong.extrinsics).shape == clip.tracks.xyz.shape


@pytest.mark.parametrize("bad", [{"noise": -1}, {"dropout": 1.5}, {"grazing": 91}])
def test_bad_strengths_are_refused(bad):
    with pytest.raises(ValueError, match=f"SensorConfig.{next(iter(bad))}"):
        SensorConfig(**bad)
