"""Streaming equals offline tracking; the recorder shows what the tracker really computed."""

import numpy as np
import pytest
import torch

import tapip3d_lite as t3d
from tapip3d_lite.model.frames import frames_from_clip
from tapip3d_lite.model.recorder import Recorder

SMALL = {"image_size": (48, 48), "window": 4, "levels": 2, "neighbors": 4, "iterations": 2}


@pytest.fixture(scope="module")
def tracker():
    torch.manual_seed(0)
    return t3d.Tracker(t3d.TrackerConfig.preset("lite", **SMALL)).eval()


@pytest.fixture(scope="module")
def clip():
    return t3d.simulate_clip(seed=3, frames=11, size=(48, 48), tracks=24)


def feed(stream, clip):
    return [
        u
        for t in range(len(clip))
        if (u := stream.push(clip.video[t], clip.depths[t], clip.intrinsics[t], clip.extrinsics[t]))
    ]


def offline_frame_by_frame(tracker, clip, **options):
    """The offline forward pass with each frame encoded alone, as a stream must.

    Convolutions round differently for other batch sizes, and an untrained tracker amplifies one such ulp about 300
    times per update; with equal features nothing but the streaming itself is compared.
    """
    frames = frames_from_clip(clip)
    with torch.no_grad():
        features = torch.cat([tracker.encoder(frames.rgb[:, t : t + 1]) for t in range(len(frames))], 1)
        xyz, logits = tracker(frames, torch.from_numpy(clip.queries)[None], features=features, **options)
    return xyz[0].numpy(), logits[0].numpy()


@pytest.mark.parametrize("space", ["world", "camera"])
@pytest.mark.parametrize("frames", [2, 3, 8, 11])
def test_stream_equals_offline(tracker, clip, space, frames):
    part = clip.cut(0, frames)
    options = {"space": space, "depth_roi": (0.5, 9.0)}
    xyz, logits = offline_frame_by_frame(tracker, part, **options)
    stream = tracker.stream(part.queries, **options)
    updates = feed(stream, part)
    result = stream.finish()
    np.testing.assert_allclose(result.xyz, xyz, atol=1e-5)
    np.testing.assert_allclose(result.visible_logits, logits, atol=1e-5)
    offline = tracker.track(part, support_grid=0, bidirectional=False, **options)
    np.testing.assert_allclose(result.xyz, offline.xyz, atol=0.1)
    assert len(updates) == max(0, (frames - 4) // 2 + 1)
    assert all(len(u.xyz) == 4 for u in updates)
    if frames % 2 == 0 and updates:
        np.testing.assert_array_equal(updates[-1].xyz, result.xyz[-4:])


def test_stream_in_pixel_space(clip):
    torch.manual_seed(0)
    tracker = t3d.Tracker(t3d.TrackerConfig.preset("lite", **SMALL, space="uv", neighborhood="window")).eval()
    stream = tracker.stream(clip.queries)
    feed(stream, clip)
    np.testing.assert_allclose(stream.finish().xyz, offline_frame_by_frame(tracker, clip)[0], atol=1e-5)


def test_stream_without_frames_or_with_a_bad_frame(tracker, clip):
    stream = tracker.stream(clip.queries)
    assert stream.finish().xyz.shape == (0, 24, 3)
    with pytest.raises(ValueError, match=r"Clip\.depths"):
        stream.push(clip.video[0], clip.depths[0][:-1], clip.intrinsics[0], clip.extrinsics[0])


def test_recorder_shows_what_was_computed(tracker, clip):
    columns = [1, 7]
    options = {"support_grid": 0, "bidirectional": False}
    plain = tracker.track(clip, **options)
    with Recorder(tracker, columns) as record:
        watched = tracker.track(clip, **options)
    np.testing.assert_array_equal(plain.xyz, watched.xyz)
    assert len(record.steps) % 2 == 0
    last = record.steps[-1]
    count = tracker.config.neighbors
    assert len(last.levels) == 2
    for level in last.levels:
        assert level.support_from_context.shape == (4, 2, count + 1, count)
        assert level.context_from_support.shape == (4, 2, count, count + 1)
        assert level.pool_support.shape == (4, 2, count + 1)
        for weights in (level.support_from_context, level.context_from_support, level.pool_support, level.pool_context):
            torch.testing.assert_close(weights.sum(-1), torch.ones(weights.shape[:-1]))
        assert level.near.indices.shape == (4, 2, count)
    # The recorded attention reproduces the context's own output, which stands in the recorded token.
    level = last.levels[0]
    pair = tracker.context.pairs[0]
    with torch.no_grad():
        support = level.support_tokens.expand(4, -1, -1, -1).flatten(0, 1)
        out = pair(support, level.context_tokens.flatten(0, 1)).unflatten(0, (4, 2))
    width = tracker.config.token_dim
    torch.testing.assert_close(
        last.tokens[..., 1 : 1 + width] - tracker.time[:, None, 1 : 1 + width], out, atol=1e-5, rtol=0
    )
    following = record.steps[-2].coords + record.steps[-2].moved
    torch.testing.assert_close(following, last.coords, atol=1e-6, rtol=0)
    before = len(record.steps)
    tracker.track(clip, **options)
    assert len(record.steps) == before  # the hooks are gone


def test_recorder_with_another_context(clip):
    tracker = t3d.Tracker(t3d.TrackerConfig.preset("lite", **SMALL, context="p2n")).eval()
    with Recorder(tracker, [0]) as record:
        tracker.track(clip, support_grid=0)
    assert record.steps[0].levels[0].support_from_context is None
    assert record.steps[0].levels[0].near.points.shape == (4, 1, 4, 3)
