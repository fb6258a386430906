"""check_clip: no false alarm on good clips, each mistake of the catalogue named, and the fix repairs the clip."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

import tapip3d_lite as t3d
from tapip3d_lite.__main__ import check
from tapip3d_lite.check import check_clip
from tapip3d_lite.measures import USUAL_COLOUR, USUAL_DEPTH, agreement, reduced, warn_of_misfit
from tapip3d_lite.mistakes import CATALOGUE
from tests.mix_ups import MIX_UPS, SHAKEN, alarms, good, verdict

REFUSED = ["K transposed", "K skewed below the diagonal"]
MENDED = [
    "1e4 for the sky",
    "65504 for the sky",
    "1e10 for the sky",
    "infinity for the sky",
    "rotations not orthonormal",
]
# Their fix restores the clip itself; others find a number, or leave out frames.
EXACT = [
    "camera to world", "OpenGL axes", "both", "millimetres", "camera to world, millimetres", "poses in millimetres",
    "divided by 5000 for 1000", "ray length", "K normalised", "cx and cy swapped, landscape for portrait",
    "quaternion order", "quaternion order, camera to world", "rotation transposed", "poses shuffled", "video mirrored",
    "video and depth mirrored",
]  # fmt: skip


@pytest.fixture(scope="module")
def clip():
    return good(501, camera="arc")


@pytest.fixture(scope="module")
def shaken():
    return good(501, camera="handheld", shake=2.0)


@pytest.mark.parametrize("name", [name for name in MIX_UPS if name not in REFUSED + MENDED])
def test_mistakes_are_named_and_undone(clip, shaken, name):
    plant, names = MIX_UPS[name]
    clip = shaken if name in SHAKEN else clip
    wrong = plant(clip)
    findings = check_clip(wrong)
    assert "+".join(finding.name for finding in findings) == names
    repaired = wrong
    for finding in findings:
        less = {"unregistered": finding.after > 1.05 * finding.before, "normalised_intrinsics": finding.after > 0.5}
        assert less.get(finding.name, finding.after < 0.7 * finding.before)
        assert finding.name in str(finding)
        repaired = finding.fix(repaired)
    assert agreement(reduced(repaired)).usual(1.3)
    if name in EXACT:
        np.testing.assert_allclose(repaired.extrinsics, clip.extrinsics, atol=1e-3)
        np.testing.assert_allclose(repaired.depths, clip.depths, rtol=1e-4)
        np.testing.assert_allclose(repaired.intrinsics, clip.intrinsics, atol=1e-2)
        assert np.array_equal(repaired.video, clip.video)


@pytest.mark.parametrize("name", REFUSED + MENDED)
def test_what_a_clip_refuses_or_mends(clip, name):
    plant, words = MIX_UPS[name]
    with pytest.raises(ValueError, match=words) if name in REFUSED else pytest.warns(UserWarning, match=words):
        plant(clip)


def test_marks_for_the_sky_are_counted_and_unknown(clip):
    for value in (1e4, 65504, 1e10, np.inf):
        depths = clip.depths.copy()
        depths[:, :24] = value
        with pytest.warns(UserWarning, match=f"{16 * 24 * 128} pixels"):
            marked = replace(clip, depths=depths)
        assert not marked.depths[:, :24].any() and np.array_equal(marked.depths[:, 24:], clip.depths[:, 24:])
        assert check_clip(marked) == []


def test_far_depths_of_an_open_landscape_are_no_marks(clip):
    depths = np.geomspace(2, 1500, 96, dtype=np.float32)[::-1, None] * np.ones((16, 1, 128), np.float32)
    assert np.array_equal(replace(clip, depths=depths).depths, depths)


def test_rounded_rotations_are_mended(clip):
    rounded = clip.extrinsics.round(3)
    with pytest.warns(UserWarning, match="not orthonormal"):
        mended = replace(clip, extrinsics=rounded).extrinsics
    rotation = mended[:, :3, :3].astype(np.float64)
    np.testing.assert_allclose(rotation @ rotation.swapaxes(1, 2), np.tile(np.eye(3), (16, 1, 1)), atol=1e-6)
    np.testing.assert_allclose(mended, rounded, atol=2e-3)


def test_good_clips_raise_no_alarm():
    assert [found for found in alarms(12) if found[1]] == []


def test_what_shows_without_camera_motion():
    still = good(503, camera="static", sensor=None)
    for name in ("ray length", "K normalised", "K of another size", "65.535 m for unknown"):
        plant, names = MIX_UPS[name]
        assert verdict(still, plant) == names
    assert verdict(replace(still, depths=(1000 * still.depths).round())) == "depth_in_millimetres"


@pytest.mark.parametrize(
    "name",
    [
        *("decimetres", "TUM's factor 5000 forgotten", "disparity", "no poses: all are the first one"),
        *("depth early by 3 frames", "colour early by 3 frames", "poses late by 3 frames"),
    ],
)
def test_a_hand_that_hardly_travels_shows_them_where_depth_is_exact(name):
    hand = good(3, camera="handheld", sensor=None, frames=24)
    assert verdict(hand) == ""
    plant, names = MIX_UPS[name]
    assert verdict(hand, plant) == names


def test_no_remedy_flattens_the_depth(clip):
    for case in (clip, good(3, camera="handheld", sensor=None, frames=24)):
        wrong = MIX_UPS["relative depth, scaled per frame"][0](case)
        for finding in check_clip(wrong):
            after = finding.fix(wrong).depths
            assert np.ptp(np.log(after[after > 0])) > 0.5 * np.ptp(np.log(case.depths[case.depths > 0]))


def test_sparse_depth_is_no_evidence(clip):
    known = np.random.default_rng(0).random(clip.depths.shape) < 0.05
    assert check_clip(replace(clip, depths=np.where(known, clip.depths, 0))) == []


def test_an_unknown_cause_is_said_with_what_is_likeliest(clip):
    noise = np.random.default_rng(0).integers(0, 255, (16, *clip.size, 3)).astype(np.uint8)
    scene = np.random.default_rng(0).uniform(1, 5, (16, 12, 16)).repeat(8, 1).repeat(8, 2)
    (found,) = check_clip(replace(clip, video=noise, depths=scene))
    assert found.name == "unknown" and "cause unknown, likeliest: " in str(found)
    assert len(found.message.rpartition("likeliest: ")[2].split(", ")) == 3
    assert found.before > found.usual and f"where less than {found.usual:.2g} is usual" in str(found)


def test_the_cheap_part_warns_once_and_only_of_what_does_not_fit(clip):
    warn_of_misfit(clip)
    with pytest.warns(UserWarning, match="does not fit together") as said:
        warn_of_misfit(MIX_UPS["OpenGL axes"][0](clip))
    assert len(said) == 1 and str(USUAL_DEPTH) in str(said[0].message) and str(USUAL_COLOUR) in str(said[0].message)


def test_every_row_of_the_catalogue_is_tested():
    named = {part for _, names in MIX_UPS.values() for part in names.split("+")}
    assert set(CATALOGUE) <= named


def test_the_command_prints_findings_and_warnings(clip, tmp_path, capsys):
    clip.save(tmp_path / "good.npz")
    MIX_UPS["OpenGL axes"][0](clip).save(tmp_path / "bad.npz")
    arrays = {key: getattr(clip, key) for key in ("video", "intrinsics", "extrinsics")}
    np.savez(tmp_path / "sky.npz", **arrays, depths=np.where(clip.depths > 0, clip.depths, 65504))
    for name in ("good", "bad", "sky"):
        check(tmp_path / f"{name}.npz")
    good, bad, sky = capsys.readouterr().out.splitlines()
    assert good.endswith("nothing suspicious found") and bad.startswith("opengl_axes: ") and "lie beyond" in sky


def test_one_frame_is_enough_to_call(clip):
    assert check_clip(clip.cut(0, 1)) == []


def test_a_clip_with_swapped_poses_can_be_loaded_and_checked(tmp_path):
    clip = t3d.simulate_clip(seed=301, frames=8, size=(64, 64), tracks=8)
    arrays = {k: getattr(clip, k) for k in ("video", "depths", "intrinsics")}
    np.savez(tmp_path / "c.npz", **arrays, extrinsics=MIX_UPS["camera to world"][0](replace(clip, queries=None, tracks=None)).extrinsics, query_point=clip.queries)  # fmt: skip
    with pytest.raises(ValueError, match="points=False"):
        t3d.load_clip(tmp_path / "c.npz")
    findings = check_clip(t3d.load_clip(tmp_path / "c.npz", points=False))
    assert [f.name for f in findings] == ["camera_to_world"]


def test_a_cropped_clip_is_correct(clip):
    """The lower right 60 % of every frame, with the principal point moved as it should be."""
    top, left = (int(0.4 * side) for side in clip.size)
    matrix = clip.intrinsics.copy()
    matrix[:, :2, 2] -= (left, top)
    video, depths = (x[:, top:, left:] for x in (clip.video, clip.depths))
    assert check_clip(replace(clip, video=video, depths=depths, intrinsics=matrix, extras={})) == []


@pytest.mark.parametrize("factor", [0.8, 1.25, (1.5, 3.0)])
def test_motion_betrays_intrinsics_of_a_slightly_or_unevenly_larger_image(clip, factor):
    scale = np.array([*np.broadcast_to(factor, 2), 1], np.float32)[:, None]
    wrong = replace(clip, intrinsics=clip.intrinsics * scale)
    findings = check_clip(wrong)
    assert [f.name for f in findings] == ["intrinsics_of_another_size"]
    np.testing.assert_allclose(findings[0].fix(wrong).intrinsics, clip.intrinsics, rtol=0.01)


def test_large_images_are_looked_at_at_a_fraction(clip):
    large = replace(clip, video=clip.video.repeat(4, 1).repeat(4, 2), depths=clip.depths.repeat(4, 1).repeat(4, 2), intrinsics=clip.intrinsics * np.array([[4], [4], [1]], np.float32), extras={})  # fmt: skip
    assert reduced(large).size == (128, 171) and reduced(clip).size == clip.size
    assert agreement(reduced(large)).usual()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert check_clip(large) == []
    wrong = MIX_UPS["camera to world"][0](large)
    (found,) = check_clip(wrong)
    assert found.name == "camera_to_world"
    np.testing.assert_allclose(found.fix(wrong).extrinsics, large.extrinsics, atol=1e-5)
