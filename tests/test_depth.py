"""Depth from stereo, from sparse points and from a camera beside, on scenes whose depth is known; flying pixels removed."""

import cv2
import numpy as np
import pytest

import tapip3d_lite as t3d
from tapip3d_lite.depth import splat
from tapip3d_lite.simulate.degrade import SensorConfig, degrade

K = np.array([[100, 0, 63.5], [0, 100, 47.5], [0, 0, 1]])


def texture(seed, size=(96, 160)):
    rng = np.random.default_rng(seed)
    image = sum(
        cv2.resize(rng.random((n, n, 3), np.float32), size[::-1], interpolation=cv2.INTER_CUBIC) for n in (12, 24, 48)
    )
    return (255 * (image - image.min()) / np.ptp(image)).astype(np.uint8)


def pair(near=12, far=5):
    """A rectified pair of a square at a disparity of `near` pixels before a wall at `far`, and the true disparity."""
    wall, square = texture(0), texture(1)[:40, :40]
    left, right = wall[:, 16:144].copy(), wall[:, 16 + far : 144 + far].copy()
    left[30:70, 50:90], right[30:70, 50 - near : 90 - near] = square, square
    disparity = np.full((96, 128), far, np.float32)
    disparity[30:70, 50:90] = near
    return left[None], right[None], disparity


def test_stereo_of_two_planes():
    left, right, disparity = pair()
    raw = t3d.stereo_depth(left, right, K, baseline=0.3, fill=False)[0]
    truth, known = 100 * 0.3 / disparity, raw > 0
    good = np.abs(raw / truth - 1) < 0.02
    assert good[known].mean() > 0.97 and known.mean() > 0.85
    hidden = np.s_[34:66, 46:49]  # left of the square the right camera sees no wall
    assert not known[hidden].mean() > 0.4 and known[:, :4].mean() < 0.05  # nor beyond its image's border
    full = t3d.stereo_depth(left, right, K, baseline=0.3)[0]
    assert (full > 0).all() and (full[known] == raw[known]).all()
    assert (np.abs(full / truth - 1) < 0.02).mean() > 0.95 and (full[hidden] > 5).mean() > 0.8
    twice = t3d.stereo_depth(left, right, np.stack([K]), baseline=0.6)[0]
    np.testing.assert_allclose(twice, 2 * full, rtol=1e-6)


def test_stereo_of_a_simulated_pair():
    clip = t3d.simulate_clip(2, frames=2, size=(96, 128), stereo_baseline=0.25, camera="handheld")
    depth = t3d.stereo_depth(clip.video, clip.extras["video_right"], clip.intrinsics, 0.25)
    error = np.abs(depth / clip.depths - 1)
    assert depth.dtype == np.float32 and np.median(error) < 0.03 and (error < 0.1).mean() > 0.85


def shifted(images, rows):
    return np.roll(images, rows, 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a, b: {"right": b[:, :-1]}, r"right: expected \(1, 96, 128, 3\) as left"),
        (lambda a, b: {"right": b[:0]}, "right: zero frames"),
        (lambda a, b: {"left": a[:0], "right": b[:0]}, "left: zero frames"),
        (lambda a, b: {"left": a / 255}, "left: .*float64"),
        (lambda a, b: {"left": a[0]}, "left: expected"),
        (lambda a, b: {"right": [[[0, 0, 0]], [[0, 0]]]}, "right: expected an array, got rows of different lengths"),
        (lambda a, b: {"baseline": 0}, "baseline: expected a positive"),
        (lambda a, b: {"baseline": -0.1}, "baseline"),
        (lambda a, b: {"baseline": np.nan}, "baseline"),
        (lambda a, b: {"intrinsics": np.eye(4)}, "intrinsics: expected"),
        (lambda a, b: {"left": b, "right": a}, "to the right in `right` .*swap left and right"),
        (lambda a, b: {"right": shifted(b, 3)}, r"differ in height by 3\.\d px .*rectify"),
        (lambda a, b: {"right": np.zeros_like(b)}, "nothing in the right images matches"),
    ],
)
def test_stereo_refuses_what_is_no_rectified_pair(change, message):
    left, right, _ = pair()
    given = {"left": left, "right": right, "intrinsics": K, "baseline": 0.3}
    with pytest.raises(ValueError, match=message):
        t3d.stereo_depth(**(given | change(left, right)))


def test_of_several_points_in_a_pixel_the_nearest_counts():
    uv = np.array([[3, 2], [3.4, 2.4], [3, 2], [5, 2], [-0.6, 2], [6.6, 2], [0, 4.6], [1, 1], [np.nan, 1]])
    depth = splat(uv, np.array([3, 2, 4, 5, 1, 1, 1, -1, 1.0]), (5, 7))
    assert depth.dtype == np.float32 and depth[2, 3] == 2 and depth[2, 5] == 5 and (depth > 0).sum() == 2


def test_sparse_depth_takes_the_nearest():
    rng = np.random.default_rng(0)
    sparse = np.where(rng.random((3, 30, 40)) < 0.03, rng.uniform(1, 9, (3, 30, 40)), 0).astype(np.float32)
    sparse[1] = 0
    dense = t3d.densify_depth(sparse)
    assert not dense[1].any()
    for old, new in ((sparse[0], dense[0]), (sparse[2], dense[2])):
        places = np.argwhere(old > 0)
        values = old[tuple(places.T)]
        assert (new[old > 0] == values).all() and len(np.unique(values)) == len(values)
        for place in np.ndindex(old.shape):
            distance = np.linalg.norm(places - place, axis=1)
            chosen = distance[values == new[place]][0]
            assert chosen <= 1.03 * distance.min() + 1e-6  # OpenCV's distances along steps are this exact
    np.testing.assert_array_equal(t3d.densify_depth(dense), dense)
    np.testing.assert_array_equal(t3d.densify_depth(np.array([[[np.nan, -1, 2, np.inf]]])), [[[2, 2, 2, 2]]])


def surfaces():
    """A steep floor, a slanted wall and a square before it: (1, 60, 80)."""
    v, u = np.indices((60, 80)).astype(np.float32)
    floor = 60 / np.maximum(v - 14, 1e-3)
    depth = np.where(v > 20, np.minimum(floor, 9), 9)
    depth = np.minimum(depth, 1 / (0.10 + 0.002 * u))
    depth[18:38, 30:55] = 1.4
    return depth[None].astype(np.float32)


def test_flying_pixels_are_removed_and_surfaces_kept():
    truth, rng = surfaces(), np.random.default_rng(0)
    kept = t3d.filter_depth(truth) > 0
    assert kept.all()  # silhouettes included
    flying = truth.copy()
    column = np.s_[0, 19:37, 29]  # as anti-aliasing makes them: the same mixture all along
    flying[column] = 0.5 * (truth[0, 19:37, 28] + 1.4)
    flying[0, 19:37, 55] = 1.4 + rng.uniform(0.2, 0.8, 18) * (truth[0, 19:37, 55] - 1.4)
    flying[0, 50, ::7] *= 1.5  # single errors
    wrong = np.abs(flying / truth - 1) > 0.1
    assert wrong.sum() > 40
    left = t3d.filter_depth(flying)
    assert (left[wrong] == 0).mean() > 0.95 and (left[~wrong] > 0).mean() > 0.97
    np.testing.assert_array_equal(left[left > 0], flying[left > 0])


def test_a_grazing_plane_is_no_edge_and_noise_none_either():
    v = np.arange(40, dtype=np.float32)[:, None] + np.zeros((1, 50), np.float32)
    steep = (8 / (v + 2.0))[None]  # neighbouring rows differ by up to a third
    assert (t3d.filter_depth(steep)[:, 1:-1, 1:-1] > 0).all()
    noisy = 3 * (1 + 0.05 * np.random.default_rng(0).standard_normal((2, 60, 80)))
    assert (t3d.filter_depth(noisy) > 0).mean() > 0.93
    assert not t3d.filter_depth(np.pad(np.eye(3), 3)[None]).any()  # single pixels are no surface


def test_a_sensor_is_nearer_to_the_truth_once_filtered():
    clip = t3d.simulate_clip(3, frames=3, size=(96, 96))
    seen = degrade(clip, SensorConfig(flying=0.7, noise=0.005, shadow=0.5), 0).depths
    left = t3d.filter_depth(seen)
    bad = [np.mean(np.abs(z[z > 0] / clip.depths[z > 0] - 1) > 0.1) for z in (seen, left)]
    assert bad[0] > 0.01 and bad[1] < 0.15 * bad[0] and (left > 0).sum() > 0.85 * (seen > 0).sum()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: t3d.filter_depth(np.ones((4, 5))), r"depths: expected shape \(N, N, N\)"),
        (lambda: t3d.filter_depth(np.ones((1, 4, 5)) > 0), "depths: expected numbers"),
        (lambda: t3d.filter_depth(np.ones((1, 4, 5)), edge=0), "edge"),
        (lambda: t3d.densify_depth([[["a"]]]), "depths: expected numbers"),
        (lambda: t3d.register_depth(np.ones((1, 4, 5)), K, K, np.eye(4), (4, 5)), "depth: expected shape"),
        (
            lambda: t3d.register_depth(np.ones((4, 5)), K, K, np.eye(3), (4, 5)),
            r"color_from_depth: expected shape \(4, 4\)",
        ),
        (lambda: t3d.register_depth(np.ones((4, 5)), K[None], K, np.eye(4), (4, 5)), "depth_intrinsics: expected"),
    ],
)
def test_bad_depth(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_a_wider_depth_camera_leaves_no_holes():
    narrow, wide = np.diag([100.0, 100, 1]), np.diag([60.0, 60, 1])
    narrow[:2, 2] = wide[:2, 2] = 39.5
    seen = t3d.register_depth(np.full((80, 80), 2, np.float32), wide, narrow, np.eye(4), (80, 80))
    assert (seen == 2).all()
    assert not t3d.register_depth(np.zeros((0, 3), np.float32), wide, narrow, np.eye(4), (8, 8)).any()


def test_registration_to_rounding():
    """A wall seen by a camera 5 cm beside moves by a whole pixel for every 2 m: each depth is found where it belongs."""
    depth = np.full((96, 128), 2.5, np.float32)
    depth[40:60, 50:80] = 1.25
    shift = np.eye(4)
    shift[0, 3] = 0.05  # 2 pixels at 2.5 m, 4 at 1.25 m
    seen = t3d.register_depth(depth, K, K, shift, (96, 128))
    expected = np.full((96, 128), 2.5, np.float32)
    expected[:, :2] = 0
    expected[40:60, 52:54] = 0  # what the near square hid from the depth camera
    expected[40:60, 54:84] = 1.25
    np.testing.assert_allclose(seen, expected, rtol=1e-6)
