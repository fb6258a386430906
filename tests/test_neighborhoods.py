"""Objects of cells, silhouettes, both neighbourhoods, their figures, and the bound behind the search that proves itself."""

import numpy as np
import pytest
from matplotlib.patches import Circle

from lessons.n03 import RIGHT, WRONG, Around, neighborhoods_3d, proof_view, share_curves, two_neighborhoods
from lessons.n03_cells import Cells, silhouettes, track_objects
from lessons.n03_exercises import search, walls
from tapip3d_lite.geometry import point_map, project
from tapip3d_lite.simulate import object_maps, render_clip, simulate_rollout


@pytest.fixture(scope="module")
def filmed():
    recording = simulate_rollout(3, frames=4, size=(48, 64), sky=True, tracks=60)
    return render_clip(recording), object_maps(recording)


@pytest.fixture(scope="module")
def clip(filmed):
    return filmed[0]


@pytest.fixture(scope="module")
def objects(filmed):
    return filmed[1]


@pytest.fixture(scope="module")
def track(clip, objects):
    return int(np.flatnonzero(clip.tracks.visible[1] & (track_objects(clip, objects) > 0))[0])


def test_objects_are_those_that_the_depth_shows(clip, objects):
    np.testing.assert_array_equal(objects < 0, clip.depths == 0)
    assert {0, 1} <= set(np.unique(objects))
    floor = point_map(clip.depths, clip.intrinsics, clip.extrinsics)[objects == 0]
    assert np.abs(floor[:, 2]).max() < 1e-3
    own = track_objects(clip, objects)
    assert (own[clip.tracks.dynamic] > 0).all()
    uv, _ = project(clip.tracks.xyz[2], clip.intrinsics[2], clip.extrinsics[2])
    seen = clip.tracks.visible[2]
    u, v = np.rint(uv[seen]).astype(int).T
    assert (objects[2, v, u] == own[seen]).mean() > 0.9  # a pixel's centre may lie just beside the point's body


def test_silhouettes_against_a_loop(clip, objects):
    distance, hides = silhouettes(objects[0], clip.depths[0], gap=0.3)
    z = np.where(clip.depths[0] > 0, clip.depths[0], 1e6)
    edge, jump = np.zeros(z.shape, bool), np.zeros(z.shape, bool)
    for v, u in np.ndindex(*z.shape):
        for i, j in ((v + 1, u), (v - 1, u), (v, u + 1), (v, u - 1)):
            if 0 <= i < z.shape[0] and 0 <= j < z.shape[1] and objects[0, i, j] != objects[0, v, u]:
                edge[v, u] = True
                jump[v, u] |= abs(z[i, j] - z[v, u]) > 0.3
    rows, columns = np.nonzero(edge)
    for v, u in np.ndindex(*z.shape):
        away = np.hypot(rows - v, columns - u)
        assert abs(distance[v, u] - away.min()) <= 0.1 + 0.03 * away.min()
        tied = away <= 1.1 * away.min() + 0.1
        assert hides[v, u] in jump[rows[tied], columns[tied]]
    alone, nothing = silhouettes(np.zeros((3, 4), int), np.ones((3, 4)))
    assert np.isinf(alone).all() and not nothing.any()


def test_cells_are_those_of_the_feature_cloud_and_near_is_near(clip, objects):
    cells = Cells.of(clip, objects, 1, stride=4)
    assert cells.objects.shape == (12, 16)
    u, v = cells.uv.reshape(-1, 2).T
    np.testing.assert_array_equal(u.reshape(12, 16)[0], np.arange(16) * 4 + 2)
    np.testing.assert_array_equal(cells.objects.ravel(), objects[1, v, u])
    own = np.flatnonzero(cells.objects.ravel() >= 0)[::9]
    xyz = cells.points.reshape(-1, 3)[own]
    index = cells.near(xyz, cells.uv.reshape(-1, 2)[own], 9)
    assert (index[:, 0] == own).all() and (cells.objects.ravel()[index] >= 0).all()
    points = np.where(cells.objects.ravel()[:, None] >= 0, cells.points.reshape(-1, 3), np.inf)
    for x, found in zip(xyz, index, strict=True):
        assert set(found) == set(np.argsort(((points - x) ** 2).sum(-1), kind="stable")[:9])
    share = cells.right(index, cells.objects.ravel()[own])
    assert share[0] == np.mean(cells.objects.ravel()[index[0]] == cells.objects.ravel()[own[0]])


@pytest.mark.parametrize("slip", [(-1, -2), (0, 0), (1, 1)])
def test_a_window_is_centred_on_the_cell_whose_pixel_is_nearest(clip, objects, slip):
    cells = Cells.of(clip, np.maximum(objects, 0), 1, stride=4)
    cells = Cells(cells.points, np.zeros_like(cells.objects), cells.uv, cells.size)
    window = cells.near(cells.points[5, 7][None], (cells.uv[5, 7] + slip)[None], 9, "window")[0]
    np.testing.assert_array_equal(window, [r * 16 + c for r in (4, 5, 6) for c in (6, 7, 8)])


def test_bad_input_is_refused(clip, objects, track):
    with pytest.raises(ValueError, match="objects: expected"):
        Cells.of(clip, objects[:2], 0)
    with pytest.raises(ValueError, match="stride: expected 1 to 48"):
        Cells.of(clip, objects, 0, stride=49)
    with pytest.raises(ValueError, match="kind: expected one of window, knn"):
        Cells.of(clip, objects, 0).near(np.zeros((1, 3)), np.zeros((1, 2)), 4, "square")
    with pytest.raises(ValueError, match="frame: expected 0 to 3"):
        two_neighborhoods(clip, objects, track, 4)
    with pytest.raises(ValueError, match="track: expected 0 to 59"):
        two_neighborhoods(clip, objects, 60, 1)
    uv, _ = project(clip.tracks.xyz, clip.intrinsics, clip.extrinsics)
    gone = np.argwhere((uv > np.array([63.6, 47.6])).any(-1))
    if len(gone):
        with pytest.raises(ValueError, match="outside the image"):
            two_neighborhoods(clip, objects, int(gone[0, 1]), int(gone[0, 0]))


def test_the_explorers_figure_shows_all_neighbours_and_counts_the_right_ones(clip, objects, track):
    around, figure = Around.of(clip, objects, track, 1, 9), two_neighborhoods(clip, objects, track, 1, 9)
    for ax, kind in zip(figure.axes[::2], ("window", "knn"), strict=True):
        right, wrong, star = ax.collections
        assert f"{around.right[kind].sum()} of 9 right" in ax.get_title()
        np.testing.assert_array_equal(right.get_offsets(), around.pixels(kind)[around.right[kind]])
        assert len(right.get_offsets()) + len(wrong.get_offsets()) == 9
        np.testing.assert_allclose(star.get_offsets()[0], around.uv)
    left, top, end, bottom = around.box()
    assert left >= 0 and top >= 0 and end <= 63 and bottom <= 47


def test_the_scene_has_a_step_for_each_k(clip, objects, track):
    figure = neighborhoods_3d(clip, objects, track, 1, counts=(1, 4, 9))
    assert [f.name for f in figure.frames] == [s.args[0][0] for s in figure.layout.sliders[0].steps] == ["1", "4", "9"]
    for frame, k in zip(figure.frames, (1, 4, 9), strict=True):
        around = Around.of(clip, objects, track, 1, k)
        assert len(frame.data[0].x) == len(frame.data[1].x) == k
        assert list(frame.data[0].marker.color) == [RIGHT if r else WRONG for r in around.right["knn"]]
        np.testing.assert_allclose(frame.data[1].z, around.points("window")[:, 2], rtol=1e-6)
    assert (
        figure.layout.scene.aspectmode == "manual"
        and figure.layout.scene.yaxis.range[0] > figure.layout.scene.yaxis.range[1]
    )


def test_share_curves_are_means_over_clips_that_have_any():
    values = np.array([[0.2, np.nan, np.nan], [0.4, 0.5, np.nan]])
    figure = share_curves(["a", "b", "c"], {"one": {"k": values}, "two": {"k": values}}, "x", "share")
    mean = figure.axes[1].containers[0].lines[0].get_ydata()
    np.testing.assert_allclose(mean[:2], [0.3, 0.5])
    low, high = figure.axes[0].containers[0].lines[2][0].get_segments()[0][:, 1]
    np.testing.assert_allclose((high - low) / 2, 1.96 * 0.1, rtol=1e-6)  # sd of two values 0.2 apart, over root 2


def test_nothing_outside_a_window_is_nearer_than_its_walls():
    rng = np.random.default_rng(0)
    intrinsics = np.array([[20.0, 0, 8], [0, 18, 7], [0, 0, 1]])
    for _ in range(20):
        depth = rng.choice([1.0, 2.0, 6.0], (15, 17)) + rng.uniform(0, 0.4, (15, 17))
        points, (row, column) = point_map(depth, intrinsics), rng.integers(4, (11, 13))
        query = points[row, column] * rng.uniform(0.9, 1.1)
        box = np.array([column - 3, row - 3, column + 3, row + 3])
        outside = np.ones(depth.shape, bool)
        outside[row - 2 : row + 3, column - 2 : column + 3] = False
        distance = np.linalg.norm(points - query, axis=-1)
        assert distance[outside].min() >= walls(query, intrinsics, box).min()
        found, margin = search(query, points, intrinsics, 4, 2)
        if margin > 0:
            assert list(found) == list(np.argsort(distance.ravel())[:4])
    assert search(query, points, intrinsics, 4, 20)[1] == np.inf
    radii = [
        c.radius
        for c in proof_view(points[row], intrinsics, query, 2, 0.1, 0.2).axes[0].patches
        if isinstance(c, Circle)
    ]
    assert radii == [0.1, 0.2]
