"""Notebook 05's figures, film and surgery, by their state."""

import numpy as np
import pytest
import torch

import tapip3d_lite as t3d
from lessons.n05 import (
    converging,
    film,
    paired,
    random_tracker,
    time_in_turns,
    time_ratios,
    token_bar,
    token_parts,
    windows_chart,
    without,
)
from lessons.n05_exercises import window_starts
from tapip3d_lite.geometry import project
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
    def run(rows=queries):
        return tracker.track(clip, rows, support_grid=0, bidirectional=False, depth_roi=None).xyz

    whole = run()
    for part in ("motion", "virtual tracks"):
        with without(tracker, part):
            assert np.abs(run() - whole).max() > 1e-5
        np.testing.assert_array_equal(run(), whole)
    tokens = torch.randn(1, 4, 5, tracker.updater.input.in_features, generator=torch.Generator().manual_seed(0))
    with torch.no_grad(), without(tracker, "virtual tracks"):  # then nobody hears of anybody
        torch.testing.assert_close(tracker.updater(tokens[:, :, :1]), tracker.updater(tokens)[:, :, :1])
    with pytest.raises(ValueError, match="part"), without(tracker, "brain"):
        pass


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


def test_a_random_tracker_is_the_same_in_both_forms_and_leaves_the_generator_alone(clip, queries):
    sizes = {"image_size": (32, 32), "window": 4, "levels": 2, "neighbors": 4, "iterations": 1, "hidden": 32}
    before = torch.random.get_rng_state()
    fast, clear = (random_tracker(fast=fast, **sizes).track(clip, queries) for fast in (True, False))
    assert torch.equal(torch.random.get_rng_state(), before)
    np.testing.assert_allclose(fast.xyz, clear.xyz, atol=1e-4)


def test_functions_are_timed_in_turns():
    called = []
    seconds = time_in_turns({name: lambda name=name: called.append(name) for name in "ab"}, rounds=3)
    assert "".join(called) == "abababab" and {name: len(times) for name, times in seconds.items()} == {"a": 3, "b": 3}
    assert time_ratios([2, 6, 3], [1, 2, 2]) == (1.5, 2, 3)
