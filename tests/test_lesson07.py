"""Lesson 07: its measurements against loops, its figures, intervals of known truth, and a milestone that notices."""

from dataclasses import replace

import numpy as np
import pytest

import tapip3d_lite as t3d
from lessons import n07
from tapip3d_lite.evaluation.intervals import Estimate
from tapip3d_lite.geometry import THRESHOLDS
from tests.milestones import notices


@pytest.fixture(scope="module")
def clip():
    return t3d.simulate_clip(5, frames=6, size=(48, 64), tracks=24)


@pytest.fixture(scope="module")
def pred(clip):
    return t3d.load_tracker("klt").track(clip)


def test_errors_are_those_of_the_metrics(clip, pred):
    error, p, q, focal = n07.errors(pred, clip)
    by_loop = np.array(
        [
            [np.linalg.norm(q[t, n] - p[t, n]) * focal[t] / p[t, n, 2] for n in range(p.shape[1])]
            for t in range(len(clip))
        ]
    )
    np.testing.assert_allclose(error, by_loop)
    seen = clip.tracks.visible
    apd = np.mean([(error < k)[seen].mean() for k in THRESHOLDS])
    assert apd == pytest.approx(t3d.evaluate(pred, clip)["APD3D_none"], abs=0.005)
    assert focal[0] == pytest.approx(clip.intrinsics[0, 0, 0] * 256 / 48, rel=1e-5)


def test_thresholds_average_to_the_scores_of_moving_points(clip, pred):
    row = t3d.evaluate(pred, clip)
    assert n07.by_threshold([pred], [clip]).mean() == pytest.approx(row["APD3D_none_dynamic"], abs=0.01)
    jaccard = n07.by_threshold([pred], [clip], "jaccard")
    assert jaccard.mean() == pytest.approx(row["AJ3D_none_dynamic"], abs=0.01)


def test_no_shuffled_track_stays_and_each_is_somebodys(clip):
    true = clip.tracks
    moved = n07.shuffled(true, seed=3)
    places = [int(np.flatnonzero((true.xyz == moved.xyz[:, [n]]).all((0, 2)))[0]) for n in range(true.xyz.shape[1])]
    assert sorted(places) == list(range(len(places))) and all(n != place for n, place in enumerate(places))
    np.testing.assert_array_equal(moved.visible, true.visible[:, places])


def test_words_by_threshold(clip):
    logits = np.linspace(-4, 4, clip.tracks.visible.size, dtype=np.float32).reshape(clip.tracks.visible.shape)
    pred = replace(clip.tracks, visible_logits=logits)
    shares = [n07.spoken(pred, clip, x).visible.mean() for x in (0, 0.5, 1)]
    assert shares[0] > shares[1] > shares[2] == 0


def test_unscaled_truth_is_perfect(clip):
    _, p, *_ = n07.errors(clip.tracks, clip)
    assert t3d.evaluate(n07.unscaled(clip, p), clip)["APD3D_none"] == 1
    assert t3d.evaluate(n07.unscaled(clip, 2 * p), clip)["APD3D_none"] < 0.01


def test_intervals_over_independent_moments_keep_their_promise_and_over_copies_do_not():
    rng = np.random.default_rng(0)
    alone = [[rng.normal(size=40) for _ in range(6)] for _ in range(60)]
    held = n07.coverage(alone, 20, rounds=400)
    assert all(0.88 < share <= 0.99 for share in held.values())
    together = [[np.full(40, rng.normal()) for _ in range(1)] * 6 for _ in range(60)]  # a clip succeeds or fails as one
    held = n07.coverage(together, 20, rounds=400)
    assert held["moments"] < 0.2 and held["tracks"] < 0.7 and held["clips"] > 0.85


def test_figures_can_be_drawn(clip, pred):
    curve, value = np.linspace(0.1, 0.9, 5), Estimate(0.2, 0.1, 0.3)
    rows = {"paired": value, "unpaired": value}
    scene, twin = n07.worst_in_3d(clip, pred, np.array([3, 1]))
    assert scene.data[-1].name == "truth" and len(scene.frames) == len(clip) and len(scene.data[-1].x) == 2 * 7
    for figure in (
        twin,
        n07.balls({"A": (2.0, 0.05), "B": (4.0, 0.05)}, 200),
        n07.by_threshold_chart({"klt": curve}, {"klt": curve / 2}, 3.0, 300.0),
        n07.by_word_chart([0, 0.5, 1], {"AJ": [0, 1, 0], "OA": [0, 1, 0]}, {"always": 0.7}),
        n07.flat_and_space({"a": (curve, curve), "b": (curve, curve)}, 1.1),
        n07.two_rows((curve, curve[::-1]), ("a", "b"), rows, "AJ3D"),
        n07.differences_chart(rows, "difference"),
        n07.coverage_chart({"8 clips": {"moments": 0.3, "clips": 0.9}}),
        n07.shares_chart({"one": 0.3, "two": 0.2}, np.arange(1.0, 9)),
        n07.depth_chart([0, 0.1], {m: {"lite": [0.5, 0.4]} for m in ("APD", "AJ")}),
    ):
        figure.canvas.draw()


def test_the_milestone_notices_what_is_not_the_librarys():
    told = ("unmasked", "ray", "mean of resamples", "predicted depth")  # some mistakes do not matter on that clip
    notices(n07, "07", told, trackers=("klt", "static"))
