"""`Budget`: what all rows of a study have in common, that is the recipe, the clips to train on and the clips to be judged by.

All sizes stand here: `BUDGETS["lab"]` trains a row in minutes on one core, `"tiny"` in seconds, to try whether it runs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tapip3d_lite.clip import Clip
from tapip3d_lite.formats import load_clip
from tapip3d_lite.lab.provenance import plain
from tapip3d_lite.parts import allowed_parts
from tapip3d_lite.simulate import SimulationConfig, simulate_dataset
from tapip3d_lite.simulate.seeds import STUDIES, TRAINING, VALIDATION
from tapip3d_lite.training.data import SamplingConfig, query_rows
from tapip3d_lite.training.motion import MotionConfig
from tapip3d_lite.training.recipe import TrainConfig


def lab_scene(seed: int) -> SimulationConfig:
    """Half a second in 64 x 64 pixels; every other clip with a still camera."""
    return SimulationConfig(frames=12, fps=24.0, size=(64, 64), tracks=192, camera=("static", "arc")[seed % 2])


def tiny_scene(seed: int) -> SimulationConfig:
    """A third of a second in 32 x 32 pixels, filmed by two cameras."""
    return replace(lab_scene(seed), frames=8, size=(32, 32), tracks=48, stereo_baseline=0.2)


def shipped_scene(seed: int) -> SimulationConfig:
    """What `lite` is judged by without a training: 128 x 128 pixels, a camera that moves, and a second one beside it."""
    return SimulationConfig(frames=16, tracks=128, camera=("arc", "linear", "handheld")[seed % 3], stereo_baseline=0.2)


@dataclass(frozen=True)
class Budget:
    """What is equal in all rows of a study.

    Attributes:
        recipe: of the rows; its `matching_steps`, `matching`, `seed` and `preset` are those of the encoder, which is
            trained once.
        scene: the settings of a seed's clip; a function at the top level of a module, since processes import it.
        held_out: number of clips that rows are judged by; their seeds are those that no training draws.
        frames, points: at most so many of a held-out clip; all its points are asked for in frame 0, which shows them.
        flops: floating-point operations of each row's training, see `step_flops`; a row then takes as many steps as fit
            into them. None: the recipe's steps.
    """

    recipe: TrainConfig
    scene: Callable[[int], SimulationConfig] = lab_scene
    held_out: int = 30
    frames: int = 8
    points: int = 64
    flops: float | None = None

    def __post_init__(self) -> None:
        if not 2 <= self.held_out <= len(STUDIES):
            raise ValueError(f"Budget.held_out: expected 2 to {len(STUDIES)} clips, got {self.held_out}")
        if self.frames < 2 or self.points < 1:
            raise ValueError(f"Budget: expected at least 2 frames and 1 point, got {self.frames}, {self.points}")
        if self.flops is not None and not 0 < self.flops < float("inf"):
            raise ValueError(f"Budget.flops: expected a positive number of operations or None, got {self.flops}")

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as they come back from JSON."""
        rest = {name: getattr(self, name) for name in ("held_out", "frames", "points", "flops")}
        return {"recipe": self.recipe.to_dict(), "scene": plain(self.scene), **rest}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], parts: Sequence[Any] = ()) -> Budget:
        """The inverse of `to_dict`; what it names of others than the library must be among `parts` (see `load_tracker`)."""
        scene = allowed_parts(values, ["scene"], ["tapip3d_lite", *parts])
        return cls(**{**values, **scene, "recipe": TrainConfig.from_dict(values["recipe"], parts)})


_LAB = {
    "image_size": (64, 64), "stride": 2, "levels": 3, "neighbors": 9, "iterations": 2, "feature_dim": 32,
    "token_dim": 48, "context_head_dim": 48, "offset_dim": 32, "hidden": 96, "heads": 4, "head_dim": 24,
    "time_depth": 2, "space_depth": 2, "virtual_tracks": 8,
}  # fmt: skip
_TINY = {
    "image_size": (32, 32), "window": 4, "levels": 2, "neighbors": 4, "feature_dim": 16, "token_dim": 16,
    "context_head_dim": 16, "offset_dim": 16, "hidden": 32, "heads": 2, "head_dim": 16, "iterations": 2,
    "time_depth": 1, "space_depth": 1, "virtual_tracks": 4,
}  # fmt: skip
_FOCUSED = {  # all of the steps go into the world frame and into perfect depth
    "optimizer": "muon", "start": "aligned",
    "motion": MotionConfig(world=1.0, turned=0.0, sliding=0.0, wrong=0.0), "sensor": 0.0, "lr": 1.5e-3, "iterations": 2,
}  # fmt: skip
_LAB_STEPS = {
    "clips": 240, "matching_steps": 5000, "steps": 1500, "average": 150, "evaluate_every": 250, "validation": 8,
    "frames": 8, "sampling": SamplingConfig(tracks=48),
}  # fmt: skip
_TINY_STEPS = {
    "clips": 4, "matching_steps": 4, "steps": 12, "average": 4, "evaluate_every": 6, "validation": 1, "save_every": 3,
    "frames": (4, 6), "sampling": SamplingConfig(tracks=6),
}  # fmt: skip
BUDGETS = {
    "lab": Budget(TrainConfig(tracker=_LAB, **_LAB_STEPS, **_FOCUSED), held_out=80),
    "gpu": Budget(
        TrainConfig(tracker=_LAB, **{**_LAB_STEPS, "batch": 8, "evaluate_every": 500}, **_FOCUSED), held_out=80
    ),
    "tiny": Budget(TrainConfig(tracker=_TINY, **_TINY_STEPS, **_FOCUSED), tiny_scene, held_out=4, frames=6, points=12),
    # For rows that are not trained.
    "shipped": Budget(TrainConfig(clips=1, validation=0), shipped_scene, held_out=24, frames=16),
}


@dataclass(frozen=True)
class Data:
    """The files of a study's clips: to train on, to watch a training by, and to be judged by."""

    train: tuple[Path, ...]
    watched: tuple[Path, ...]
    held_out: tuple[Path, ...]


def simulated(folder: Path, budget: Budget, workers: int, progress: bool) -> Data:
    """The clips of a budget; missing ones are simulated."""
    recipe, options = budget.recipe, (budget, workers, progress)
    watched = _made(folder / "watched", recipe.validation, VALIDATION, *options)
    return Data(_made(folder / "train", recipe.clips, TRAINING, *options), watched, judged_by(folder, *options))


def judged_by(folder: Path, budget: Budget, workers: int = 1, progress: bool = False) -> tuple[Path, ...]:
    """The clips of a budget that rows are judged by; missing ones are simulated."""
    return _made(folder / "held_out", budget.held_out, STUDIES, budget, workers, progress)


def _made(folder: Path, count: int, seeds: range, budget: Budget, *options: Any) -> tuple[Path, ...]:
    return tuple(simulate_dataset(folder, count, budget.scene, seeds.start, *options)) if count else ()


def judged_clip(path: Path, budget: Budget) -> Clip:
    """A held-out clip as it is judged: its first frames, and points that frame 0 shows and that are asked for there."""
    clip = load_clip(path)
    if clip.tracks is None or not clip.tracks.visible[0].any():
        raise ValueError(f"{path}: a held-out clip needs true tracks, some of them visible in frame 0")
    clip = clip.cut(0, min(len(clip), budget.frames))
    seen = np.flatnonzero(clip.tracks.visible[0])
    chosen = np.random.default_rng(0).permutation(seen)[: budget.points]
    tracks = clip.tracks.select(chosen)
    queries = query_rows(tracks.xyz, np.zeros(len(chosen), int))
    return replace(clip, queries=queries, tracks=replace(tracks, queries=queries), name=Path(path).stem)
