"""Tracks written for other programs, read back; a suffix that is not known is refused."""

import csv

import cv2
import numpy as np
import plotly.graph_objects as go
import pytest

import tapip3d_lite as t3d
from tapip3d_lite.export import overlay
from tapip3d_lite.figures.flat import track_colors
from tapip3d_lite.geometry import project


@pytest.fixture(scope="module")
def clip():
    return t3d.simulate_clip(seed=4, frames=5, size=(47, 63), camera="handheld", tracks=7)


def test_csv(clip, tmp_path):
    xyz = clip.tracks.xyz.copy()
    xyz[2, 3] = (
        t3d.geometry.invert(clip.extrinsics)[2, :3, :3] @ [0, 0, -1] + t3d.geometry.invert(clip.extrinsics)[2, :3, 3]
    )
    tracks = t3d.Tracks(xyz, clip.tracks.visible, clip.tracks.queries)
    t3d.export_tracks(tracks, tmp_path / "a.csv", clip)
    with open(tmp_path / "a.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 35 and list(rows[0]) == ["frame", "track", "x", "y", "z", "visible", "u", "v"]
    uv, _ = project(xyz, clip.intrinsics, clip.extrinsics)
    for row in rows:
        t, n = int(row["frame"]), int(row["track"])
        np.testing.assert_allclose([float(row[k]) for k in "xyz"], xyz[t, n], rtol=1e-6)
        assert row["visible"] == str(int(tracks.visible[t, n]))
        if (t, n) == (2, 3):
            assert row["u"] == row["v"] == ""  # behind the camera
        else:
            np.testing.assert_allclose([float(row["u"]), float(row["v"])], uv[t, n], atol=6e-4)
    assert [(int(r["frame"]), int(r["track"])) for r in rows] == [(t, n) for t in range(5) for n in range(7)]


def test_ply(clip, tmp_path):
    t3d.export_tracks(clip.tracks, tmp_path / "a.ply", clip)
    head, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    names = [line.split()[1:] for line in lines if line.startswith("property")]
    codes = {"float": "<f4", "uchar": "u1", "int": "<i4"}
    vertex = np.dtype([(name, codes[kind]) for kind, name in names[:-2]])
    counts = [int(line.split()[2]) for line in lines if line.startswith("element")]
    assert counts == [35, 28] and len(body) == 35 * vertex.itemsize + 28 * 8
    points = np.frombuffer(body[: 35 * vertex.itemsize], vertex).reshape(5, 7)
    np.testing.assert_array_equal(np.stack([points[k] for k in "xyz"], -1), clip.tracks.xyz)
    np.testing.assert_array_equal(points["visible"], clip.tracks.visible)
    colors = np.stack([points[k][0] for k in ("red", "green", "blue")], -1)
    np.testing.assert_allclose(colors / 255, track_colors(clip, clip.tracks), atol=0.002)
    edges = np.frombuffer(body[35 * vertex.itemsize :], "<i4").reshape(28, 2)
    flat = points.ravel()
    assert (flat["track"][edges[:, 0]] == flat["track"][edges[:, 1]]).all()
    assert (flat["frame"][edges[:, 1]] - flat["frame"][edges[:, 0]] == 1).all()


def test_npz_is_the_authors_result(clip, tmp_path):
    t3d.export_tracks(clip.tracks, tmp_path / "a.npz", clip)
    np.testing.assert_array_equal(t3d.load_tracks(tmp_path / "a.npz").xyz, clip.tracks.xyz)
    np.testing.assert_array_equal(t3d.load_clip(tmp_path / "a.npz").depths, clip.depths)


def test_films_show_the_overlay(clip, tmp_path):
    drawn = overlay(clip.tracks, clip)
    assert drawn.shape == (5, 470, 630, 3) and drawn.dtype == np.uint8
    uv, z = project(clip.tracks.xyz, clip.intrinsics, clip.extrinsics)
    colors = track_colors(clip, clip.tracks)
    inside = clip.tracks.visible & (z > 0) & (uv > 1).all(-1) & (uv < (61, 45)).all(-1)
    alone = np.linalg.norm(uv[:, :, None] - uv[:, None], axis=-1) + 99 * np.eye(7)
    hits = [(t, n) for t, n in np.argwhere(inside) if alone[t, n].min() > 2]
    assert len(hits) > 5
    for t, n in hits:
        u, v = np.rint((uv[t, n] + 0.5) * 10 - 0.5).astype(int)
        np.testing.assert_allclose(drawn[t, v, u] / 255, colors[n], atol=0.02)
    t3d.export_tracks(clip.tracks, tmp_path / "a.mp4", clip)
    film = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    frames = []
    while film.grab():
        frames.append(film.retrieve()[1][..., ::-1])
    assert film.get(cv2.CAP_PROP_FPS) == clip.fps and len(frames) == 5
    assert np.abs(np.stack(frames).astype(int) - drawn).mean() < 8
    t3d.export_tracks(clip.tracks, tmp_path / "a.gif", clip)
    read, gif = cv2.imreadanimation(str(tmp_path / "a.gif"))
    assert (
        read and len(gif.frames) == 5 and np.abs(gif.frames[3][..., 2::-1].astype(int) - drawn[3]).mean() < 20
    )  # 256 fixed colours


def test_points_far_outside_or_unknown_do_no_harm(clip):
    xyz = clip.tracks.xyz.copy()
    xyz[1, 0], xyz[2, 1] = np.nan, 1e20
    drawn = overlay(t3d.Tracks(xyz, clip.tracks.visible, clip.tracks.queries), clip)
    assert drawn.shape[0] == 5


def test_an_unknown_suffix_writes_nothing(clip, tmp_path):
    figure = t3d.figures.overview(clip, clip.tracks, columns=1)
    for write in (
        lambda: t3d.export_tracks(clip.tracks, tmp_path / "a.xyz", clip),
        lambda: t3d.export_tracks(clip.tracks, tmp_path / "a", clip),
        lambda: clip.tracks.save(tmp_path / "a.csv", clip),
        lambda: clip.save(tmp_path / "a.mat"),
        lambda: t3d.figures.save_png(figure, tmp_path / "a.jpg"),
        lambda: t3d.figures.save_html(go.Figure(), tmp_path / "a.png"),
    ):
        with pytest.raises(ValueError, match=r"this is written as .*, got (\.\w+|no suffix); rename it"):
            write()
    with pytest.raises(ValueError, match="expected 4 frames"):
        t3d.export_tracks(clip.tracks, tmp_path / "a.csv", clip.cut(0, 4))
    assert not list(tmp_path.iterdir())
