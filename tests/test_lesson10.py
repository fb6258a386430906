"""Lesson 10: its recording read back, its measures against loops, its mistakes named, its matcher the library's, a milestone that notices."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

import tapip3d_lite as t3d
from lessons import n10, n10_measure
from lessons.n10_folder import START, quaternion
from lessons.widgets import PointPicker
from tapip3d_lite.depth import _matched
from tapip3d_lite.evaluation.intervals import Estimate
from tapip3d_lite.geometry import invert, transform
from tests.milestones import notices


@pytest.fixture(scope="module")
def source():
    clip = t3d.simulate_clip(1001, camera="handheld", handheld=2.0, frames=18, size=(72, 96), tracks=24)
    return replace(clip, depths=n10.sensor(clip, 0))


def test_a_recording_is_read_as_what_was_written(source, tmp_path):
    kept = n10.write_recording(source, tmp_path / "desk")
    clip = t3d.load_clip(tmp_path / "desk")
    assert kept == [t for t in range(18) if t not in (4, 15)] and len(clip) == len(kept)
    assert np.array_equal(clip.video, source.video[kept])
    near = np.where(source.depths < 65534.5 / n10.SCALE, source.depths, 0)[kept]
    assert (near == 0).sum() > (source.depths[kept] == 0).sum()  # some lies farther than 16 bits reach
    np.testing.assert_allclose(clip.depths, near, atol=0.5 / n10.SCALE + 1e-6)
    np.testing.assert_allclose(clip.extrinsics, source.extrinsics[kept], atol=1e-5)
    np.testing.assert_allclose(clip.intrinsics, source.intrinsics[kept], rtol=1e-6)
    assert clip.fps == pytest.approx(source.fps, rel=0.02)
    times, files = n10.stamps(tmp_path / "desk" / "depth.txt")
    assert len(times) == len(kept) and times.dtype == np.float64 and all(file.is_file() for file in files)
    assert times[0] - START < 0.02 and n10.stored(files[0]).dtype == np.uint16
    text = n10.listing(tmp_path / "desk")
    assert "depth/  16 files" in text and "rgb.txt  19 lines" in text and str(tmp_path) not in text


def test_quaternions_are_those_of_the_rotations():
    rng = np.random.default_rng(0)
    for _ in range(20):
        vector = rng.normal(size=3)
        x, y, z, w = quaternion(cv2.Rodrigues(vector)[0])
        p = rng.normal(size=3)
        axis = np.array([x, y, z])
        turned = p + 2 * np.cross(axis, np.cross(axis, p) + w * p)
        np.testing.assert_allclose(turned, cv2.Rodrigues(vector)[0] @ p, atol=1e-9)


def test_an_error_map_is_a_loops(source):
    t, s = 2, 9
    errors = n10.error_map(source, t, s)
    height, width = source.size
    by_loop = np.full((height, width), np.nan)
    lens = source.intrinsics[t].astype(np.float64)
    e, e_s = (x.astype(np.float64) for x in source.extrinsics[[t, s]])
    for v in range(height):
        for u in range(width):
            z = float(source.depths[t, v, u])
            if z > 0:
                ray = np.linalg.inv(lens) @ [u, v, 1]
                p = transform(transform(z * ray[None], invert(e)), e_s)[0]
                column, row = np.rint((lens @ p / p[2])[:2]).astype(int)
                if p[2] > 0 and 0 <= column < width and 0 <= row < height and source.depths[s, row, column] > 0:
                    by_loop[v, u] = abs(p[2] / source.depths[s, row, column] - 1)
    np.testing.assert_allclose(errors, by_loop, rtol=1e-6, atol=1e-7)
    assert n10.misfit(source, 3) < 0.05 < n10.misfit(replace(source, depths=1 / np.maximum(source.depths, 0.1)), 8)
    alone = np.where(np.arange(len(source))[:, None, None] == 0, source.depths, 0)
    assert n10.misfit(replace(source, depths=alone), 3) == 1.0  # nothing to compare with


def test_fingerprints_show_what_each_mistake_changes(source):
    clip = n10.without_points(source)
    healthy = n10.fingerprint(clip)
    print_of = {name: n10.fingerprint(plant(clip)) for name, plant in n10.SUSPECTS.items()}
    assert print_of["depth_in_millimetres"]["depth"] == pytest.approx(1000 * healthy["depth"], rel=1e-4)
    assert print_of["colour_mirrored"]["far"] == healthy["far"]
    assert print_of["colour_mirrored"]["colour"] > 3 * healthy["colour"]
    assert print_of["camera_to_world"]["travel"] != pytest.approx(healthy["travel"], rel=0.01)
    assert print_of["focal_length"]["far"] > 1.3 * healthy["far"]
    for name in ("ray_length", "disparity"):
        assert print_of[name]["bend"] > healthy["bend"] + 1
    for name, row in print_of.items():
        assert row != healthy, name
    assert len(n10.SUSPECTS["poses_shifted_in_time"](clip)) == len(clip) - 3


def test_every_suspect_can_be_drawn_and_undone(source):
    clip = n10.without_points(source)
    drawn = {n10.planted(clip, seed)[1] for seed in range(40)}
    assert drawn == set(n10.SUSPECTS)
    patient, name = n10.planted(clip, 5)
    again, same = n10.planted(clip, 5)
    assert name == same and np.array_equal(patient.intrinsics, again.intrinsics)
    found = n10.undone(n10.SUSPECTS["colour_mirrored"](clip))
    assert list(found) == ["as it is", *n10.SUSPECTS]
    assert min(found, key=lambda row: found[row][1]) == "colour_mirrored"
    assert found["as it is"][1] > 2 * found["colour_mirrored"][1]


def test_matches_are_the_librarys_before_it_compares_them():
    clip = n10.benchmark_clips(1, 2, 12)[0]
    assert len(clip) == 2 and clip.tracks.xyz.shape == (2, 12, 3) and "video_right" in clip.extras
    left, right = n10.pair(clip, 0)
    assert left.shape == tuple(3 * n for n in clip.size)
    depth = n10.EXERCISES[3].reference(*n10.disparities(left, right, 50), 1.0, 1.0)
    library = _matched(left, right, 50)
    np.testing.assert_allclose(np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0), library, rtol=1e-6)
    for source in (n10.sensor, n10.stereo, n10.sparse):
        error, within, known = n10.depth_errors(source(clip, 0), clip.depths)
        assert 0 < error < 0.15 and 0.7 < within < 1 and known > 0.7
    assert n10.depth_errors(clip.depths, clip.depths) == (0, 1, 1)


def test_step_errors_are_those_that_were_made(source):
    assert max(x.max() for x in n10.step_errors(source, source)) < 1e-3
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(np.radians([0, 2.0, 0]))[0]
    turn[:3, 3] = 0.03, 0, 0
    poses = source.extrinsics.astype(np.float64)
    poses[5:] = turn @ poses[5:]
    degrees, metres = n10.step_errors(replace(source, extrinsics=poses, queries=None, tracks=None), source)
    assert degrees.argmax() == metres.argmax() == 4 and degrees[4] == pytest.approx(2, abs=0.01)
    assert degrees[3] < 1e-3  # before it nothing has changed
    np.testing.assert_allclose(n10.places(source), invert(source.extrinsics)[:, :3, 3], atol=1e-5)


def test_figures_can_be_drawn(source):
    errors, depth = n10.error_map(source, 0, 5), source.depths[0]
    value, rows = Estimate(0.2, 0.1, 0.3), ("true", "sensor", "sensor, filtered")
    track = source.tracks.select(slice(0, 4))
    path = n10.places(source)
    steps = np.full(len(path) - 1, 0.01)
    for figure in (
        n10.errors_figure(source.video[0], {"one": errors, "two": errors}, "frame 0"),
        n10.remedies_chart({"as it is": (0.1, 0.5), "disparity": (0.01, 0.05)}, (0.045, 0.15)),
        n10.matched_figure(source.video[0], depth, depth, depth),
        n10.sources_figure(source.video[0], dict.fromkeys(rows, depth), depth),
        n10.costs_chart(dict.fromkeys(rows, value), {"sensor": value}, "AJ3D", "true depth"),
        n10.paths_figure({"one": (path, path), "two": (path, path)}, {"one": steps, "two": steps}),
        n10.picks_figure(source, track, (0, 8)),
    ):
        figure.canvas.draw()


def test_a_click_becomes_a_query(source):
    picker = PointPicker(source)
    assert len(picker.pixels) == 0
    v, u = np.argwhere(source.depths[3] > 0)[40]
    picker.text.value = f"3, {u}, {v}; "
    queries = t3d.queries_from_pixels(source, picker.pixels)
    uv, z = t3d.geometry.project(queries[:, 1:], source.intrinsics[3], source.extrinsics[3])
    np.testing.assert_allclose(uv[0], (u, v), atol=1e-3)
    assert z[0] == pytest.approx(source.depths[3, v, u], rel=1e-5)


def test_the_milestone_notices_what_is_not_the_librarys():
    notices(n10, "10", ("thousand", "no limit", "turned", "no check", "not aligned"), tracker="static")
    assert n10_measure.carried is n10.EXERCISES[2].reference  # nothing stays plugged in
