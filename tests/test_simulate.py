from dataclasses import replace

import numpy as np
import pytest

from lessons import samples
from tapip3d_lite.formats import load_clip
from tapip3d_lite.geometry import project, unproject
from tapip3d_lite.simulate import SimulationConfig, simulate_clip, simulate_dataset, simulator
from tapip3d_lite.simulate.bodies import random_scene
from tapip3d_lite.simulate.cameras import random_path
from tapip3d_lite.simulate.physics import UnstableSceneError, roll_out
from tapip3d_lite.simulate.render import Shots
from tapip3d_lite.simulate.settings import CAMERAS, SHAPES
from tapip3d_lite.simulate.tracks import point_visibility, sample_pixels

SMALL = {"frames": 6, "size": (64, 64)}


@pytest.fixture(scope="module")
def clips():
    return [simulate_clip(seed, frames=8, size=(96, 96), camera=camera) for seed, camera in enumerate(CAMERAS)]


def arrays(clip):
    tracks = clip.tracks
    named = {key: getattr(clip, key) for key in ("video", "depths", "intrinsics", "extrinsics")}
    return named | {key: getattr(tracks, key) for key in ("xyz", "visible", "queries", "dynamic")} | dict(clip.extras)


def different(a, b):
    return [key for key in arrays(a) if not np.array_equal(arrays(a)[key], arrays(b)[key])]


def projected(clip):
    tracks = clip.tracks
    return project(tracks.xyz.astype(float), clip.intrinsics.astype(float), clip.extrinsics.astype(float))


def test_same_seed_same_clip_bit_for_bit_and_another_seed_another_clip():
    settings = {**SMALL, "camera": "handheld", "stereo_baseline": 0.1, "motion_blur": True}
    first = simulate_clip(5, **settings)
    assert different(first, simulate_clip(5, SimulationConfig(**settings))) == []
    assert {"video", "depths", "xyz"} <= set(different(first, simulate_clip(6, **settings)))


def test_queries_lie_exactly_on_the_depth_of_their_pixel(clips):
    for clip in clips:
        t = clip.queries[:, 0].astype(int)
        uv, z = project(clip.queries[:, None, 1:].astype(float), clip.intrinsics[t], clip.extrinsics[t])
        pixel = np.rint(uv[:, 0]).astype(int)
        assert np.abs(uv[:, 0] - pixel).max() < 1e-3
        np.testing.assert_allclose(z[:, 0], clip.depths[t, pixel[:, 1], pixel[:, 0]], rtol=1e-5)
        here = clip.tracks.xyz[t, np.arange(len(t))]
        np.testing.assert_allclose(here, clip.queries[:, 1:], atol=1e-5)
        assert clip.tracks.visible[t, np.arange(len(t))].all()


def smooth_pixels(clip):
    """Least and greatest depth (T, H, W) around each pixel, and where the surface there is smooth."""
    padded = np.pad(clip.depths, ((0, 0), (1, 1), (1, 1)), mode="edge")
    height, width = clip.size
    around = np.stack([padded[:, r : r + height, c : c + width] for r in range(3) for c in range(3)])
    least, greatest = around.min(0), around.max(0)
    return least, greatest, greatest < 1.05 * np.maximum(least, 1e-9)


def test_visibility_agrees_with_a_naive_test_against_the_depth_maps(clips):
    for clip in clips:
        uv, z = projected(clip)
        inside = (z > 0) & (uv >= -0.5).all(-1) & (uv < np.array(clip.size[::-1]) - 0.5).all(-1)
        assert not (clip.tracks.visible & ~inside).any()
        t, n = np.nonzero(inside)
        u, v = np.clip(np.rint(uv[t, n]).astype(int), 0, np.array(clip.size[::-1]) - 1).T
        least, greatest, smooth = (a[t, v, u] for a in smooth_pixels(clip))
        visible, z = clip.tracks.visible[t, n], z[t, n]
        seen = (z > least * 0.999) & (z < greatest * 1.001)  # on the surface that the camera sees there
        assert smooth.mean() > 0.5 and 0.1 < visible[smooth].mean() < 1
        assert (visible == seen)[smooth].mean() > 0.99  # the rest: two surfaces in contact, nearer than 5 %
        assert not (visible & (z > greatest * 1.01)).any()  # what lies behind everything around cannot be seen


def test_visibility_is_exact_at_silhouettes():
    config = SimulationConfig(shapes=("sphere",), moving=(1, 1), resting=(0, 0), frames=1)
    rng = np.random.default_rng(0)
    path = random_path(rng, config)
    scene = random_scene(rng, config, 0.0)
    states = roll_out(scene, 1, 12.0, np.zeros(1))[:, 0]
    center, radius = next(scene.posed(states)).geom_xpos[-1], scene.bodies[0].half[0]
    extrinsics = path.extrinsics(np.zeros(1))
    eye = -extrinsics[0, :3, :3].T @ extrinsics[0, :3, 3]
    normal = rng.normal(size=(4000, 3))
    towards = (eye - center) / np.linalg.norm(eye - center)
    edge = radius / np.linalg.norm(eye - center)
    ring = normal - (normal @ towards)[:, None] * towards  # half of them hug the silhouette, within 1e-6 radii
    ring /= np.linalg.norm(ring, axis=-1, keepdims=True)
    normal[::2] = (ring * np.sqrt(1 - edge**2) + (edge + rng.uniform(-1e-6, 1e-6, (4000, 1))) * towards)[::2]
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    points = center + radius * normal
    uv, _ = project(points, path.intrinsics, extrinsics[0])
    expected = ((eye - points) * normal).sum(-1) > 0
    expected &= (uv >= -0.5).all(-1) & (uv < 127.5).all(-1)
    empty = np.zeros((1, *config.size))
    shots = Shots(scene, states, path.intrinsics, extrinsics, np.eye(4), empty, empty, empty)
    visible = point_visibility(shots, points[None], normal[None])
    assert 0.2 < expected.mean() < 0.8
    np.testing.assert_array_equal(visible[0], expected)


def test_dynamic_points_move_and_the_others_stay(clips):
    for clip in clips:
        tracks = clip.tracks
        path = np.linalg.norm(tracks.xyz - tracks.xyz[:1], axis=-1).max(0)
        assert path[~tracks.dynamic].max() <= 0.05 + 1e-6
        assert np.median(path[tracks.dynamic]) > 0.2


def test_points_of_one_body_keep_their_distances(clips):
    # Rigidity, seen from the tracks alone: the floor's and each sphere's points never change their distances.
    clip = simulate_clip(0, **SMALL, shapes=("sphere",), moving=(1, 1), resting=(0, 0), camera="static")
    for mask in (clip.tracks.dynamic, ~clip.tracks.dynamic):
        xyz = clip.tracks.xyz[:, mask].astype(float)
        distance = np.linalg.norm(xyz[:, :, None] - xyz[:, None], axis=-1)
        assert np.ptp(distance, axis=0).max() < 1e-5


@pytest.mark.parametrize("share", [0.0, 0.6, 1.0])
def test_share_of_queries_on_moving_bodies(share):
    clip = simulate_clip(1, **SMALL, tracks=50, share_dynamic=share)
    assert clip.tracks.dynamic.sum() == round(50 * share)
    assert len(clip.queries) == 50
    if share:
        assert len(np.unique(clip.queries[:, 0])) > 3  # spread over the frames


def test_sample_pixels_falls_back_when_one_sort_is_missing():
    geom = np.zeros((2, 3, 3), int)
    rows = sample_pixels(np.random.default_rng(0), geom, np.array([False, True]), 20, 0.6)
    assert rows.shape == (20, 3)
    rows = sample_pixels(np.random.default_rng(0), geom + 1, np.array([False, True]), 20, 0.6)
    assert rows.shape == (20, 3)


@pytest.mark.parametrize("camera", CAMERAS)
def test_cameras_move_as_named(camera):
    config = SimulationConfig(camera=camera)
    poses = random_path(np.random.default_rng(2), config).extrinsics(np.arange(24.0))
    centers = -(poses[:, :3, :3].swapaxes(1, 2) @ poses[:, :3, 3:])[..., 0]
    steps = np.diff(centers, axis=0)
    bends = np.linalg.norm(np.diff(steps, axis=0), axis=-1)
    travel = np.linalg.norm(steps, axis=-1).sum()
    assert (travel > 0.1) == (camera != "static")
    assert (bends.max() > 1e-4) == (camera in ("arc", "handheld"))
    assert travel < 15 and (centers[:, 2] > 0.3).all()


def test_a_stronger_hand_shakes_more():
    bends = []
    for strength in (0.5, 3.0):
        config = SimulationConfig(camera="handheld", handheld=strength)
        poses = random_path(np.random.default_rng(2), config).extrinsics(np.arange(24.0))
        bends.append(np.abs(np.diff(poses[:, :3], 2, axis=0)).mean())
    assert bends[1] > 3 * bends[0]


def test_sizes_frames_and_shapes():
    clip = simulate_clip(0, frames=3, size=(48, 80), fps=24.0, tracks=7, shapes=("gear",), same_texture=True)
    assert clip.video.shape == (3, 48, 80, 3) and clip.depths.shape == (3, 48, 80)
    assert clip.tracks.xyz.shape == (3, 7, 3) and clip.fps == 24
    assert len(SHAPES) >= 8
    assert len(simulate_clip(0, frames=1, size=(32, 32), moving=(12, 12))) == 1


def test_stereo_pair_differs_by_the_disparity():
    clip = simulate_clip(2, frames=2, size=(128, 128), stereo_baseline=0.25, camera="static")
    assert clip.extras["stereo_baseline"] == np.float32(0.25)
    focal = clip.intrinsics[0, 0, 0]
    disparity = focal * 0.25 / clip.depths[0]
    v, u = np.indices(clip.size)
    source = np.rint(u - disparity).astype(int)
    inside = source >= 0
    left, right = clip.video[0].astype(float), clip.extras["video_right"][0].astype(float)
    error = np.abs(left - right[v, np.maximum(source, 0)]).mean(-1)[inside]
    shifted = np.abs(left - right[v, np.minimum(source + 4, 127)]).mean(-1)[inside]
    assert disparity.min() > 1  # otherwise nothing is tested
    assert np.median(error) < 0.5 * np.median(shifted)


def test_open_sky_has_invalid_depth():
    clip = simulate_clip(3, frames=4, size=(64, 64), sky=True)
    empty = clip.depths == 0
    assert 0.02 < empty.mean() < 0.9
    assert empty[:, :8].mean() > empty[:, -8:].mean()
    t = clip.queries[:, 0].astype(int)
    uv, _ = project(clip.queries[:, None, 1:], clip.intrinsics[t], clip.extrinsics[t])
    u, v = np.rint(uv[:, 0]).astype(int).T
    assert (clip.depths[t, v, u] > 0).all()
    assert np.isfinite(clip.tracks.xyz).all()


def test_motion_blur_changes_colours_only():
    sharp, blurred = (simulate_clip(4, **SMALL, camera="static", motion_blur=blur) for blur in (False, True))
    assert different(sharp, blurred) == ["video"]


def test_pictures_are_pictures(clips):
    for clip in clips:
        gray = clip.video.astype(float).mean(-1)
        assert 30 < gray.mean() < 220 and gray.std() > 15
        steps = np.abs(np.diff(gray, axis=2))
        assert np.median(steps) < 0.5 * gray.std()  # neighbours look alike: no noise


def test_static_scene_is_consistent_between_frames(clips):
    # Lift the floor of frame 0, project it into the last frame: the depths have to agree.
    clip = clips[2]
    v, u = np.indices(clip.size).reshape(2, -1)
    world = unproject(
        np.stack([u, v], -1).astype(float), clip.depths[0].ravel(), clip.intrinsics[0], clip.extrinsics[0]
    )
    uv, z = project(world, clip.intrinsics[-1], clip.extrinsics[-1])
    pixel = np.rint(uv).astype(int)
    inside = ((pixel >= 0) & (pixel < clip.size[::-1])).all(-1) & (z > 0) & (np.abs(world[:, 2]) < 1e-4)
    assert inside.sum() > 500
    found = clip.depths[-1, pixel[inside, 1], pixel[inside, 0]]
    assert np.median(np.abs(found / z[inside] - 1)) < 0.01


def spoil(monkeypatch, change, times):
    drawn = []

    def bad_scene(*arguments):
        scene = random_scene(*arguments)
        drawn.append(scene)
        return change(scene) if len(drawn) <= times else scene

    monkeypatch.setattr(simulator, "random_scene", bad_scene)
    return drawn


def explode(scene):
    return replace(scene, bodies=tuple(replace(b, velocity=b.velocity + 1e4) for b in scene.bodies))


def not_a_number(scene):
    return replace(scene, bodies=tuple(replace(b, velocity=b.velocity * np.nan) for b in scene.bodies))


def far_away(scene):
    scene.model.qpos0[0::7] += 25
    return scene


@pytest.mark.parametrize("change", [explode, not_a_number, far_away])
def test_unusable_scenes_are_drawn_again(monkeypatch, change):
    drawn = spoil(monkeypatch, change, times=1)
    clip = simulate_clip(0, **SMALL)
    assert len(drawn) >= 2
    assert np.isfinite(clip.tracks.xyz).all() and np.abs(clip.tracks.xyz).max() < 50


def test_seed_without_a_usable_scene_says_so(monkeypatch):
    spoil(monkeypatch, explode, times=1000)
    with pytest.raises(ValueError, match=r"seed 0 .* another seed"):
        simulate_clip(0, **SMALL)


def test_explosion_is_noticed_by_the_physics():
    config = SimulationConfig(resting=(0, 0))
    scene = explode(random_scene(np.random.default_rng(0), config, 0.0))
    with pytest.raises(UnstableSceneError):
        roll_out(scene, 4, 12.0, np.zeros(1))


def test_dataset_resumes_after_an_interruption(tmp_path):
    config = SimulationConfig(frames=2, size=(32, 32), tracks=16)
    paths = simulate_dataset(tmp_path, 3, config, first_seed=7, workers=1, progress=False)
    kept = paths[0].stat().st_mtime_ns
    whole = load_clip(paths[1])
    paths[1].unlink()
    (tmp_path / ".clip_000008.npz.x.npz").write_bytes(b"half")
    again = simulate_dataset(tmp_path, 4, config, first_seed=7, workers=1, progress=False)
    assert again[:3] == paths and again[3].exists()
    assert paths[0].stat().st_mtime_ns == kept
    assert different(whole, load_clip(paths[1])) == []
    assert different(whole, simulate_clip(8, config)) == []
    assert sorted(p.name for p in tmp_path.iterdir()) == [*(p.name for p in again), "dataset.json"]
    with pytest.raises(ValueError, match=r"camera='arc' .*'static'"):
        simulate_dataset(tmp_path, 4, replace(config, camera="static"), workers=1, progress=False)


def test_dataset_of_several_processes_is_the_same(tmp_path):
    config = SimulationConfig(frames=2, size=(32, 32), tracks=16)
    paths = simulate_dataset(tmp_path, 2, config, workers=2, progress=False)
    assert [different(load_clip(p), simulate_clip(i, config)) for i, p in enumerate(paths)] == [[], []]


@pytest.mark.parametrize("description", [None, "{", '{"simulation": {"colour": 1}}'])
def test_dataset_refuses_a_folder_it_cannot_read(tmp_path, description):
    (tmp_path / "clip_000000.npz").write_bytes(b"")
    if description is not None:
        (tmp_path / "dataset.json").write_text(description)
    with pytest.raises(ValueError, match=r"dataset\.json"):
        simulate_dataset(tmp_path, 1, workers=1, progress=False)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("frames", 0),
        ("frames", 2.5),
        ("fps", 0),
        ("size", (4, 128)),
        ("size", 128),
        ("camera", "dolly"),
        ("handheld", -1),
        ("arc", (90, 30)),
        ("moving", (0, 3)),
        ("moving", (5, 4)),
        ("resting", (0, 100)),
        ("shapes", ()),
        ("shapes", ("teapot",)),
        ("speed", float("nan")),
        ("drop", 0),
        ("stereo_baseline", -0.1),
        ("tracks", 0),
        ("share_dynamic", 1.5),
    ],
)
def test_bad_settings_are_named(name, value):
    with pytest.raises(ValueError, match=rf"{name}.*expected.*got"):
        simulate_clip(0, **{name: value})


def test_settings_may_be_numbers_of_numpy_and_lists():
    config = SimulationConfig(fps=np.float32(10), frames=np.int64(4), size=[64, 48], sky=np.bool_(True))
    assert config == SimulationConfig(fps=10.0, frames=4, size=(64, 48), sky=True)


def test_unknown_setting_bad_seed_and_bad_counts(tmp_path):
    with pytest.raises(ValueError, match="unknown setting colour"):
        simulate_clip(0, colour=1)
    for seed in (-1, 0.5):
        with pytest.raises(ValueError, match="seed must be"):
            simulate_clip(seed)
    for bad in ({"count": 0}, {"count": 1, "first_seed": -1}, {"count": 1, "workers": -2}):
        with pytest.raises(ValueError, match="whole number"):
            simulate_dataset(tmp_path, progress=False, **bad)


def test_samples_are_few_small_and_described(tmp_path, monkeypatch):
    monkeypatch.setattr(samples, "SAMPLES", {"open_sky": samples.SAMPLES["open_sky"]})
    (path,) = samples.write_samples(tmp_path)
    clip, exact = load_clip(path), simulate_clip(samples.SAMPLES["open_sky"].seed, sky=True)
    assert path.stat().st_size < 2e6 and clip.name == "open_sky"
    assert (clip.depths == 0).any()
    np.testing.assert_allclose(clip.depths, exact.depths, rtol=1e-5, atol=0)
    assert different(replace(clip, depths=exact.depths), exact) == []
    assert "`open_sky.npz`" in (tmp_path / "README.md").read_text(encoding="utf-8")


def test_longest_gap_counts_hidden_frames_between_visible_ones():
    rng = np.random.default_rng(0)
    visible = rng.uniform(size=(12, 50)) < 0.3
    texts = ["".join("01"[int(v)] for v in column) for column in visible.T]
    expected = [max(len(gap) for gap in text.strip("0").split("1")) for text in texts]
    np.testing.assert_array_equal(samples.longest_gap(visible), expected)
