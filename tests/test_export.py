"""Tracks written for other programs, read back; a suffix that is not known is refused."""

import csv
import json
import os
import re
import subprocess
import sys
from urllib.request import urlopen

import cv2
import numpy as np
import plotly.graph_objects as go
import pytest

import tapip3d_lite as t3d
from tapip3d_lite.export import check_export, overlay
from tapip3d_lite.figures.flat import track_colors
from tapip3d_lite.geometry import project, transform


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


@pytest.mark.parametrize("name", ["\udcff.mp4", "\udcff.gif"])
def test_a_name_that_opencv_cannot_take_is_refused(clip, tmp_path, name):
    with pytest.raises(ValueError, match="no UTF-8"):
        t3d.export_tracks(clip.tracks, tmp_path / name, clip)
    assert not list(tmp_path.iterdir())
    t3d.save_clip(clip, tmp_path / "\udcff")  # images need no name there
    assert len(t3d.load_clip(tmp_path / "\udcff")) == len(clip)


def test_what_cannot_be_written_is_known_before_the_work(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file" / "a.csv", "/proc/a.csv" if os.getuid() else tmp_path / "file" / "b.npz"):
        with pytest.raises(ValueError, match="no folder in which files can be written"):
            check_export(path)
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ValueError, match="rerun-sdk"):
        check_export(tmp_path / "a.rrd")
    assert check_export(tmp_path / "new" / "A.CSV") == ".csv"


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


def test_glb(clip, tmp_path):
    """glTF lines with their colours, in the first camera's frame with y up; read back by the same library."""
    trimesh = pytest.importorskip("trimesh")
    t3d.export_tracks(clip.tracks, tmp_path / "a.glb", clip)
    scene = trimesh.load(tmp_path / "a.glb")
    assert len(scene.geometry) == 8
    for n in range(7):
        pose, name = scene.graph[f"track {n}"]
        line = scene.geometry[name]
        places = trimesh.transform_points(np.asarray(line.vertices), pose)
        path = transform(clip.tracks.xyz[:, n], clip.extrinsics[0]) * [1, -1, -1]
        np.testing.assert_allclose(places, np.stack([path[:-1], path[1:]], 1).reshape(-1, 3), rtol=1e-5, atol=1e-6)
    data = (tmp_path / "a.glb").read_bytes()  # the library that wrote them does not read lines' colours
    size = int.from_bytes(data[12:16], "little")
    head, body = json.loads(data[20 : 20 + size]), data[28 + size :]
    meshes = {mesh["name"]: mesh["primitives"][0]["attributes"] for mesh in head["meshes"]}
    for n, wanted in enumerate(np.rint(255 * track_colors(clip, clip.tracks))):
        accessor = head["accessors"][meshes[f"track {n}"]["COLOR_0"]]
        begin = head["bufferViews"][accessor["bufferView"]].get("byteOffset", 0)
        found = np.frombuffer(body, np.uint8, 4 * accessor["count"], begin).reshape(-1, 4)
        assert np.abs(found[:, :3] - wanted).max() <= 1
    _, name = scene.graph["frame 0"]
    cloud = scene.geometry[name]
    uv, z = project(np.asarray(cloud.vertices)[None] * [1, -1, -1], clip.intrinsics[:1])
    column, row = np.rint(uv[0]).astype(int).T
    np.testing.assert_allclose(z[0], clip.depths[0][row, column], rtol=1e-4)
    np.testing.assert_array_equal(np.asarray(cloud.colors)[:, :3], clip.video[0][row, column])


def test_rrd(clip, tmp_path):
    pytest.importorskip("rerun")
    t3d.export_tracks(clip.tracks, tmp_path / "a.rrd", clip)
    assert [path.name for path in tmp_path.iterdir()] == ["a.rrd"]
    told = [sys.executable, "-m", "rerun", "rrd"]
    subprocess.run([*told, "verify", tmp_path / "a.rrd"], check=True, capture_output=True)
    text = subprocess.run([*told, "print", "-v", tmp_path / "a.rrd"], check=True, capture_output=True, text=True).stdout
    for part in (
        "tracks/visible",
        "tracks/hidden",
        "tracks/tails",
        "camera",
        "camera/image/video",
        "camera/image/depth",
    ):
        assert re.search(rf"with 5 rows .* - /world/{part} ", text), part


def test_tracks_are_served_by_viser(clip):
    viser = pytest.importorskip("viser")
    server = t3d.serve_tracks(clip.tracks, clip, port=18923)
    try:
        assert isinstance(server, viser.ViserServer)
        with urlopen("http://localhost:18923") as page:
            assert b"viser" in page.read().lower()
    finally:
        server.stop()
    with pytest.raises(ValueError, match="frames"):
        t3d.serve_tracks(clip.tracks, clip.cut(0, 3))


@pytest.mark.parametrize(("name", "package"), [("a.glb", "trimesh"), ("a.rrd", "rerun-sdk"), ("", "viser")])
def test_what_needs_another_package_says_so(clip, tmp_path, monkeypatch, name, package):
    for module in ("trimesh", "rerun", "viser"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ValueError, match=f"pip install {package}"):
        if name:
            t3d.export_tracks(clip.tracks, tmp_path / name, clip)
        else:
            t3d.serve_tracks(clip.tracks, clip)
    assert not list(tmp_path.iterdir())
