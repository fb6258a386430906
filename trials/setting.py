"""The small setting in which options of the training are tried: clips, model, recipe, and the store that all runs share."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

HERE = Path(__file__).resolve().parent
CODE = HERE.parent
sys.path.insert(0, str(CODE))

import numpy as np  # noqa: E402
import torch  # noqa: E402

from tapip3d_lite.clip import Clip, load_clip  # noqa: E402
from tapip3d_lite.simulate import SimulationConfig, simulate_dataset  # noqa: E402
from tapip3d_lite.simulate.seeds import TRAINING, VALIDATION  # noqa: E402
from tapip3d_lite.training.data import FeatureCache, SamplingConfig  # noqa: E402
from tapip3d_lite.training.motion import MotionConfig  # noqa: E402
from tapip3d_lite.training.recipe import TrainConfig  # noqa: E402
from tapip3d_lite.training.trainer import Trainer  # noqa: E402

CLIPS, HELD_OUT, MATCHING = 240, 32, 1500
SHARED = HERE / "shared"
ENCODER, FEATURES = SHARED / "encoder.pt", SHARED / "features"
SMALL = {  # lesson 06
    "image_size": (64, 64), "stride": 2, "levels": 3, "neighbors": 9, "iterations": 2, "feature_dim": 32,
    "token_dim": 32, "context_head_dim": 32, "offset_dim": 32, "hidden": 96, "heads": 4, "head_dim": 24,
    "time_depth": 2, "space_depth": 2, "virtual_tracks": 8,
}  # fmt: skip


def scene(seed: int) -> SimulationConfig:
    """Lesson 06's slow scenes, with 16 frames (three windows) instead of 12."""
    return SimulationConfig(frames=16, fps=24.0, size=(64, 64), tracks=192, camera=("static", "arc")[seed % 2])


def training_paths() -> list[Path]:
    return simulate_dataset(SHARED / "train", CLIPS, scene, TRAINING.start, 1, False)


def held_out() -> list[Clip]:
    """32 clips of other seeds; points that frame 0 shows, asked for there."""
    paths = simulate_dataset(SHARED / "held_out", HELD_OUT, scene, VALIDATION.start, 1, False)
    return [_from_start(load_clip(path)) for path in paths]


def _from_start(clip: Clip, most: int = 64) -> Clip:
    seen = np.flatnonzero(clip.tracks.visible[0])
    tracks = clip.tracks.select(np.random.default_rng(0).permutation(seen)[:most])
    queries = np.concatenate([np.zeros((tracks.xyz.shape[1], 1)), tracks.xyz[0]], -1).astype(np.float32)
    return replace(clip, queries=queries, tracks=replace(tracks, queries=queries))


def recipe(seed: int, steps: int, **changes) -> TrainConfig:
    """Lesson 06's recipe with 8 or 12 frames (one or two windows) instead of 8, from the shared encoder."""
    trial = {"encoder": str(ENCODER), "features": str(FEATURES)} | changes.pop("trial", {})
    base = dict(
        tracker=SMALL, clips=CLIPS, matching_steps=0, steps=steps, frames=(8, 12), iterations=2, lr=1.5e-3,
        motion=MotionConfig(world=1.0, turned=0.0, sliding=0.0, wrong=0.0), sensor=0.0,
        sampling=SamplingConfig(tracks=48), seed=seed, evaluate_every=10**6, validation=0, save_every=100,
    )  # fmt: skip
    return TrainConfig(**(base | changes), trial=trial)


def prepare() -> None:
    """Clips, encoder, features: once."""
    torch.set_num_threads(1)
    paths = training_paths()
    print(len(paths), "training clips", len(held_out()), "held-out", flush=True)
    if not ENCODER.exists():
        config = replace(recipe(1000, 1, matching_steps=MATCHING), trial={}, save_every=250)
        trainer, seen = Trainer(SHARED / "encoder", config, paths, resume=True), []
        if trainer.schedule.matching:
            for line in trainer.steps(lambda: not trainer.schedule.matching):
                seen.append((line["loss"], line.get("right", np.nan)))
                if line["step"] % 100 == 0:
                    print("matching", line["step"], np.nanmean(seen[-100:], 0).round(3), flush=True)
        torch.save(trainer.tracker.encoder.state_dict(), ENCODER)

    from tapip3d_lite.model.tracker import Tracker

    tracker = Tracker(recipe(0, 1).tracker_config()).eval()
    tracker.encoder.load_state_dict(torch.load(ENCODER))
    cache = FeatureCache(FEATURES, tracker.encoder, (64, 64))
    FEATURES.mkdir(parents=True, exist_ok=True)
    for path in paths:
        cache.frames(path, np.arange(1))
    print("features ready", flush=True)

