"""Files are written through links, with their permissions, the same each time; two processes do not share a folder."""

import os
import signal
import stat
import subprocess
import sys

import numpy as np
import pytest
import torch

import tapip3d_lite as t3d
from tapip3d_lite.files import atomic_path, locked, write_text
from tapip3d_lite.lab.train import train
from tapip3d_lite.simulate import SimulationConfig, simulate_dataset
from tapip3d_lite.training.pretrain import MatchingConfig
from tapip3d_lite.training.trainer import Trainer
from tests.tiny import ROOT, SIZES, recipe, start, wait_for


def test_a_link_is_written_through(tmp_path):
    (tmp_path / "far").mkdir()
    (tmp_path / "far" / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to("far/real.txt")
    (tmp_path / "dangling.txt").symlink_to("far/new.txt")
    write_text(tmp_path / "link.txt", "new")
    write_text(tmp_path / "dangling.txt", "new")
    assert (tmp_path / "link.txt").is_symlink() and (tmp_path / "dangling.txt").is_symlink()
    assert {path.name: path.read_text() for path in (tmp_path / "far").iterdir()} == {
        "real.txt": "new",
        "new.txt": "new",
    }


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o755])
def test_permissions_stay(tmp_path, mode):
    (tmp_path / "x").write_text("old")
    (tmp_path / "x").chmod(mode)
    write_text(tmp_path / "x", "new")
    assert stat.S_IMODE((tmp_path / "x").stat().st_mode) == mode and (tmp_path / "x").read_text() == "new"


def test_what_is_no_file_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "folder").mkdir()
    (tmp_path / "null").symlink_to(os.devnull)
    for path in (os.devnull, *(tmp_path / name for name in ("fifo", "folder", "null"))):
        with pytest.raises(ValueError, match="expected the name of a file"), atomic_path(path):
            pass
    assert stat.S_ISCHR(os.stat(os.devnull).st_mode) and stat.S_ISFIFO((tmp_path / "fifo").stat().st_mode)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fifo", "folder", "null"]


HOLD = """
import sys
from tapip3d_lite.files import locked
with locked(sys.argv[1], "it"):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_lock_names_its_owner_and_ends_with_it(tmp_path):
    path = tmp_path / "deep" / ".lock"
    command = [sys.executable, "-c", HOLD, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT) as owner:
        assert owner.stdout.readline() == "held\n"
        with (
            pytest.raises(ValueError, match=f"the folder is in use by process {owner.pid} "),
            locked(path, "the folder"),
        ):
            pass
        owner.send_signal(signal.SIGKILL)
    assert path.exists()  # left over, and locks nothing
    with locked(path, "the folder"):
        assert path.read_text() == str(os.getpid())
        with pytest.raises(ValueError, match=f"process {os.getpid()}"), locked(path, "the folder"):
            pass
    assert not path.exists()


def test_two_trainings_in_one_folder(tmp_path, clips):
    first = start(tmp_path, clips)
    wait_for(first, 2)
    with pytest.raises(ValueError, match=f"in use by process {first.pid}"):
        Trainer(tmp_path, recipe(), clips, resume=True)
    first.kill()
    first.communicate()
    (tmp_path / ".checkpoint.pt.abc.pt").write_bytes(b"half")
    trainer = Trainer(tmp_path, recipe(), clips, resume=True)
    assert trainer.run(progress=False) and not list(tmp_path.glob(".*"))


def test_two_simulations_in_one_folder(tmp_path):
    config = SimulationConfig(frames=2, size=(32, 32), tracks=8)
    (whole,) = simulate_dataset(tmp_path, 1, config, workers=1, progress=False)
    (tmp_path / ".clip_000001.npz.abc.npz").write_bytes(b"another process's")
    with locked(tmp_path / ".lock", "it"):
        assert simulate_dataset(tmp_path, 1, config, workers=1, progress=False) == [whole]  # nothing to write
        with pytest.raises(ValueError, match="the folder is in use by process"):
            simulate_dataset(tmp_path, 2, config, workers=1, progress=False)
        assert len(list(tmp_path.glob(".clip_*"))) == 1
    simulate_dataset(tmp_path, 2, config, workers=1, progress=False)
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lr": float("inf")}, "TrainConfig.lr: expected float, got inf"),
        ({"lr": float("nan")}, "TrainConfig.lr"),
        ({"seed": -1}, "TrainConfig.seed"),
        ({"steps": 2.5}, "TrainConfig.steps: expected int"),
        ({"clip_norm": 0.0}, "TrainConfig.clip_norm"),
        ({"frames": (8,)}, "TrainConfig.frames"),
        ({"frames": "8"}, "TrainConfig.frames"),
        ({"augment": 1}, "TrainConfig.augment: expected bool"),
        ({"init": 5}, "TrainConfig.init"),
    ],
)
def test_recipes_are_checked_by_type_and_range(change, message):
    with pytest.raises(ValueError, match=message):
        recipe(**change)


@pytest.mark.parametrize("change", [{"pairs": 0}, {"points": 0}, {"lr": float("nan")}, {"spread": 0.0}, {"gap": "far"}])
def test_the_matching_is_checked(change):
    with pytest.raises(ValueError, match=f"MatchingConfig.{next(iter(change))}"):
        MatchingConfig(**change)


@pytest.mark.parametrize(
    ("changes", "options", "message"),
    [
        ({"frames": (8, 40)}, {}, "the simulated clips have 24 frames"),
        ({"init": "nonsense"}, {}, "nonsense: no such file"),
        ({"init": "lite"}, {}, "other sizes"),
        ({}, {"device": "tpu"}, "no TPU device"),
        ({}, {"device": "cuda:99"}, "no CUDA:99 device"),
        ({}, {"workers": -1}, "workers"),
    ],
)
def test_what_cannot_work_is_refused_before_anything_is_written(tmp_path, changes, options, message):
    with pytest.raises(ValueError, match=message):
        train(tmp_path / "run", recipe(**changes), None, False, **({"device": "cpu"} | options))
    assert not list(tmp_path.iterdir())


def test_a_folder_in_use_is_refused_before_clips_are_simulated(tmp_path):
    write_text(tmp_path / "config.json", "{}")
    with pytest.raises(ValueError, match="holds a training already"):
        train(tmp_path, recipe(), None, False, "cpu")
    write_text(tmp_path / "config.json", '{"steps": "many"}')
    with pytest.raises(ValueError, match=r"config\.json: not a readable JSON file .*TrainConfig.steps"):
        train(tmp_path, recipe(), None, True, "cpu")
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]


def test_an_update_that_is_not_finite_stops_the_training(tmp_path, clips):
    trainer = Trainer(tmp_path, recipe(matching_steps=0, steps=1), clips)
    trainer.schedule.rate = lambda: (1e37, 0.9)
    with pytest.raises(FloatingPointError, match="step 1 are not finite, or make the weights so"):
        trainer.run(progress=False)
    assert not (tmp_path / "weights.safetensors").exists() and not (tmp_path / "checkpoint.pt").exists()


def test_a_damaged_checkpoint_is_refused(tmp_path, clips):
    Trainer(tmp_path, recipe(), clips)
    torch.save({"model": {}}, tmp_path / "checkpoint.pt")
    with pytest.raises(ValueError, match="no checkpoint of a training"):
        Trainer(tmp_path, recipe(), clips, resume=True)
    (tmp_path / "checkpoint.pt").write_bytes(b"half")
    with pytest.raises(ValueError, match=r"checkpoint\.pt: not a readable checkpoint"):
        Trainer(tmp_path, recipe(), clips, resume=True)


def test_the_same_result_has_the_same_bytes(tmp_path):
    torch.manual_seed(0)
    tracker = t3d.Tracker(t3d.TrackerConfig.preset("lite", **SIZES))
    clip = t3d.simulate_clip(seed=0, frames=3, size=(16, 16), tracks=3)
    written = []
    for folder in (tmp_path / "a", tmp_path / "b"):
        for _ in range(4):
            t3d.save_weights(tracker, folder / "weights.safetensors", half=True)
            clip.save(folder / "clip.npz")
            t3d.figures.save_html(t3d.figures.tracks_3d(clip, clip.tracks), folder / "page.html")
            written.append({path.name: path.read_bytes() for path in folder.iterdir()})
    assert len(written[0]) == 3 and all(one == written[0] for one in written)
    assert t3d.load_weights(tmp_path / "a" / "weights.safetensors").config == tracker.config


@pytest.mark.parametrize("size", [(1, 100), (100, 1), (16, 2000), (1, 1), (5, 300)])
@pytest.mark.parametrize("side", [1, 3, 16])
def test_grids_stay_inside_flat_images(size, side):
    eye = np.tile(np.eye(4), (2, 1, 1))
    camera = np.array([[9.0, 0, 0], [0, 9, 0], [0, 0, 1]])
    clip = t3d.Clip(np.zeros((2, *size, 3), np.uint8), np.ones((2, *size)), np.tile(camera, (2, 1, 1)), eye)
    assert len(t3d.grid_queries(clip, side)) == side**2
