"""`Schedule`: how far a training has come, by its number of steps or by the clock, and what follows from that.

Paper: appendix (training): one cosine cycle up to 5e-4, with 5 % of the steps for the warm-up.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator

from tapip3d_lite.training.parallel import Group
from tapip3d_lite.training.pretrain import MatchingConfig
from tapip3d_lite.training.recipe import TrainConfig


class Schedule:
    """The two stages of a training, and its position in them.

    Attributes:
        position: from 0 to the recipe's `total`; the number of steps done, or with a time budget the share of the time
            that has passed, times `total`.
    """

    def __init__(self, config: TrainConfig, group: Group, position: float = 0) -> None:
        self.config, self.group, self.position = config, group, position
        self._budget = 60 * (config.minutes or 0)  # seconds; 0: no time budget
        self.start_clock()

    @property
    def matching(self) -> bool:
        """Whether the training is in its first stage, which pretrains the encoder."""
        return self.position < self.config.matching_steps

    @property
    def finished(self) -> bool:
        """Whether the training is at its end."""
        return self.position >= self.config.total

    @property
    def recipe(self) -> MatchingConfig | TrainConfig:
        """The settings of this stage's optimiser: `lr`, `weight_decay`, `clip_norm`."""
        return self.config.matching if self.matching else self.config

    def start_clock(self) -> None:
        """Let a time budget's clock run on from the present position."""
        self._begun = time.perf_counter() - self._budget * self.position / self.config.total

    def advance(self, done: int) -> None:
        """Move on to a number of steps done; with a time budget by the main process's clock, evaluations included."""
        if not self._budget:
            self.position = done
            return
        share = min((time.perf_counter() - self._begun) / self._budget, 1.0)
        self.position = self.group.sum(self.config.total * share if self.group.is_main else 0.0)

    def places(self, done: int) -> Iterator[tuple[int, float]]:
        """Step and position of this stage's steps after those done; a position may be read ahead of time."""
        if self._budget:
            return ((step, self.position) for step in itertools.count(done))
        end = self.config.matching_steps if self.matching else self.config.total
        return ((step, step) for step in range(done, end))

    def rate(self) -> tuple[float, float]:
        """Learning rate and beta1 of the next step; each stage is one cycle."""
        matching, steps = self.config.matching_steps, self.config.steps
        first, steps = (0, matching) if self.matching else (matching, steps)
        return one_cycle(self.position - first, steps, self.recipe.lr, self.config.warmup)

    def due(self, before: float) -> bool:
        """Whether to evaluate: at the end, or if `evaluate_every` steps of the second stage were completed since `before`."""
        first, every = self.config.matching_steps, self.config.evaluate_every
        done = [max(x - first, 0) // every for x in (before, self.position)]
        return done[0] < done[1] or self.finished


def one_cycle(position: float, steps: int, peak: float, warmup: float) -> tuple[float, float]:
    """Learning rate and beta1 at a position from 0 to `steps`, to the bit those of `OneCycleLR(total_steps=steps + 1)`.

    A function of the position rather than torch's counter, so that elapsed time can take the place of steps. The rate
    rises from peak / 25 over the share `warmup`, and falls to peak / 250,000; beta1 is between 0.95 and 0.85.
    """
    top = warmup * (steps + 1) - 1  # position of the peak
    start, end = peak / 25, peak / 25 / 1e4
    if top > 0 and position <= top:
        return _cosine(start, peak, position / top), _cosine(0.95, 0.85, position / top)
    share = (position - top) / (steps - top)
    return _cosine(peak, end, share), _cosine(0.85, 0.95, share)


def _cosine(start: float, end: float, share: float) -> float:
    return end + (start - end) / 2.0 * (math.cos(math.pi * share) + 1)
