import numpy as np
import pytest

from lessons.n02_straightness import SPACES, bend, fit_windows, from_space, stays_in_view, to_space
from tapip3d_lite.geometry import look_at, project

T, N = 12, 7


@pytest.fixture
def scene():
    rng = np.random.default_rng(0)
    t = np.arange(T)[:, None, None]
    xyz = rng.uniform(-1, 1, (N, 3)) + 0.05 * t * rng.normal(size=(N, 3))
    angle = np.linspace(0, 1, T)
    eye = 6 * np.stack([np.cos(angle), np.sin(angle), 0.4 + 0 * angle], -1)
    extrinsics = look_at(eye, np.zeros((T, 3)), np.broadcast_to([0.0, 0, 1], (T, 3)))
    intrinsics = np.tile(np.array([[90.0, 0, 40], [0, 100, 30], [0, 0, 1]]), (T, 1, 1))
    return xyz, intrinsics, extrinsics


@pytest.mark.parametrize("space", SPACES)
def test_spaces_round_trip_and_agree_with_a_loop(scene, space):
    xyz, intrinsics, extrinsics = scene
    coords = to_space(xyz, intrinsics, extrinsics, space)
    np.testing.assert_allclose(from_space(coords, intrinsics, extrinsics, space), xyz, atol=1e-9)
    for t, n in ((0, 0), (5, 3), (T - 1, N - 1)):
        camera = extrinsics[t, :3, :3] @ xyz[t, n] + extrinsics[t, :3, 3]
        u, v = 90 * camera[0] / camera[2] + 40, 100 * camera[1] / camera[2] + 30
        expected = {
            "world": xyz[t, n],
            "camera": camera,
            "uvd": [u, v, camera[2]],
            "uvlogd": [u, v, np.sqrt(9000) * np.log(camera[2])],
        }
        np.testing.assert_allclose(coords[t, n], expected[space], atol=1e-9)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_fits_agree_with_polyfit(scene, degree):
    xyz, window = scene[0] + np.random.default_rng(1).normal(size=(T, N, 3)), 5
    fits = fit_windows(xyz, window, degree)
    for start, n, c in ((0, 0, 0), (3, 4, 1), (T - window, N - 1, 2)):
        frames = np.arange(window)
        curve = np.polyval(np.polyfit(frames, xyz[start : start + window, n, c], degree), frames)
        np.testing.assert_allclose(fits[start, :, n, c], curve, atol=1e-9)


def test_constant_velocity_is_straight_in_world_only_when_the_camera_moves(scene):
    xyz, intrinsics, extrinsics = scene
    assert bend(xyz, intrinsics, extrinsics, "world").max() < 1e-9
    assert bend(xyz, intrinsics, extrinsics, "camera").min() > 1e-4
    still = np.repeat(extrinsics[:1], T, 0)
    assert bend(xyz, intrinsics, still, "camera").max() < 1e-9
    assert bend(xyz, intrinsics, still, "uvd").max() > 1e-5  # perspective bends a line in time


def test_bend_is_in_scene_units_and_free_fall_is_a_parabola(scene):
    _, intrinsics, extrinsics = scene
    seconds = np.arange(T) / 12
    fall = np.zeros((T, 1, 3))
    fall[:, 0, 2] = 1 - 9.81 / 2 * seconds**2
    # Five samples of a t^2 / 2 leave (2, -1, -2, -1, 2) a / 2: RMS sqrt(14 / 5) a / 2.
    expected = np.sqrt(14 / 5) * 9.81 / 144 / 2
    np.testing.assert_allclose(bend(fall, intrinsics, extrinsics, "world"), expected, rtol=1e-9)
    assert bend(fall, intrinsics, extrinsics, "world", degree=2).max() < 1e-9


def test_stays_in_view_agrees_with_a_loop(scene):
    xyz, intrinsics, extrinsics = scene
    xyz = xyz * 6  # so that some points leave the image and some pass behind the camera
    got = stays_in_view(xyz, intrinsics, extrinsics, (60, 80), 4)
    assert 0 < got.mean() < 1
    for start in range(T - 3):
        for n in range(N):
            fine = True
            for t in range(start, start + 4):
                (u, v), z = (a[0] for a in project(xyz[t, n : n + 1], intrinsics[t], extrinsics[t]))
                fine &= bool(z > 0 and -0.5 < u < 79.5 and -0.5 < v < 59.5)
            assert got[start, n] == fine


@pytest.mark.parametrize(
    ("change", "match"),
    [({"space": "polar"}, "expected one of"), ({"window": 13}, r"\[1, 12\]"), ({"degree": 5}, r"\[0, 4\]")],
)
def test_bad_input(scene, change, match):
    with pytest.raises(ValueError, match=match):
        bend(*scene, **({"space": "world"} | change))
