"""`Schedule`: how far a training has come, by its number of steps or by the clock, and what follows from that."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator

from tapip3d_lite.training.optimizer import one_cycle
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

    def advance(self, step: int) -> None:
        """Move on after a step; with a time budget by the main process's clock, evaluations included.

        Args:
            step: number of steps done.
        """
        if not self._budget:
            self.position = step
            return
        share = min((time.perf_counter() - self._begun) / self._budget, 1.0)
        self.position = self.group.sum(self.config.total * share if self.group.is_main else 0.0)

    def places(self, step: int) -> Iterator[tuple[int, float]]:
        """Step and position of the steps of this stage from a step on; a position may be read ahead of time.

        Args:
            step: number of steps done.
        """
        if self._budget:
            return ((s, self.position) for s in itertools.count(step))
        return ((s, s) for s in range(step, self.config.matching_steps if self.matching else self.config.total))

    def rate(self) -> tuple[float, float]:
        """Learning rate and beta1 of the next step; each stage is one cycle."""
        matching, steps = self.config.matching_steps, self.config.steps
        first, steps = (0, matching) if self.matching else (matching, steps)
        return one_cycle(self.position - first, steps, self.recipe.lr, self.config.warmup)

    def due(self, before: float) -> bool:
        """Whether to evaluate: at the end, and where `evaluate_every` steps of the second stage were completed.

        Args:
            before: position before the last step.
        """
        first, every = self.config.matching_steps, self.config.evaluate_every
        done = [max(x - first, 0) // every for x in (before, self.position)]
        return done[0] < done[1] or self.finished
