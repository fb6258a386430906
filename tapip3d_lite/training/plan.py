"""How many steps fit into a given time on this machine."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tapip3d_lite.training.config import TrainConfig
from tapip3d_lite.training.data import FeatureCache
from tapip3d_lite.training.trainer import Trainer

_WARM = 3  # first steps of a stage that are not timed: they encode clips and warm caches


def fit_to_time(
    config: TrainConfig,
    clips: Sequence[Path],
    seconds: float,
    matching: float = 0.15,
    device: str = "cpu",
    probe: int = 8,
) -> TrainConfig:
    """The same recipe with as many steps as fit into a time, found by timing a few steps of each stage.

    So the learning rate reaches its end when the time does. The first encoding of each clip is counted, evaluations
    and whatever else runs meanwhile are not: ask for a little less time than there is.

    Args:
        config: the recipe; its numbers of steps are replaced.
        clips: training clips, of which two are used.
        seconds: for both stages together.
        matching: share of the time for the encoder's matching; 0 leaves that stage out.
        device: `"cpu"` or `"cuda"`.
        probe: steps of each stage that are timed.

    Returns:
        The recipe with `matching_steps` and `steps` set, at least one step of each stage that has a share.

    Raises:
        ValueError: no time, or a share outside [0, 1).
    """
    if seconds <= 0 or not 0 <= matching < 1 or probe < 1:
        raise ValueError(
            f"fit_to_time: expected seconds > 0, matching in [0, 1), probe >= 1, got {seconds}, {matching}, {probe}"
        )
    count = probe + _WARM
    trial = replace(config, matching_steps=count if matching else 0, steps=count, validation=0, save_every=10**9)
    lines: list[dict] = []
    with tempfile.TemporaryDirectory() as folder:
        trainer = Trainer(folder, trial, list(clips)[:2], device=device)
        trainer.run(watch=lines.append, progress=False)
        encoding = 0.0 if config.train_encoder or device == "cuda" else _encoding(trainer, Path(folder) / "again")
    costs = np.diff([0.0] + [line["seconds"] for line in lines])
    cost = {
        stage: float(np.mean([c for c, line in zip(costs, lines, strict=True) if line["stage"] == stage][_WARM:]))
        for stage in {line["stage"] for line in lines}
    }
    first = max(1, round(matching * seconds / cost["matching"])) if matching else 0
    left = (1 - matching) * seconds - min(config.clips, len(clips)) * encoding
    # So little time that not every clip is met: then nearly every step encodes one.
    steps = max(left / cost["tracking"], (1 - matching) * seconds / (cost["tracking"] + encoding))
    return replace(config, matching_steps=first, steps=max(1, round(steps)))


def _encoding(trainer: Trainer, folder: Path) -> float:
    """Seconds to encode a clip."""
    clips = trainer.examples.clips
    cache = FeatureCache(folder, trainer.tracker.encoder, trainer.examples.size)
    started = time.perf_counter()
    for clip in clips:
        cache.path(clip)
    return (time.perf_counter() - started) / len(clips)
