"""`Examples`: what each step of a training looks at, made here or by other processes while the device computes.

Whatever step s draws depends on the seed and s alone. So a continued run goes where an undisturbed one would have
gone, and it does not matter which process makes an example, or when.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from tapip3d_lite.clip import Clip
from tapip3d_lite.simulate.dataset import leave_interrupts
from tapip3d_lite.training.augment import augment
from tapip3d_lite.training.config import TrainConfig
from tapip3d_lite.training.data import Batch, FeatureCache, make_batch
from tapip3d_lite.training.matching import Pair, draw_pair
from tapip3d_lite.training.motion import random_coordinates
from tapip3d_lite.training.sampling import draw_frames, load_part, sample_tracks


class Examples(Dataset):
    """`examples[step]`: a list of pairs of frames in the matching stage, then batches of clips; all on the CPU."""

    def __init__(
        self, config: TrainConfig, clips: Sequence[Path], rank: int = 0, cache: FeatureCache | None = None
    ) -> None:
        """Draw from clips.

        Args:
            config: the whole recipe.
            clips: npz with tracks, of any image size.
            rank: of this process among those that share the training.
            cache: features of a frozen encoder; images are then left out of the batches.
        """
        self.config, self.clips, self.rank, self.cache = config, list(clips), rank, cache
        self.size = config.tracker_config().image_size

    def __len__(self) -> int:
        return self.config.total

    def __getitem__(self, step: int) -> list[Pair] | Batch:
        return self.pairs(step) if step < self.config.matching_steps else self.batch(step)

    def lengths(self, step: int) -> tuple[int, int]:
        """Frames and iterations M of a step, the same in all processes."""
        config, rng = self.config, np.random.default_rng([self.config.seed, step])
        if step - config.matching_steps < config.short * config.steps:
            return config.frames[0], config.iterations[0]
        half = config.tracker_config().window // 2
        frames = rng.choice(np.arange(config.frames[0], config.frames[1] + 1, half))
        return int(frames), int(rng.integers(config.iterations[0], config.iterations[1] + 1))

    def pairs(self, step: int) -> list[Pair]:
        """This process's share of a step's pairs of frames."""
        config = self.config
        augmentation, pairs = config.augmentation if config.augment else None, []
        for slot in _share(self.rank, config.matching.pairs):
            rng = np.random.default_rng([config.seed, step, slot])
            path = self.clips[rng.integers(len(self.clips))]
            pairs.append(draw_pair(path, rng, config.matching, self.size, augmentation))
        return pairs

    def draw(self, step: int, slot: int) -> tuple[Clip, torch.Tensor | None]:
        """The clip of one slot of a step's batch, and its features if they are kept."""
        config, rng = self.config, np.random.default_rng([self.config.seed, step, slot])
        path, wanted = self.clips[rng.integers(len(self.clips))], self.lengths(step)[0]
        chosen = np.zeros(0, int)

        def choose(available: int) -> np.ndarray:
            nonlocal chosen
            chosen = draw_frames(rng, available, wanted, config.sampling.backward)
            return chosen

        clip = load_part(path, choose, self.cache is None, self.size)
        if config.augment:
            clip = augment(clip, rng, config.augmentation)
        clip = random_coordinates(sample_tracks(clip, rng, config.sampling), rng, config.motion)
        return clip, None if self.cache is None else self.cache.frames(path, chosen)

    def batch(self, step: int) -> Batch:
        """This process's share of a step's clips."""
        slots = _share(self.rank, self.config.batch)
        clips, features = zip(*(self.draw(step, slot) for slot in slots), strict=True)
        return make_batch(list(clips), None if self.cache is None else list(features))

    def stream(self, first: int, workers: int = 0) -> Iterator[list[Pair] | Batch]:
        """The examples of step `first` and the others of its stage, in order.

        A stage ends the stream: what the next one is made of may depend on what this one teaches the encoder.

        Args:
            first: step.
            workers: processes that make the next ones meanwhile; 0: each is made when it is asked for.
        """
        matching = self.config.matching_steps
        steps = range(first, matching if first < matching else len(self))
        if not workers:
            return (self[step] for step in steps)
        own = {"generator": torch.Generator(), "worker_init_fn": leave_interrupts}  # the caller's chance is not ours
        return iter(DataLoader(self, None, sampler=steps, num_workers=workers, **own))


def _share(rank: int, count: int) -> range:
    return range(rank * count, (rank + 1) * count)
