"""`Examples`: the input of each training step, made in this process or ahead of time by worker processes.

The input of step s depends on the seed and on s (and on its position in the schedule) alone. So a continued run sees
what an uninterrupted one would have seen, whichever process makes it, and whenever.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from tapip3d_lite.clip import Clip
from tapip3d_lite.files import load_npz
from tapip3d_lite.simulate.dataset import leave_interrupts
from tapip3d_lite.simulate.degrade import SensorConfig, degrade
from tapip3d_lite.training.augment import augment
from tapip3d_lite.training.data import Batch, FeatureCache, draw_frames, make_batch, pick_frames, sample_tracks
from tapip3d_lite.training.motion import random_coordinates
from tapip3d_lite.training.pretrain import FramePair, draw_pair
from tapip3d_lite.training.recipe import TrainConfig


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
        half = config.tracker_config().window // 2
        frames = rng.choice(np.arange(config.frames[0], config.frames[1] + 1, half))
        return int(frames), int(rng.integers(config.iterations[0], config.iterations[1] + 1))

    def pairs(self, step: int) -> list[FramePair]:
        """This process's share of a step's pairs of frames."""
        config = self.config
        options = config.matching, self.size, config.augmentation if config.augment else None
        return [draw_pair(path, rng, *options) for path, rng in self._draws(step, config.matching.pairs)]

    def batch(self, step: int, position: float) -> Batch:
        """This process's share of a step's clips."""
        frames, iterations = self.lengths(step, position)
        drawn = [self._example(path, rng, frames) for path, rng in self._draws(step, self.config.batch)]
        clips, features = map(list, zip(*drawn, strict=True))
        return make_batch(clips, None if self.cache is None else features, iterations)

    def _draws(self, step: int, count: int) -> Iterator[tuple[Path, np.random.Generator]]:
        """A clip's file and a random generator for each of this process's `count` places in a step."""
        for slot in range(self.rank * count, (self.rank + 1) * count):
            rng = np.random.default_rng([self.config.seed, step, slot])
            yield self.clips[rng.integers(len(self.clips))], rng

    def _example(self, path: Path, rng: np.random.Generator, frames: int) -> tuple[Clip, torch.Tensor | None]:
        """Some frames of a clip, augmented, with drawn tracks; and its features if these are stored."""
        config = self.config
        arrays = load_npz(path, skip=() if self.cache is None else ("video",))
        index = draw_frames(rng, len(arrays["depths"]), frames, config.sampling.backward)
        clip = pick_frames(arrays, index, self.size)
        if config.augment:
            clip = augment(clip, rng, config.augmentation)
        if rng.random() < config.sensor:
            clip = degrade(clip, SensorConfig.draw(rng, images=self.cache is None), rng)
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
