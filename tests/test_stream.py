"""Streaming equals offline tracking; the recorder shows what the tracker really computed."""

import numpy as np
import pytest
import torch

import tapip3d_lite as t3d
from tapip3d_lite.model.frames import frames_from_clip
from tapip3d_lite.recorder import Recorder
from tests.stream_memory import grown
from tests.tiny import SYSTEMS

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
    frames, window = frames_from_clip(clip), tracker.config.window
    frames = frames if len(clip) > window // 2 else frames.pad(window)  # a short clip gets one window
    with torch.no_grad():
        features = torch.cat([tracker.encoder(frames.rgb[:, t : t + 1]) for t in range(len(frames))], 1)
        xyz, logits = tracker(frames, torch.from_numpy(clip.queries)[None], features=features, **options)
    return xyz[0, : len(clip)].numpy(), logits[0, : len(clip)].numpy()


def in_a_window(clip):
    """(T, N): from the first window on that contains the query. Before, it stays at its place, in the world or in `space`."""
    return np.arange(len(clip))[:, None] >= np.maximum(0, np.ceil((clip.queries[:, 0] + 1 - 4) / 2) * 2)


@pytest.mark.parametrize("space", ["world", "camera", "first"])
@pytest.mark.parametrize("frames", [2, 3, 8, 11])
def test_stream_equals_offline(tracker, clip, space, frames):
    part = clip.cut(0, frames)
    options = {"space": space, "depth_roi": (0.5, 9.0)}
    xyz, logits = offline_frame_by_frame(tracker, part, **options)
    stream = tracker.stream(part.queries, **options)
    updates = feed(stream, part)
    result = stream.finish()
    solved = in_a_window(part)
    np.testing.assert_allclose(result.xyz[solved], xyz[solved], atol=1e-5)
    np.testing.assert_array_equal(result.xyz[~solved], np.broadcast_to(part.queries[:, 1:], xyz.shape)[~solved])
    np.testing.assert_allclose(result.visible_logits, logits, atol=1e-5)
    offline = tracker.track(part, support_grid=0, bidirectional=False, **options)
    np.testing.assert_allclose(result.xyz[solved], offline.xyz[solved], atol=0.1)
    assert len(updates) == max(0, (frames - 4) // 2 + 1)
    assert all(len(u.xyz) == 4 for u in updates)
    if frames % 2 == 0 and updates:
        np.testing.assert_array_equal(updates[-1].xyz, result.xyz[-4:])


@pytest.mark.parametrize("name", ["uvd", "CoTracker3-like", "SpatialTracker-like"])
def test_stream_of_other_systems(clip, name):
    torch.manual_seed(0)
    tracker = t3d.Tracker(t3d.TrackerConfig.preset("lite", **(SMALL | {"neighbors": 9} | SYSTEMS[name]))).eval()
    stream = tracker.stream(clip.queries)
    feed(stream, clip)
    xyz, solved = offline_frame_by_frame(tracker, clip)[0], in_a_window(clip)
    np.testing.assert_allclose(stream.finish().xyz[solved], xyz[solved], atol=1e-4)


def test_stream_with_a_support_grid_does_not_tell_it(tracker, clip):
    """The grid is attended to like queries of the user's on the first frame, and left out."""
    stream, grid = tracker.stream(clip.queries, support_grid=3), t3d.grid_queries(clip, 3)
    updates = feed(stream, clip)
    both = tracker.stream(np.concatenate([clip.queries, grid]))
    feed(both, clip)
    result, other, alone = stream.finish(), both.finish(), tracker.stream(clip.queries)
    assert updates[0].xyz.shape == (4, 24, 3) and result.xyz.shape == (11, 24, 3)
    np.testing.assert_array_equal(result.xyz, other.xyz[:, :24])
    feed(alone, clip)
    assert np.abs(alone.finish().xyz - result.xyz).max() > 1e-6


def test_queries_of_the_future_stand_at_their_query(tracker, clip):
    rows = clip.queries.copy()
    rows[:, 0] = [0] * 12 + [9] * 12
    stream = tracker.stream(rows, space="camera")
    first = next(iter(feed(stream, clip.cut(0, 5))))
    np.testing.assert_array_equal(first.xyz[:, 12:], np.broadcast_to(rows[12:, 1:], (4, 12, 3)))
    assert not first.visible[:, 12:].any()


def test_stream_without_frames_or_with_a_bad_frame(tracker, clip):
    stream = tracker.stream(clip.queries)
    assert stream.finish().xyz.shape == (0, 24, 3)
    stream = tracker.stream(clip.queries)
    with pytest.raises(ValueError, match=r"Clip\.depths"):
        stream.push(clip.video[0], clip.depths[0][:-1], clip.intrinsics[0], clip.extrinsics[0])


def test_queries_come_and_go(tracker, clip):
    """A query that is added in time is tracked as one known before; one that is dropped leaves no trace in the others."""
    rows = clip.queries[:6].copy()
    rows[:, 0] = 0, 0, 0, 0, 5, 6
    early, late = tracker.stream(rows[[0, 1, 2, 4, 5]]), tracker.stream(rows[:3])
    updates = feed(early, clip.cut(0, 5))
    assert late.followed.tolist() == [0, 1, 2]
    feed(late, clip.cut(0, 5))
    assert late.add(rows[4:]).tolist() == [3, 4] and late.followed.tolist() == [0, 1, 2, 3, 4]
    rest = clip.cut(5, 11)
    updates, same = feed(early, rest), feed(late, rest)
    for one, two in zip(updates, same, strict=True):
        np.testing.assert_allclose(one.xyz, two.xyz, atol=1e-6)
        np.testing.assert_array_equal(one.visible, two.visible)
    np.testing.assert_allclose(early.finish().xyz, late.finish().xyz, atol=1e-6)

    fewer, many = tracker.stream(rows[[0, 2]]), tracker.stream(rows[:4])
    many.drop([1, 3])
    for one, two in zip(feed(fewer, clip), feed(many, clip), strict=True):
        assert two.xyz.shape == (4, 2, 3) and np.array_equal(two.queries, rows[[0, 2]])
        np.testing.assert_array_equal(one.xyz, two.xyz)
    few, all_rows = fewer.finish(), many.finish()
    np.testing.assert_array_equal(few.xyz, all_rows.xyz[:, [0, 2]])
    np.testing.assert_array_equal(all_rows.xyz[:, [1, 3]], np.broadcast_to(rows[[1, 3], 1:], (11, 2, 3)))
    assert not all_rows.visible[:, [1, 3]].any()


def test_a_query_dropped_on_the_way_keeps_what_was_found(tracker, clip):
    stream = tracker.stream(clip.queries[:4] * [0, 1, 1, 1], support_grid=2)
    before = feed(stream, clip.cut(0, 6))[-1]
    stream.drop(1)
    assert stream.add([[4, 0.1, 0.2, 0.3]]).tolist() == [4] and stream.followed.tolist() == [0, 2, 3, 4]
    after = feed(stream, clip.cut(6, 11))[-1]
    assert after.xyz.shape == (4, 4, 3)
    result = stream.finish()
    np.testing.assert_array_equal(result.xyz[2:6, 1], before.xyz[:, 1])
    np.testing.assert_array_equal(result.xyz[6:, 1], np.broadcast_to(stream.queries[1, 1:], (5, 3)))
    assert result.xyz.shape == (11, 5, 3) and not result.visible[6:, 1].any() and not result.visible[:4, 4].any()


def test_a_query_added_last_is_still_tracked(tracker, clip):
    stream = tracker.stream(clip.queries[:3] * [0, 1, 1, 1])
    feed(stream, clip.cut(0, 6))  # the last window is solved
    row = clip.queries[3] * [0, 1, 1, 1] + [5, 0, 0, 0]
    stream.add(row[None])
    result = stream.finish()
    assert result.xyz.shape == (6, 4, 3) and not np.array_equal(result.xyz[5, 3], row[1:])


def test_a_stream_that_keeps_nothing(tracker, clip):
    whole, last = tracker.stream(clip.queries), tracker.stream(clip.queries, keep=False)
    for one, two in zip(feed(whole, clip), feed(last, clip), strict=True):
        np.testing.assert_array_equal(one.xyz, two.xyz)
    ours, theirs = last.finish(), whole.finish()
    np.testing.assert_array_equal(ours.xyz, theirs.xyz[-3:])
    np.testing.assert_array_equal(ours.visible, theirs.visible[-3:])
    assert len(last.window) == 2 and last.past.nbytes == 4 * 24 * 5 * 4


def test_a_finished_stream_takes_nothing_more(tracker, clip):
    stream = tracker.stream(clip.queries)
    feed(stream, clip.cut(0, 5))
    first = stream.finish()
    for refused in (lambda: feed(stream, clip), lambda: stream.add(clip.queries), lambda: stream.drop([0])):
        with pytest.raises(ValueError, match="this stream is finished; begin another"):
            refused()
    np.testing.assert_array_equal(stream.finish().xyz, first.xyz)  # once more, the same
    assert len(first.xyz) == 5


def test_bad_additions(tracker, clip):
    stream = tracker.stream(clip.queries)
    feed(stream, clip.cut(0, 8))
    for call, message in (
        (lambda: stream.add([[5, 0, 0, 1]]), "whole frame number from 6 on, got 5"),
        (lambda: stream.add([[6.5, 0, 0, 1]]), "whole frame number"),
        (lambda: stream.add(np.zeros((1, 3))), "queries: expected shape"),
        (lambda: stream.drop([24]), "drop: expected numbers of"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
    stream.drop(3)
    with pytest.raises(ValueError, match="drop"):
        stream.drop(3)
    cameras = clip.intrinsics[8], clip.extrinsics[8]
    with pytest.raises(ValueError, match=r"push: expected a frame of \(\d+, \d+\) \(H, W\) as before"):
        stream.push(clip.video[8, ::2], clip.depths[8, ::2], *cameras)
    for wrong in (None, "a", {}):
        with pytest.raises(ValueError, match="expected"):
            stream.push(wrong, clip.depths[8], *cameras)


def test_memory_stays_constant():
    """`python -m tests.stream_memory` shows it over 2,000 frames."""
    tables = grown(frames=60, side=32, points=16)
    assert tables["keep=False"] < 0.1  # MiB a frame; forgotten frames would be 0.2, their features more


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"queries": np.zeros((2, 3))}, "queries: expected shape"),
        ({"queries": [[0.5, 0, 0, 1]]}, "whole frame number"),
        ({"queries": [[-1.0, 0, 0, 1]]}, "whole frame number"),
        ({"queries": [[0, np.nan, 0, 1]]}, "finite"),
        ({"depth_roi": "auto"}, "does not know the whole clip"),
        ({"space": "uvd"}, "only camera, world and first"),
        ({"iterations": 0}, "iterations"),
        ({"visible_threshold": 2}, "probability"),
    ],
)
def test_bad_options_of_a_stream(tracker, clip, options, message):
    with pytest.raises(ValueError, match=message):
        tracker.stream(**({"queries": clip.queries} | options))


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


@torch.no_grad()
def test_recorder_counts_queries_not_members_of_a_window(tracker, clip):
    rows = clip.queries[:3].copy()
    rows[:, 0] = 9, 0, 4  # the first is in no window but the last ones
    frames = frames_from_clip(clip)
    with Recorder(tracker, [2, 0]) as record:
        steps = list(tracker.steps(frames, torch.from_numpy(rows)[None], iterations=1))
    assert [step.columns for step in record.steps] == [[], [2], [2], [2, 0], [2, 0]]
    assert [step.start for step in record.steps] == [0, 2, 4, 6, 8]
    for seen, step in zip(record.steps, steps, strict=True):
        places = [step.columns.tolist().index(column) for column in seen.columns]
        torch.testing.assert_close(seen.xyz, step.xyz[0, :, places])
        torch.testing.assert_close(seen.logits, step.logits[0, :, places])
        for level in seen.levels:
            assert level.support.indices[:, 0].tolist() == [-1] * len(seen.columns)
            cells = level.near.indices  # the recorded cells are those around the estimate
            assert cells.shape == (4, len(seen.columns), 4) and int(cells.min() if cells.numel() else 0) >= 0


def test_recorder_leaves_the_tracker_as_it_was_even_after_an_error(tracker, clip):
    with pytest.raises(RuntimeError, match="stop"), Recorder(tracker, [0]):
        raise RuntimeError("stop")
    assert "update" not in vars(tracker)


@pytest.mark.parametrize("context", ["p2n", "correlation"])
def test_recorder_with_another_context(clip, context):
    changes = SMALL | {"context": context, "neighborhood": "knn" if context == "p2n" else "window"}
    tracker = t3d.Tracker(t3d.TrackerConfig.preset("lite", **changes)).eval()
    with Recorder(tracker, [0]) as record:
        tracker.track(clip, support_grid=0)
    level = record.steps[0].levels[0]
    assert level.support_from_context is None
    assert level.near.points.shape == (4, 1, 4, 3) and level.support.points.shape == (1, 5, 3)
    if context == "p2n":
        assert level.query_from_context.shape == (4, 1, 4)
        torch.testing.assert_close(level.query_from_context.sum(-1), torch.ones(4, 1))
