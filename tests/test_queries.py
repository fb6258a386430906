"""Queries: on pixels of any frame, grids, masks, whole frames; what has no depth is named, and nothing is lost silently."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

import tapip3d_lite as t3d
from tapip3d_lite.geometry import project
from tapip3d_lite.queries import QueryChoice, support_queries


@pytest.fixture(scope="module")
def clip():
    clip = t3d.simulate_clip(seed=5, frames=4, size=(24, 36), camera="arc", tracks=6)
    depths = clip.depths.copy()
    depths[2, 10:, 5:9] = 0
    depths[3] = 0
    return replace(clip, depths=depths, queries=None, tracks=None)


def pixels_of(clip, queries):
    t = queries[:, 0].astype(int)
    uv, z = project(queries[:, None, 1:].astype(np.float64), clip.intrinsics[t], clip.extrinsics[t])
    return np.column_stack([t, uv[:, 0]]), z[:, 0]


def test_pixels_of_several_frames_come_back(clip):
    rows = np.array([[0, 3, 4], [2, 30, 2], [1, 35, 23]])
    queries = t3d.queries_from_pixels(clip, rows)
    back, z = pixels_of(clip, queries)
    np.testing.assert_allclose(back, rows, atol=1e-3)
    np.testing.assert_allclose(z, clip.depths[rows[:, 0], rows[:, 2], rows[:, 1]], rtol=1e-5)


def test_rows_on_invalid_depth_are_named_and_can_be_skipped(clip):
    rows = np.array([[0, 3, 4], [2, 6, 12], [2, 30, 2], [3, 1, 1]])
    with pytest.raises(ValueError, match=r"2 of 4 rows fall on invalid depth: 1 = \[2.0, 6.0, 12.0\], 3 = .*skip"):
        t3d.queries_from_pixels(clip, rows)
    assert t3d.has_depth(clip, rows).tolist() == [True, False, True, False]
    kept = t3d.queries_from_pixels(clip, rows, on_invalid="skip")
    np.testing.assert_array_equal(kept, t3d.queries_from_pixels(clip, rows[[0, 2]]))
    with pytest.raises(ValueError, match="which would leave none"):
        t3d.queries_from_pixels(clip, rows[[1, 3]], on_invalid="skip")
    assert t3d.queries_from_pixels(clip, np.zeros((0, 3))).shape == (0, 4)  # nothing asked, nothing lost


def test_dense_queries_are_all_pixels_with_depth(clip):
    back, _ = pixels_of(clip, t3d.dense_queries(clip, frame=2))
    v, u = np.nonzero(clip.depths[2])
    np.testing.assert_allclose(back, np.column_stack([np.full(len(u), 2), u, v]), atol=1e-3)
    mask = np.zeros(clip.size, np.uint8)
    mask[4:14, 3:8] = 1
    back, _ = pixels_of(clip, t3d.dense_queries(clip, 2, mask, step=2))
    expected = [(2, u, v) for v in range(1, 24, 2) for u in range(1, 36, 2) if mask[v, u] and clip.depths[2, v, u]]
    np.testing.assert_allclose(back, expected, atol=1e-3)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda c: t3d.grid_queries(c, 4, frame=3), r"frame 3 has no valid depth at any node of the 4x4 grid \(0.0%"),
        (lambda c: t3d.dense_queries(c, 3), "frame 3 has no valid depth at any of the 864 pixels chosen"),
        (lambda c: t3d.dense_queries(c, 0, np.zeros(c.size, bool)), "the mask is empty"),
        (lambda c: t3d.dense_queries(c, 0, np.ones((3, 3), bool)), r"mask: expected shape \(24, 36\)"),
        (lambda c: t3d.dense_queries(c, 0, np.full(c.size, 7)), "mask: expected booleans"),
        (lambda c: t3d.dense_queries(c, 4), r"frame in \[0, 3\]"),
        (lambda c: t3d.dense_queries(c, step=0), "step >= 1"),
        (lambda c: t3d.queries_from_pixels(c, [[0, 36, 3]]), r"row 0 = \[0.0, 36.0, 3.0\] is outside the 36x24"),
        (lambda c: t3d.queries_from_pixels(c, [[0, 3, 3]], on_invalid="ignore"), "on_invalid"),
        (lambda c: t3d.track_many(t3d.load_tracker("static"), c, block=0), "block"),
    ],
)
def test_bad_queries_say_why(clip, call, message):
    with pytest.raises(ValueError, match=message):
        call(clip)


def test_a_frame_without_depth_has_no_support(clip):
    assert support_queries(clip, 4, frame=3).shape == (0, 4)
    tracker = t3d.Tracker(t3d.TrackerConfig.preset("lite", image_size=(24, 36), levels=2, window=4)).eval()
    rows = t3d.queries_from_pixels(clip, [[1, 4, 4], [2, 20, 9]])  # the pass backward begins where nothing is known
    assert np.isfinite(tracker.track(clip, rows, support_grid=2).xyz).all()


def test_blocks_are_tracked_one_after_another(clip):
    tracker = t3d.Tracker(t3d.TrackerConfig.preset("lite", image_size=(24, 36), levels=2, window=4)).eval()
    rows, sizes = t3d.dense_queries(clip, step=5), []
    once = tracker.track(clip, rows)
    whole = t3d.track_many(tracker, clip, rows)
    np.testing.assert_array_equal(whole.xyz, once.xyz)
    np.testing.assert_array_equal(whole.visible_logits, once.visible_logits)
    tracker.context.register_forward_hook(lambda *given: sizes.append(given[2].shape[2]))
    parts = t3d.track_many(tracker, clip, rows, block=8, support_grid=0)
    assert parts.xyz.shape == once.xyz.shape and max(sizes) == 8
    np.testing.assert_array_equal(parts.xyz[:, :8], tracker.track(clip, rows[:8], support_grid=0).xyz)
    np.testing.assert_array_equal(parts.xyz[:, 8:16], tracker.track(clip, rows[8:16], support_grid=0).xyz)
    static = t3d.track_many(t3d.load_tracker("static"), clip, rows, block=8)
    assert static.visible_logits is None and static.xyz.shape == once.xyz.shape


def test_the_command_lines_choice(clip, tmp_path):
    (tmp_path / "p.csv").write_text("# t, u, v\n2, 6, 12\n0, 3, 4\n")
    rows, note = QueryChoice(pixels=tmp_path / "p.csv", on_invalid="skip").of(clip)
    assert len(rows) == 1 and note == "; rows [0] on invalid depth skipped"
    mask = np.zeros(clip.size, np.uint8)
    mask[3, 4:6] = 255
    cv2.imwrite(str(tmp_path / "m.png"), mask)
    np.testing.assert_array_equal(
        QueryChoice(mask=tmp_path / "m.png", frame=1).of(clip)[0], t3d.dense_queries(clip, 1, mask > 0)
    )
    assert len(QueryChoice(dense=True, step=3).of(clip)[0]) == 8 * 12
    np.testing.assert_array_equal(QueryChoice(grid=3, frame=1).of(clip)[0], t3d.grid_queries(clip, 3, 1))
    own = replace(clip, queries=rows)
    assert QueryChoice().of(own)[0] is own.queries and len(QueryChoice(own_queries=False, grid=2).of(own)[0]) == 4
    (tmp_path / "bad.csv").write_text("zero,one\n")
    for name, message in (("bad.csv", "lines of numbers"), ("absent.csv", "lines of numbers")):
        with pytest.raises(ValueError, match=message):
            QueryChoice(pixels=tmp_path / name).of(clip)
    for name in ("p.csv", "absent.png"):
        with pytest.raises(ValueError, match="not a readable image"):
            QueryChoice(mask=tmp_path / name).of(clip)


def test_points_picked_in_the_explorer(clip):
    from lessons.widgets import PointPicker

    picker = PointPicker(clip, width=360)
    assert picker.pixels.shape == (0, 3) and "const u=" in picker.children[1].value
    picker.text.value = "0, 3, 4; 2,6,12;2 30.4 2"  # as clicks and typing leave it
    np.testing.assert_allclose(picker.pixels, [[0, 3, 4], [2, 6, 12], [2, 30.4, 2]], rtol=1e-6)
    assert len(t3d.queries_from_pixels(clip, picker.pixels, on_invalid="skip")) == 2
    assert picker.children[1].value.count("●") == 1
    picker.frame.value = 2
    assert "Frame 2" in picker.children[1].value
    assert picker.children[1].value.count("●") == 1 and picker.children[1].value.count("✕") == 1  # no depth there
    picker.text.value += "; 1, half"
    assert "expected t, u, v" in picker.children[1].value
    with pytest.raises(ValueError, match="expected t, u, v"):
        picker.pixels  # noqa: B018
