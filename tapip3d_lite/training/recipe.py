"""`TrainConfig`: all settings of a training; together with the clips they determine the weights on one machine."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field, is_dataclass
from typing import Any

from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.training.augment import AugmentConfig
from tapip3d_lite.training.data import SamplingConfig
from tapip3d_lite.training.loss import LossConfig
from tapip3d_lite.training.motion import MotionConfig
from tapip3d_lite.training.pretrain import MatchingConfig
from tapip3d_lite.validate import check_range


@dataclass(frozen=True)
class TrainConfig:
    """What is trained, on what, and how long. The defaults are the `lite` recipe for two CPU cores; see `recipe`.

    Attributes:
        preset: of the tracker, `"lite"` or `"paper"`.
        tracker: fields of the preset to set differently, e.g. `{"context": "p2n"}`; `--tracker context p2n`.
        init: weights to start from, `"lite"` or a file, instead of a random initialisation; usually with
            `matching_steps=0`.
        clips: number of training clips; the stored features of one take 13 MB.
        matching_steps: steps of the first stage, which pretrains the encoder; 0 keeps it as initialised.
        steps: steps of the second stage, which trains the tracker.
        minutes: time budget for both stages; None: none. With a budget the training ends when the time does, however
            many steps that makes; `matching_steps`, `steps`, `short`, `warmup` and `evaluate_every` then count equal
            parts of the time, `matching_steps + steps` in all, so that learning rate and stages follow the clock.
        batch: number of clips in a step (of each process).
        frames: (fewest, most) frames of an example; drawn for each step, in multiples of half a window.
        iterations: (fewest, most) updates of a window; drawn for each step. One number stands for both.
        short: share of the steps, at the start, with the fewest frames and updates: they teach to leave zero motion;
            later steps teach to continue from good estimates, as later updates and windows must.
        train_encoder: train the encoder too; otherwise its features are stored in files, and a step costs half.
        lr, weight_decay, warmup, clip_norm: of AdamW with one cosine cycle (paper: 5e-4, 5e-4, 0.05, 10).
        precision: `"float32"`, or `"bfloat16"` for autocast.
        average: the weights that are scored and saved are an exponential average over so many steps, or over a tenth of
            the steps done where that is less; 0: the last weights.
        head: standard deviation of the output layer's initial weights.
        seed: of the random generators.
        evaluate_every: steps between evaluations on held-out clips.
        validation: number of held-out clips.
        save_every: steps between checkpoints.
        sensor: share of the examples whose depth (and image, where it is encoded anew) is that of a poor sensor.
        augment: apply `augmentation` to the images of both stages; needs `train_encoder`, since stored features cannot
            follow changed images.

    Raises:
        ValueError: a value outside its range, or values that exclude one another.
    """

    preset: str = "lite"
    tracker: dict[str, bool | int | float | str] = field(default_factory=dict)
    init: str | None = None
    clips: int = 1000
    matching_steps: int = 2500
    steps: int = 6000
    minutes: float | None = None
    batch: int = 1
    frames: tuple[int, int] = (8, 16)
    iterations: tuple[int, int] = (2, 3)
    short: float = 0.35
    train_encoder: bool = False
    lr: float = 1e-3
    weight_decay: float = 5e-4
    warmup: float = 0.05
    clip_norm: float = 10.0
    precision: str = "float32"
    average: int = 1000
    head: float = 0.01
    seed: int = 0
    evaluate_every: int = 1000
    validation: int = 8
    save_every: int = 250
    augment: bool = False
    sensor: float = 0.4
    trial: dict[str, Any] = field(default_factory=dict)
    loss: LossConfig = field(default_factory=lambda: LossConfig(visibility=0.5))
    motion: MotionConfig = field(default_factory=MotionConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    augmentation: AugmentConfig = field(default_factory=AugmentConfig)

    def __post_init__(self) -> None:
        for name in ("frames", "iterations"):
            value = getattr(self, name)  # lists come from JSON
            object.__setattr__(self, name, (value, value) if isinstance(value, int) else tuple(value))
            if len(getattr(self, name)) != 2 or not 1 <= getattr(self, name)[0] <= getattr(self, name)[1]:
                raise ValueError(f"TrainConfig.{name}: expected (fewest, most), both at least 1, got {value}")
        check_range(self, 1, math.inf, "clips", "steps", "batch", "evaluate_every", "save_every")
        check_range(self, 0, math.inf, "matching_steps", "validation", "average")
        check_range(self, 0, 1, "short", "sensor")
        if self.minutes is not None and self.minutes <= 0:
            raise ValueError(f"TrainConfig.minutes: expected a positive time or None, got {self.minutes}")
        if self.precision not in ("float32", "bfloat16"):
            raise ValueError(f'TrainConfig.precision: expected "float32" or "bfloat16", got {self.precision!r}')
        if self.lr <= 0 or not 0 < self.warmup < 1:
            raise ValueError(f"TrainConfig: lr must be positive, warmup in (0, 1), got {self.lr} and {self.warmup}")
        if self.augment and not self.train_encoder:
            raise ValueError(
                "TrainConfig.augment: features of a frozen encoder are stored in files and cannot follow changed images; "
                "set train_encoder=True, or augment=False"
            )
        half = self.tracker_config().window // 2
        if min(self.frames) <= half:
            raise ValueError(f"TrainConfig.frames: expected more than half a window ({half}), got {self.frames}")

    @classmethod
    def recipe(cls, preset: str = "lite", **changes: Any) -> TrainConfig:
        """The recipe of a preset: `"lite"` (the defaults), or `"paper"`.

        Paper: section 4 and appendix; 8 processes with a GPU each. Optimiser, schedule, batches, loss and augmentation
        are the paper's; ours are the simulated clips, and the pretraining in place of CoTracker3's encoder. `changes`
        are fields to set differently.
        """
        paper = {
            "clips": 10_000,
            "steps": 200_000,
            "frames": (24, 24),  # two windows
            "iterations": (4, 4),
            "short": 0.0,
            "train_encoder": True,
            "augment": True,
            "lr": 5e-4,
            "precision": "bfloat16",
            "average": 0,
            "evaluate_every": 5000,
            "save_every": 1000,
            "loss": LossConfig(form="paper", visibility=3.0),
            "motion": MotionConfig(
                world=0.0, turned=0.0, still=0.0, rotation=0.1, rotation_noise=0.05, sliding=0.0, wrong=0.0
            ),
            "sensor": 0.0,
            "sampling": SamplingConfig(tracks=384),
        }
        return cls(**({"preset": preset} | (paper if preset == "paper" else {}) | changes))

    def tracker_config(self) -> TrackerConfig:
        """The settings of the tracker that is trained."""
        return TrackerConfig.preset(self.preset, **self.tracker)

    @property
    def total(self) -> int:
        """Steps of both stages; with a time budget, the number of its equal parts."""
        return self.matching_steps + self.steps

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as they come back from JSON."""
        return json.loads(json.dumps(asdict(self)))

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> TrainConfig:
        """The inverse of `to_dict`; fields that an older file lacks get their defaults, unknown ones are a ValueError."""
        parts = vars(cls())
        unknown = set(values) - set(parts)
        if unknown:
            raise ValueError(f"TrainConfig: unknown {', '.join(sorted(unknown))}; was it written by another version?")
        return cls(**{k: type(parts[k])(**v) if is_dataclass(parts[k]) else v for k, v in values.items()})
