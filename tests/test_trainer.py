"""A training that is killed, interrupted, poisoned or shared by two processes."""

import json
import os
import shutil
import signal
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import tapip3d_lite as t3d
from tapip3d_lite.evaluation.evaluate import evaluate, mean_scores
from tapip3d_lite.files import load_npz
from tapip3d_lite.lab import make_trainer
from tapip3d_lite.model.weights import load_weights
from tapip3d_lite.training.augment import AugmentConfig
from tapip3d_lite.training.data import FeatureCache, SamplingConfig, pick_frames
from tapip3d_lite.training.motion import MotionConfig
from tapip3d_lite.training.pretrain import MatchingConfig, draw_pair
from tapip3d_lite.training.recipe import TrainConfig
from tapip3d_lite.training.run_folder import read_log
from tapip3d_lite.training.trainer import Trainer
from tests.tiny import ROOT, SIZES, checkpoint, recipe, start, wait_for


def test_continuing_after_a_kill_changes_no_bit(tmp_path, clips, one_thread):
    Trainer(tmp_path / "whole", recipe(), clips).run(progress=False)
    with start(tmp_path / "killed", clips) as process:
        wait_for(process, 8)  # checkpoints stand at 3, 6, 9, ...
        process.send_signal(signal.SIGKILL)
    with open(tmp_path / "killed" / "log.jsonl", "a") as log:
        log.write('{"step": 9, "lo')  # what a kill may leave
    trainer = Trainer(tmp_path / "killed", recipe(), clips, resume=True)
    assert 0 < trainer.step < 16
    assert trainer.run(progress=False)
    whole, killed = checkpoint(tmp_path / "whole"), checkpoint(tmp_path / "killed")
    assert all(torch.equal(whole[name], killed[name]) for name in whole)
    logs = [
        [{k: v for k, v in line.items() if k != "seconds"} for line in read_log(tmp_path / x)]
        for x in ("whole", "killed")
    ]
    assert logs[0] == logs[1]
    assert [line["step"] for line in logs[0]] == list(range(1, 17))
    assert t3d.load_tracker(tmp_path / "killed" / "weights.safetensors").config.window == 4


@pytest.mark.parametrize("span", [5, 1000])
def test_the_saved_weights_are_the_average_of_the_last(tmp_path, clips, span):
    """Against the recursion written out: 1 / span, or 10 / (step + 9) while that is more; so the first weights vanish."""
    trainer, mean = Trainer(tmp_path / "run", recipe(average=span), clips), None
    scored = []
    trainer.validate = lambda tracker: scored.append(weights_of(tracker)) or {}
    for line in trainer.steps():
        share = max(1 / span, 10 / (line["step"] + 9))
        new = weights_of(trainer.tracker).double()
        mean = new if mean is None else mean + share * (new - mean)
    assert torch.allclose(weights_of(trainer.average).double(), mean, atol=1e-6)
    assert not torch.allclose(mean, new, atol=1e-4)  # so that the two can be told apart
    assert torch.equal(scored[-1], weights_of(trainer.average))
    saved = load_weights(tmp_path / "run/weights.safetensors")
    assert torch.allclose(weights_of(saved), weights_of(trainer.average), atol=2e-3)


def test_without_an_average_the_last_weights_are_saved(tmp_path, clips):
    trainer = Trainer(tmp_path / "run", recipe(average=0), clips)
    assert trainer.run(progress=False) and trainer.average is trainer.tracker
    saved = load_weights(tmp_path / "run/weights.safetensors")
    assert torch.allclose(weights_of(saved), weights_of(trainer.tracker), atol=2e-3)


def weights_of(tracker):
    return torch.cat([p.detach().flatten() for p in tracker.parameters()])


def test_interrupt_saves_between_two_steps(tmp_path, clips):
    with start(tmp_path, clips) as process:
        wait_for(process, 2)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
    assert process.returncode == 130
    saved = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert saved["step"] == read_log(tmp_path)[-1]["step"] < 16


def test_a_loss_that_is_not_finite_stops_with_its_batch(tmp_path, clips):
    trainer = Trainer(tmp_path, recipe(matching_steps=0), clips)
    with torch.no_grad():
        trainer.tracker.updater.head.bias[0] = torch.nan
    before = {name: x.clone() for name, x in trainer.tracker.state_dict().items()}
    with pytest.raises(FloatingPointError, match=r"step 1 are not finite.*not_finite_1\.pt"):
        trainer.run(progress=False)
    batch = torch.load(tmp_path / "not_finite_1.pt", weights_only=True)
    assert batch["queries"].shape == (1, 6, 4) and batch["truth"]["xyz"].shape == (1, 4, 6, 3)
    after = trainer.tracker.state_dict()
    assert all(torch.equal(after[name].nan_to_num(), before[name].nan_to_num()) for name in before)


def test_training_overfits_one_clip(tmp_path, clips):
    whole = {"sampling": SamplingConfig(tracks=24, seen=0.0, anywhere=0.0, backward=0.0), "frames": (8, 8)}
    world = {
        "motion": MotionConfig(world=1.0, turned=0.0, sliding=0.0, wrong=0.0),
        "sensor": 0.0,
    }  # so every step sees the same example
    config = recipe(matching_steps=0, steps=150, lr=2e-3, save_every=1000, head=1e-3, **whole, **world)
    trainer = Trainer(tmp_path, config, clips[:1])
    assert trainer.run(progress=False)
    losses = [line["position"] for line in read_log(tmp_path)]
    assert np.mean(losses[-30:]) < 0.6 * np.mean(losses[:30])


@pytest.mark.parametrize("train_encoder", [False, True])
def test_half_precision_follows_single_precision(tmp_path, clips, train_encoder):
    positions = {}
    for precision in ("float32", "bfloat16"):
        config = recipe(precision=precision, steps=3, matching_steps=0, train_encoder=train_encoder)
        assert Trainer(tmp_path / precision, config, clips).run(progress=False)
        positions[precision] = [line["position"] for line in read_log(tmp_path / precision)]
    assert positions["bfloat16"] != positions["float32"]
    assert positions["bfloat16"] == pytest.approx(positions["float32"], rel=0.05)


def _gradients(rank, size, folder, clips, batch):
    torch.set_num_threads(1)
    if size > 1:
        address = f"file://{folder}/meet"
        torch.distributed.init_process_group("gloo", init_method=address, rank=rank, world_size=size)
    trainer = Trainer(f"{folder}/{size}_{rank}", recipe(matching_steps=0, batch=batch), clips)
    with torch.no_grad():
        for parameter in trainer.parameters:
            parameter += rank  # so only the main process has the weights of the other training
    trainer.group.copy_from_main(trainer.tracker.parameters())
    trainer.optimizer.zero_grad()
    trainer._track(trainer.example())
    trainer.group.average(trainer.parameters)
    torch.save([p.grad for p in trainer.parameters], f"{folder}/gradients_{size}_{rank}.pt")
    if size > 1:
        torch.distributed.destroy_process_group()


def test_two_processes_give_the_gradients_of_one_with_twice_the_batch(tmp_path, clips):
    torch.multiprocessing.spawn(_gradients, (2, str(tmp_path), clips, 1), nprocs=2)
    _gradients(0, 1, str(tmp_path), clips, 2)
    first, second, alone = (
        torch.load(tmp_path / f"gradients_{name}.pt", weights_only=True) for name in ("2_0", "2_1", "1_0")
    )
    assert len(alone) > 20 and sum(float(x.abs().sum()) for x in alone) > 0
    for a, b, c in zip(first, second, alone, strict=True):
        assert torch.equal(a, b)
        torch.testing.assert_close(a, c, rtol=1e-3, atol=1e-6)


def test_torchrun_makes_one_training_of_all_processes(tmp_path):
    options = "--clips 2 --matching-steps 1 --steps 2 --frames 8 8 --iterations 1 1 --validation 0 --sampling.tracks 8"
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", "2"]
    command = [*torchrun, "-m", "tapip3d_lite", "train", "--out", str(tmp_path), *options.split()]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0 and "finished" in done.stdout, done.stderr
    assert [line["step"] for line in read_log(tmp_path)] == [1, 2, 3]
    again = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert again.returncode != 0 and "--resume" in again.stderr


def test_held_out_clips_are_scored_on_time(tmp_path, clips):
    seen = []

    def validate(tracker):
        seen.append((trainer.step, tracker.training))
        return {"val_x": float(len(seen))}

    trainer = Trainer(tmp_path / "own", recipe(evaluate_every=5), clips, validate)
    modes = [trainer.tracker.training for _ in trainer.steps()]
    assert seen == [(9, False), (14, False), (16, False)] and all(modes)  # steps 5, 10 and 12 of tracking
    assert {line["step"]: line.get("val_x") for line in read_log(tmp_path / "own")[8::5]} == {9: 1.0, 14: 2.0}
    held_out = [t3d.load_clip(path) for path in clips[:2]]
    trainer = make_trainer(tmp_path / "made", recipe(matching_steps=0, steps=1), clips, held_out)
    (line,) = trainer.steps()
    # An equal copy can round otherwise where its weights lie elsewhere in memory, and an untrained tracker magnifies it.
    scores = mean_scores([evaluate(trainer.average.eval().track(clip), clip) for clip in held_out])
    names = {name for name in line if name.startswith("val_")}
    assert len(names) == 6 and all(line[name] == round(scores[name.removeprefix("val_")], 4) for name in names)


def test_weights_to_start_from(tmp_path, clips):
    first = Trainer(tmp_path / "first", recipe(), clips)
    t3d.save_weights(first.tracker, tmp_path / "w.safetensors")
    init = {"init": str(tmp_path / "w.safetensors"), "seed": 1}
    second = Trainer(tmp_path / "second", recipe(**init), clips)
    random = Trainer(tmp_path / "random", recipe(seed=1), clips)
    states = [x.tracker.state_dict() for x in (first, second, random)]
    assert all(torch.equal(x, states[1][name]) for name, x in states[0].items())
    assert not all(torch.equal(x, states[2][name]) for name, x in states[0].items())
    with pytest.raises(ValueError, match="other sizes"):
        Trainer(tmp_path / "third", recipe(**init, tracker=SIZES | {"hidden": 16}), clips)
    with pytest.raises(ValueError, match="static: no such file"):
        Trainer(tmp_path / "fourth", recipe(init="static"), clips)


def test_features_belong_to_a_clips_content_not_to_its_name(tmp_path, clips):
    twins = [tmp_path / folder / "clip.npz" for folder in ("one", "other")]
    for twin, clip in zip(twins, clips, strict=False):
        twin.parent.mkdir()
        shutil.copy(clip, twin)
    encoder = t3d.Tracker(t3d.TrackerConfig.preset("lite", **SIZES)).encoder
    cache = FeatureCache(tmp_path / "features", encoder, (32, 32))
    (tmp_path / "features").mkdir()
    index = np.arange(3)
    one, other = (cache.frames(twin, index) for twin in twins)
    assert not torch.equal(one, other) and len(list((tmp_path / "features").iterdir())) == 2
    assert torch.equal(FeatureCache(tmp_path / "features", encoder, (32, 32)).frames(clips[0], index), one)


def test_a_disk_without_room_for_the_features_is_noticed_before_training(tmp_path, clips, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=3 * 8 * 16 * 16 * 16 * 2 - 1))
    with pytest.raises(ValueError, match=r"features of 3 clips take 0\.0 GB.*use fewer clips"):
        Trainer(tmp_path, recipe(), clips)
    Trainer(tmp_path / "two", recipe(), clips[:2])
    Trainer(tmp_path / "along", recipe(train_encoder=True), clips)


def test_a_folder_holds_one_recipe(tmp_path, clips):
    Trainer(tmp_path, recipe(), clips)
    with pytest.raises(ValueError, match="--resume"):
        Trainer(tmp_path, recipe(), clips)
    with pytest.raises(ValueError, match="lr="):
        Trainer(tmp_path, recipe(lr=1e-5), clips, resume=True)
    with pytest.raises(ValueError, match="no training clips"):
        Trainer(tmp_path / "other", recipe(), [])
    again = TrainConfig.from_dict(json.loads((tmp_path / "config.json").read_text()))
    assert again.tracker_config() == recipe().tracker_config() and again.sampling == recipe().sampling
    with pytest.raises(ValueError, match="unknown colour"):
        TrainConfig.from_dict({"colour": 1})


@pytest.mark.parametrize(
    "wrong", [{"steps": 0}, {"frames": (2, 6)}, {"precision": "int8"}, {"lr": 0.0}, {"matching_steps": -1}]
)
def test_recipes_that_cannot_work(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        recipe(**wrong)


def test_the_papers_recipe_takes_a_tiny_step(tmp_path, clips):
    sizes = SIZES | {"image_size": (32, 48)}  # clips are 32x32: they are brought to the tracker's size
    small = {"tracker": sizes, "frames": (6, 6), "sampling": SamplingConfig(tracks=12), "validation": 0}
    trainer = Trainer(tmp_path, TrainConfig.recipe("paper", **small, matching_steps=1, steps=1), clips)
    before = {name: p.clone() for name, p in trainer.tracker.named_parameters()}
    assert trainer.run(progress=False)
    matching, tracking = read_log(tmp_path)
    assert (
        matching["right"] is not None and tracking["loss"] > 0 and trainer.examples.batch(1, 1).frames.size == (32, 48)
    )
    changed = {name.split(".")[0] for name, p in trainer.tracker.named_parameters() if not torch.equal(p, before[name])}
    assert {"encoder", "updater"} <= changed


def test_only_a_recipe_with_augmentation_changes_the_clips(tmp_path, clips):
    options = {"train_encoder": True, "matching_steps": 0}
    plain = Trainer(tmp_path / "plain", recipe(**options), clips)
    changed = Trainer(tmp_path / "changed", recipe(**options, augment=True), clips)
    pairs = [[trainer.examples.batch(step, step).frames.depths for trainer in (plain, changed)] for step in range(8)]
    different = [not torch.equal(*pair) for pair in pairs]
    assert sum(different) >= 7
    part = pick_frames(load_npz(clips[0]), np.arange(4), (32, 32))
    assert np.array_equal(part.video, t3d.load_clip(clips[0]).video[:4])
    with pytest.raises(ValueError, match="train_encoder"):
        recipe(augment=True)


@pytest.mark.parametrize("augmentation", [None, AugmentConfig(), AugmentConfig(flip_x=1, flip_y=1)])
def test_pairs_show_the_same_point_twice(clips, augmentation):
    """Both places of a point show its surface: their colours agree better than those of shuffled points."""
    matched, shuffled = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        pair = draw_pair(clips[seed % 3], rng, MatchingConfig(gap=2, jitter=0.0), (64, 64), augmentation)
        assert pair.rgb.shape == (2, 3, 64, 64) and len(pair.uv[0]) >= 1
        u, v = pair.uv.round().long().clamp(0, 63).unbind(-1)
        colours = [pair.rgb[i, :, v[i], u[i]].T for i in range(2)]
        matched.append(float((colours[0] - colours[1]).abs().mean()))
        shuffled.append(float((colours[0] - colours[1][torch.from_numpy(rng.permutation(len(u[0])))]).abs().mean()))
    assert np.mean(matched) < 0.6 * np.mean(shuffled)


def test_a_recipe_from_before_a_setting_existed_is_continued(tmp_path, clips):
    Trainer(tmp_path, recipe(), clips)
    stored = json.loads((tmp_path / "config.json").read_text())
    del stored["augment"], stored["augmentation"], stored["motion"]["smoothing"]
    (tmp_path / "config.json").write_text(json.dumps(stored))
    assert TrainConfig.from_dict(stored).motion == recipe().motion and not TrainConfig.from_dict(stored).augment
    assert Trainer(tmp_path, recipe(), clips, resume=True).step == 0
