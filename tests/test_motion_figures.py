import numpy as np
import pytest

import tapip3d_lite as t3d
from lessons.n02 import motion_fit, paths_in_spaces
from lessons.n02_straightness import bend, to_space


@pytest.fixture(scope="module")
def clip():
    return t3d.simulate_clip(seed=2, frames=8, size=(32, 32), tracks=30, camera="handheld")


def test_paths_show_the_same_points_in_three_spaces(clip):
    figure = paths_in_spaces(clip, still=np.array([0, 1]), moving=np.array([5]))
    image, camera, world = figure.axes
    for ax, space, pair in ((image, "uvd", [0, 1]), (camera, "camera", [0, 2]), (world, "world", [0, 1])):
        coords = to_space(clip.tracks.xyz, clip.intrinsics, clip.extrinsics, space)
        paths = [line for line in ax.lines if len(line.get_xdata()) == len(clip)]
        assert len(paths) == 3 and len(ax.lines) == 6
        np.testing.assert_allclose(np.stack(paths[2].get_data(), -1), coords[:, 5][:, pair])


@pytest.mark.parametrize("space", ["uvd", "uvlogd", "camera", "world"])
def test_motion_fit_draws_the_truth_and_the_windows_fit(clip, space):
    figure = motion_fit(clip, track=3, frame=2, space=space, window=4)
    coords = to_space(clip.tracks.xyz[:, 3:4], clip.intrinsics, clip.extrinsics, space)[:, 0]
    for i, ax in enumerate(figure.axes[1:]):
        truth, fit = ax.lines
        np.testing.assert_allclose(truth.get_ydata(), coords[:, i])
        assert list(fit.get_xdata()) == [2, 3, 4, 5]
        line = np.polyval(np.polyfit(range(4), coords[2:6, i], 1), range(4))
        np.testing.assert_allclose(fit.get_ydata(), line, atol=1e-3)
    error = bend(clip.tracks.xyz, clip.intrinsics, clip.extrinsics, space, 4)[2, 3]
    assert f"{100 * error:.1f} cm" in figure.axes[2].get_title()


def test_a_window_at_the_end_is_moved_back_and_rest_is_not_magnified(clip):
    still = int(np.flatnonzero(~clip.tracks.dynamic)[0])
    figure = motion_fit(clip, track=still, frame=7, window=5)
    assert list(figure.axes[1].lines[1].get_xdata()) == [3, 4, 5, 6, 7]
    for ax in figure.axes[1:]:
        assert np.ptp(ax.get_ylim()) > 0.19  # metres: rounding must not look like motion
