"""The seeds of each purpose, kept apart so that no clip of an evaluation is ever used for training."""

from __future__ import annotations

SAMPLES = range(0, 1_000)  # sample clips, examples, tests
BENCHMARK = range(20_000, 50_000)  # the Lite benchmark; each split takes a thousand
VALIDATION = range(50_000, 51_000)  # held-out clips that a training looks at now and then
STUDIES = range(51_000, 52_000)  # held-out clips by which the rows of a study are judged
TRAINING = range(100_000, 2**31)
