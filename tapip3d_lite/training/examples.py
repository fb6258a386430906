"""`Examples`: the input of each training step, made in this process or ahead of time by worker processes.

The input of step s depends on the seed and on s (and on its position in the schedule) alone. So a continued run sees
what an uninterrupted one would have seen, whichever process makes it, and whenever.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset
from tqdm.auto import tqdm

from tapip3d_lite.clip import Clip
from tapip3d_lite.formats.arrays import clip_arrays
from tapip3d_lite.simulate.dataset import leave_interrupts
from tapip3d_lite.simulate.degrade import SensorConfig, degrade
from tapip3d_lite.training.augment import augment
from tapip3d_lite.training.data import Batch, FeatureCache, draw_frames, fault, make_batch, pick_frames, sample_tracks
from tapip3d_lite.training.motion import random_coordinates
from tapip3d_lite.training.pretrain import FramePair, draw_pair
from tapip3d_lite.training.recipe import TrainConfig
from tapip3d_lite.validate import check_depths

_TRIES = 100  # for an example


def check_clips(clips: Sequence[str | Path], config: TrainConfig) -> list[Path]:
    """The paths of clips if a training can use them all, else a ValueError that says which it cannot, and why."""
    if not clips:
        raise ValueError("Trainer: no training clips; make some with `training_clips` or `simulate`")
    paths, needed = [Path(clip) for clip in clips], (_lengths(config), config.sampling.seen)
    bar = tqdm(paths, "checking clips", leave=False, delay=3)
    if wrong := [text for path in bar if (text := fault(path, *needed))]:
        text = f"Trainer: {len(wrong)} of {len(paths)} clips cannot be used; repair them or leave them out:"
        raise ValueError("\n".join([text, *wrong[:5]]))
    return paths


def _lengths(config: TrainConfig) -> range:
    return range(config.frames[0], config.frames[1] + 1, config.tracker_config().window // 2)


class Examples(Dataset):
    """`examples[step, position]`: pairs of frames in the matching stage, then batches of clips; all on the CPU.

    The position in the schedule, from 0 to the recipe's `total`, is the step itself unless the recipe has a time budget.
    """

    def __init__(
        self, config: TrainConfig, clips: Sequence[Path], rank: int = 0, cache: FeatureCache | None = None
    ) -> None:
        """Draw from clips (npz files with tracks, of any image size) the share of the process with this rank.

        With a cache of a frozen encoder's features, batches have no images.
        """
        self.config, self.clips, self.rank, self.cache = config, list(clips), rank, cache
        self.size = config.tracker_config().image_size

    def __getitem__(self, place: tuple[int, float]) -> list[FramePair] | Batch:
        step, position = place
        return self.pairs(step) if position < self.config.matching_steps else self.batch(step, position)

    def lengths(self, step: int, position: float) -> tuple[int, int]:
        """Frames and updates M of a step, the same in all processes."""
        config, rng = self.config, np.random.default_rng([self.config.seed, step])
        if position - config.matching_steps < config.short * config.steps:
            return config.frames[0], config.iterations[0]
        frames = rng.choice(_lengths(config))
        return int(frames), int(rng.integers(config.iterations[0], config.iterations[1] + 1))

    def pairs(self, step: int) -> list[FramePair]:
        """This process's share of a step's pairs of frames."""
        config = self.config
        options = config.matching, self.size, config.augmentation if config.augment else None
        return self._drawn(step, config.matching.pairs, lambda path, rng: draw_pair(path, rng, *options))

    def batch(self, step: int, position: float) -> Batch:
        """This process's share of a step's clips."""
        frames, iterations = self.lengths(step, position)
        drawn = self._drawn(step, self.config.batch, lambda path, rng: self._example(path, rng, frames))
        clips, features = map(list, zip(*drawn, strict=True))
        return make_batch(clips, None if self.cache is None else features, iterations)

    def _drawn(self, step: int, count: int, make: Callable[..., Any]) -> list[Any]:
        """What `make` makes of a clip's file and a random generator, for each of this process's `count` places in a step."""
        slots = range(self.rank * count, (self.rank + 1) * count)
        return [self._usable(np.random.default_rng([self.config.seed, step, slot]), make) for slot in slots]

    def _usable(self, rng: np.random.Generator, make: Callable[..., Any], tries: int = _TRIES) -> Any:
        """One example; where what is drawn has no depth, or no track stays in view, the same generator draws again."""
        path = self.clips[rng.integers(len(self.clips))]
        try:
            return make(path, rng)
        except ValueError as error:
            if tries == 1:
                raise ValueError(f"Examples: none of {_TRIES} could be used; the last: {path}: {error}") from error
            warnings.warn(f"{path}: {error}; another example is drawn", stacklevel=2)
        return self._usable(rng, make, tries - 1)

    def _example(self, path: Path, rng: np.random.Generator, frames: int) -> tuple[Clip, torch.Tensor | None]:
        """Some frames of a clip, augmented, with drawn tracks; and its features if these are stored."""
        config = self.config
        arrays = clip_arrays(path, skip=() if self.cache is None else ("video",))
        index = draw_frames(arrays, rng, frames, config.sampling)
        clip = pick_frames(arrays, index, self.size)
        if config.augment:
            clip = augment(clip, rng, config.augmentation)
        if rng.random() < config.sensor:
            clip = degrade(clip, SensorConfig.draw(rng, images=self.cache is None), rng)
        check_depths(clip.depths, config.tracker_config().window)
        clip = random_coordinates(sample_tracks(clip, rng, config.sampling), rng, config.motion)
        return clip, None if self.cache is None else self.cache.frames(path, index)

    def stream(self, places: Iterable[tuple[int, float]], workers: int = 0) -> Iterator[list[FramePair] | Batch]:
        """The examples at some places (step, position), in order.

        Worker processes read places and make examples a few steps ahead. All are of one stage, because the next stage's
        examples depend on what this one teaches the encoder.
        """
        if not workers:
            return (self[place] for place in places)
        own = {"generator": torch.Generator(), "worker_init_fn": leave_interrupts}  # not the caller's generator
        return iter(DataLoader(self, None, sampler=places, num_workers=workers, **own))
