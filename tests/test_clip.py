"""Clip, Tracks and their files: round trips, and every kind of bad input refused with a useful message."""

import zipfile
from dataclasses import replace

import numpy as np
import pytest

import tapip3d_lite as t3d
from tapip3d_lite.files import atomic_path


def arrays(frames=3, height=6, width=8):
    rng = np.random.default_rng(0)
    k = np.array([[8, 0, (width - 1) / 2], [0, 8, (height - 1) / 2], [0, 0, 1.0]])
    e = np.tile(np.eye(4), (frames, 1, 1))
    e[:, 0, 3] = 0.1 * np.arange(frames)
    return {
        "video": rng.integers(0, 256, (frames, height, width, 3)).astype(np.uint8),
        "depths": rng.uniform(1, 3, (frames, height, width)).astype(np.float32),
        "intrinsics": np.tile(k, (frames, 1, 1)),
        "extrinsics": e,
    }


def clip_with_tracks():
    clip = t3d.Clip(**arrays())
    queries = t3d.queries_from_pixels(clip, [[0, 2, 3], [2, 7, 0]])
    tracks = t3d.Tracks(
        np.repeat(queries[None, :, 1:], 3, 0),
        np.array([[1, 0], [1, 1], [0, 1]]),
        queries,
        dynamic=np.array([True, False]),
    )
    return replace(
        clip,
        queries=queries,
        tracks=tracks,
        name="two",
        fps=24.0,
        extras={"video_right": clip.video + 1, "note": np.array("hi")},
    )


def test_round_trip_keeps_everything_and_unknown_keys(tmp_path):
    clip = clip_with_tracks()
    clip.save(tmp_path / "deep" / "clip.npz")
    again = t3d.load_clip(tmp_path / "deep" / "clip.npz")
    for key in ("video", "depths", "intrinsics", "extrinsics", "queries"):
        np.testing.assert_array_equal(getattr(again, key), getattr(clip, key))
    for key in ("xyz", "visible", "queries", "dynamic"):
        np.testing.assert_array_equal(getattr(again.tracks, key), getattr(clip.tracks, key))
    assert (again.name, again.fps) == ("two", 24.0)
    assert set(again.extras) == {"video_right", "note"} and str(again.extras["note"]) == "hi"
    again.save(tmp_path / "again.npz")
    with np.load(tmp_path / "again.npz") as a, np.load(tmp_path / "deep" / "clip.npz") as b:
        assert set(a.files) == set(b.files)
        assert all(np.array_equal(a[k], b[k]) for k in a.files)


def test_the_authors_file_loads_as_it_is(tmp_path):
    theirs = arrays() | {"query_point": np.array([[1, 0.0, 0.1, 2.0]])}
    np.savez(tmp_path / "theirs.npz", **theirs)
    clip = t3d.load_clip(tmp_path / "theirs.npz")
    assert clip.queries.tolist() == theirs["query_point"].astype(np.float32).tolist()
    assert clip.tracks is None and clip.name == "theirs" and len(clip) == 3 and clip.size == (6, 8)


def test_one_camera_serves_all_frames(tmp_path):
    data = arrays()
    np.savez(tmp_path / "c.npz", **data | {"intrinsics": data["intrinsics"][0], "extrinsics": data["extrinsics"][0]})
    assert t3d.load_clip(tmp_path / "c.npz").intrinsics.shape == (3, 3, 3)


def test_results_are_the_authors_result_format(tmp_path):
    clip = clip_with_tracks()
    clip.tracks.save(tmp_path / "r.npz", clip)
    with np.load(tmp_path / "r.npz") as data:
        assert data["video"].shape == (3, 3, 6, 8) and data["video"].max() <= 1
        assert {"coords", "visibs", "query_points", "depths", "intrinsics", "extrinsics"} <= set(data.files)
    again = t3d.load_tracks(tmp_path / "r.npz")
    np.testing.assert_array_equal(again.xyz, clip.tracks.xyz)
    with pytest.raises(ValueError, match="coords"):
        clip.save(tmp_path / "c.npz")
        t3d.load_tracks(tmp_path / "c.npz")


def test_invalid_depth_becomes_zero_and_points_nan():
    data = arrays()
    data["depths"][0, 0, :3] = [np.nan, -1, np.inf]
    clip = t3d.Clip(**data)
    assert clip.depths[0, 0, :3].tolist() == [0, 0, 0]
    assert np.isnan(clip.points()[0, 0, :3]).all() and np.isfinite(clip.points("camera")[1:]).all()
    with pytest.raises(ValueError, match="space"):
        clip.points("moon")


def test_cut_moves_queries_and_drops_those_outside():
    part = clip_with_tracks().cut(1, 3)
    assert len(part) == 2 and part.queries[:, 0].tolist() == [1.0]
    assert part.tracks.xyz.shape == (2, 1, 3) and part.extras["video_right"].shape[0] == 2
    with pytest.raises(ValueError, match="cut"):
        part.cut(1, 5)


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "x.npz"
    path.write_text("old")

    def write():
        with atomic_path(path) as temporary:
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write()
    assert path.read_text() == "old" and [p.name for p in tmp_path.iterdir()] == ["x.npz"]


BAD = {
    "video dtype": ({"video": np.zeros((3, 6, 8, 3), np.float32)}, "uint8"),
    "video axes": ({"video": np.zeros((3, 3, 6, 8), np.uint8)}, "colour axis last"),
    "zero frames": ({"video": np.zeros((0, 6, 8, 3), np.uint8)}, "zero frames"),
    "depth shape": ({"depths": np.ones((3, 8, 6))}, r"Clip.depths: expected shape \(3, 6, 8\).*got \(3, 8, 6\)"),
    "depth dtype": ({"depths": np.full((3, 6, 8), "x")}, "dtype"),
    "all-invalid depth": ({"depths": np.zeros((3, 6, 8))}, "no valid pixel"),
    "NaN intrinsics": ({"intrinsics": np.full((3, 3, 3), np.nan)}, "Clip.intrinsics: expected finite"),
    "negative focal": ({"intrinsics": -np.tile(np.eye(3), (3, 1, 1))}, "positive"),
    "transposed intrinsics": (
        {"intrinsics": arrays()["intrinsics"].swapaxes(-1, -2)},
        r"\[0 0 1\], got .* frame 0; transpose",
    ),
    "skewed intrinsics": ({"intrinsics": arrays()["intrinsics"] + [[0, 0, 0], [0.5, 0, 0], [0, 0, 0]]}, r"\[0 fy cy\]"),
    "scaled intrinsics": ({"intrinsics": 2 * arrays()["intrinsics"]}, "divide it by its last number"),
    "frames differ": ({"extrinsics": np.tile(np.eye(4), (2, 1, 1))}, r"Clip.extrinsics: expected shape \(3, 4, 4\)"),
    "scaled rotation": ({"extrinsics": np.tile(np.diag([2, 2, 2, 1.0]), (3, 1, 1))}, "not a rigid"),
    "mirrored": ({"extrinsics": np.tile(np.diag([-1, 1, 1, 1.0]), (3, 1, 1))}, "not a rigid"),
    "query frame": ({"queries": [[3, 0, 0, 2.0]]}, r"frame index in \[0, 2\], got 3"),
    "fractional frame": ({"queries": [[0.5, 0, 0, 2.0]]}, "whole frame"),
    "query outside": ({"queries": [[0, 50, 0, 2.0]]}, "outside the view"),
    "query behind": ({"queries": [[0, 0, 0, -2.0]]}, "outside the view"),
    "query shape": ({"queries": [[0, 0, 0]]}, r"\(N, 4\)"),
    "query NaN": ({"queries": [[0, 0, np.nan, 1]]}, "finite"),
    "fps": ({"fps": 0.0}, "fps"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_arrays_are_named(case):
    change, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        t3d.Clip(**arrays() | change)


def test_bad_tracks_are_named():
    clip = clip_with_tracks()
    with pytest.raises(ValueError, match=r"Tracks.visible: expected shape \(3, 2\)"):
        t3d.Tracks(clip.tracks.xyz, clip.tracks.visible.T, clip.queries)
    with pytest.raises(ValueError, match="booleans"):
        t3d.Tracks(clip.tracks.xyz, clip.tracks.visible * 0.3, clip.queries)
    with pytest.raises(ValueError, match="3 frames"):
        replace(clip, tracks=t3d.Tracks(clip.tracks.xyz[:2], clip.tracks.visible[:2], clip.queries))


@pytest.mark.parametrize(
    ("pixel", "message"), [([0, 8, 0], "outside the 8x6"), ([0, 1, 1], "invalid depth"), ([9, 1, 2], "frame index")]
)
def test_pixel_queries_outside_or_without_depth(pixel, message):
    data = arrays()
    data["depths"][0, 1, 1] = 0
    with pytest.raises(ValueError, match=message):
        t3d.queries_from_pixels(t3d.Clip(**data), [pixel])


def test_grid_skips_invalid_depth_and_lies_on_the_surface():
    data = arrays()
    data["depths"][1, :3] = 0
    clip = t3d.Clip(**data)
    grid = t3d.grid_queries(clip, 4, frame=1)
    assert len(grid) == 8 and (grid[:, 0] == 1).all()
    assert len(t3d.resolve_queries(clip, None, grid=2)) == 4
    with pytest.raises(ValueError, match="grid_queries"):
        t3d.grid_queries(clip, 0)


def bad_files(folder):
    good = folder / "good.npz"
    np.savez(good, **arrays())
    (folder / "truncated.npz").write_bytes(good.read_bytes()[:-200])
    (folder / "text.npz").write_text("not a zip")
    (folder / "empty.npz").write_bytes(b"")
    np.save(folder / "bare.npy", np.zeros(3))
    np.savez(folder / "pickled.npz", **arrays() | {"video": np.array([{"a": 1}], dtype=object)})
    np.savez(folder / "rgb_only.npz", video=arrays()["video"])
    np.savez(folder / "scalar.npz", **arrays() | {"video": np.array(3), "intrinsics": np.eye(3)})
    with zipfile.ZipFile(folder / "foreign.npz", "w") as archive:
        archive.writestr("readme.txt", "hello")
    data = arrays() | {"tracks": np.zeros((3, 2, 3))}
    np.savez(folder / "halftracks.npz", **data)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("truncated.npz", "not a readable npz"),
        ("text.npz", "not a readable npz"),
        ("empty.npz", "not a readable npz"),
        ("bare.npy", "not a readable npz"),
        ("pickled.npz", "not a readable npz"),
        ("absent.npz", "no such file"),
        ("rgb_only.npz", "depths, intrinsics, extrinsics missing"),
        ("scalar.npz", "Clip.video"),
        ("foreign.npz", "readme.txt, which is no array"),
        ("halftracks.npz", "visible, query_point missing"),
    ],
)
def test_bad_files_are_value_errors(tmp_path, name, message):
    bad_files(tmp_path)
    with pytest.raises(ValueError, match=message):
        t3d.load_clip(tmp_path / name)
