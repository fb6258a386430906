"""check_clip: no false alarm on correct clips, and each mix-up named with a fix that repairs it."""

from dataclasses import replace

import numpy as np
import pytest

import tapip3d_lite as t3d
from tapip3d_lite.__main__ import check
from tapip3d_lite.check import consistency
from tapip3d_lite.geometry import invert, pixel_grid, unproject

FLIP = np.diag([1, -1, -1, 1]).astype(np.float32)


def rows(a, b):
    return np.array([[a], [b], [1]], np.float32)


def ray_lengths(clip):
    height, width = clip.size
    uv = pixel_grid(height, width, clip.depths).reshape(-1, 2)
    rays = unproject(uv, np.ones(len(uv), np.float32), clip.intrinsics)
    return clip.depths * np.linalg.norm(rays, axis=-1).reshape(clip.depths.shape)


def translated(clip, factor):
    moved = clip.extrinsics.copy()
    moved[:, :3, 3] *= factor
    return moved


NEEDS_MOTION = {
    "camera_to_world": lambda c: replace(c, extrinsics=invert(c.extrinsics)),
    "opengl_axes": lambda c: replace(c, extrinsics=FLIP @ c.extrinsics),
    "camera_to_world+opengl_axes": lambda c: replace(c, extrinsics=invert(FLIP @ c.extrinsics)),
    "depth_in_millimetres": lambda c: replace(c, depths=c.depths * 1000),
    "poses_in_millimetres": lambda c: replace(c, extrinsics=translated(c, 1000)),
    "camera_to_world+depth_in_millimetres": lambda c: replace(
        c, extrinsics=invert(c.extrinsics), depths=1000 * c.depths
    ),
}
ALWAYS = {
    "ray_length": lambda c: replace(c, depths=ray_lengths(c)),
    "normalised_intrinsics": lambda c: replace(c, intrinsics=c.intrinsics * rows(1 / c.size[1], 1 / c.size[0])),
    "intrinsics_of_another_size": lambda c: replace(c, intrinsics=c.intrinsics * rows(3, 3)),
}


def clips(cameras, seeds):
    for camera in cameras:
        for seed in seeds:
            size = (96, 128) if seed % 2 else (64, 64)
            clip = t3d.simulate_clip(seed=seed, camera=camera, size=size, frames=12, sky=seed % 3 == 0, tracks=8)
            yield replace(clip, queries=None, tracks=None)


@pytest.fixture(scope="module")
def moving():
    return list(clips(("linear", "arc", "handheld"), (301, 302)))


@pytest.fixture(scope="module")
def still():
    return list(clips(("static",), (303, 304)))


def test_correct_clips_raise_no_alarm(moving, still):
    for clip in [*moving, *still]:
        assert t3d.check_clip(clip) == []
        assert consistency(clip) < 1e-3


@pytest.mark.parametrize("names", [*NEEDS_MOTION, *ALWAYS])
def test_mix_ups_are_named_and_the_fix_repairs(moving, names):
    for clip in moving:
        findings = t3d.check_clip((NEEDS_MOTION | ALWAYS)[names](clip))
        assert "+".join(f.name for f in findings) == names
        repaired = (NEEDS_MOTION | ALWAYS)[names](clip)
        for finding in findings:
            assert finding.after < 0.5 * finding.before
            repaired = finding.fix(repaired)
        np.testing.assert_allclose(repaired.extrinsics, clip.extrinsics, atol=1e-4)
        np.testing.assert_allclose(repaired.depths, clip.depths, rtol=1e-4)
        np.testing.assert_allclose(repaired.intrinsics, clip.intrinsics, atol=2.0)
        assert names.split("+")[0] in str(findings[0])


@pytest.mark.parametrize("name", ALWAYS)
def test_some_mix_ups_show_without_camera_motion(still, name):
    for clip in still:
        findings = t3d.check_clip(ALWAYS[name](clip))
        assert [f.name for f in findings] == [name]


def test_whole_numbers_betray_millimetres_without_camera_motion(still):
    sensor = replace(still[0], depths=(still[0].depths * 1000).round())
    assert [f.name for f in t3d.check_clip(sensor)] == ["depth_in_millimetres"]


def test_noise_and_wrong_poses_beyond_repair_are_no_mix_up(moving):
    rng = np.random.default_rng(0)
    noisy = replace(moving[0], depths=moving[0].depths * rng.normal(1, 0.02, moving[0].depths.shape))
    assert t3d.check_clip(noisy) == []
    shuffled = replace(moving[0], extrinsics=moving[0].extrinsics[rng.permutation(12)])
    assert t3d.check_clip(shuffled) == []


def test_the_command_names_an_error_that_no_fix_explains(moving, tmp_path, capsys):
    rng = np.random.default_rng(0)
    moving[0].save(tmp_path / "good.npz")
    replace(moving[0], extrinsics=moving[0].extrinsics[rng.permutation(12)]).save(tmp_path / "bad.npz")
    check(tmp_path / "good.npz")
    check(tmp_path / "bad.npz")
    good, bad = capsys.readouterr().out.splitlines()
    assert good.endswith("nothing suspicious found") and "does not fit together: relative depth error 0." in bad


def test_one_frame_is_enough_to_call(moving):
    assert t3d.check_clip(moving[0].cut(0, 1)) == []


def test_a_clip_with_swapped_poses_can_be_loaded_and_checked(tmp_path):
    clip = t3d.simulate_clip(seed=301, frames=8, size=(64, 64), tracks=8)
    arrays = {k: getattr(clip, k) for k in ("video", "depths", "intrinsics")}
    np.savez(tmp_path / "c.npz", **arrays, extrinsics=invert(clip.extrinsics), query_point=clip.queries)
    with pytest.raises(ValueError, match="points=False"):
        t3d.load_clip(tmp_path / "c.npz")
    findings = t3d.check_clip(t3d.load_clip(tmp_path / "c.npz", points=False))
    assert [f.name for f in findings] == ["camera_to_world"]


def cropped(clip):
    """The lower right 60 % of every frame, with the principal point moved as it should be."""
    top, left = (int(0.4 * side) for side in clip.size)
    matrix = clip.intrinsics.copy()
    matrix[:, :2, 2] -= (left, top)
    return replace(clip, video=clip.video[:, top:, left:], depths=clip.depths[:, top:, left:], intrinsics=matrix)


def test_a_cropped_clip_is_correct(moving, still):
    for clip in [*moving, *still]:
        assert t3d.check_clip(cropped(clip)) == []


@pytest.mark.parametrize("factor", [0.8, 1.25, (1.5, 3.0)])
def test_motion_betrays_intrinsics_of_a_slightly_or_unevenly_larger_image(moving, factor):
    across, down = np.broadcast_to(factor, 2)
    for clip in moving:
        findings = t3d.check_clip(replace(clip, intrinsics=clip.intrinsics * rows(across, down)))
        assert [f.name for f in findings] == ["intrinsics_of_another_size"]
        repaired = findings[0].fix(replace(clip, intrinsics=clip.intrinsics * rows(across, down)))
        np.testing.assert_allclose(repaired.intrinsics, clip.intrinsics, rtol=0.01)
