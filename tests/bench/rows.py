"""Rows of the bench and their table."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from tests.bench.timing import ratios


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        part: of the bench.
        case: what was computed.
        way: how.
        seconds: of each round.
        faster: (minimum, median, maximum) of how many times sooner than the way named in `than` it was done.
        than: the way compared with.
        values: other numbers by name.
    """

    part: str
    case: str
    way: str = ""
    seconds: list[float] = field(default_factory=list)
    faster: tuple[float, float, float] | None = None
    than: str = ""
    values: dict[str, float] = field(default_factory=dict)


def compared(part: str, case: str, seconds: dict[str, list[float]], **values: dict[str, float]) -> Iterator[Row]:
    """Rows of ways that took turns, all compared with the first; `values` by way, spaces written as `_`."""
    first = next(iter(seconds))
    for way, times in seconds.items():
        faster = None if way == first else ratios(seconds[first], times)
        yield Row(part, case, way, times, faster, "" if faster is None else first, values.get(way, {}))


def table(rows: list[Row]) -> str:
    """Rows as a Markdown table; `faster` is median (minimum to maximum)."""
    lines = ["| part | case | way | seconds | times faster | than | |", "|---|---|---|---|---|---|---|"]
    for row in rows:
        seconds = f"{np.median(row.seconds):.3g}" if row.seconds else ""
        faster = "" if row.faster is None else "{1:.2f} ({0:.2f} to {2:.2f})".format(*row.faster)
        values = ", ".join(f"{name} {value:.3g}" for name, value in row.values.items() if name != "frames")
        lines.append(f"| {row.part} | {row.case} | {row.way} | {seconds} | {faster} | {row.than} | {values} |")
    if any(row.part == "k-NN" for row in rows) and not any(row.way == "cKDTree" for row in rows):
        lines.append("\nSciPy is not installed, so its cKDTree was not measured.")
    return "\n".join(lines)
