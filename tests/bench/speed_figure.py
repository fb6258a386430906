"""Figure of the bench: where time goes before and after, and how memory grows with a clip's length."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from tests.bench.bench import Row

_STAGES = ("encoder", "k-NN", "context", "updater", "the rest")
_COLOURS = ("#4c78a8", "#f58518", "#54a24b", "#b279a2", "#9d9d9d")


def speed(rows: Sequence[Row]) -> Figure:
    """Draw the rows of `bench` for parts `model` and `memory`; a part that was not measured stays empty.

    Args:
        rows: from `evaluation.bench.bench`.
    """
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    runs = [row for row in rows if row.part == "model" and row.way and ":" not in row.case]
    times = {(row.case, row.way): float(np.median(row.seconds)) for row in rows if row.part == "model"}
    for place, row in enumerate(runs):
        start = 0.0
        for stage, colour in zip(_STAGES, _COLOURS, strict=True):
            width = times.get((f"{row.case}: {stage}", row.way), 0.0)
            left.barh(place, width, left=start, color=colour, label=stage if place == 0 else None)
            start += width
        left.text(start, place, f" {start:.3g} s", va="center", fontsize=8)
    left.set_yticks(range(len(runs)), [f"{row.case}, {row.way}" for row in runs], fontsize=8)
    left.invert_yaxis()
    left.set(xlabel="seconds", title="Where the time goes")
    left.margins(x=0.15)
    if runs:
        left.legend(fontsize=8)
    memory = [row for row in rows if row.part == "memory"]
    for way in dict.fromkeys(row.way for row in memory):
        points = [(row.values["frames"], row.values["MiB"]) for row in memory if row.way == way]
        right.plot(*zip(*points, strict=True), "o-", label=way)
    right.set(xlabel="frames", ylabel="MiB above the start", title="Peak memory of a run", ylim=(0, None))
    if memory:
        right.legend(fontsize=8)
    return figure
