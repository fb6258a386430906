"""Notebook 05's figures, film, look inside and surgery, by their state; its exercises beyond their matrix."""

from itertools import pairwise

import numpy as np
import pytest
import torch

import tapip3d_lite as t3d
from lessons import milestone, n05
from lessons.checker import cases_of, judge
from lessons.n05 import (
    converging,
    corrections,
    film,
    heard,
    hearing,
    inside,
    interval,
    looks_over_time,
    paired,
    time_in_turns,
    time_ratios,
    token_bar,
    token_parts,
    windows_chart,
    without,
)
from lessons.n05_exercises import GROUP, TOKEN, token, update_group
from lessons.n05_windows import BACKWARD, HAND_OVER, WINDOWS, both_ways, hand_over, window_starts
from tapip3d_lite.geometry import project
from tapip3d_lite.model.frames import frames_from_clip
from tapip3d_lite.model.updater import token_width
from tapip3d_lite.model.windows import window_ends


@pytest.fixture(scope="module")
def clip():
    return t3d.simulate_clip(seed=4, frames=10, size=(32, 32), tracks=40)


@pytest.fixture(scope="module")
def tracker():
    torch.manual_seed(0)
    sizes = {"image_size": (32, 32), "window": 4, "levels": 2, "neighbors": 4, "iterations": 2, "hidden": 32}
    tracker = t3d.Tracker(t3d.TrackerConfig.preset("lite", **sizes)).eval()
    for name in ("head", "vis_head"):
        torch.nn.init.normal_(getattr(tracker.updater, name).weight, std=0.02)  # moves, so that differences show
    return tracker


@pytest.fixture(scope="module")
def queries(clip):
    rows = np.concatenate([np.zeros((5, 1)), clip.tracks.xyz[0, :5]], -1).astype(np.float32)
    rows[4, 0] = 5
    return rows


@pytest.fixture(scope="module")
def shown(tracker, clip, queries):
    return film(tracker, clip, queries, clip.tracks.xyz[:, :5])


def test_parts_fill_the_token(tracker):
    parts = token_parts(tracker.config, tracker.context.width)
    assert sum(parts.values()) == token_width(tracker.context.width, 2, True)
    ax = token_bar(parts).axes[0]
    assert [p.get_width() for p in ax.patches] == list(parts.values())


def test_starts_are_the_trackers():
    for frames in range(1, 30):
        for window in (4, 8):
            padded = -(-frames // (window // 2)) * (window // 2)
            expected = [end - window for end in window_ends(padded, window)]
            assert window_starts(frames, window).tolist() == expected
    ax = windows_chart(10, 4, [0, 2, 4, 6], [0, 5]).axes[0]
    assert [list(line.get_xdata()) for line in ax.lines[:4]] == [[0], [5], [], []]
    words = [text.get_text() for text in ax.texts]
    assert words == ["query"] * 2 + ["handed over", "last place repeated"] * 3


def test_the_film_begins_and_ends_as_the_tracker_does(tracker, clip, queries, shown):
    assert shown.starts == [0, 2, 4, 6] and [list(c) for c in shown.columns] == [[0, 1, 2, 3]] * 1 + [
        [0, 1, 2, 3, 4] if start + 4 > 5 else [0, 1, 2, 3] for start in (2, 4, 6)
    ]
    whole = tracker.track(clip, queries, support_grid=0, bidirectional=False, depth_roi=None)
    np.testing.assert_allclose(shown.xyz[-1][-1], whole.xyz[6:], atol=1e-4)
    with t3d.Recorder(tracker, columns=range(5)) as record:
        tracker.track(clip, queries, support_grid=0, bidirectional=False, depth_roi=None)
    for i, xyz in enumerate(shown.xyz):  # normalised and world differ by a similarity: compare distances
        first = record.steps[2 * i].coords.numpy()
        scale = np.linalg.norm(np.diff(xyz[1], axis=0)) / np.linalg.norm(
            np.diff((record.steps[2 * i].coords + record.steps[2 * i].moved).numpy(), axis=0)
        )
        steps = [np.linalg.norm(np.diff(x, axis=0), axis=-1) for x in (xyz[0], scale * first)]
        np.testing.assert_allclose(*steps, atol=1e-4)


def test_converging_draws_the_iteration(clip, shown):
    image, top, error = converging(clip, shown, 1, 2, 1).axes
    np.testing.assert_allclose(top.lines[1].get_xydata(), shown.xyz[2][1, :, 1, :2])
    assert len(error.lines) == 2
    drawn = image.lines[1].get_xydata()
    for i, frame in enumerate(range(4, 8)):
        uv, _ = project(shown.xyz[2][1, i, 1:2], clip.intrinsics[frame], clip.extrinsics[frame])
        np.testing.assert_allclose(drawn[i], uv[0], rtol=1e-4)
    assert len(drawn) == 4
    truth = clip.tracks.xyz[4:8, 1]
    np.testing.assert_allclose(error.lines[1].get_ydata(), 100 * np.linalg.norm(shown.xyz[2][1, :, 1] - truth, axis=-1))
    for bad in ({"track": 4, "window": 0}, {"window": 9}, {"iteration": 3}):
        with pytest.raises(ValueError, match="expected"):
            converging(clip, shown, **bad)


def test_surgery_acts_and_heals(tracker, clip, queries):
    def run():
        return tracker.track(clip, queries, support_grid=0, bidirectional=False, depth_roi=None).xyz

    whole = run()
    for part in ("motion", "other tracks", "other frames", "whole block"):
        with without(tracker, part):
            assert np.abs(run() - whole).max() > 1e-5
        np.testing.assert_array_equal(run(), whole)
    with pytest.raises(ValueError, match="part"), without(tracker, "brain"):
        pass


def test_surgery_leaves_each_alone(tracker):
    updater = tracker.updater
    tokens = torch.randn(2, 4, 5, updater.input.in_features, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        one, frame = updater(tokens[:, :, 2:3]), updater(tokens[:, 1:2])
        with without(tracker, "other tracks"):
            torch.testing.assert_close(updater(tokens)[:, :, 2:3], one)
        with without(tracker, "whole block"):
            torch.testing.assert_close(updater(tokens)[:, :, :1], updater(tokens[:, :, :1]))
        with without(tracker, "other frames"):
            torch.testing.assert_close(updater(tokens)[:, 1:2], frame)
            active = torch.tensor([[True] * 4 + [False]] * 2)
            torch.testing.assert_close(updater(tokens, active)[:, :, :4], updater(tokens[:, :, :4]))


def test_the_look_inside_sees_what_the_tracker_does(tracker, clip, queries):
    rows = queries[:4]
    seen = inside(tracker, clip, rows)
    assert seen.looks.shape == (2, 3, 4, tracker.config.heads, 4, 4) and len(seen.tokens) == 2
    np.testing.assert_allclose(seen.looks.sum(-1), 1, atol=1e-5)
    whole = tracker.track(clip.cut(0, 4), rows, support_grid=0, bidirectional=False)
    np.testing.assert_allclose(seen.xyz[-1], whole.xyz, atol=1e-5)
    np.testing.assert_allclose(seen.vis[-1], whole.visible_logits, atol=1e-5)
    updater = tracker.updater
    blocks = list(zip(updater.time, updater.gather, updater.mix, updater.scatter, strict=True))
    for given, tokens, x in zip(seen.given, seen.tokens, seen.x, strict=True):
        torch.testing.assert_close(token(*given), tokens)
        torch.testing.assert_close(x[0][:, :4], updater.input(tokens))
        for group, (before, after) in zip(blocks, pairwise(x), strict=True):
            torch.testing.assert_close(update_group(before, 4, *group)[:, :4], after[:, :4])
    assert len(updater.time[0]._forward_pre_hooks) == len(updater.scatter[-1]._forward_hooks) == 0
    matrix = hearing(update_group, seen.x[0][0], 4, blocks[0])
    assert matrix.shape == (4, 4) and matrix.min() > 0
    alone = hearing(lambda x, count, *group: x * 2, seen.x[0][0], 4, blocks[0])
    assert np.count_nonzero(alone) == 4  # only each point's own
    assert len(looks_over_time(seen.looks[-1, 0, 1]).axes) == tracker.config.heads + 1
    assert len(heard([matrix] * 3, 2).axes) == 6
    moved, logit = corrections(seen.xyz[:, :, 1], seen.vis[:, :, 1], np.array([True, True, False, True])).axes
    np.testing.assert_allclose(
        [bar.get_height() for bar in moved.patches[:4]], 100 * np.linalg.norm(seen.xyz[1] - seen.xyz[0], axis=-1)[:, 1]
    )
    np.testing.assert_allclose(logit.lines[1].get_ydata(), seen.vis[2, :, 1])
    assert list(logit.lines[-1].get_xdata()) == [2]


def test_without_motion_tokens_say_that_all_stand_still(tracker, clip, queries):
    seen = []
    handle = tracker.updater.input.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    try:
        with without(tracker, "motion"):
            tracker.track(clip, queries, support_grid=0, bidirectional=False)
    finally:
        handle.remove()
    start = 1 + 2 * tracker.context.width
    tokens = seen[1] - tracker.time[:, None]  # after the first update points do move
    torch.testing.assert_close(tokens[..., start : start + 102], torch.zeros_like(tokens[..., :102]), rtol=0, atol=1e-5)
    assert tokens[..., 1:start].abs().max() > 1e-3


def test_paired_shows_every_clip():
    ax = paired({"a": np.array([1.0, 2, 3]), "b": np.array([0.0, 0])}, "difference").axes[0]
    assert list(ax.lines[0].get_xdata()) == [1, 2, 3]
    assert [t.get_text() for t in ax.get_yticklabels()] == ["a", "b"]


def test_intervals_are_wide_for_a_few_clips():
    assert interval(np.array([1.0, 2, 3])) == (2, pytest.approx(4.30 / 3**0.5))
    assert interval(np.array([5.0])) == (5, float("inf"))
    many = np.random.default_rng(0).normal(size=400)
    assert interval(many)[1] == pytest.approx(0.1, abs=0.02)


def test_functions_are_timed_in_turns():
    called = []
    seconds = time_in_turns({name: lambda name=name: called.append(name) for name in "ab"}, rounds=3)
    assert "".join(called) == "abababab" and {name: len(times) for name, times in seconds.items()} == {"a": 3, "b": 3}
    assert time_ratios([2, 6, 3], [1, 2, 2]) == (1.5, 2, 3)


def test_the_hand_over_knows_whom_the_window_before_has_solved():
    def late_from_the_start(coords, vis, queries, start):
        late = queries[:, 0] >= start
        first, logits = hand_over(coords, vis, np.where(late[:, None], queries, 0), start)
        return np.where(late[:, None], queries[:, 1:], first), np.where(late, 0, logits)

    verdict = judge(HAND_OVER, late_from_the_start)
    assert verdict.status == "wrong" and "a query in the first half is not late" in verdict.hint
    for _, _, queries, start in cases_of(HAND_OVER):
        half = len(_) // 2
        assert {start, start + half - 1, start + half, start + 2 * half - 1} <= set(queries[:, 0])


def test_short_clips_are_asked_for():
    frames = np.array([(frames, window) for frames, window in cases_of(WINDOWS)])
    assert (frames[:, 0] <= frames[:, 1] // 2).sum() >= 2 and (frames[:, 0] > frames[:, 1]).sum() >= 4
    assert (frames[:, 0] % (frames[:, 1] // 2) > 0).sum() >= 3

    def by_hand(frames, window):
        starts, half = [], window // 2
        while frames > half and (not starts or starts[-1] + window < frames):
            starts.append(starts[-1] + half if starts else 0)
        return starts

    assert judge(WINDOWS, by_hand).status == "passed"


def test_right_answers_in_other_forms_and_single_precision_pass():
    def single(answer):
        return lambda *case: answer(*(x.float() if isinstance(x, torch.Tensor) else x for x in case))

    def single_rows(coords, vis, queries, start):
        return hand_over(*(x.astype(np.float32) for x in (coords, vis, queries)), start)

    def over_all_frames(x, count, over_time, read, talk, write):
        x = torch.stack([over_time(x[:, i]) for i in range(x.shape[1])], 1)
        frames = []
        for tokens in x:
            virtual = talk(read(tokens[count:], tokens[:count]))
            frames.append(torch.cat([write(tokens[:count], virtual), virtual]))
        return torch.stack(frames)

    def by_masks(forward, backward, queries):
        result = forward(queries)
        back = backward(np.c_[len(result) - 1 - queries[:, 0], queries[:, 1:]])
        for n, t in enumerate(queries[:, 0].astype(int)):
            result[:t, n] = back[::-1][:t, n]
        return result.astype(np.float32)

    for exercise, answer in (
        (TOKEN, single(token)),
        (GROUP, over_all_frames),
        (GROUP, single(update_group)),
        (HAND_OVER, single_rows),
        (BACKWARD, by_masks),
    ):
        assert judge(exercise, answer).status == "passed", judge(exercise, answer)


def test_both_ways_is_what_the_library_does(tracker, clip, queries):
    frames = frames_from_clip(clip)
    whole = tracker.track(clip, queries, support_grid=0, depth_roi=None)

    def way(frames):
        return lambda rows: tracker(frames, torch.from_numpy(rows)[None])[0][0].numpy()

    with torch.no_grad():
        for joined in (milestone.both_ways, both_ways):
            found = joined(way(frames), way(frames.flip()), queries)
            np.testing.assert_allclose(found, whole.xyz, atol=1e-4)
        assert queries[4, 0] == 5 and np.abs(way(frames)(queries)[:5, 4] - whole.xyz[:5, 4]).max() > 1e-3


def test_the_last_digit_stays_where_neighbours_and_fine_waves_do():
    """And what is held is what was there before: nothing moves where the queries do not."""
    clip = t3d.simulate_clip(3, frames=8, size=(64, 64), tracks=40)
    seen = np.flatnonzero(clip.tracks.visible[0])[:6]
    queries = np.concatenate([np.zeros((6, 1)), clip.tracks.xyz[0, seen]], 1).astype(np.float32)
    tracker = t3d.load_tracker("lite", fast=False)
    far = {kept: n05.grown(tracker, clip, queries, kept) for kept in ((), ("neighbours", "fine waves"))}
    assert far[()].shape == (tracker.config.iterations, 8, 6) and np.isfinite(far[()]).all()
    assert far["neighbours", "fine waves"].max() < 1e-5 and far[()].max() > 10 * far["neighbours", "fine waves"].max()
    n05.growth_chart({"a": far[()][:, 0], "b": np.zeros((3, 6))}, 3).canvas.draw()
    whole, deaf = (n05.without_waves("lite", degree).track(clip, queries).xyz for degree in (13, 3))
    np.testing.assert_array_equal(whole, tracker.track(clip, queries).xyz)
    assert np.abs(deaf - whole).max() > 1e-3
