"""A study's table: each row's scores with intervals, its difference to one row, a verdict, and what it costs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from tapip3d_lite.evaluation.evaluate import markdown_table
from tapip3d_lite.lab.statistics import Effect, effect, paired, two_way_bootstrap, verdicts
from tapip3d_lite.validate import check_names

JUDGED = ("APD3D_none_dynamic", "AJ3D_none")  # first, second
Results = Mapping[str, Mapping[int, Mapping[str, Any]]]  # row → seed → what its file holds
_TITLES = {"APD3D_none_dynamic": "APD3D, moving points", "AJ3D_none": "AJ3D"}
_COSTS = {"parameters": "parameters (M)", "multiply_adds": "multiply-adds (M)", "step_ms": "step (ms)", "steps": "steps"}


@dataclass(frozen=True)
class Table:
    """Rows as dictionaries; printed as Markdown, which a notebook shows as a table.

    Attributes:
        rows: name, seeds, costs, failure; under each metric the mean with its interval, the difference and its verdict.
        against: the row that the others are compared with.
        metrics: in the order in which they judge.
        notes: what a reader must know beside the numbers.
    """

    rows: list[dict[str, Any]]
    against: str | None
    metrics: tuple[str, ...]
    notes: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        head = ["row", "seeds"]
        for metric in self.metrics:
            head += [_TITLES.get(metric, metric)]
            head += [f"minus {self.against}", "verdict"] if self.against else []
        cells = [[row["row"], row["seeds"], *self._scores(row), *_cost_cells(row)] for row in self.rows]
        if self.against:
            seen = [[x for row in self.rows if (x := row[m].get("seen", math.nan)) == x] for m in self.metrics]
            shown = [[f"{max(one):.3f}" if one else "–", "", ""][k] for one in seen for k in (1, 0, 2)]
            cells.append(["smallest difference that each comparison would see", "", *shown, *[""] * len(_COSTS)])
        table = markdown_table([*head, *_COSTS.values()], [[str(cell) for cell in row] for row in cells])
        return "\n\n".join([table, *self.notes])

    def _repr_markdown_(self) -> str:
        return str(self)

    def _scores(self, row: dict[str, Any]) -> list[str]:
        shown = []
        for metric in self.metrics:
            one = row[metric]
            shown.append(_interval(one))
            if self.against:
                shown += [_interval(one["difference"], "+"), one["verdict"]] if "difference" in one else ["", ""]
        return shown

    def to_dict(self) -> dict[str, Any]:
        """Everything in plain values; NaN as None."""
        return _without_nan(asdict(self))


def compare(results: Results, drawn: Mapping[str, bool], against: str | None, metrics: Sequence[str]) -> Table:
    """The table of some results.

    Args:
        results: of all rows, in their order.
        drawn: which rows were trained, so that their seeds are drawn.
        against: the row that the others are compared with; None: none.
        metrics: that judge; one family, over which Holm's correction goes.

    Raises:
        ValueError: an unknown row or metric, or no scores at all.
    """
    check_names("table: against", [] if against is None else [against], results)
    scored = {row: {seed: x for seed, x in seeds.items() if "scores" in x} for row, seeds in results.items()}
    known = {name for seeds in scored.values() for x in seeds.values() for one in x["scores"].values() for name in one}
    if not known:
        raise ValueError("table: no row has scores yet; run the study first")
    check_names("table: metric", metrics, known)
    rows, found = [], []
    for name, seeds in scored.items():
        failed = next((x["failed"] for x in results[name].values() if "failed" in x), None)
        row = {"row": name, "seeds": len(seeds) if drawn[name] else 0, "failed": failed, **_costs(seeds)}
        for metric in metrics:
            row[metric] = asdict(effect(matrix(seeds, metric), drawn[name])) if seeds else {"mean": math.nan}
            if against not in (None, name) and seeds and scored[against]:
                pair, is_drawn = _pair(scored, drawn, name, against, metric)
                found.append((row[metric], paired(*pair, is_drawn), pair, is_drawn))
        rows.append(row)
    for (one, difference, pair, is_drawn), verdict in zip(found, verdicts([x[1] for x in found]), strict=True):
        one |= {"difference": asdict(difference), "verdict": verdict, "seen": difference.seen}
        gaps = pair[0] - pair[1]
        gaps = gaps[:, ~np.isnan(gaps).any(0)]
        one["bootstrap"] = two_way_bootstrap(gaps) if is_drawn and gaps.size else None
    return Table(rows, against, tuple(metrics), _notes(rows, results, against))


def matrix(seeds: Mapping[int, Mapping[str, Any]], metric: str, some: Sequence[int] | None = None) -> np.ndarray:
    """A metric (S, C) of one row by seed and clip, in the order of their names; NaN where it is undefined."""
    values = [[seeds[seed]["scores"][clip].get(metric) for clip in sorted(seeds[seed]["scores"])] for seed in some or seeds]
    return np.array([[math.nan if x is None else x for x in one] for one in values], float)


def _pair(
    scored: Results, drawn: Mapping[str, bool], one: str, other: str, metric: str
) -> tuple[tuple[np.ndarray, np.ndarray], bool]:
    """Scores of two rows on the seeds that both have, and whether these are drawn."""
    common = [seed for seed in scored[one] if seed in scored[other] or not drawn[other]] if drawn[one] else None
    common = [seed for seed in scored[other]] if common is None and drawn[other] else common
    both = [matrix(scored[row], metric, common if drawn[row] else None) for row in (one, other)]
    return tuple(both), drawn[one] or drawn[other]


def _costs(seeds: Mapping[int, Mapping[str, Any]]) -> dict[str, float | None]:
    found = [x["costs"] for x in seeds.values()]
    values = {name: [x[name] for x in found if name in x] for name in _COSTS}
    return {name: float(np.median(x)) if x else None for name, x in values.items()}


def _notes(rows: Sequence[dict[str, Any]], results: Results, against: str | None) -> list[str]:
    notes = [f"**{row['row']}** failed: {row['failed']}" for row in rows if row["failed"]]
    codes = {x.get("code") for seeds in results.values() for x in seeds.values()}
    if len(codes) > 1:
        notes.append(f"The rows were made by {len(codes)} versions of the code.")
    if against:
        notes.append(
            f"Differences to {against}, paired by seed and clip, with 95 % intervals over seeds and clips. A verdict counts "
            "all comparisons of the table (Holm); the last row is for one comparison alone, at 80 % power. Multiply-adds "
            "are for each query and frame, the encoder's share included."
        )
    return notes


def _interval(one: Mapping[str, float] | Effect, sign: str = "") -> str:
    if math.isnan(one["mean"]):
        return "–"
    bounds = "" if math.isnan(one["low"]) else f" [{one['low']:{sign}.3f}, {one['high']:{sign}.3f}]"
    return f"{one['mean']:{sign}.3f}{bounds}"


def _cost_cells(row: Mapping[str, Any]) -> list[str]:
    million = [f"{row[name] / 1e6:.3f}" if row[name] is not None else "–" for name in ("parameters", "multiply_adds")]
    step = "–" if row["step_ms"] is None else f"{row['step_ms']:.0f}"
    return [*million, step, "–" if row["steps"] is None else f"{row['steps']:.0f}"]


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _without_nan(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(one) for one in value]
    return None if isinstance(value, float) and math.isnan(value) else value
