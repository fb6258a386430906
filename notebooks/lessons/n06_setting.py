"""Lesson 06: what is trained on which device, on which clips, and for how long; the cells are the same everywhere.

On a CPU: a small tracker, small and short clips, an encoder that is frozen once it has learnt to match. On a GPU: the
real `lite` from nothing, its encoder trained along, 128 x 128 pixels, in bfloat16, with recorded steps.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.evaluation.evaluate import evaluate, mean_scores
from tapip3d_lite.formats import load_clip
from tapip3d_lite.lab.budgets import lab_scene as small_scene
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.simulate import SimulationConfig, simulate_dataset
from tapip3d_lite.simulate.seeds import TRAINING, VALIDATION
from tapip3d_lite.training.data import SamplingConfig, training_config
from tapip3d_lite.training.loss import LossConfig
from tapip3d_lite.training.motion import MotionConfig
from tapip3d_lite.training.recipe import TrainConfig
from tapip3d_lite.training.trainer import Trainer

SMALL = {
    "image_size": (64, 64), "stride": 2, "levels": 3, "neighbors": 9, "iterations": 2, "feature_dim": 32,
    "token_dim": 32, "context_head_dim": 32, "offset_dim": 32, "hidden": 96, "heads": 4, "head_dim": 24,
    "time_depth": 2, "space_depth": 2, "virtual_tracks": 8,
}  # fmt: skip
"""The tracker that a CPU trains: the `lite` preset with these sizes."""


def large_scene(seed: int) -> SimulationConfig:
    """What `lite` is judged by: two seconds in 128 x 128 pixels; every other clip with a still camera."""
    return SimulationConfig(tracks=192, camera=("static", "arc")[seed % 2])


@dataclass(frozen=True)
class Setting:
    """All that depends on the device.

    Attributes:
        device: `"cpu"` or `"cuda"`.
        recipe: of the long training.
        training: gives the training clip of a seed; at a module's top level, for worker processes.
        scene: the same of the held-out clips.
        held_out: how many clips to judge by; their first `recipe.frames` frames.
        enough: steps of tracking that a claim about the long training needs, and
        enough_short: one about a short training.
        workers: processes that make examples ahead of time.
    """

    device: str
    recipe: TrainConfig
    training: Callable[[int], SimulationConfig]
    scene: Callable[[int], SimulationConfig]
    held_out: int
    enough: int
    enough_short: int
    workers: int

    def simulate(self, folder: Path) -> tuple[list[Path], list[Clip]]:
        """Training clips (files) and held-out clips, whose seeds no training draws; worker processes simulate them."""
        paths = simulate_dataset(
            folder / "train", self.recipe.clips, self.training, TRAINING.start, os.cpu_count(), False
        )
        return paths, judged_by(folder / "held_out", self.scene, self.held_out, self.recipe.frames[1])

    def trainer(
        self,
        folder: Path,
        paths: Sequence[Path],
        watched: Sequence[Clip] = (),
        loss: LossConfig | None = None,
        minutes: float | None = None,
    ) -> Trainer:
        """A trainer that begins anew.

        Args:
            folder: of the training; what an earlier one left there is deleted.
            paths: training clips.
            watched: held-out clips that it is scored on now and then.
            loss: another one than the recipe's.
            minutes: another time than the recipe's.
        """
        shutil.rmtree(folder, ignore_errors=True)
        if self.recipe.precision == "bfloat16":
            torch.set_float32_matmul_precision("high")  # TF32, for what is left in float32
        recipe = replace(
            self.recipe, loss=loss or self.recipe.loss, minutes=minutes or self.recipe.minutes, validation=len(watched)
        )
        scores = held_out_scores(watched) if watched else None
        return Trainer(folder, recipe, paths, scores, device=self.device, workers=self.workers)


def setting(device: str, minutes: float) -> Setting:
    """The setting of a device, for a long training of some minutes."""
    return gpu_setting(minutes, device) if torch.device(device).type == "cuda" else cpu_setting(minutes)


def cpu_setting(minutes: float) -> Setting:
    """A small tracker, clips as many as it can use, positions in pixels."""
    recipe = TrainConfig(
        tracker=SMALL,
        clips=max(16, round(40 * minutes)),
        frames=8,  # one window
        iterations=2,
        lr=1.5e-3,
        motion=MotionConfig(world=1.0, turned=0.0, sliding=0.0, wrong=0.0),  # all of the time goes into one kind of
        sensor=0.0,  # motion and into perfect depth
        sampling=SamplingConfig(tracks=48),
        minutes=minutes,
        matching_steps=80,  # shares of the time, as all that follows
        steps=920,
        evaluate_every=115,
        save_every=500,
    )
    return Setting("cpu", recipe, small_scene, small_scene, held_out=24, enough=700, enough_short=500, workers=0)


def gpu_setting(minutes: float, device: str = "cuda") -> Setting:
    """The real `lite` from nothing; on another device than a GPU in single precision, to test the same path there."""
    gpu = torch.device(device).type == "cuda"
    recipe = TrainConfig(
        clips=max(64, round(80 * minutes)),
        batch=8,
        frames=(8, 16),
        iterations=3,  # one number: each pair of frames and updates is recorded anew, and keeps a step's memory
        train_encoder=True,
        lr=1e-3,
        motion=MotionConfig(world=1.0, turned=0.0, sliding=0.0, wrong=0.0),
        sensor=0.0,
        sampling=SamplingConfig(tracks=64),
        minutes=minutes,
        matching_steps=80,
        steps=920,
        evaluate_every=115,
        save_every=500,
        precision="bfloat16" if gpu else "float32",
    )
    workers = max(1, (os.cpu_count() or 2) - 2) if gpu else 0
    return Setting(
        device, recipe, training_config, large_scene, held_out=24, enough=800, enough_short=300, workers=workers
    )


def judged_by(folder: Path, scene: Callable[[int], SimulationConfig], count: int, frames: int) -> list[Clip]:
    """Held-out clips: their first frames, and points that frame 0 shows and that are asked for there."""
    paths = simulate_dataset(folder, count, scene, VALIDATION.start, min(count, os.cpu_count() or 1), False)
    return [from_start(load_clip(path).cut(0, frames)) for path in paths]


def from_start(clip: Clip, most: int = 64) -> Clip:
    """Keep at most so many tracks that frame 0 shows, and ask for them there: all the motion lies ahead."""
    seen = np.flatnonzero(clip.tracks.visible[0])
    tracks = clip.tracks.select(np.random.default_rng(0).permutation(seen)[:most])
    queries = np.concatenate([np.zeros((tracks.xyz.shape[1], 1)), tracks.xyz[0]], -1).astype(np.float32)
    return replace(clip, queries=queries, tracks=replace(tracks, queries=queries))


def follow(tracker: Tracker, clip: Clip, film: Clip | None = None) -> Tracks:
    """Track a clip's queries alone, in this clip or in another film of it."""
    return tracker.track(film or clip, clip.queries, support_grid=0)


def held_out_scores(clips: Sequence[Clip]) -> Callable[[Tracker], dict[str, float]]:
    """What a training's log says of held-out clips, tracked as they are judged in the end."""

    def validate(tracker: Tracker) -> dict[str, float]:
        scores = mean_scores([evaluate(follow(tracker, clip), clip) for clip in clips])
        return {f"val_{name}": round(scores[name], 4) for name in ("APD3D_none", "APD3D_none_dynamic")}

    return validate
