"""The figures of lesson 01 draw the numbers that they are given, and the lesson's functions stand in the tracker."""

import numpy as np
import pytest
import torch

import tapip3d_lite as t3d
from lessons import n01, n01_figures
from lessons.checker import find
from lessons.milestone import plugged
from tapip3d_lite.model import spaces, tracker
from tapip3d_lite.model.cloud import feature_cloud, nearest_exact


@pytest.fixture(scope="module")
def clip():
    return t3d.simulate_clip(seed=2, frames=3, size=(32, 48), tracks=10)


def test_panels_show_image_depth_and_side(clip):
    figure = n01.image_and_depth(clip, 1, n01.from_the_side(clip, 1))
    assert len(figure.axes) == 4  # and the colour bar
    (side,) = (ax for ax in figure.axes if "side" in ax.get_title())
    drawn = side.collections[0].get_offsets()
    assert 0.5 * 32 * 48 < len(drawn) <= 32 * 48 and drawn[:, 0].min() == pytest.approx(clip.depths[1].min(), rel=1e-4)


def test_curves_are_told_apart_by_dashes_and_keep_their_numbers():
    x = np.arange(5.0)
    (ax,) = n01.lines_over_pixels({"a": x, "b": 2 * x}, x, "y (px)").axes
    assert [line.get_linestyle() for line in ax.lines] == ["-", "--"]
    np.testing.assert_array_equal(ax.lines[1].get_ydata(), 2 * x)
    (ax,) = n01.slip_over_depth(x + 1, 2 * x, x).axes
    np.testing.assert_array_equal(np.sort(ax.lines[0].get_ydata()), 2000 * x)


def test_copies_are_joined(clip):
    a, b = np.random.default_rng(0).normal(size=(2, 4, 3))
    left, right = n01.two_liftings({"one": (a, a), "other": (a, b)}).axes
    assert len(left.lines) == len(right.lines) == 4
    assert [tuple(line.get_xdata()) for line in right.lines] == list(zip(a[:, 0], b[:, 0], strict=True))


def test_flying_cells_are_counted_and_marked_by_form():
    rng = np.random.default_rng(1)
    surface, cells = rng.uniform(1, 2, (50, 3)), rng.uniform(1, 2, (9, 3))
    fly = np.arange(9) < 4
    ax, other = n01.cells_from_the_side(surface, {"averaged": (cells, fly), "picked": (cells, fly & False)}).axes
    assert "4 of 9" in ax.get_title() and "0 of 9" in other.get_title()
    assert [len(part.get_offsets()) for part in ax.collections[1:]] == [5, 4]
    scene = n01.cells_in_space(surface, cells, fly)
    assert [trace.marker.symbol for trace in scene.figure.data] == ["circle", "circle", "diamond"]
    assert len(scene.figure.data[2].x) == 4 and len(scene.twin.axes[0].collections) == 3


def test_coarse_levels_are_drawn_larger():
    rng = np.random.default_rng(2)
    levels = [(rng.random((n, 3)), rng.normal(size=(n, 3))) for n in (16, 4)]
    fine, coarse = n01.levels_from_above(levels).axes
    assert coarse.collections[0].get_sizes()[0] > 2 * fine.collections[0].get_sizes()[0]
    assert fine.get_xlim() == coarse.get_xlim() and fine.get_ylim() == coarse.get_ylim()
    assert n01_figures.panels(lambda ax: None).axes


@pytest.mark.parametrize("frames", [1, 3])
def test_the_lessons_functions_give_the_librarys_numbers(clip, frames):
    depths, intrinsics, extrinsics = (torch.from_numpy(x[:frames])[None].double() for x in
                                      (clip.depths, clip.intrinsics, clip.extrinsics))  # fmt: skip
    features = torch.rand(1, frames, 2, 9, 13, dtype=torch.float64)
    calls = {}
    points, in_camera = spaces.point_map(depths, intrinsics, extrinsics), spaces.point_map(depths, intrinsics)
    with plugged(("01",), calls):
        mine = spaces.point_map(depths, intrinsics, extrinsics)
        torch.testing.assert_close(mine, points)
        torch.testing.assert_close(spaces.point_map(depths, intrinsics), in_camera)
        found = tracker.feature_cloud(features, points, depths > 0, 2)
    assert set(calls) == {"01.unproject", "01.to_world", "01.nearest_cells", "01.cloud"} and all(calls.values())
    for level, right in zip(found, feature_cloud(features, points, depths > 0, 2), strict=True):
        for name in ("features", "points", "valid"):
            torch.testing.assert_close(getattr(level, name), getattr(right, name))


def test_the_picked_pixels_are_the_librarys():
    pick = find("01.nearest_cells").reference
    for length, cells in ((8, 4), (9, 4), (60, 7), (7, 7), (128, 32), (100, 24)):
        assert pick(length, cells).tolist() == nearest_exact(length, cells, torch.device("cpu")).tolist()
