"""Objects of cells, silhouettes, both neighbourhoods, their figures, and the bound behind the search that proves itself."""

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.patches import Circle

from lessons.checker import check
from lessons.n03 import (
    SAMPLES,
    Around,
    Proof,
    exact_search,
    frame_inside,
    inside_image,
    neighborhoods_3d,
    proof_view,
    share_curves,
    two_neighborhoods,
)
from lessons.n03_cells import Cells, silhouettes, track_objects
from lessons.n03_exercises import nearest, window
from lessons.n03_figures import MARKS, RIGHT, WRONG
from lessons.n03_proof_exercises import PROOF, cells_visited, search, walls
from lessons.n03_search import filled, lens, stand_ins
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
        for marks, color in ((right, RIGHT), (wrong, WRONG)):
            assert not len(marks.get_offsets()) or to_hex(marks.get_facecolor()[0]) == color
        np.testing.assert_array_equal(right.get_offsets(), around.pixels(kind)[around.right[kind]])
        assert len(right.get_offsets()) + len(wrong.get_offsets()) == 9
        np.testing.assert_allclose(star.get_offsets()[0], around.uv)
    left, top, end, bottom = around.box()
    assert left >= 0 and top >= 0 and end <= 63 and bottom <= 47


def test_the_scene_has_a_step_for_each_k(clip, objects, track):
    figure = neighborhoods_3d(clip, objects, track, 1, counts=(1, 4, 9), first=4)
    assert figure.layout.sliders[0].active == 1 and sum(len(trace.x) for trace in figure.data[2:]) == 8
    assert [f.name for f in figure.frames] == [s.args[0][0] for s in figure.layout.sliders[0].steps] == ["1", "4", "9"]
    legend = {trace.name: (trace.marker.symbol, trace.marker.color) for trace in figure.data[2:]}
    assert len({symbol for symbol, _ in legend.values()}) == len(legend) == len(MARKS) == 4
    for frame, k in zip(figure.frames, (1, 4, 9), strict=True):
        around = Around.of(clip, objects, track, 1, k)
        assert sum(len(trace.x) for trace in frame.data) == 2 * k
        for trace, (kind, right) in zip(frame.data, MARKS, strict=True):
            assert legend[trace.name] == (trace.marker.symbol, RIGHT if right else WRONG)
            assert ("another" in trace.name) != right and ("window" in trace.name) == (kind == "window")
            np.testing.assert_allclose(trace.z, around.points(kind)[around.right[kind] == right, 2], rtol=1e-6)
    assert (
        figure.layout.scene.aspectmode == "manual"
        and figure.layout.scene.yaxis.range[0] > figure.layout.scene.yaxis.range[1]
    )


@pytest.fixture(scope="module")
def long_occlusion():
    recording = simulate_rollout(SAMPLES["long_occlusion"].seed, SAMPLES["long_occlusion"].config)
    return render_clip(recording), object_maps(recording)


def test_the_explorer_shows_something_for_every_setting(long_occlusion):
    clip, objects = long_occlusion
    distance, hides = silhouettes(objects[8], clip.depths[8])
    inside = inside_image(clip)
    left = np.flatnonzero(inside.any(0) & ~inside.all(0))[:6]  # points that are outside in some frames
    near = np.flatnonzero(inside.all(0) & clip.tracks.visible[8])[:6]
    assert len(left) == len(near) == 6 and hides.any() and distance.min() == 0
    for track in (*left, *near):
        for frame in range(len(clip)):
            at = frame_inside(clip, track, frame)
            assert inside[at, track] and (at == frame or not inside[frame, track])
            for level in range(3):
                around = Around.of(clip, objects, track, at, 32, level)
                assert all(len(around.found[kind]) == 32 for kind in ("window", "knn"))
                points, _ = around.surroundings(around.box())
                assert len(points) and np.ptp(around.box()[::2]) > 10
    figure = two_neighborhoods(clip, objects, left[0], frame_inside(clip, left[0], 0), 1, 2)
    assert all(sum(len(c.get_offsets()) for c in ax.collections) >= 2 for ax in figure.axes)


@pytest.mark.parametrize("level", [0, 1])
def test_the_learners_functions_find_what_the_trackers_modules_find(filmed, level):
    clip, objects = filmed
    rng = np.random.default_rng(level)
    cells = Cells.of(clip, objects, 2, stride=4 << level)
    assert (cells.objects < 0).any()  # sky: cells without depth
    own = rng.choice(np.flatnonzero(clip.depths[2].ravel() > 0), 60)
    uv = np.stack([own % 64, own // 64], -1)
    xyz = point_map(clip.depths[2], clip.intrinsics[2], clip.extrinsics[2])[uv[:, 1], uv[:, 0]] + 0.1
    for kind, answer in (("knn", nearest), ("window", window)):
        for count in (4, 9, 16):
            mine, library = (cells.near(xyz, uv, count, kind, by=by) for by in (answer, None))
            np.testing.assert_array_equal(mine, library)
    np.testing.assert_array_equal(cells.near(xyz, uv, 12, "window", by=window), cells.near(xyz, uv, 12, "window"))


def test_slots_without_valid_cells_are_filled():
    valid = np.array([True, False, True, True])
    np.testing.assert_array_equal(filled(np.array([[2, 0, 3, 1]]), valid), [[2, 0, 3, 2]])
    np.testing.assert_array_equal(stand_ins(np.array([0, 1, 2, 3]), valid), [0, 0, 2, 3])
    np.testing.assert_array_equal(stand_ins(np.array([0, 1, 2, 3]), np.zeros(4, bool)), [0, 1, 2, 3])


def test_a_camera_is_read_off_a_map_in_any_space_of_true_distances():
    rng = np.random.default_rng(0)
    intrinsics = np.array([[20.0, 0, 7.3], [0, 18, 5.9], [0, 0, 1]])
    points = point_map(rng.uniform(2, 5, (12, 16)), intrinsics)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    for scale, turned, place in ((1.0, np.eye(3), np.zeros(3)), (0.5, turn, np.array([0.3, -0.2, -1.5]))):
        found, rotation, at = lens(scale * points @ turned + place)
        np.testing.assert_allclose(found, intrinsics, atol=1e-6)
        np.testing.assert_allclose(rotation, turned, atol=1e-6)
        np.testing.assert_allclose(at, place, atol=1e-6)
    v, u = np.indices((12, 16))
    others = (
        points * [1, 1, 3],
        points * [-1, 1, 1],
        np.stack([u, v, points[..., 2]], -1),
        point_map(np.full((12, 16), 2.0), intrinsics),
    )
    assert lens(others[0]) is not None  # other focal lengths would do
    assert all(lens(x) is None for x in others[1:])
    assert lens(points @ np.array([[1, 0.3, 0], [0, 1, 0], [0, 0, 1]]).T) is None  # a skewed camera


def test_argpartition_and_unstable_sorts_are_rejected():
    def partitioned(queries, points, count, valid):
        distance = np.where(valid, ((points - queries[:, None]) ** 2).sum(-1), np.inf)
        found = np.argpartition(distance, count - 1, axis=-1)[:, :count]
        order = np.argsort(np.take_along_axis(distance, found, -1), axis=-1, kind="stable")
        return np.take_along_axis(found, order, -1)

    def unstable(queries, points, count, valid):
        return np.argsort(np.where(valid, ((points - queries[:, None]) ** 2).sum(-1), np.inf), axis=-1)[:, :count]

    def rooted(queries, points, count, valid):
        distance = np.linalg.norm(points[None] - queries[:, None], axis=-1)
        distance = np.where(valid, np.float32(distance), np.inf)
        return np.stack([np.lexsort([np.arange(len(points)), row])[:count] for row in distance])

    assert check("03.knn", partitioned).status == check("03.knn", unstable).status == "wrong"
    assert check("03.knn", rooted).status == "passed"


def test_cells_are_counted_however_they_are_read():
    def by_loop(query, points, intrinsics, count, radius):
        column, row = np.floor(project(query[None], intrinsics)[0][0] + 0.5).astype(int)
        rows = range(max(row - radius, 0), min(row + radius + 1, points.shape[0]))
        columns = range(max(column - radius, 0), min(column + radius + 1, points.shape[1]))
        return [sum((points[i, j] - query) ** 2) ** 0.5 for i in rows for j in columns]

    def by_block(query, points, intrinsics, count, radius):
        column, row = np.floor(project(query[None], intrinsics)[0][0] + 0.5).astype(int)
        block = points[max(row - radius, 0) : row + radius + 1, max(column - radius, 0) : column + radius + 1]
        return np.linalg.norm(block - query, axis=-1), np.linalg.norm(block - query, axis=-1)  # twice costs nothing

    def all_of_them(query, points, *_):
        return np.linalg.norm(points - query, axis=-1)

    for size in (1, 2, 3, 4):
        case = PROOF.cases(np.random.default_rng([size, 0]), size)
        wanted = cells_visited(search, case)
        assert cells_visited(by_loop, case) == cells_visited(by_block, case) == wanted
        assert cells_visited(all_of_them, case) == case[1].size / 3 >= wanted


def test_the_exact_search_finds_the_exact_neighbours():
    rng = np.random.default_rng(1)
    intrinsics = np.array([[20.0, 0, 8], [0, 18, 7], [0, 0, 1]])
    radii = set()
    for count in (1, 7, 9):
        for _ in range(30):
            depth = rng.choice([1.0, 2.0, 6.0], (15, 17)) + rng.uniform(0, 0.4, (15, 17))
            points, (row, column) = point_map(depth, intrinsics), rng.integers(0, (15, 17))
            query = points[row, column] * rng.uniform(0.6, 1.5)
            found, cells, radius = exact_search(query, points, intrinsics, count, search, walls, window)
            distance = np.linalg.norm(points - query, axis=-1).ravel()
            assert list(found) == list(np.argsort(distance, kind="stable")[:count])
            assert count < cells <= 25 + points.size / 3
            radii.add(radius)
    assert min(radii) <= 2 and max(radii) >= 8


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
    figure = proof_view(points[row], intrinsics, {"one": Proof(query, 2, 0.1, 0.2)})
    radii = [c.radius for c in figure.axes[0].patches if isinstance(c, Circle)]
    assert radii == [0.1, 0.2]
