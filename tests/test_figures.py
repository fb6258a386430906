"""Figures are checked by their state, not by their pixels."""

import base64
import io
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

import tapip3d_lite as t3d
from lessons import n00
from lessons.widgets import explore
from tapip3d_lite.figures import png_bytes


@pytest.fixture(scope="module")
def clip():
    clip = t3d.simulate_clip(seed=1, frames=5, size=(48, 64), tracks=40)
    depths = clip.depths.copy()
    depths[:, :6, :6] = 0
    return replace(clip, depths=depths)


def unpack(value):
    if isinstance(value, dict):
        return np.frombuffer(base64.b64decode(value["bdata"]), value["dtype"])
    return np.asarray(value, float)


def test_3d_scene_keeps_ranges_and_has_a_step_for_each_frame(clip):
    figure = t3d.figures.tracks_3d(clip, clip.tracks, points=300)
    layout = figure.layout
    assert len(figure.frames) == len(layout.sliders[0].steps) == 5
    assert [f.name for f in figure.frames] == [s.args[0][0] for s in layout.sliders[0].steps] == list("01234")
    assert layout.uirevision == "keep" and layout.scene.aspectmode == "manual"
    for step in layout.sliders[0].steps:
        assert step.args[1]["mode"] == "immediate" and step.args[1]["frame"]["redraw"] is True
    for name in "xyz":
        axis, ratio = layout.scene[f"{name}axis"], layout.scene.aspectratio[name]
        assert axis.autorange is False and axis.range[0] < axis.range[1] and "scene units" in axis.title.text
        # One scale for all axes, whatever a frame shows.
        assert ratio / (axis.range[1] - axis.range[0]) == pytest.approx(
            layout.scene.aspectratio.x / np.ptp(layout.scene.xaxis.range)
        )
    for frame in figure.frames:
        cloud, tails, heads = frame.data
        assert 0 < len(cloud.x) <= 300 and np.isfinite(cloud.x).all() and np.asarray(cloud.x).dtype == np.float32
        assert len(heads.x) == len(heads.marker.symbol) == len(set(tails.line.color.tolist()))


def test_heads_stand_on_the_tracks_and_show_occlusion(clip):
    figure = t3d.figures.tracks_3d(clip, clip.tracks, points=50, max_tracks=1000)
    heads = figure.frames[3].data[2]
    drawn = np.stack([heads.x, heads.y, heads.z], -1)
    distance = np.linalg.norm(drawn[:, None] - clip.tracks.xyz[3][None], axis=-1)
    assert distance.min(1).max() < 1e-6
    hollow = np.array([s == "circle-open" for s in heads.marker.symbol])
    np.testing.assert_array_equal(hollow, ~clip.tracks.visible[3][distance.argmin(1)])


def test_colours_of_a_track_agree_between_figures(clip):
    colors = t3d.figures.track_colors(clip, clip.tracks)
    np.testing.assert_array_equal(t3d.figures.track_colors(clip, clip.tracks.select(slice(5, 9))), colors[5:9])
    flat = t3d.figures.frame_with_tracks(clip, clip.tracks, 2).axes[0]
    assert [tuple(line.get_color()) for line in flat.lines] == [tuple(c) for c in colors]


def test_frame_markers_are_hollow_where_occluded_and_at_the_projection(clip):
    ax = t3d.figures.frame_with_tracks(clip, clip.tracks, 3, truth=clip.tracks).axes[0]
    hollow, filled = ax.collections
    seen = clip.tracks.visible[3]
    assert (len(hollow.get_offsets()), len(filled.get_offsets())) == ((~seen).sum(), seen.sum())
    uv, _ = t3d.geometry.project(clip.tracks.xyz[3], clip.intrinsics[3], clip.extrinsics[3])
    np.testing.assert_allclose(filled.get_offsets(), uv[seen], atol=1e-3)
    assert len(hollow.get_facecolors()) == 0


def test_depth_masks_invalid_pixels(clip):
    figure = t3d.figures.depth_map(clip, 0)
    shown = figure.axes[0].images[0].get_array()
    assert shown.mask[:6, :6].all() and not shown.mask[20:, 20:].any()
    assert "scene units" in figure.axes[1].get_ylabel()


def test_html_is_self_contained_and_png_is_a_picture(clip, tmp_path):
    t3d.figures.save_html(t3d.figures.tracks_3d(clip, clip.tracks, points=200), tmp_path / "a.html")
    page = (tmp_path / "a.html").read_text()
    assert not re.findall(r"<(?:script|link)[^>]+(?:src|href)=", page)
    assert "Plotly.newPlot" in page and len(page) < 8e6
    t3d.figures.save_png(t3d.figures.overview(clip, clip.tracks), tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as picture:
        assert np.asarray(picture.convert("RGB")).std() > 20


def test_notebook_bundle_has_a_static_twin(clip):
    shown = t3d.figures.show_3d(
        t3d.figures.tracks_3d(clip, clip.tracks, points=200), t3d.figures.tracks_3d_static(clip, clip.tracks)
    )
    scene, twin = shown.bundles()
    assert "image/png" not in scene, "JupyterLab would show the PNG instead of the scene"
    assert len(scene["application/vnd.plotly.v1+json"]["frames"]) == 5 and "5 frames" in scene["text/plain"]
    cloud = scene["application/vnd.plotly.v1+json"]["data"][0]
    assert len(unpack(cloud["x"])) == 200
    with Image.open(io.BytesIO(twin["image/png"])) as picture:
        assert picture.size[0] > 300


def test_cloud_codes_stand_for_the_pixels_colours(clip):
    figure = t3d.figures.tracks_3d(clip, clip.tracks, points=10**6)
    scale = [re.findall(r"\d+", color) for _, color in figure.layout.coloraxis.colorscale]
    drawn = np.array(scale, int)[np.asarray(figure.frames[2].data[0].marker.color)]
    cloud = figure.frames[2].data[0]
    uv, z = t3d.geometry.project(np.stack([cloud.x, cloud.y, cloud.z], -1), clip.intrinsics[2], clip.extrinsics[2])
    u, v = np.rint(uv).astype(int).T
    np.testing.assert_allclose(z, clip.depths[2, v, u], rtol=1e-4)
    assert np.abs(drawn - clip.video[2, v, u]).max() <= 255 / 12


def opening(scene):
    """How a plotly scene opens: points (P, 3) to places in the image, whose upper and lower borders are -1 and 1."""
    ranges = np.array([scene[f"{k}axis"].range for k in "xyz"])
    scale = np.array([scene.aspectratio[k] for k in "xyz"]) / np.ptp(ranges, axis=1)
    up, eye, center = (np.array([scene.camera[name][k] for k in "xyz"]) for name in ("up", "eye", "center"))
    ahead = (center - eye) / np.linalg.norm(center - eye)
    right = np.cross(ahead, up) / np.linalg.norm(np.cross(ahead, up))

    def places(xyz):
        local = ((xyz - ranges.mean(1)) * scale - eye) @ np.stack([right, np.cross(right, ahead), ahead]).T
        assert (local[:, 2] > 0).all()
        return local[:, :2] / local[:, 2:] / np.tan(np.pi / 8)

    return places, ranges, ahead


SAMPLES = sorted((Path(__file__).parents[1] / "data_samples").glob("*.npz"))


def as_from_a_sensor(clip):
    """Noise, spikes, holes and a frame without depth; a world that is not level; no truth."""
    rng = np.random.default_rng(0)
    depths = clip.depths * rng.normal(1, 0.03, clip.depths.shape)
    depths *= np.where(rng.random(depths.shape) < 0.001, rng.uniform(0.1, 10, depths.shape), 1)
    depths *= rng.random(depths.shape) > 0.2
    depths[3] = 0
    tilt = t3d.geometry.look_at(np.array([3.0, -2, 5]), np.array([0.0, 1, 0]), np.array([0.3, 0.2, 1]))
    tracks = replace(clip.tracks, xyz=t3d.geometry.transform(clip.tracks.xyz, tilt), dynamic=None)
    queries = np.c_[clip.queries[:, :1], t3d.geometry.transform(clip.queries[:, 1:], tilt)]
    tracks = replace(tracks, queries=queries)
    poses = clip.extrinsics @ t3d.geometry.invert(tilt)
    return replace(clip, depths=depths, extrinsics=poses, queries=queries, tracks=tracks)


@pytest.mark.parametrize("path", [*SAMPLES, "sensor"], ids=lambda p: Path(p).stem)
def test_scene_opens_on_all_that_is_drawn_in_any_frame(path):
    shown = as_from_a_sensor(t3d.load_clip(SAMPLES[0])) if path == "sensor" else t3d.load_clip(path)
    figure = t3d.figures.tracks_3d(shown, shown.tracks, points=600)
    places, ranges, ahead = opening(figure.layout.scene)
    clouds, _, heads = (
        np.concatenate([np.stack([frame.data[i][k] for k in "xyz"], -1) for frame in figure.frames]) for i in range(3)
    )
    assert len(clouds) > 0.99 * 600 * (shown.depths.any((1, 2))).sum() and np.isfinite(heads).all()
    for xyz in (clouds, heads):
        assert ((xyz > ranges[:, 0]) & (xyz < ranges[:, 1])).all()  # else plotly would cut it off
        assert (np.abs(places(xyz)) <= [1.6 * 0.9301, 0.9301]).all()
    assert (np.abs(places(np.concatenate([clouds, heads]))) / [1.6, 1]).max() > 0.92  # and as near as that allows
    assert ahead @ shown.extrinsics[0, 2, :3] > 0.8  # from behind the first camera


def test_moving_bodies_are_whole_in_the_scene(clip):
    far = clip.depths.copy()
    seen = clip.tracks.visible & clip.tracks.dynamic
    limit = t3d.geometry.transform(clip.tracks.xyz, clip.extrinsics)[..., 2][seen].max()
    far[far > limit] *= 0.5  # more than half of the pixels are now far nearer than the farthest body
    figure = t3d.figures.tracks_3d(replace(clip, depths=far), clip.tracks, points=10**6)
    cloud = np.stack([figure.frames[0].data[0][k] for k in "xyz"], -1)
    uv, _ = t3d.geometry.project(cloud, clip.intrinsics[0], clip.extrinsics[0])
    drawn = np.zeros(clip.size, bool)
    drawn[tuple(np.rint(uv).astype(int).T[::-1])] = True
    assert drawn[(far[0] > 0) & (far[0] <= limit)].mean() > 0.99


def test_a_track_that_went_astray_does_not_shrink_the_scene(clip):
    xyz = clip.tracks.xyz.copy()
    xyz[-1, 0], xyz[-1, 1] = 1e4, np.nan
    lost = replace(clip.tracks, xyz=xyz)
    plain = opening(t3d.figures.tracks_3d(clip, clip.tracks, points=300, max_tracks=1000).layout.scene)[1]
    wild = opening(t3d.figures.tracks_3d(clip, lost, points=300, max_tracks=1000).layout.scene)[1]
    assert (np.ptp(wild, axis=1) <= 1.01 * np.ptp(plain, axis=1)).all()


def test_the_twin_is_the_scenes_opening_view(clip):
    figure = t3d.figures.tracks_3d(clip, clip.tracks, points=4000)
    places, _, _ = opening(figure.layout.scene)
    twin = t3d.figures.tracks_3d_static(clip, clip.tracks, frames=[0, 3])
    for ax, t in zip(twin.axes, (0, 3), strict=True):
        cloud, heads = (places(np.stack([figure.frames[t].data[i][k] for k in "xyz"], -1)) for i in (0, 2))
        drawn, marks = (np.asarray(c.get_offsets()) / np.tan(np.pi / 8) for c in ax.collections)
        np.testing.assert_allclose(marks, heads, atol=2e-4)
        np.testing.assert_allclose(np.sort(drawn, axis=0), np.sort(cloud, axis=0), atol=2e-4)
        assert np.abs(marks).max(0)[1] < ax.get_ylim()[1] / np.tan(np.pi / 8)


def test_the_scene_says_what_its_colours_and_axes_mean(clip):
    layout = t3d.figures.tracks_3d(clip, clip.tracks, points=100, tail=5).layout
    assert all(word in layout.title.text for word in ("Colour of a track", "Hollow: hidden", "5 frames", "scene units"))
    assert [layout.scene[f"{k}axis"].title.text for k in "xyz"] == [f"{k}, world (scene units)" for k in "xyz"]
    assert "scene unit" in t3d.figures.tracks_3d_static(clip, clip.tracks).axes[0].get_title()


def test_scene_stands_upright_in_world_and_camera_coordinates(clip):
    back = t3d.geometry.invert(clip.extrinsics[0])
    local = t3d.geometry.transform(clip.tracks.xyz, clip.extrinsics[0])
    queries = t3d.geometry.transform(clip.queries[:, 1:], clip.extrinsics[0])
    own = replace(clip.tracks, xyz=local, queries=np.c_[clip.queries[:, :1], queries])
    in_camera = replace(clip, extrinsics=clip.extrinsics @ back, tracks=own, queries=None)
    for shown, up in ((clip, [0, 0, 1]), (in_camera, [0, -1, 0])):
        camera = t3d.figures.tracks_3d(shown, shown.tracks, points=100).layout.scene.camera
        np.testing.assert_allclose([camera.up.x, camera.up.y, camera.up.z], up, atol=1e-6)
        view = np.array([camera.center[k] - camera.eye[k] for k in "xyz"])
        assert view @ shown.extrinsics[0, 2, :3] > 0.8 * np.linalg.norm(view)


def test_many_tracks_no_tracks_and_tracks_of_another_clip(clip):
    many = clip.tracks.select(np.arange(400) % clip.tracks.xyz.shape[1])
    tails = t3d.figures.tracks_3d(clip, many, points=10, max_tracks=400).frames[1].data[1]
    assert tails.line.color.max() == len(set(tails.line.color.tolist())) - 1 > 255
    for most in (1, 7, 39):
        heads = t3d.figures.tracks_3d(clip, clip.tracks, points=10, max_tracks=most).frames[0].data[2]
        assert 1 <= len(heads.x) <= most
    none = clip.tracks.select(slice(0, 0))
    assert len(t3d.figures.tracks_3d(clip, none, points=10).frames) == 5
    for draw in (t3d.figures.tracks_3d_static, t3d.figures.overview):
        assert len(png_bytes(draw(clip, none))) > 1000
    short = replace(clip.tracks, xyz=clip.tracks.xyz[:3], visible=clip.tracks.visible[:3], visible_logits=None)
    for draw in (t3d.figures.tracks_3d, t3d.figures.tracks_3d_static, t3d.figures.overview):
        with pytest.raises(ValueError, match=r"tracks: expected 5 frames .* got 3"):
            draw(clip, short)
    with pytest.raises(ValueError, match=r"frame: expected 0 to 4 .* got 5"):
        t3d.figures.frame_with_tracks(clip, clip.tracks, 5)
    with pytest.raises(ValueError, match=r"frame: expected 0 to 4 .* got -1"):
        t3d.figures.depth_map(clip, -1)


def test_depth_map_of_a_frame_without_depth_is_all_grey(clip):
    depths = clip.depths.copy()
    depths[1] = 0
    figure = t3d.figures.depth_map(replace(clip, depths=depths, queries=None, tracks=None), 1)
    assert figure.axes[0].images[0].get_array().mask.all() and len(png_bytes(figure)) > 1000


def test_sheets_and_bars(clip):
    sheet = t3d.figures.contact_sheet([clip, clip], frames=3)
    assert len(sheet.axes) == 6 and sheet.axes[0].get_title() == "t = 0"
    bars = n00.scores_bar({"a": {"AJ3D": 0.5, "APD3D": 0.25, "OA": 1}, "b": {"AJ3D": 0, "APD3D": 0, "OA": 0}})
    assert [p.get_height() for p in bars.axes[0].patches] == [0.5, 0.25, 1, 0, 0, 0]


def test_no_figure_stays_open(clip):
    import matplotlib.pyplot as plt

    before = plt.get_fignums()
    t3d.figures.frame_with_tracks(clip, clip.tracks, 0)
    assert plt.get_fignums() == before
    assert isinstance(t3d.figures.depth_map(clip, 0), Figure)


def test_explorer_redraws_with_the_values_of_its_controls():
    calls = []

    def draw(frame, space, noise):
        calls.append((frame, space, noise))
        if frame == 9:
            raise ValueError("no such frame")
        return Figure(figsize=(1, 1))

    box = explore(draw, frame=(0, 9), space=["world", "camera"], noise=(0.0, 1.0))
    frame, space, _ = box.children[0].children
    space.value = "camera"
    _, picture, refusal = box.children
    assert '<img alt="The figure above. Shown with frame 4' in picture.value and picture.layout.display is None
    frame.value = 9
    assert calls == [(4, "world", 0.5), (4, "camera", 0.5), (9, "camera", 0.5)]
    assert refusal.value == "no such frame" and picture.layout.display == "none"
    frame.value = 3
    assert refusal.value == "" and picture.layout.display is None


def test_png_is_deterministic(clip):
    assert png_bytes(t3d.figures.depth_map(clip, 0)) == png_bytes(t3d.figures.depth_map(clip, 0))
