"""What `track` and `stream` promise whatever the weights are: short clips, honest visibility, other sizes, a crop."""

import numpy as np
import pytest
import torch

import tapip3d_lite as t3d
from tapip3d_lite.geometry import in_image, project, unproject
from tapip3d_lite.model.frames import crop_clip
from tapip3d_lite.simulate import simulate_clip


@pytest.fixture(scope="module")
def lite():
    return t3d.load_tracker("lite")


@pytest.fixture(scope="module")
def clip():
    return simulate_clip(seed=3, camera="handheld", frames=12, tracks=24)


def cut(clip, count):
    queries = clip.queries[clip.queries[:, 0] < count]
    return t3d.Clip(clip.video[:count], clip.depths[:count], clip.intrinsics[:count], clip.extrinsics[:count]), queries


def streamed(tracker, clip, queries, **options):
    stream = tracker.stream(queries, **options)
    for t in range(len(clip)):
        stream.push(clip.video[t], clip.depths[t], clip.intrinsics[t], clip.extrinsics[t])
    return stream.finish()


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8, 9])
def test_clips_of_any_length_are_tracked(lite, clip, count):
    part, queries = cut(clip, count)
    pred = lite.track(part, queries)
    assert pred.xyz.shape == (count, len(queries), 3) and pred.visible_logits.shape == pred.visible.shape
    assert (pred.visible_logits != 0).all()  # every frame of every track was solved by some window
    forward = lite.track(part, queries, bidirectional=False, depth_roi=None)
    online = streamed(lite, part, queries)
    gap = np.abs(online.xyz - forward.xyz)  # a rounding may pick another neighbour
    assert np.median(gap) < 1e-4 and gap.max() < 0.1
    assert (online.visible == forward.visible).mean() > 0.99


def test_a_clip_of_a_few_frames_follows_what_moves(lite):
    """Two frames of a sliding picture: a tracker that rests would be wrong by all of the motion."""
    clip = simulate_clip(seed=1, camera="static", frames=8, tracks=64)
    part, _ = cut(clip, 3)
    queries = np.concatenate([np.zeros((64, 1)), clip.tracks.xyz[0]], -1).astype(np.float32)
    moved = np.linalg.norm(clip.tracks.xyz[2] - clip.tracks.xyz[0], axis=-1)
    which = clip.tracks.visible[:3].all(0) & (moved > 0.02)
    assert which.sum() >= 3
    error = np.linalg.norm(lite.track(part, queries[which]).xyz[2] - clip.tracks.xyz[2, which], axis=-1)
    assert np.median(error / moved[which]) < 0.5


@pytest.mark.parametrize("bidirectional", [True, False])
def test_visible_is_never_claimed_where_nothing_can_be_seen(lite, clip, bidirectional):
    """Threshold 0 makes every logit say visible: what is left hidden is hidden by construction."""
    queries = clip.queries.copy()
    queries[:, 0] = np.arange(len(queries)) % len(clip)
    queries[:, 1:] = clip.tracks.xyz[queries[:, 0].astype(int), np.arange(len(queries))]
    pred = lite.track(clip, queries, visible_threshold=0.0, bidirectional=bidirectional)
    uv, z = project(pred.xyz, clip.intrinsics, clip.extrinsics)
    inside = (z > 0) & ((uv > -0.5) & (uv < np.array(clip.size[::-1]) - 0.5)).all(-1)
    begun = np.arange(len(clip))[:, None] >= queries[:, 0]
    assert (pred.visible == (inside & (begun | bidirectional))).all()
    assert not inside.all() and inside.any()
    if not bidirectional:
        online = streamed(lite, clip, queries, visible_threshold=0.0)
        assert not online.visible[~begun].any() and (online.visible == pred.visible).mean() > 0.99


def test_points_behind_the_camera_are_hidden():
    k, e = np.array([[10.0, 0, 4.5], [0, 10, 4.5], [0, 0, 1]])[None], np.eye(4)[None]
    uv = np.array([[[-0.4, 0], [-0.6, 0], [9.4, 9.4], [9.6, 5], [5, 9.6]]])
    points = unproject(uv, np.ones(uv.shape[:2]), k, e)
    assert in_image(points, k, e, (10, 10)).tolist() == [[True, False, True, False, False]]
    assert not in_image(-points, k, e, (10, 10)).any()
    assert in_image(torch.from_numpy(points), torch.from_numpy(k), torch.from_numpy(e), (10, 10)).sum() == 2


@pytest.mark.parametrize("size", [(96, 96), (160, 160), (192, 108), (100, 132)])
def test_any_image_size(lite, clip, size):
    before = lite.config
    pred = lite.track(clip, size=size)
    assert lite.config is before and np.isfinite(pred.xyz).all()
    scores = t3d.evaluate(pred, clip)
    assert scores["AJ3D_none"] > 0.4


def test_a_size_that_is_too_small_is_named(lite, clip):
    with pytest.raises(ValueError, match="fewer than K"):
        lite.track(clip, size=(16, 16))


def test_a_crop_looks_at_its_pixels_only(lite, clip):
    box = (32, 16, 112, 120)
    part = crop_clip(clip, box)
    assert part.size == (104, 80) and (part.video == clip.video[:, 16:120, 32:112]).all()
    before, after = (project(clip.tracks.xyz, c.intrinsics, c.extrinsics)[0] for c in (clip, part))
    assert np.allclose(before - after, (32, 16), atol=1e-3)
    at = clip.queries[:, 0].astype(int)
    uv = before[at, np.arange(len(at))]
    queries = clip.queries[((uv > box[:2]) & (uv < np.array(box[2:]) - 1)).all(-1)]
    pred = lite.track(clip, queries, crop=box)
    assert len(queries) >= 5 and np.array_equal(pred.xyz, lite.track(part, queries).xyz)
    uv, _ = project(pred.xyz, clip.intrinsics, clip.extrinsics)
    assert not pred.visible[(uv < np.array(box[:2]) - 0.51).any(-1) | (uv > np.array(box[2:]) - 0.49).any(-1)].any()


def test_a_crop_makes_a_small_object_large(lite):
    """The whole image at a quarter of the pixels against its middle at all of them."""
    large = simulate_clip(seed=8, camera="static", frames=8, size=(256, 256), tracks=192)
    uv, _ = project(large.tracks.xyz, large.intrinsics, large.extrinsics)
    mine = large.tracks.visible.all(0) & ((uv > 70) & (uv < 186)).all((0, 2)) & large.tracks.dynamic
    queries = np.concatenate([np.zeros((mine.sum(), 1)), large.tracks.xyz[0, mine]], -1).astype(np.float32)
    error = {
        crop: np.linalg.norm(
            lite.track(large, queries, crop=crop, size=(128, 128)).xyz - large.tracks.xyz[:, mine], axis=-1
        ).mean()
        for crop in (None, (64, 64, 192, 192))
    }
    assert mine.sum() >= 8 and error[64, 64, 192, 192] < error[None]


@pytest.mark.parametrize("box", [(0, 0, 129, 10), (-1, 0, 5, 5), (5, 5, 5, 9), (9, 0, 5, 5)])
def test_a_crop_outside_the_image_is_refused(lite, clip, box):
    with pytest.raises(ValueError, match="crop: expected"):
        lite.track(clip, crop=box)


def test_released_weights_keep_the_released_visibility(clip):
    config = t3d.TrackerConfig.preset("lite", as_released=True, neighbors=4)
    torch.manual_seed(0)
    tracker = t3d.Tracker(config).eval()
    assert tracker.track(clip, visible_threshold=0.0).visible.all()
    assert streamed(tracker, clip, clip.queries, visible_threshold=0.0).visible.all()
