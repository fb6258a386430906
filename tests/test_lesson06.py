"""Lesson 06: one path for both devices, films that hide something, what steps can prove, and the milestone."""

import asyncio
import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import nbformat
import numpy as np
import pytest
import torch

import tapip3d_lite as t3d
from lessons import milestone, n06, progress
from lessons.checker import check
from lessons.n06_exercises import counted, discounted, update_loss
from lessons.n06_judge import Ratio
from lessons.n06_setting import cpu_setting, from_start, gpu_setting
from lessons.n06_step import TrackerChain
from lessons.teaching import solution_copy
from tapip3d_lite.training.loss import LossConfig
from tests import tiny
from tests.notebook_tools import notebooks


@pytest.fixture(autouse=True)
def nothing_solved():
    progress.reset()
    yield
    progress.reset()


def small(settings, **changes):
    """A setting of the same path, of two steps and four clips."""
    recipe = replace(settings.recipe, clips=4, minutes=None, matching_steps=1, steps=2, evaluate_every=1, **changes)
    return replace(settings, recipe=recipe, held_out=2)


def test_a_device_chooses_its_setting():
    cpu, gpu = n06.setting("cpu", 6), n06.setting("cuda", 10)
    assert (cpu.device, gpu.device) == ("cpu", "cuda")
    assert cpu.recipe.tracker_config().image_size == (64, 64) and gpu.recipe.tracker_config().image_size == (128, 128)
    assert gpu.recipe.tracker_config() == t3d.TrackerConfig.preset("lite") and gpu.recipe.init is None
    assert (gpu.recipe.precision, gpu.recipe.train_encoder, gpu.workers > 0) == ("bfloat16", True, True)
    assert (cpu.recipe.minutes, gpu.recipe.minutes) == (6, 10)


@pytest.mark.parametrize("branch", ["cpu", "gpu"])
def test_both_branches_train_by_the_same_functions(branch, tmp_path):
    if branch == "cpu":
        setting = small(cpu_setting(1.0))
    else:  # the GPU's settings on the CPU, where bfloat16 and recorded steps are not to be had
        setting = gpu_setting(1.0, device="cpu")
        assert setting.recipe.precision == "float32" and setting.workers == 0
        setting = small(replace(setting, workers=1), batch=2, tracker=tiny.SIZES, frames=(4, 4), iterations=(2, 2))
    # Workers import them; here `one_core` simulates.
    assert all(pickle.loads(pickle.dumps(scene)) is scene for scene in (setting.training, setting.scene))
    paths, held_out = setting.simulate(tmp_path)
    assert len(paths) == 4 and len(held_out) == 2 and len(held_out[0]) == setting.recipe.frames[1]
    assert not ({path.stem for path in paths} & {clip.name for clip in held_out})
    assert all((clip.queries[:, 0] == 0).all() and clip.tracks.visible[0].all() for clip in held_out)
    lines = asyncio.run(n06.train_live(setting.trainer(tmp_path / "long", paths, held_out)))
    assert [line["stage"] for line in lines] == ["matching", "tracking", "tracking"]
    assert {"val_APD3D_none", "val_APD3D_none_dynamic"} <= lines[-1].keys()
    other = setting.trainer(tmp_path / "short", paths, loss=LossConfig(form="paper"))
    assert asyncio.run(n06.train_unseen(other)) == 2
    pred = n06.follow(other.tracker.eval(), held_out[0])
    assert pred.xyz.shape == held_out[0].tracks.xyz.shape


def test_a_film_hides_what_it_says():
    clip = from_start(t3d.simulate_clip(1, frames=5, size=(32, 32), tracks=20))
    grey, depth, film = n06.grey(clip), n06.frozen(clip, ["depths"]), n06.frozen(clip)
    assert len(np.unique(grey.video)) == 1 and (grey.depths == clip.depths).all()
    assert (depth.depths == clip.depths[0]).all() and (depth.video == clip.video).all()
    assert (film.depths == clip.depths[0]).all() and (film.video == clip.video[0]).all()
    assert (film.extrinsics == clip.extrinsics[0]).all() and (film.tracks.xyz == clip.tracks.xyz).all()


def test_the_ratio_is_of_means_over_clips():
    clips = [t3d.simulate_clip(seed, frames=5, size=(32, 32), tracks=40) for seed in (1, 2, 3)]
    still = [t3d.load_tracker("static").track(clip) for clip in clips]
    half = [replace(s, xyz=(s.xyz + c.tracks.xyz) / 2) for s, c in zip(still, clips, strict=True)]
    found = n06.ratio(half, still, clips)
    assert found.value == pytest.approx(0.5) and found.low == pytest.approx(0.5) == found.high
    assert found.below(0.6) and not found.below(0.5)


@pytest.mark.parametrize(
    ("steps", "ratio", "status", "word"),
    [
        (2000, Ratio(0.5, 0.45, 0.6), "passed", "learnt"),
        (150, Ratio(1.0, 0.97, 1.03), "not attempted", "undecided: 150 steps"),
        (150, Ratio(0.8, 0.7, 0.9), "passed", "learnt"),  # it may be quick
        (2000, Ratio(1.0, 0.97, 1.03), "wrong", "not learnt"),
    ],
)
def test_a_run_says_what_it_shows(steps, ratio, status, word):
    said = n06.verdict(steps, 1000, ratio)
    assert said.status == status and said.message.startswith(word)


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ((0.5, 0.51, 1.0), "depth"),
        ((0.5, 1.0, 0.55), "colour"),
        ((0.2, 0.5, 0.86), "both"),
        ((0.5, 0.52, 0.5), "neither"),
        ((0.97, 1.0, 1.0), "undecided"),
    ],
)
def test_what_a_tracker_lives_on(values, word):
    assert n06.lives_on(*(Ratio(value, value, value) for value in values)) == word


def test_an_undecided_run_scores_no_guess():
    assert n06.reveal("depth", "undecided", choices=("colour", "depth")).verdict.status == "shown"
    assert n06.reveal(None, "undecided").verdict.status == "sealed"
    assert n06.reveal("depth", "both", choices=("depth", "both")).verdict.status == "wrong"


def solve(**functions):
    right = {"counted": counted, "loss": update_loss, "discount": discounted, "backward": n06.EXERCISES[3].reference}
    for name, function in (right | functions).items():
        assert check(f"06.{name}", function).status == "passed", name


@pytest.fixture(scope="module")
def tracker():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return t3d.Tracker(t3d.TrackerConfig.preset("lite", **n06.SMALL))


@pytest.fixture(scope="module")
def clip():
    return t3d.simulate_clip(0, n06.small_scene(1))


def test_a_training_step_on_the_learners_functions(tracker, clip, monkeypatch):
    assert n06.training_step(tracker, clip).status == "not attempted"
    solve()
    said = n06.training_step(tracker, clip)
    assert said.status == "passed" and str(said).count("yours, called") == 4
    for name, wrong in (
        ("06.counted", lambda frames, times, length: counted(frames, times, length + 1)),
        ("06.loss", lambda *case: update_loss(*case) * 1.001),
        ("06.discount", lambda losses, gamma: losses.sum()),
        ("06.backward", lambda chain: n06.EXERCISES[3].mistakes[-1].answer(chain)),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(progress._ENTRIES[name], "answer", wrong)
            assert n06.training_step(tracker, clip).status == "wrong", name


def test_a_function_of_another_form_is_refused(tracker, clip):
    batch = n06.example(clip, frames=8)
    with pytest.raises(ValueError, match="alpha = 3"):
        TrackerChain(tracker, batch.frames, batch.queries, batch.truth, LossConfig(), [len] * 3)


def test_the_whole_path_is_the_learners(tmp_path, monkeypatch):
    """What is solved in notebooks 00 to 05 is collected from a folder, and the tracker runs on it."""
    monkeypatch.setattr(milestone, "_FRAMES", 12)  # two windows in place of three
    monkeypatch.setattr(milestone, "_library", milestone._tracks)  # not what other tests have kept
    lessons = ("00", "01", "02", "03", "04", "05")
    for path in notebooks():
        if path.stem[:2] in lessons:
            nbformat.write(solution_copy(nbformat.read(path, as_version=4)), tmp_path / path.name)
    shutil.copytree(Path(tiny.ROOT) / "data_samples", tmp_path / "data_samples")
    said = n06.collect(tmp_path, lessons)
    assert said.status == "passed", str(said)
    tracked = n06.milestone(*lessons[1:], spaces=("world", "camera"))
    assert tracked.status == "passed", str(tracked)
    assert "the reference" not in str(tracked)
