"""Rows of the bench, their table, and a figure of stages and memory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from matplotlib.figure import Figure

from tests.bench.timing import ratios

STAGES = {"encoder": "#4c78a8", "k-NN": "#f58518", "context": "#54a24b", "updater": "#b279a2", "the rest": "#9d9d9d"}


@dataclass(frozen=True)
class Row:
    """One measurement: part of the bench, case, way, seconds of each round, and other numbers by name.

    `faster` is (minimum, median, maximum) of how many times faster this way is than the way named in `than`.
    """

    part: str
    case: str
    way: str = ""
    seconds: list[float] = field(default_factory=list)
    values: dict[str, float] = field(default_factory=dict)
    faster: tuple[float, float, float] | None = None
    than: str = ""


def compared(
    part: str, case: str, seconds: Mapping[str, list[float]], values: Mapping[str, dict] | None = None, than: str = ""
) -> Iterator[Row]:
    """Rows of ways that took turns, all compared with one of them, by default the first."""
    than = than or next(iter(seconds))
    for way, times in seconds.items():
        relative = (None, "") if way == than else (ratios(seconds[than], times), than)
        yield Row(part, case, way, times, (values or {}).get(way, {}), *relative)


def table(rows: Sequence[Row]) -> str:
    """Rows as a Markdown table; `times faster` is median (minimum to maximum)."""
    lines = ["| part | case | way | seconds | times faster | than | |", "|---|---|---|---|---|---|---|"]
    for row in rows:
        seconds = f"{np.median(row.seconds):.3g}" if row.seconds else ""
        faster = "" if row.faster is None else "{1:.2f} ({0:.2f} to {2:.2f})".format(*row.faster)
        values = ", ".join(f"{name} {value:.3g}" for name, value in row.values.items())
        lines.append(f"| {row.part} | {row.case} | {row.way} | {seconds} | {faster} | {row.than} | {values} |")
    return "\n".join(lines)


def figure(rows: Sequence[Row]) -> Figure:
    """Draw parts `model` and `memory`: where the time goes, and how memory grows with a clip's length."""
    drawn = Figure(figsize=(11, 3.6), layout="constrained")
    left, right = drawn.subplots(1, 2, width_ratios=(3, 2))
    times = {(row.case, row.way): float(np.median(row.seconds)) for row in rows if row.part == "model"}
    runs = [key for key in times if ":" not in key[0]]
    for place, (case, way) in enumerate(runs):
        widths = [times[f"{case}: {stage}", way] for stage in STAGES]
        left.barh([place] * len(STAGES), widths, left=np.cumsum([0, *widths[:-1]]), color=STAGES.values())
        left.text(sum(widths), place, f" {times[case, way]:.3g} s", va="center", fontsize=8)
    left.set_yticks(range(len(runs)), [", ".join(key) for key in runs], fontsize=8)
    left.set(xlabel="seconds", title="Where the time goes", xmargin=0.15)
    left.invert_yaxis()
    if runs:
        left.legend(left.containers[0], STAGES, fontsize=8)
    memory = [row for row in rows if row.part == "memory"]
    for way in dict.fromkeys(row.way for row in memory):
        right.plot(*zip(*[row.values.values() for row in memory if row.way == way], strict=True), "o-", label=way)
    right.set(xlabel="frames", ylabel="MiB above the start", title="Peak memory of a run", ylim=(0, None))
    if memory:
        right.legend(fontsize=8)
    return drawn
