"""A world whose origin is far away gives the same tracks, moved; a frame without depth is met in one way."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

import tapip3d_lite as t3d
from tapip3d_lite.queries import near_origin
from tests.tiny import untrained


@pytest.fixture(scope="module")
def clip():
    return t3d.simulate_clip(seed=3, frames=10, size=(32, 32), tracks=12)


@pytest.fixture(scope="module")
def tracker():
    return untrained()


def moved(clip, offset):
    """The clip in a world whose origin lies elsewhere, in float64."""
    poses = clip.extrinsics.astype(np.float64)
    poses[:, :3, 3] -= poses[:, :3, :3] @ offset
    queries = clip.queries + np.r_[0, offset]
    return replace(clip, extrinsics=poses, queries=queries, tracks=None)


OFFSETS = [(2e3, 0, 0), (0, -1e4, 2e3), (1e5, -3e5, 0), (5e5, 4_649_700.0, 1e6)]


@pytest.mark.parametrize("offset", OFFSETS, ids=str)
@pytest.mark.parametrize("space", ["world", "camera"])
def test_tracks_move_with_the_world(clip, tracker, offset, space):
    offset = np.array(offset)
    near, far = (
        tracker.track(x, space=space, support_grid=3) for x in (replace(clip, tracks=None), moved(clip, offset))
    )
    assert near.xyz.dtype == np.float32 and far.xyz.dtype == np.float64
    np.testing.assert_allclose(far.xyz - offset, near.xyz, atol=2e-5)
    np.testing.assert_array_equal(far.visible, near.visible)
    np.testing.assert_allclose(far.queries, moved(clip, offset).queries, rtol=0, atol=1e-9)


def test_a_stream_moves_with_the_world(clip, tracker):
    offset, tracks = np.array([1e5, -3e5, 0]), []
    for x in (clip, moved(clip, offset)):
        stream = tracker.stream(x.queries, support_grid=3)
        for i in range(len(x)):
            stream.push(x.video[i], x.depths[i], x.intrinsics[i], x.extrinsics[i])
        tracks.append(stream.finish())
    np.testing.assert_allclose(tracks[1].xyz - offset, tracks[0].xyz, atol=2e-5)
    np.testing.assert_array_equal(tracks[0].visible, tracks[1].visible)


def test_baselines_and_scores_move_with_the_world(clip):
    offset = np.array([1e5, -3e5, 0])
    for name in ("static", "klt"):
        near, far = (t3d.load_tracker(name).track(x) for x in (clip, moved(clip, offset)))
        np.testing.assert_allclose(far.xyz - offset, near.xyz, atol=2e-5)


def test_a_file_keeps_the_places(clip, tmp_path):
    far = moved(clip, np.array([5e5, 4_649_700.0, 1e6]))
    far.save(tmp_path / "c.npz")
    again = t3d.load_clip(tmp_path / "c.npz")
    np.testing.assert_array_equal(again.extrinsics, far.extrinsics)
    np.testing.assert_array_equal(again.queries, far.queries)


def test_most_worlds_stay_as_they_are(clip):
    assert near_origin(clip)[0] is clip
    for factor in (1e-3, 1.0, 1e3):  # units change nothing
        scaled = replace(clip, depths=clip.depths * factor, extrinsics=_scaled(clip, factor), queries=None, tracks=None)
        assert not near_origin(scaled)[1].any()


def _scaled(clip, factor):
    poses = clip.extrinsics.astype(np.float64)
    poses[:, :3, 3] *= factor
    return poses


@pytest.mark.parametrize("frame", [0, 4, 9])
def test_a_frame_without_depth_is_met_in_one_way(clip, tracker, frame, monkeypatch):
    depths = clip.depths.copy()
    depths[frame] = 0
    queries = clip.queries[clip.queries[:, 0] != frame]
    dark = replace(clip, depths=depths, tracks=None, queries=queries)
    whole = tracker.track(dark, support_grid=2)
    monkeypatch.setattr("tapip3d_lite.model.track._KEPT", 0)  # as for long clips
    streamed = tracker.track(dark, support_grid=2)
    np.testing.assert_allclose(streamed.xyz, whole.xyz, atol=1e-2)
    stream = tracker.stream(queries)
    for i in range(len(dark)):
        stream.push(dark.video[i], dark.depths[i], dark.intrinsics[i], dark.extrinsics[i])
    pushed = stream.finish()
    forward = tracker.track(dark, support_grid=0, bidirectional=False, depth_roi=None)
    np.testing.assert_allclose(pushed.xyz, forward.xyz, atol=1e-2)


def test_a_clip_without_any_depth_is_refused(clip, tracker):
    with pytest.raises(ValueError, match="no valid pixel in the whole clip"):
        replace(clip, depths=0 * clip.depths, tracks=None, queries=None)
    one = replace(clip.cut(0, 1), depths=0 * clip.depths[:1], tracks=None, queries=np.zeros((0, 4)))
    with warnings.catch_warnings(), pytest.raises(ValueError, match="depth"):
        tracker.track(replace(one, queries=clip.queries[clip.queries[:, 0] == 0]))
