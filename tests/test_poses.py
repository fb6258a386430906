"""Poses from RGB-D and steadied clips: errors of known size are found, and what is right or cannot be known is left."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

import tapip3d_lite as t3d
from tapip3d_lite.bundle import Pair, _errors, motion, small
from tapip3d_lite.geometry import invert, project
from tapip3d_lite.poses import _median, _smooth, move
from tapip3d_lite.simulate.degrade import SensorConfig, degrade, wrong_poses
from tests.pose_errors import centres_apart, steps_apart


@pytest.fixture(scope="module", params=[(1, "arc"), (2, "handheld")], ids=lambda p: p[1])
def clip(request):
    seed, camera = request.param
    return t3d.simulate_clip(seed, camera=camera, arc=(20, 30), frames=10, size=(96, 112), tracks=40)


def still_clip():
    return t3d.simulate_clip(4, camera="static", frames=8, size=(96, 96), tracks=40)


def pose_errors(poses, truth):
    """Degrees and metres (T,) between poses and true ones, in a common world of least rotation and centre errors."""
    poses, truth = (x.astype(np.float64) for x in (poses, truth))
    u, _, v = np.linalg.svd((invert(poses) @ truth)[:, :3, :3].sum(0))
    centres, true_centres = (invert(x)[:, :3, 3] for x in (poses, truth))
    align = np.eye(4)
    align[:3, :3] = u @ v
    align[:3, 3] = (centres - true_centres @ (u @ v).T).mean(0)
    left = np.stack([small(x) for x in poses @ align @ invert(truth)])
    moved = invert(poses @ align)[:, :3, 3] - true_centres
    return np.degrees(np.linalg.norm(left[:, 3:], axis=1)), np.linalg.norm(moved, axis=1)


def log_scales(clip, truth):
    """The logarithm of each frame's depth scale (T,)."""
    return np.array([np.median(np.log(a[b > 0] / b[b > 0])) for a, b in zip(clip.depths, truth.depths, strict=True)])


@pytest.mark.parametrize("degrees", [0.5, 2.0])
def test_wrong_poses_are_corrected(clip, degrees):
    wrong = wrong_poses(clip, degrees, seed=3, drift=0)
    steady = t3d.steady_clip(wrong)
    before, after = (pose_errors(x.extrinsics, clip.extrinsics)[0] for x in (wrong, steady))
    assert np.sqrt((before**2).mean()) > 0.3 * degrees
    assert np.sqrt((after**2).mean()) < 0.15
    assert np.array_equal(steady.depths, wrong.depths)
    # The world stays where the wrong poses put it, on average; truth and queries keep pixels and depths.
    change = steady.extrinsics.astype(np.float64) @ invert(wrong.extrinsics.astype(np.float64))
    assert np.abs(np.mean([small(x) for x in change], 0)).max() < 0.02
    for one, other in zip(*(project(c.tracks.xyz, c.intrinsics, c.extrinsics) for c in (wrong, steady)), strict=True):
        np.testing.assert_allclose(one, other, atol=0.01)


def test_flickering_scale_is_corrected(clip):
    flicker = degrade(clip, SensorConfig(flicker=0.02), seed=3)
    steady = t3d.steady_clip(flicker)
    assert log_scales(flicker, clip).std() > 0.01
    scales = log_scales(steady, clip)
    assert scales.std() < 0.002 and abs(scales.mean()) < 0.01
    assert np.array_equal(steady.extrinsics, clip.extrinsics)
    assert np.array_equal(steady.queries, clip.queries) and np.array_equal(steady.tracks.xyz, clip.tracks.xyz)


def test_both_at_once_are_corrected(clip):
    wrong = degrade(wrong_poses(clip, 1.0, seed=5, drift=0), SensorConfig(flicker=0.02), seed=5)
    steady = t3d.steady_clip(wrong)
    assert pose_errors(steady.extrinsics, clip.extrinsics)[0].max() < 0.3
    assert log_scales(steady, clip).std() < 0.003


def test_a_clip_without_jitter_is_left_as_it_is(clip):
    assert t3d.steady_clip(clip) is clip
    noisy = degrade(clip, SensorConfig(noise=0.03), seed=1)
    steady = t3d.steady_clip(noisy)
    assert np.array_equal(steady.extrinsics, clip.extrinsics) and np.array_equal(steady.depths, _smooth(noisy).depths)


def test_a_camera_at_rest():
    clip = still_clip()
    assert t3d.steady_clip(clip) is clip
    steady = t3d.steady_clip(wrong_poses(clip, 1.0, seed=1, drift=0))
    assert pose_errors(steady.extrinsics, clip.extrinsics)[0].max() < 0.15
    flicker = degrade(clip, SensorConfig(flicker=0.02), seed=1)
    scales = log_scales(t3d.steady_clip(flicker), flicker)
    assert abs(scales.mean()) < 0.003 < scales.std()  # nothing tells the true scale: the mean is kept
    estimated = t3d.estimate_poses(hidden(clip))
    assert pose_errors(estimated.extrinsics, clip.extrinsics)[0].max() < 0.1


def test_depth_noise_is_smoothed_and_holes_stay_holes(clip):
    noisy = degrade(clip, SensorConfig(noise=0.05, dropout=0.2), 0)
    steady = t3d.steady_clip(noisy)
    np.testing.assert_array_equal(steady.depths > 0, noisy.depths > 0)
    seen = noisy.depths > 0
    before, after = (np.median(np.abs(x.depths / clip.depths - 1)[seen]) for x in (noisy, steady))
    assert before == pytest.approx(0.0337, rel=0.05) and after < 0.4 * before  # the median of a normal error of 5 %
    assert np.array_equal(steady.queries, clip.queries)


def test_medians_are_those_of_the_known_neighbours():
    depth = np.random.default_rng(0).uniform(1, 2, (7, 9)).astype(np.float32)
    depth[2, 3:6] = depth[6] = 0
    for (i, j), value in np.ndenumerate(_median(depth)):
        near = depth[max(i - 2, 0) : i + 3, max(j - 2, 0) : j + 3]
        assert value == (pytest.approx(np.median(near[near > 0])) if depth[i, j] else 0)


def hidden(clip):
    """The clip without its poses."""
    return replace(clip, extrinsics=np.repeat(clip.extrinsics[:1], len(clip), 0), queries=None, tracks=None)


def test_poses_from_nothing_but_colour_and_depth(clip):
    found = t3d.estimate_poses(hidden(clip))
    np.testing.assert_allclose(found.extrinsics[0], clip.extrinsics[0], atol=1e-5)
    degrees, metres = pose_errors(found.extrinsics, clip.extrinsics)
    assert degrees.max() < 0.3 and metres.max() < 0.03
    turned = pose_errors(hidden(clip).extrinsics, clip.extrinsics)[0].max()
    assert turned > 5 * degrees.max()


def patches(frames, speed, parts, size=96):
    """A wall of parts x parts pictures at one distance, each sliding in a direction of its own, before a camera at rest."""
    rng, side = np.random.default_rng(0), size // parts
    video = np.zeros((frames, size, size, 3), np.uint8)
    for i in range(parts * parts):
        picture = cv2.resize(rng.integers(0, 255, (40, 40, 3), np.uint8), (200, 200), interpolation=cv2.INTER_CUBIC)
        angle, (y, x) = rng.uniform(0, 2 * np.pi), np.multiply(divmod(i, parts), side)
        for t in range(frames):
            u, v = 70 + speed * t * np.array([np.cos(angle), np.sin(angle)])
            shift = np.array([[1, 0, u], [0, 1, v]])
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            video[t, y : y + side, x : x + side] = cv2.warpAffine(picture, shift, (side, side), flags=flags)
    k = np.array([[100, 0, size / 2], [0, 100, size / 2], [0, 0, 1]])
    return t3d.Clip(video, np.full(video.shape[:3], 3.0), np.stack([k] * frames), np.stack([np.eye(4)] * frames))


def test_where_nothing_rests_nothing_is_changed():
    world = patches(8, 2.0, parts=4)
    assert t3d.steady_clip(world) is world
    with pytest.raises(ValueError, match=r"estimate_poses: clip 'clip', frames .*agree on the camera's motion"):
        t3d.estimate_poses(world)
    carried = patches(8, 1.0, parts=1)  # all slides alike: either the world moves or a pose drifts
    assert t3d.steady_clip(carried) is carried
    poses = t3d.estimate_poses(carried).extrinsics  # without poses the world is what most of the picture shows
    assert np.linalg.norm(poses[-1, :3, 3]) == pytest.approx(7 / 100 * 3, rel=0.05)


def test_blank_frames_are_named(clip):
    blank = replace(clip, video=np.full_like(clip.video, 90))
    assert t3d.steady_clip(blank) is blank
    with pytest.raises(ValueError, match="frames 1, 2, 3"):
        t3d.estimate_poses(blank)
    depths, video = clip.depths.copy(), clip.video.copy()
    depths[4], video[7] = 0, 0
    with pytest.raises(ValueError, match=r"frames 4, 5, 7, 8:.*leave these frames out"):
        t3d.estimate_poses(replace(clip, depths=depths, video=video))
    wrong = wrong_poses(replace(clip, depths=depths, video=video), 1.0, seed=2, drift=0)
    steady = t3d.steady_clip(wrong)  # frames that show nothing keep their poses, the others are corrected
    np.testing.assert_allclose(steady.extrinsics[[4, 7]], wrong.extrinsics[[4, 7]], atol=1e-6)
    seen = [t for t in range(len(clip)) if t not in (4, 7)]
    assert pose_errors(steady.extrinsics[seen], clip.extrinsics[seen])[0].max() < 0.4
    one = clip.cut(0, 1)
    assert t3d.steady_clip(one) is one and t3d.estimate_poses(one) is one


def test_units_do_not_matter():
    metres = replace(wrong_poses(still_clip(), 1.0, seed=3, drift=0), queries=None, tracks=None)
    scaled = metres.extrinsics * np.array([[1, 1, 1, 1000]] * 3 + [[1, 1, 1, 1]])
    millimetres = replace(metres, depths=metres.depths * 1000, extrinsics=scaled)
    one, other = t3d.steady_clip(metres), t3d.steady_clip(millimetres)
    np.testing.assert_allclose(one.extrinsics[:, :3, :3], other.extrinsics[:, :3, :3], atol=2e-4)
    np.testing.assert_allclose(one.extrinsics[:, :3, 3], other.extrinsics[:, :3, 3] / 1000, atol=2e-3)


def test_tracks_are_carried_back(clip):
    wrong = wrong_poses(clip, 1.0, seed=3, drift=0)
    steady = t3d.steady_clip(wrong)
    back = t3d.carry(steady.tracks, steady, wrong)
    np.testing.assert_allclose(back.xyz, wrong.tracks.xyz, atol=1e-4)
    np.testing.assert_allclose(back.queries, wrong.queries, atol=1e-4)
    assert t3d.evaluate(back, wrong)["APD3D_none"] == 1
    assert move(replace(clip, queries=None, tracks=None), np.stack([np.eye(4)] * len(clip))).tracks is None


def test_derivatives_are_those_of_the_errors():
    rng = np.random.default_rng(0)
    poses = np.stack([motion(0.1 * rng.normal(size=6)) for _ in range(2)])
    k = np.repeat([[[100.0, 2, 50], [0, 90, 40], [0, 0, 1]]], 2, 0)
    pair = Pair(0, 1, rng.normal(size=(5, 3)) + [0, 0, 5], rng.uniform(0, 90, (5, 2)), rng.uniform(3, 6, 5))
    scale = 0.1 * rng.normal(size=2)
    _, by = _errors(pair, k, poses, scale)
    for i in range(14):
        step, (frame, part) = np.zeros((2, 7)), divmod(i, 7)
        step[frame, part] = 1e-5
        ends = [
            _errors(pair, k, np.stack([motion(s * x) @ p for x, p in zip(step, poses, strict=True)]), scale + s * step[:, 6])[0]
            for s in (1, -1)
        ]  # fmt: skip
        np.testing.assert_allclose(by[:, :, i], (ends[0] - ends[1]) / 2e-5, rtol=1e-4, atol=1e-4)


def test_errors_of_poses_are_those_of_the_definitions():
    """Of a rigid motion of everything no ATE is left; a turn of each camera about itself is all RPE of angle."""
    rng = np.random.default_rng(0)
    truth = np.repeat(np.eye(4)[None], 6, 0)
    truth[:, :3, 3] = rng.normal(size=(6, 3))
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = cv2.Rodrigues(np.array([0.3, -0.2, 0.5]))[0], [1, 2, 3]
    assert centres_apart(truth @ world, truth) == pytest.approx(0, abs=1e-9)
    assert steps_apart(truth @ world, truth) == pytest.approx((0, 0), abs=1e-9)
    away = truth.copy()
    away[3, :3, 3] += [0.3, 0, 0]
    plain = np.sqrt(((truth - away)[:, :3, 3] ** 2).sum(1).mean())
    assert 0.3 * plain < centres_apart(away, truth) < plain
    assert steps_apart(away, truth)[0] == pytest.approx(0.3 * np.sqrt(2 / 5)) and steps_apart(away, truth)[1] == 0
    turned = truth.copy()
    turned[1::2] = (
        np.block([[cv2.Rodrigues(np.array([0, np.radians(2), 0]))[0], np.zeros((3, 1))], [0, 0, 0, 1]]) @ turned[1::2]
    )
    assert steps_apart(turned, truth)[1] == pytest.approx(2) and centres_apart(turned, truth) == pytest.approx(
        0, abs=1e-9
    )
