"""Lesson 00: what it measures, its milestone, and right answers that are written in another way."""

from pathlib import Path

import numpy as np
import pytest

import tapip3d_lite as t3d
from lessons import n00, progress
from lessons.checker import check
from tapip3d_lite.geometry import project

SAMPLES = Path(__file__).parents[1] / "data_samples"


def test_one_frame_repeats_the_trackers_first_step():
    clip = t3d.load_clip(SAMPLES / "arc.npz")
    one, klt = n00.one_frame(clip), t3d.load_tracker("klt").track(clip)
    age = np.abs(np.arange(len(clip))[:, None] - clip.queries[:, 0])
    chosen = clip.tracks.visible & ~clip.tracks.dynamic & (age == 1)
    assert len(one.here) == chosen.sum()
    assert one.kept["as filmed"].sum() == (chosen & klt.visible).sum()
    uv, _ = project(clip.tracks.xyz, clip.intrinsics, clip.extrinsics)
    truth = uv[one.frames[:, 1]]
    assert np.linalg.norm(truth - one.there[:, None], axis=-1).min(1).max() < 1e-3


def test_a_camera_at_rest_changes_no_shape():
    one = n00.one_frame(t3d.load_clip(SAMPLES / "static_camera.npz"))
    np.testing.assert_array_equal(one.kept["shape repaired"], one.kept["as filmed"])


def test_the_milestone_notices_a_wrong_score(monkeypatch):
    progress.reset()
    assert n00.milestone("00").status == "not attempted"
    right = {e.name: e.reference for e in n00.EXERCISES}
    for name, answer in right.items():
        check(name, lambda *a, answer=answer: answer(*a))
    passed = n00.milestone("00")
    assert passed.status == "passed" and str(passed).count("yours, called") == 3 and "0.000000" in str(passed)
    progress.record("00.hits", lambda p, q, f, k: right["00.hits"](p, q, f, 1.1 * k), "passed")
    assert n00.milestone("00").status == "wrong"
    progress.reset()


def movers(xyz, visible, least):
    rows = []
    for n in range(xyz.shape[1]):
        frames = np.flatnonzero(visible[:, n])
        if len(frames) and max(np.linalg.norm(xyz[frames, n] - xyz[frames[0], n], axis=1)) > least:
            rows.append([frames[0], *xyz[frames[0], n]])
    return np.array(rows, np.float32).reshape(-1, 4)


def visible(uv, z, depth, slack):
    found = []
    for (u, v), own in zip(uv, z, strict=True):
        column, row = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
        inside = 0 <= column < depth.shape[1] and 0 <= row < depth.shape[0]
        found.append(bool(inside and own > 0 and own - depth[row, column] <= slack * depth[row, column]))
    return found


def hits(p, q, focal, k):
    squared = ((p - q) ** 2).sum(-1)
    return squared < (k * p[..., 2] / focal.reshape(-1, 1)) ** 2


def two_scores(hit, seen, said):
    found = np.count_nonzero(hit & seen & said)
    false_claims = np.count_nonzero(said & ~seen) + np.count_nonzero(said & seen & ~hit)
    return [np.float32(hit[seen].mean()), np.float32(found / (np.count_nonzero(seen) + false_claims))]


def median_scale(p, q, seen, said):
    both = np.logical_and(seen, said)
    sizes = [np.median(np.sqrt((x.astype(np.float32) ** 2).sum(-1))[both]) for x in (p, q)]
    return sizes[0] / sizes[1]


@pytest.mark.parametrize("answer", [movers, visible, hits, two_scores, median_scale])
def test_right_answers_may_be_written_differently(answer):
    assert check(f"00.{answer.__name__}", answer).status == "passed"


def test_the_card_is_read():
    card = n00.card("lite")
    assert {"parameters", "model", "data", "steps", "hardware", "visible from", "limits"} <= set(card)
    assert n00.card("no such tracker") == {}
