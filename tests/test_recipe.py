"""The recipes are what they claim: their values, weight decay, clipping, the learning rate, the accuracy in the log."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from torch import nn

import tapip3d_lite as t3d
from tapip3d_lite.training import schedule as clock
from tapip3d_lite.training.data import make_batch
from tapip3d_lite.training.loss import LossConfig, accuracy, step_accuracy
from tapip3d_lite.training.optimizers import Muon, hidden_matrices, make_optimizer
from tapip3d_lite.training.parallel import Group
from tapip3d_lite.training.pretrain import MatchingConfig
from tapip3d_lite.training.recipe import TrainConfig
from tapip3d_lite.training.run_folder import read_log
from tapip3d_lite.training.schedule import Schedule, one_cycle
from tapip3d_lite.training.trainer import Trainer
from tests.tiny import SIZES, checkpoint, recipe

PAPER = {
    "clips": 10_000, "steps": 200_000, "batch": 1, "frames": (24, 24), "iterations": (4, 4), "short": 0.0,
    "train_encoder": True, "augment": True, "lr": 5e-4, "weight_decay": 5e-4, "warmup": 0.05, "clip_norm": 10.0,
    "precision": "bfloat16", "minutes": None, "init": None, "sensor": 0.0, "average": 0,
    "loss": {"form": "paper", "visibility": 3.0, "discount": 0.8, "scale": 0.005, "soften": 0.0, "within": 0.0},
    "motion": {
        "world": 0.0, "turned": 0.0, "still": 0.0, "velocity": 0.03, "velocity_noise": 0.015, "rotation": 0.1,
        "rotation_noise": 0.05, "smoothing": 0.8, "sliding": 0.0, "slide": (0.002, 0.2), "wrong": 0.0,
        "pose_noise": (0.05, 2.5),
    },
    "sampling": {"tracks": 384, "seen": 0.2, "anywhere": 0.25, "backward": 0.5},
    "augmentation": {
        "erase": 0.5, "erase_boxes": 10, "erase_side": (2 / 512, 100 / 512),
        "jitter": 0.25, "jitter_strength": (0.2, 0.2, 0.2, 0.08), "blur": 0.25, "blur_sigma": (0.1 / 512, 2 / 512),
        "depth_blur": 0.5, "depth_blur_sigma": (0.5 / 512, 3 / 512),
        "reframe": 1.0, "pad": 25 / 512, "scale": (0.75, 1.25), "drift": 15 / 512, "flip_x": 0.5, "flip_y": 0.5,
    },
}  # fmt: skip
"""The paper's values; its pixels are fractions of a width of 512."""

LITE = {
    "clips": 1000, "steps": 6000, "matching_steps": 2500, "batch": 1, "frames": (8, 16), "iterations": (2, 3),
    "short": 0.35, "train_encoder": False, "augment": False, "lr": 1e-3, "weight_decay": 5e-4, "warmup": 0.05,
    "clip_norm": 10.0, "precision": "float32", "average": 1000, "sensor": 0.4,
    "loss": {"form": "pixels", "visibility": 0.5, "discount": 0.8, "scale": 0.005, "soften": 0.0, "within": 0.0},
    "sampling": {"tracks": 48, "seen": 0.2, "anywhere": 0.25, "backward": 0.5},
    "matching": {
        "pairs": 1, "points": 128, "gap": 12, "levels": 4, "spread": 0.5, "place": 1.0, "jitter": 0.2, "lr": 1e-3,
        "weight_decay": 1e-4, "clip_norm": 1.0,
    },
}  # fmt: skip


@pytest.mark.parametrize(("name", "values"), [("paper", PAPER), ("lite", LITE)])
def test_values(name, values):
    config = TrainConfig.recipe(name)
    assert {key: asdict(config)[key] for key in values} == values
    assert config.tracker_config() == t3d.TrackerConfig.preset(name)
    assert TrainConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.fixture(params=["lite", "paper"])
def config(request):
    small = {"tracker": SIZES, "frames": (4, 6), "sampling": recipe().sampling, "validation": 0, "clips": 3}
    matching = MatchingConfig(clip_norm=0.5)
    return TrainConfig.recipe(request.param, **small, matching_steps=3, steps=37, matching=matching)


def test_only_matrices_and_kernels_are_decayed(tmp_path, clips, config):
    config = replace(config, matching_steps=0, train_encoder=True, weight_decay=0.5)
    trainer = Trainer(tmp_path, config, clips)
    parameters = dict(trainer.tracker.named_parameters())
    with torch.no_grad():
        for parameter in parameters.values():  # no zeros, which decay would leave as they are
            parameter.uniform_(1, 2)
            parameter.grad = torch.zeros_like(parameter)
    before = {name: parameter.detach().clone() for name, parameter in parameters.items()}
    lr = trainer.optimizer.param_groups[0]["lr"]
    trainer.optimizer.step()
    kinds = nn.Linear | nn.Conv2d, nn.LayerNorm | nn.InstanceNorm2d
    weights, norms = (
        {f"{name}.weight" for name, part in trainer.tracker.named_modules() if isinstance(part, kind)} & set(parameters)
        for kind in kinds
    )
    plain = norms | {name for name in parameters if name.endswith("bias")}
    assert len(weights) > 10 and len(norms) > 3 and len(plain) > 20 and not weights & plain
    for name, parameter in parameters.items():
        factor = 1.0 if name in plain else 1 - lr * 0.5
        torch.testing.assert_close(parameter, before[name] * factor, rtol=1e-6, atol=0, msg=name)
    learnt_inputs = ("virtual", "token")  # decayed, as every matrix
    assert weights | plain >= {name for name in parameters if not any(word in name for word in learnt_inputs)}


def watch_steps(trainer):
    """(norm of the gradient, learning rate, beta1) of each of the optimiser's steps, as it takes it."""
    seen, enter = [], trainer._enter_stage

    def attach():
        optimizer = trainer.optimizer

        def look(*_):
            norm = torch.stack([p.grad.norm() for p in trainer.parameters if p.grad is not None]).norm()
            group = optimizer.param_groups[0]
            assert all((g["lr"], g["betas"]) == (group["lr"], group["betas"]) for g in optimizer.param_groups)
            seen.append((float(norm), group["lr"], group["betas"][0]))

        optimizer.register_step_pre_hook(look)

    def entered(saved):
        enter(saved)
        attach()

    trainer._enter_stage = entered
    attach()
    return seen


def reference(lr, steps, warmup):
    """Learning rate and beta1 of each step by torch's own scheduler."""
    optimizer = torch.optim.AdamW([nn.Parameter(torch.zeros(()))], lr)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, lr, total_steps=steps + 1, pct_start=warmup)
    rates = []
    for _ in range(steps):
        rates.append((schedule.get_last_lr()[0], optimizer.param_groups[0]["betas"][0]))
        optimizer.step()
        schedule.step()
    return rates


def test_each_step_has_the_learning_rate_of_torchs_cycle_and_a_clipped_gradient(tmp_path, clips, config):
    trainer = Trainer(tmp_path, replace(config, clip_norm=0.05), clips)
    seen = watch_steps(trainer)
    assert trainer.run(progress=False)
    peak = {"lite": 1e-3, "paper": 5e-4}[config.preset]
    rates = reference(1e-3, 3, 0.05) + reference(peak, 37, 0.05)
    log = read_log(tmp_path)
    assert [(lr, beta1) for _, lr, beta1 in seen] == rates
    assert [line["lr"] for line in log] == [lr for lr, _ in rates]
    limits = [0.5] * 3 + [0.05] * 37
    clipped = [min(line["norm"], limit) for line, limit in zip(log, limits, strict=True)]
    assert [norm for norm, *_ in seen] == pytest.approx(clipped, rel=1e-4)
    assert log[0]["norm"] > 0.5 and max(line["norm"] for line in log[3:]) > 0.05  # so there was something to clip


@pytest.mark.parametrize("steps", [1, 2, 12, 19, 250])
@pytest.mark.parametrize("warmup", [0.05, 0.3])
def test_one_cycle_is_torchs(steps, warmup):
    if warmup * (steps + 1) == 1:  # torch divides by zero
        assert one_cycle(0, steps, 2e-3, warmup)[0] == pytest.approx(2e-3)
        return
    assert [one_cycle(step, steps, 2e-3, warmup) for step in range(steps)] == reference(2e-3, steps, warmup)


def test_accuracy_is_the_loop(clips):
    clip = t3d.load_clip(clips[0]).cut(0, 6)  # two windows of 4
    batch = make_batch([clip]).to("cpu")
    assert len({int(t) for t in clip.queries[:, 0]}) > 1 and 0 < int(batch.dynamic.sum()) < batch.dynamic.numel()
    tracker = t3d.Tracker(t3d.TrackerConfig.preset("lite", **SIZES))
    totals, rng = torch.zeros(2, 2), np.random.default_rng(0)
    inside, counted = np.zeros(2), np.zeros(2)
    for step in tracker.steps(batch.frames, batch.queries, iterations=2):
        pixels = 2.0 ** rng.uniform(-1, 5, step.coords.shape[:3])[..., None]  # errors of half a pixel to 32
        direction = rng.normal(size=step.coords.shape)
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        moved = np.zeros(step.coords.shape, np.float32)
        for i in range(4):
            t = min(step.start + i, 5)
            xyz = clip.tracks.xyz[t, step.columns.numpy()]
            z = t3d.geometry.transform(xyz, clip.extrinsics[t])[:, 2]
            focal = np.sqrt(clip.intrinsics[t, 0, 0] * clip.intrinsics[t, 1, 1]) * 256 / 32
            moved[0, i] = xyz + direction[0, i] * (pixels[0, i, :, 0] * z / focal)[:, None]
            if step.start + i > 5:
                continue
            for k, n in enumerate(step.columns.tolist()):
                if clip.tracks.visible[t, n] and t >= clip.queries[n, 0]:
                    share = np.mean([pixels[0, i, k, 0] < limit for limit in (1, 2, 4, 8, 16)])
                    inside += share * np.array([1, clip.tracks.dynamic[n]])
                    counted += np.array([1, clip.tracks.dynamic[n]])
        totals += step_accuracy(replace(step, coords=torch.from_numpy(moved)), batch.truth, batch.dynamic)
    np.testing.assert_allclose(totals.numpy(), [inside, counted], rtol=1e-4)
    result = accuracy(totals)
    assert result == pytest.approx({"apd": inside[0] / counted[0], "apd_dynamic": inside[1] / counted[1]}, rel=1e-4)
    assert 0.2 < result["apd"] < 0.8 and accuracy(torch.zeros(2, 2)) == {"apd": None, "apd_dynamic": None}


def test_the_log_has_the_accuracy_of_each_windows_last_update(tmp_path, clips, one_thread):
    trainer = Trainer(tmp_path, recipe(matching_steps=0, frames=(8, 8), iterations=2, head=0.003), clips)
    batch = trainer.examples.batch(0, 0).to("cpu")
    steps = trainer.tracker.steps(
        batch.frames, batch.queries, iterations=2, depth_roi=batch.roi, features=batch.features
    )
    totals = [torch.zeros(2, 2), torch.zeros(2, 2)]
    for step in steps:
        totals[step.iteration] += step_accuracy(step, batch.truth, batch.dynamic)
    line = next(trainer.steps())
    first, last = map(accuracy, totals)
    assert {name: line[name] for name in last} == pytest.approx(last) and first != pytest.approx(last)


def test_the_loss_is_the_recipes(tmp_path, clips, one_thread):
    lines = {}
    for name, loss in {"one": LossConfig(), "other": LossConfig(scale=0.05, visibility=1.5)}.items():
        trainer = Trainer(tmp_path / name, recipe(matching_steps=0, loss=loss), clips)
        lines[name] = next(trainer.steps())
    assert lines["other"]["position"] == pytest.approx(10 * lines["one"]["position"], rel=1e-5)
    assert lines["other"]["visibility"] == pytest.approx(5 * lines["one"]["visibility"], rel=1e-5)
    assert lines["one"]["loss"] == lines["one"]["position"] + lines["one"]["visibility"]


@pytest.fixture
def seconds(monkeypatch):
    """A clock to be set by hand."""
    now = [100.0]
    monkeypatch.setattr(clock.time, "perf_counter", lambda: now[0])
    return now


def test_a_time_budget_drives_stages_learning_rate_and_end(seconds):
    config = recipe(minutes=2, matching_steps=20, steps=80, evaluate_every=20)
    schedule, positions, due = Schedule(config, Group()), [], []
    for step in range(1, 9):
        assert next(schedule.places(step - 1)) == (step - 1, schedule.position)
        assert schedule.rate() == one_cycle(*((p, 20) if (p := schedule.position) < 20 else (p - 20, 80)), 1e-3, 0.05)
        before = schedule.position
        seconds[0] += 18  # 15 % of the time
        schedule.advance(step)
        positions.append(schedule.position)
        due.append(not schedule.matching and schedule.due(before))
        if schedule.finished:
            break
    assert positions == pytest.approx([15, 30, 45, 60, 75, 90, 100])
    assert due == [False, False, True, True, False, True, True]  # 40, 60, 80, the end
    continued = Schedule(config, Group(), 45.0)
    seconds[0] += 999  # between two runs
    continued.start_clock()
    seconds[0] += 6
    continued.advance(4)
    assert continued.position == pytest.approx(50)


def test_a_training_with_a_time_budget_ends_with_it_and_continues(tmp_path, clips, seconds, monkeypatch):
    advance = Schedule.advance

    def slowly(schedule, done):  # a step takes 4 % of the time
        seconds[0] += 0.1201
        advance(schedule, done)

    monkeypatch.setattr(Schedule, "advance", slowly)
    config = recipe(minutes=0.05, matching_steps=20, steps=80, short=0.5, lr=2e-3)
    first = Trainer(tmp_path, config, clips)
    assert not first.run(stop=lambda: first.schedule.position > 50, progress=False)
    seconds[0] += 999  # between two runs
    second = Trainer(tmp_path, config, clips, resume=True)
    assert second.schedule.position == pytest.approx(52, abs=0.1) and second.step == first.step == 13
    assert second.run(progress=False)
    log = read_log(tmp_path)
    assert [line["step"] for line in log] == list(range(1, 26))
    assert [line["stage"] for line in log] == ["matching"] * 5 + ["tracking"] * 20
    rates = [line["lr"] for line in log if line["stage"] == "tracking"]
    assert rates[-1] < 0.3 * max(rates) and max(rates) == pytest.approx(2e-3, rel=0.01)
    assert (tmp_path / "weights.safetensors").exists()
    assert checkpoint(tmp_path).keys() == second.tracker.state_dict().keys()
    with pytest.raises(ValueError, match="minutes"):
        recipe(minutes=0)


def test_muon_takes_the_matrices_inside_blocks_and_steps_as_far_as_adamw():
    """AdamW's first step moves each number by the learning rate; Muon's a number by 0.2 of it, as later ones of AdamW."""
    torch.manual_seed(0)
    tracker = t3d.Tracker(t3d.TrackerConfig.preset("lite", **SIZES))
    names = {id(p): name for name, p in tracker.named_parameters()}
    hidden = {names[id(p)] for p in hidden_matrices(tracker)}
    assert {"updater.time.0.attention.to_q.weight", "updater.time.0.mlp.0.weight"} <= hidden
    assert not [name for name in hidden if "head" in name or "input" in name or "encoder" in name or "bias" in name]
    pair = make_optimizer(tracker, list(tracker.parameters()), "muon", 1e-2, 0.0, False)
    assert len(pair.param_groups) == 3
    assert sum(len(group["params"]) for group in pair.param_groups) == len(names)
    before = {name: p.detach().clone() for name, p in tracker.named_parameters()}
    for p in tracker.parameters():
        p.grad = torch.randn_like(p)
    pair.step()
    for name, p in tracker.named_parameters():
        length = (p.detach() - before[name]).square().mean().sqrt().item() / 1e-2
        assert length == pytest.approx(0.2 if name in hidden else 1.0, rel=0.25), name
    pair.zero_grad()
    assert all(p.grad is None for p in tracker.parameters())
    assert isinstance(make_optimizer(nn.Linear(2, 2), [], "muon", 1e-2, 0.0, False), torch.optim.AdamW)


def test_muon_of_stacked_matrices_is_torchs_to_the_bit():
    sizes, pairs = [(6, 6), (4, 8), (6, 6), (8, 4), (4, 8)], []
    for kind in (torch.optim.Muon, Muon):
        torch.manual_seed(0)
        weights = [nn.Parameter(torch.randn(size)) for size in sizes]
        optimizer = kind(weights, 1e-2, 0.1, adjust_lr_fn="match_rms_adamw")
        for _ in range(3):
            for weight in weights[:-1]:  # one has no gradient
                weight.grad = torch.randn(weight.shape)
            optimizer.step()
        pairs.append((weights, [state["momentum_buffer"] for state in optimizer.state.values() if state]))
    for theirs, ours in zip(*pairs, strict=True):
        assert len(theirs) == len(ours) and all(map(torch.equal, theirs, ours))


def test_a_training_with_muon_continues_exactly(tmp_path, clips, one_thread):
    change = recipe(optimizer="muon")
    assert Trainer(tmp_path / "whole", change, clips).run(progress=False)
    for _ in range(2):
        stop = iter([False] * 5 + [True]).__next__
        Trainer(tmp_path / "halted", change, clips, resume=True).run(stop, progress=False)
    assert Trainer(tmp_path / "halted", change, clips, resume=True).run(progress=False)
    whole, halted = checkpoint(tmp_path / "whole"), checkpoint(tmp_path / "halted")
    assert all(torch.equal(whole[name], halted[name]) for name in whole)
    other = Trainer(tmp_path / "adamw", recipe(), clips)
    assert other.run(progress=False) and any(
        not torch.equal(x, whole[name]) for name, x in checkpoint(tmp_path / "adamw").items()
    )
