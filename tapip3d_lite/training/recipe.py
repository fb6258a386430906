"""`TrainConfig`: all settings of a training; together with the clips they determine the weights on one machine."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, is_dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from tapip3d_lite.files import read_json, shipped_weights
from tapip3d_lite.model.config import SWITCHES, TrackerConfig
from tapip3d_lite.model.weights import outline, read_weights
from tapip3d_lite.parts import allowed_parts, find_part, part_name
from tapip3d_lite.training.augment import AugmentConfig
from tapip3d_lite.training.data import SamplingConfig
from tapip3d_lite.training.loss import FORMS, LossConfig
from tapip3d_lite.training.motion import MotionConfig
from tapip3d_lite.training.optimizers import OPTIMIZERS
from tapip3d_lite.training.pretrain import MatchingConfig
from tapip3d_lite.training.start import STARTS
from tapip3d_lite.validate import check_names, check_range, check_state, check_types


@dataclass(frozen=True)
class TrainConfig:
    """What is trained, on what, and how long. The defaults are the `lite` recipe for two CPU cores; see `recipe`.

    Attributes:
        preset: of the tracker, `"lite"` or `"paper"`.
        tracker: fields of the preset to set differently, e.g. `{"context": "p2n"}` or `{"context": MyContext}`;
            `--tracker context p2n` or `--tracker context my_parts:MyContext`.
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
        optimizer: `"adamw"`, the paper's, or `"muon"` for the matrices inside blocks, beside AdamW for all else.
        lr, weight_decay, warmup, clip_norm: of its one cosine cycle (paper: 5e-4, 5e-4, 0.05, 10).
        precision: `"float32"`, or `"bfloat16"` for autocast.
        average: the weights that are scored and saved are an exponential average over so many steps, or over a tenth of
            the steps done where that is less; 0: the last weights.
        head: standard deviation of the output layer's initial weights.
        start: of the tracker's weights: `"random"`, or `"aligned"`, with attention that compares looks; see `start`.
        seed: of the random generators.
        evaluate_every: steps between evaluations on held-out clips.
        validation: number of held-out clips.
        save_every: steps between checkpoints.
        loss: a `LossConfig`, `"paper"` or `"pixels"`, or a callable like `LossConfig`: a class, a function or
            `"module:name"`; `--loss.soften 2` or `--loss my_parts:MyLoss`.
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
    optimizer: str = "adamw"
    lr: float = 1e-3
    weight_decay: float = 5e-4
    warmup: float = 0.05
    clip_norm: float = 10.0
    precision: str = "float32"
    average: int = 1000
    head: float = 0.01
    start: str = "random"
    seed: int = 0
    evaluate_every: int = 1000
    validation: int = 8
    save_every: int = 250
    augment: bool = False
    sensor: float = 0.4
    loss: LossConfig = field(default_factory=lambda: LossConfig(visibility=0.5))
    motion: MotionConfig = field(default_factory=MotionConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    augmentation: AugmentConfig = field(default_factory=AugmentConfig)

    def __post_init__(self) -> None:
        loss = self.loss if isinstance(self.loss, LossConfig) else find_part("TrainConfig.loss", self.loss, FORMS)
        object.__setattr__(self, "loss", LossConfig(form=loss) if isinstance(loss, str) else loss)
        for name in ("frames", "iterations"):
            value = getattr(self, name)
            object.__setattr__(self, name, (value, value) if isinstance(value, int) else value)
        check_types(self)
        for name in ("frames", "iterations"):
            if not 1 <= getattr(self, name)[0] <= getattr(self, name)[1]:
                raise ValueError(f"TrainConfig.{name}: expected (fewest, most) from 1 on, got {getattr(self, name)}")
        check_range(self, 1, 1e9, "clips", "steps", "evaluate_every", "save_every")
        check_range(self, 1, 4096, "batch")
        check_range(self, 0, math.inf, "matching_steps", "validation", "average", "weight_decay", "head")
        check_range(self, 0, 2**63, "seed")
        check_range(self, 0, 1, "short", "sensor")
        if self.minutes is not None and self.minutes <= 0:
            raise ValueError(f"TrainConfig.minutes: expected a positive time or None, got {self.minutes}")
        check_names("TrainConfig.optimizer", [self.optimizer], OPTIMIZERS)
        check_names("TrainConfig.start", [self.start], STARTS)
        if self.precision not in ("float32", "bfloat16"):
            raise ValueError(f'TrainConfig.precision: expected "float32" or "bfloat16", got {self.precision!r}')
        check_range(self, 1e-12, 1e3, "lr")
        check_range(self, 1e-12, math.inf, "clip_norm")
        if not 0 < self.warmup < 1:
            raise ValueError(f"TrainConfig.warmup: expected a value in (0, 1), got {self.warmup}")
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

    @property
    def custom(self) -> list[Any]:
        """The parts of the tracker that are not built in, and such a loss."""
        return self.tracker_config().custom + ([] if type(self.loss) is LossConfig else [self.loss])

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as they come back from JSON, classes as `"module:Class"`; ValueError where one has no name."""
        values = {k: asdict(x) if is_dataclass(x) and not isinstance(x, type) else x for k, x in vars(self).items()}
        if type(self.loss) is not LossConfig:
            values["loss"] = part_name(self.loss, "TrainConfig.loss")
        named = {k: part_name(x, f"TrainConfig.tracker[{k!r}]") for k, x in self.tracker.items() if k in SWITCHES}
        values["tracker"] = self.tracker | named
        return json.loads(json.dumps(values))

    @classmethod
    def complete(cls, values: dict[str, Any]) -> dict[str, Any]:
        """A stored recipe with the defaults of fields that an older file lacks; unknown ones are a ValueError."""
        usual = cls()
        if unknown := set(values) - set(vars(usual)):
            raise ValueError(f"TrainConfig: unknown {', '.join(sorted(unknown))}; was it written by another version?")
        own = {name: asdict(type(x)()) for name, x in vars(usual).items() if is_dataclass(x)}
        given = {name: own.get(name, {}) | x if isinstance(x, dict) else x for name, x in values.items()}
        return usual.to_dict() | json.loads(json.dumps(given))

    @classmethod
    def from_dict(cls, values: dict[str, Any], parts: Sequence[Any] = ()) -> TrainConfig:
        """The inverse of `to_dict`, with the custom `parts` that it may name, as for `load_tracker`; see `complete`."""
        usual, values = vars(cls()), cls.complete(values)
        values |= allowed_parts(values, ["loss"], parts)
        values["tracker"] = values["tracker"] | allowed_parts(values["tracker"], SWITCHES, parts)
        made = {
            name: type(usual[name])(**x)
            for name, x in values.items()
            if is_dataclass(usual[name]) and (isinstance(x, dict) or name != "loss")
        }
        return cls(**(values | made))

    @classmethod
    def read(cls, path: str | Path, parts: Sequence[Any] = ()) -> TrainConfig:
        """The recipe in a training's `config.json`, with `parts` as for `from_dict`; a damaged file is a ValueError."""
        return read_json(path, lambda values: cls.from_dict(values, parts))


def initial_weights(config: TrainConfig) -> dict[str, Tensor]:
    """The weights that a recipe's `init` names; a ValueError if they are not readable or of other sizes."""
    state = read_weights(shipped_weights().get(config.init, config.init))[0]
    try:
        check_state(state, outline(config.tracker_config()).state_dict())
    except ValueError as error:
        raise ValueError(f"TrainConfig.init: {config.init!r} belongs to a tracker of other sizes: {error}") from None
    return state
