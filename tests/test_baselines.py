"""The trackers without learning, on scenes where the right answer is known."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

import tapip3d_lite as t3d


def sliding_wall(frames=6, size=(64, 80), step=1.5, jumps=False):
    """A textured wall at depth 2 that slides sideways by `step` pixels a frame before a fixed camera."""
    rng = np.random.default_rng(0)
    height, width = size
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (height, 2 * width)).astype(np.float32), (0, 0), 2)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(np.float32)
    frame = [cv2.remap(texture, grid[..., 0] - step * t + 30, grid[..., 1], cv2.INTER_LINEAR) for t in range(frames)]
    video = np.repeat(np.stack(frame)[..., None], 3, -1).round().astype(np.uint8)
    k = np.array([[70, 0, (width - 1) / 2], [0, 70, (height - 1) / 2], [0, 0, 1.0]])
    depths = np.full((frames, height, width), 2.0)
    clip = t3d.Clip(video, depths, np.tile(k, (frames, 1, 1)), np.tile(np.eye(4), (frames, 1, 1)), name="wall")
    rows = [(t, u, v) for t in (0, 3, frames - 1) for u in (25, 40, 55) for v in (20, 40)]
    queries = t3d.queries_from_pixels(clip, rows)
    shift = (np.arange(frames)[:, None] - queries[:, 0]) * step * 2 / 70
    xyz = queries[None, :, 1:] + shift[..., None] * np.array([1, 0, 0])
    return replace(clip, queries=queries, tracks=t3d.Tracks(xyz, np.ones(shift.shape, bool), queries))


def test_klt_follows_a_sliding_wall_in_both_time_directions():
    clip = sliding_wall()
    pred = t3d.load_tracker("klt").track(clip)
    assert pred.visible.all()
    assert np.abs(pred.xyz - clip.tracks.xyz).max() < 0.5 * 2 / 70  # half a pixel at depth 2
    assert t3d.evaluate(pred, clip)["AJ3D"] > t3d.evaluate(t3d.load_tracker("static").track(clip), clip)["AJ3D"] + 0.3


def test_klt_interpolates_where_it_is_lost_and_says_so():
    clip = sliding_wall()
    depths = clip.depths.copy()
    depths[2] = 1.0  # something stands in front for one frame
    pred = t3d.load_tracker("klt").track(replace(clip, depths=depths))
    early = clip.queries[:, 0] < 2
    assert not pred.visible[2, early].any()
    assert pred.visible[:2, early].all()
    held = pred.xyz[2:, early]
    np.testing.assert_array_equal(held, np.broadcast_to(pred.xyz[1, early], held.shape))


def test_klt_finds_a_point_again_and_interpolates_the_gap():
    clip = sliding_wall(step=0.5)
    depths = clip.depths.copy()
    depths[2:4] = 1.0
    pred = t3d.load_tracker("klt").track(replace(clip, depths=depths))
    early = clip.queries[:, 0] < 2
    np.testing.assert_array_equal(pred.visible[:, early].all(1), [True, True, False, False, True, True])
    assert np.abs(pred.xyz - clip.tracks.xyz)[:, early].max() < 0.25 * 2 / 70
    ends = pred.xyz[1, early], pred.xyz[4, early]
    np.testing.assert_allclose(pred.xyz[2, early], (2 * ends[0] + ends[1]) / 3, atol=1e-6)


def test_klt_finds_nothing_where_another_texture_is():
    clip = sliding_wall(step=0.5)
    video = clip.video.copy()
    video[3:] = np.random.default_rng(1).integers(0, 255, video[3:].shape, np.uint8)
    pred = t3d.load_tracker("klt").track(replace(clip, video=video))
    assert pred.visible[3:, clip.queries[:, 0] == 0].mean() < 0.3


def test_klt_forward_only_knows_nothing_before_the_query():
    clip = sliding_wall()
    pred = t3d.load_tracker("klt").track(clip, bidirectional=False)
    before = np.arange(len(clip))[:, None] < clip.queries[:, 0]
    np.testing.assert_array_equal(pred.visible, ~before)
    held = np.broadcast_to(clip.queries[:, 1:], pred.xyz.shape)
    np.testing.assert_array_equal(pred.xyz[before], held[before])


def test_klt_keeps_the_depth_of_the_nearer_surface_at_silhouettes():
    clip = sliding_wall(step=0)
    depths = clip.depths.copy()
    depths[1:, :, 41:] = 9.0  # the pixel right of the query jumps to the background
    pred = t3d.load_tracker("klt").track(replace(clip, depths=depths), t3d.queries_from_pixels(clip, [[0, 40, 30]]))
    np.testing.assert_allclose(pred.xyz[..., 2], 2, atol=1e-5)


def test_static_is_right_on_a_still_scene_and_sees_occlusion():
    clip = sliding_wall(step=0)
    pred = t3d.load_tracker("static").track(clip)
    assert t3d.evaluate(pred, clip)["AJ3D_none"] == 1
    depths = clip.depths.copy()
    depths[1, :, :50] = 1.0
    pred = t3d.load_tracker("static").track(replace(clip, depths=depths))
    u = np.rint(t3d.geometry.project(clip.queries[:, 1:], clip.intrinsics[0])[0][:, 0])
    np.testing.assert_array_equal(pred.visible[1], u >= 50)
    depths[1, :, :50] = 3.0  # what the points lay on has gone
    pred = t3d.load_tracker("static").track(replace(clip, depths=depths))
    np.testing.assert_array_equal(pred.visible[1], u >= 50)


def test_klt_beats_static_on_moving_bodies():
    moving = []
    for seed in (1, 2):
        clip = t3d.simulate_clip(seed=seed, frames=12)
        moving.append(
            [t3d.evaluate(t3d.load_tracker(n).track(clip), clip)["AJ3D_none_dynamic"] for n in ("klt", "static")]
        )
    klt, static = np.mean(moving, axis=0)
    assert klt > static


@pytest.mark.parametrize("name", ["klt", "static"])
def test_baselines_take_the_arguments_of_track(name):
    clip = sliding_wall(frames=4)
    tracker = t3d.load_tracker(name)
    queries = t3d.grid_queries(clip, 3)
    pred = tracker.track(clip, queries, space="camera", iterations=2, support_grid=0, visible_threshold=0.5)
    assert pred.xyz.shape == (4, 9, 3)
    np.testing.assert_allclose(pred.xyz[0], queries[:, 1:], atol=1e-6)
    without = replace(clip, queries=None, tracks=None)
    assert tracker.track(without).xyz.shape[1] == 16 * 16
    assert tracker.track(clip.cut(0, 1)).xyz.shape[0] == 1
    with pytest.raises(TypeError, match="visible_treshold"):
        tracker.track(clip, visible_treshold=0.5)


def test_names():
    assert {"static", "klt"} <= set(t3d.list_trackers())
    with pytest.raises(ValueError, match="static"):
        t3d.load_tracker("nonsense")
