"""Tiny sizes, recipes and helpers that several test modules share; fixtures are in conftest."""

import os
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from importlib import import_module
from io import StringIO
from pathlib import Path
from unittest import mock

import torch

from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.training.data import SamplingConfig
from tapip3d_lite.training.recipe import TrainConfig

ROOT = Path(__file__).resolve().parents[1]

SIZES = {
    "image_size": (32, 32), "window": 4, "levels": 2, "neighbors": 4, "feature_dim": 16, "token_dim": 16,
    "context_head_dim": 16, "offset_dim": 16, "hidden": 32, "heads": 2, "head_dim": 16, "iterations": 2,
    "time_depth": 1, "space_depth": 1, "virtual_tracks": 4,
}  # fmt: skip
"""Of a tracker that takes a training step in about 20 ms."""

SMALL = {
    "image_size": (32, 48), "window": 4, "feature_dim": 8, "levels": 2, "neighbors": 3, "token_dim": 6,
    "context_heads": 2, "context_head_dim": 3, "offset_layers": 2, "offset_dim": 7, "hidden": 12, "heads": 2,
    "head_dim": 5, "time_depth": 2, "space_depth": 1, "virtual_tracks": 3,
}  # fmt: skip
"""Of a tracker whose sizes all differ, so that no two can be confused."""

SYSTEMS = {
    "uvd": {"space": "uvd", "neighbors": 12},
    "uvlogd": {"space": "uvlogd"},
    "fixed neighbours in 2D": {"neighborhood": "window", "neighbors": 12},
    "without N2N": {"context": "p2n", "space": "camera"},
    "CoTracker3-like": {"space": "uv", "neighborhood": "window", "context": "correlation"},
    "DELTA-like": {"space": "uvlogd", "neighborhood": "window", "context": "correlation", "depth_ratio": True},
    "SpatialTracker-like": {"space": "uvd", "neighborhood": "planes", "context": "planes", "updater": "temporal"},
}
"""Switches of the systems that the paper compares."""


def untrained(**changes):
    """A tracker of these sizes, the same one each time."""
    torch.manual_seed(0)
    return Tracker(TrackerConfig.preset("lite", **(SIZES | changes))).eval()


def recipe(**changes):
    """A training of 4 + 12 steps."""
    settings = {"tracker": SIZES, "frames": (4, 6), "sampling": SamplingConfig(tracks=6), "save_every": 3}
    settings |= {"matching_steps": 4, "steps": 12, "evaluate_every": 100, "validation": 0}
    return TrainConfig(**(settings | changes))


def checkpoint(folder):
    """The weights in a training's folder."""
    return torch.load(folder / "checkpoint.pt", weights_only=True)["model"]


def command(*arguments, cwd=ROOT, main=None):
    """A command in this process, which spares the seconds that Python takes to start: exit code and what it printed."""
    said, words, before = (StringIO(), StringIO()), list(map(str, arguments)), os.getcwd()
    with (
        mock.patch.object(sys, "argv", ["tapip3d_lite", *words]),
        mock.patch.object(sys, "path", [*sys.path]),
        mock.patch.dict(os.environ, COLUMNS="200"),
        redirect_stdout(said[0]),
        redirect_stderr(said[1]),
    ):
        os.chdir(cwd)
        try:
            code = (main or import_module("tapip3d_lite.__main__").main)() or 0
        except SystemExit as stopped:
            code = stopped.code or 0
        finally:
            os.chdir(before)
    return subprocess.CompletedProcess(words, code, *(text.getvalue() for text in said))


RUN = """
import sys, torch
from pathlib import Path
from tests.tiny import recipe
from tapip3d_lite.lab.train import interruptible
from tapip3d_lite.training.trainer import Trainer
torch.set_num_threads(1)
trainer = Trainer(sys.argv[1], recipe(), sorted(Path(sys.argv[2]).glob("*.npz")), resume=True)
with interruptible() as stop:
    for line in trainer.steps(stop):
        print(line["step"], flush=True)
sys.exit(0 if trainer.schedule.finished else 130)
"""


def start(folder, clips, run=RUN, **options):
    """Train in a process of its own, which prints its steps."""
    command = [sys.executable, "-c", run, str(folder), str(clips[0].parent)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT, **options)


def wait_for(process, step):
    """Wait until a process that `start` started has printed a step."""
    for line in process.stdout:
        if int(line) >= step:
            return
    raise AssertionError("ended before that step")
