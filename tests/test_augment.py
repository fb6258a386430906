"""Augmentations: pixels, cameras and truth must still agree after each, and each must have its share of the clips."""

import json
from dataclasses import asdict, replace

import cv2
import numpy as np
import pytest

import tapip3d_lite as t3d
from lessons.n06_augmentations import flip_time
from tapip3d_lite.geometry import pixel_grid, project, transform
from tapip3d_lite.training.augment import (
    AugmentConfig,
    augment,
    augmentations,
    blur_colors,
    blur_depth,
    erase,
    flip,
    jitter_colors,
    random_view,
    reframe,
    requery,
)

NEVER = {"erase": 0, "jitter": 0, "blur": 0, "depth_blur": 0, "reframe": 0, "flip_x": 0, "flip_y": 0}
NAMES = [*NEVER, "flip_time"]
GEOMETRIC = ["reframe", "flip_x", "flip_y", "flip_time"]


@pytest.fixture(scope="module")
def clip():
    return t3d.simulate_clip(seed=3, frames=8, size=(64, 80), tracks=120, camera="handheld")


def change(clip, name, seed=0):
    if name == "flip_time":
        return flip_time(clip)
    return augmentations(AugmentConfig())[name][1](clip, np.random.default_rng(seed))


def pixels(clip):
    return project(clip.tracks.xyz, clip.intrinsics, clip.extrinsics)


def agreement(clip):
    """Share of visible points whose depth the depth map confirms within 3 %."""
    uv, z = pixels(clip)
    t, n = np.nonzero(clip.tracks.visible)
    u, v = np.rint(uv[t, n]).astype(int).T
    return (np.abs(clip.depths[t, v, u] / z[t, n] - 1) < 0.03).mean()


def plane_clip(frames=3, size=(40, 56), skew=0.0):
    """A slanted plane whose colours say where a pixel came from: red is 4u, green is 6v; tracks on the plane."""
    height, width = size
    k = np.array([[50.0, skew, 26.3], [0, 47, 18.8], [0, 0, 1]])
    uv = pixel_grid(height, width, like=k)
    rays = np.concatenate([uv, np.ones((height, width, 1))], -1) @ np.linalg.inv(k).T
    depth = 4 / (rays @ np.array([0.3, -0.5, 1.0]))
    video = np.stack([uv[..., 0] * 4, uv[..., 1] * 6, 0 * depth], -1).round().astype(np.uint8)
    angle = 0.3
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(np.array([0.2, angle, -0.4]))[0], (0.3, -1, 2)
    at = np.random.default_rng(0).integers(0, (width, height), (30, 2))
    camera = rays[at[:, 1], at[:, 0]] * depth[at[:, 1], at[:, 0], None]
    world = transform(camera, np.linalg.inv(pose))
    xyz = np.repeat(world[None], frames, 0)
    queries = np.concatenate([np.zeros((30, 1)), world], -1)
    tracks = t3d.Tracks(xyz, np.ones((frames, 30), bool), queries, dynamic=np.arange(30) < 7)
    repeated = (np.repeat(np.asarray(x)[None], frames, 0) for x in (video, depth, k, pose))
    return t3d.Clip(*repeated, tracks=tracks)


@pytest.mark.parametrize("name", NAMES)
def test_truth_agrees_with_depth_and_the_checks_find_nothing(clip, name):
    before, slack = agreement(clip), 0.15 if name == "depth_blur" else 0.05  # smeared edges are what it is for
    assert before > 0.9
    for seed in range(4):
        changed = change(clip, name, seed)
        assert agreement(changed) > before - slack
        assert not t3d.check_clip(changed)
        assert changed.size == clip.size and len(changed) == len(clip)
        assert np.array_equal(changed.queries, changed.tracks.queries)
        t, n = changed.queries[:, 0].astype(int), np.arange(len(changed.queries))
        assert changed.tracks.visible[t, n].all()
        np.testing.assert_allclose(changed.tracks.xyz[t, n], changed.queries[:, 1:], atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_same_seed_same_clip_and_the_input_is_untouched(clip, name):
    kept = {key: getattr(clip, key).copy() for key in ("video", "depths", "intrinsics", "extrinsics", "queries")}
    first, second = change(clip, name, 5), change(clip, name, 5)
    for key, value in kept.items():
        assert np.array_equal(getattr(clip, key), value)
        assert np.array_equal(getattr(first, key), getattr(second, key))
    if "flip" not in name:
        other = change(clip, name, 6)
        assert not all(np.array_equal(getattr(first, key), getattr(other, key)) for key in kept)


@pytest.mark.parametrize("scale", [0.75, 1.0, 1.25])
@pytest.mark.parametrize("skew", [0.0, 3.0])
def test_reframing_is_exact_on_a_plane(scale, skew):
    clip = plane_clip(skew=skew)
    offsets = np.array([[-3.3, 2.1], [0, 0], [4.6, -1.7]])
    changed = reframe(clip, scale, offsets)
    uv = pixel_grid(*clip.size, like=offsets)
    for t in range(3):
        source = (uv + offsets[t]) / scale
        inside = ((source > 1) & (source < np.array(clip.size[::-1]) - 2)).all(-1)
        distance = np.maximum(-source, source - np.array(clip.size[::-1]) + 1).max(-1)  # beyond the last centres
        colors = changed.video[t][..., :2].astype(float) / (4, 6)
        assert np.abs(colors - source)[inside].max() < 0.2  # rounding to 8 bit is up to 0.125 pixel
        assert not changed.depths[t][distance > 0.6].any() and not changed.video[t][distance > 1.1].any()
        # Every pixel's point must lie on the plane, to a hundredth of a pixel of interpolation.
        camera = changed.points("camera")[t][inside]
        np.testing.assert_allclose(camera @ [0.3, -0.5, 1.0], 4, rtol=2e-3)
    assert inside.sum() > 500
    kept = requery(clip.tracks, changed_visibility(clip, scale, offsets))
    assert np.array_equal(kept.visible, changed.tracks.visible)
    assert np.array_equal(kept.queries, changed.queries) and np.array_equal(kept.dynamic, changed.tracks.dynamic)


def changed_visibility(clip, scale, offsets):
    """The rule by hand: a point is in view from half a pixel left of the first centre to half right of the last."""
    old, _ = pixels(clip)
    height, width = clip.size
    visible = clip.tracks.visible.copy()
    for t in range(len(clip)):
        for n in range(visible.shape[1]):
            u, v = scale * old[t, n] - offsets[t]
            visible[t, n] &= -0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5
    return visible


def test_reframing_moves_projections_by_the_map(clip):
    changed = reframe(clip, 1.2, np.tile([5.5, 3.25], (8, 1)))
    uv = project(clip.tracks.xyz, changed.intrinsics, clip.extrinsics)[0]
    np.testing.assert_allclose(uv, 1.2 * pixels(clip)[0] - (5.5, 3.25), atol=1e-3)
    assert np.array_equal(reframe(clip, 1.0, np.zeros((8, 2))).video, clip.video)
    np.testing.assert_allclose(reframe(clip, 1.0, np.zeros((8, 2))).depths, clip.depths, rtol=1e-5)


def test_reframing_makes_no_surface_between_two():
    clip = plane_clip()
    depths = np.full_like(clip.depths, 2)
    depths[:, :, 28:], depths[:, :10] = 5, 0
    clip = replace(clip, depths=depths)
    got = np.unique(reframe(clip, 1.13, np.full((3, 2), 2.37)).depths)
    assert np.allclose(got, np.array([0, 2, 5])[np.abs(got[:, None] - [0, 2, 5]).argmin(1)], rtol=1e-5)
    assert {0, 2, 5} == set(np.rint(got))


def test_views_keep_to_their_bounds(clip):
    rng = np.random.default_rng(0)
    corner, scales = np.array([[0.0, 0.0], [79, 63]]), []
    for _ in range(300):
        scale, offsets = random_view(clip, rng, 0.05, (0.75, 1.25), 0.03)
        scales.append(scale)
        assert np.abs(np.diff(offsets, axis=0)).max() <= 0.03 * 80 + 1e-9
        ends = scale * corner[:, None] - offsets  # where the image's corners come to lie: (2, T, 2)
        border = scale * 0.05 * 80
        # Beyond its padding the image never leaves a crop that it can fill, and never leaves one that holds it.
        room = scale * corner[1] - corner[1]
        assert (ends[0] <= np.maximum(0, -room) + 2 * border + 1e-6).all()
        assert (ends[1] >= corner[1] - np.maximum(0, -room) - 2 * border - 1e-6).all()
    assert min(scales) < 0.8 < 1.2 < max(scales) and min(scales) >= 0.75 and max(scales) <= 1.25
    still = random_view(clip, rng, 0, (1.0, 1.0), 0)
    assert still[0] == 1 and not still[1].any()


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("skew", [0.0, 3.0])
def test_flips_mirror_pixels_and_keep_poses_rigid(axis, skew):
    clip = plane_clip(skew=skew)
    changed = flip(clip, axis)
    expected = pixels(clip)[0].copy()
    expected[..., axis] = clip.size[1 - axis] - 1 - expected[..., axis]
    np.testing.assert_allclose(pixels(changed)[0], expected, atol=1e-3)
    np.testing.assert_allclose(pixels(changed)[1], pixels(clip)[1], rtol=1e-5)
    np.testing.assert_allclose(np.linalg.det(changed.extrinsics[:, :3, :3]), 1, atol=1e-5)
    assert np.array_equal(changed.video[:, ::-1] if axis else changed.video[:, :, ::-1], clip.video)
    np.testing.assert_allclose(changed.tracks.xyz, clip.tracks.xyz * (-1, 1, 1), rtol=1e-6)
    # The mirrored image of a point map, pixel by pixel.
    points = np.flip(clip.points(), 2 - axis) * (-1, 1, 1)
    np.testing.assert_allclose(changed.points(), points, atol=1e-4)
    again = flip(changed, axis)
    for key in ("video", "depths", "intrinsics", "extrinsics", "queries"):
        np.testing.assert_allclose(getattr(again, key), getattr(clip, key), atol=1e-5)


def test_both_flips_turn_the_camera_and_leave_the_world(clip):
    changed = flip(flip(clip, 0), 1)
    np.testing.assert_allclose(changed.tracks.xyz, clip.tracks.xyz)
    np.testing.assert_allclose(changed.extrinsics, np.diag([-1, -1, 1, 1]) @ clip.extrinsics, atol=1e-6)


def test_time_runs_backward(clip):
    changed = flip_time(clip)
    for key in ("video", "depths", "intrinsics", "extrinsics"):
        assert np.array_equal(getattr(changed, key)[0], getattr(clip, key)[-1])
    assert np.array_equal(changed.tracks.xyz[2], clip.tracks.xyz[5])
    assert np.array_equal(changed.tracks.visible[2], clip.tracks.visible[5])
    assert np.array_equal(changed.queries[:, 0], 7 - clip.queries[:, 0])
    assert np.array_equal(flip_time(changed).queries, clip.queries)


def test_the_eraser_fills_with_means_and_occludes_what_it_covers(clip):
    changed = erase(clip, np.random.default_rng(1), 1.0, 1, (0.3, 0.3))
    covered = 0
    for t in range(8):
        differs = (changed.video[t] != clip.video[t]).any(-1)
        v, u = np.nonzero(differs)
        box = np.s_[v.min() : v.max() + 1, u.min() : u.max() + 1]
        assert max(differs[box].shape) <= 25 and (differs[box].mean() > 0.5)
        np.testing.assert_allclose(changed.video[t][box][0, 0], clip.video[t][box].mean((0, 1)), atol=2)
        old, new = clip.depths[t][box], changed.depths[t][box]
        assert np.ptp(new) == 0 and new[0, 0] == pytest.approx(old[old > 0].mean(), rel=0.02)
        kept = np.flatnonzero(clip.tracks.visible.any(0))
        uv = np.rint(pixels(clip)[0][t, kept])
        inside = (uv >= (u.min(), v.min())).all(-1) & (uv <= (u.max(), v.max())).all(-1)
        lost = clip.tracks.visible[t, kept] & ~visible_after(clip, changed, t)[kept]
        assert np.array_equal(lost, clip.tracks.visible[t, kept] & inside)
        covered += lost.sum()
    assert covered > 20


def visible_after(clip, changed, t):
    """(N,) by the original columns; tracks are recognised by their path."""
    paths = {x.tobytes(): n for n, x in enumerate(np.ascontiguousarray(clip.tracks.xyz.transpose(1, 0, 2)))}
    visible = np.zeros(clip.tracks.xyz.shape[1], bool)
    for n, x in enumerate(np.ascontiguousarray(changed.tracks.xyz.transpose(1, 0, 2))):
        visible[paths[x.tobytes()]] = changed.tracks.visible[t, n]
    return visible


def test_the_eraser_leaves_holes_holes_and_takes_its_share_of_frames(clip):
    hollow = replace(clip, depths=np.where(np.arange(80) < 40, clip.depths, 0))
    changed = erase(hollow, np.random.default_rng(0), 1.0, 1, (0.1, 0.1))
    assert not changed.depths[:, :, 48:].any() and np.isfinite(changed.depths).all()
    frames = 0
    for seed in range(60):
        changed = erase(clip, np.random.default_rng(seed), 0.5, 3, (0.1, 0.2))
        frames += (changed.depths != clip.depths).any((1, 2)).sum()
    assert abs(frames / 480 - 0.5) < 0.1  # 4.4 standard deviations


def test_lost_queries_move_to_the_first_frame_that_shows_them():
    visible = np.array([[1, 0, 0, 0], [1, 1, 0, 0], [0, 1, 0, 1]], bool)
    xyz = np.arange(36, dtype=np.float32).reshape(3, 4, 3)
    queries = np.array([[1, 3 * 4, 13, 14], [0, 3, 4, 5], [0, 6, 7, 8], [0, 9, 10, 11]], np.float32)
    got = requery(t3d.Tracks(xyz, np.ones_like(visible), queries, dynamic=np.array([0, 1, 0, 1], bool)), visible)
    assert got.queries.tolist() == [[1, 12, 13, 14], [1, *xyz[1, 1]], [2, *xyz[2, 3]]]
    assert got.dynamic.tolist() == [False, True, True] and got.xyz.shape == (3, 3, 3)


def test_jitter_by_hand(clip):
    image = clip.video[:1]
    gray = (image[0] @ [0.299, 0.587, 0.114]).astype(float)
    small = replace(clip.cut(0, 1), tracks=None, queries=None)
    for seed in range(3):
        got = jitter_colors(small, np.random.default_rng(seed), (0.2, 0.2, 0.2, 0)).video[0]
        b, c, s, _ = np.random.default_rng(seed).uniform([-0.2, -0.2, -0.2, 0], [0.2, 0.2, 0.2, 0]) + (1, 1, 1, 0)
        expected = s * image[0] + (1 - s) * gray[..., None]
        expected = b * (c * expected + (1 - c) * gray.mean())
        np.testing.assert_allclose(got, np.clip(expected, 0, 255), atol=0.7)
    assert np.abs(jitter_colors(small, np.random.default_rng(0), (0, 0, 0, 0)).video.astype(int) - image).max() <= 1
    turned = jitter_colors(small, np.random.default_rng(0), (0, 0, 0, 0.08)).video[0]
    assert np.abs(turned.astype(int) - image[0]).max() > 10  # hue changes colours and leaves brightness
    inner = ((turned > 0) & (turned < 255)).all(-1)
    np.testing.assert_allclose((turned @ [0.299, 0.587, 0.114])[inner], gray[inner], atol=1)


def test_blur_conserves_means_and_lessens_contrast(clip):
    got = blur_colors(clip, np.random.default_rng(0), (0.02, 0.02)).video.astype(float)
    np.testing.assert_allclose(got.mean((1, 2)), clip.video.mean((1, 2)), atol=2)
    roughness = [np.abs(np.diff(x.astype(float), axis=2)).mean() for x in (clip.video, got)]
    assert roughness[1] < 0.7 * roughness[0]


def test_depth_blur_is_a_weighted_mean_of_valid_pixels():
    clip = plane_clip(frames=1)
    rng = np.random.default_rng(0)
    depths = np.where(rng.random(clip.depths.shape) < 0.3, 0, clip.depths).astype(np.float32)
    clip = replace(clip, depths=depths, tracks=None, queries=None)
    got = blur_depth(clip, rng, (0.02, 0.02)).depths[0]
    sigma, depth = 0.02 * 56, depths[0]
    for v, u in ((20, 20), (5, 40), (33, 9), (11, 30)):
        y, x = np.mgrid[-5:6, -5:6]
        weight = np.exp(-(x**2 + y**2) / (2 * sigma**2)) * (depth[v - 5 : v + 6, u - 5 : u + 6] > 0)
        expected = (weight * depth[v - 5 : v + 6, u - 5 : u + 6]).sum() / weight.sum()
        assert got[v, u] == (pytest.approx(expected, rel=1e-3) if depth[v, u] else 0)
    assert np.array_equal(got > 0, depth > 0)


@pytest.mark.parametrize("name", ["jitter", "blur", "depth_blur", "reframe", "flip_x", "flip_y"])
def test_shares_are_kept(name):
    clip = replace(plane_clip(), name="plane")
    config = AugmentConfig(**NEVER | {name: 0.3})
    changed = sum(augment(clip, np.random.default_rng(seed), config) is not clip for seed in range(400))
    assert abs(changed / 400 - 0.3) < 0.1  # 4.4 standard deviations
    assert augment(clip, np.random.default_rng(0), AugmentConfig(**NEVER)) is clip


def test_all_together_at_the_papers_strength(clip):
    for seed in range(12):
        changed = augment(clip, np.random.default_rng(seed))
        again = augment(clip, np.random.default_rng(seed))
        assert np.array_equal(changed.video, again.video) and np.array_equal(changed.tracks.xyz, again.tracks.xyz)
        assert len(changed.queries) > 0.6 * len(clip.queries) and not t3d.check_clip(changed)
        sharp = augment(clip, np.random.default_rng(seed), AugmentConfig(depth_blur=0))
        assert agreement(sharp) > agreement(clip) - 0.08


@pytest.mark.parametrize("name", GEOMETRIC)
def test_arrays_of_unknown_meaning_are_dropped_where_pixels_move(clip, name):
    assert change(replace(clip, extras={"video_right": clip.video}), name).extras == {}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"erase": 1.5}, "erase"),
        ({"flip_x": -0.1}, "flip_x"),
        ({"scale": (1.2, 0.8)}, "scale"),
        ({"blur_sigma": (0, 1)}, "blur_sigma"),
        ({"erase_boxes": 0}, "erase_boxes"),
        ({"pad": -1}, "pad"),
        ({"jitter_strength": (0.2, 0.2, 0.2)}, "jitter"),
    ],
)
def test_bad_configurations_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        AugmentConfig(**changes)


def test_a_configuration_survives_json():
    config = AugmentConfig(scale=(0.9, 1.1))
    assert AugmentConfig(**json.loads(json.dumps(asdict(config)))) == config


def test_a_clip_may_lose_all_its_tracks(clip):
    dark = replace(clip, tracks=replace(clip.tracks.select(slice(5)), visible=np.zeros((8, 5), bool)))
    assert change(dark, "erase").queries.shape == (0, 4)


def test_a_view_of_nothing_is_refused(clip):
    with pytest.raises(ValueError, match="no valid pixel"):
        reframe(clip, 1.0, np.full((8, 2), 500))
