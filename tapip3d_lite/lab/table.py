"""A study's table: each row's scores with intervals, its difference to one row, a verdict, and what it costs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from tapip3d_lite.evaluation.evaluate import markdown_table
from tapip3d_lite.lab.statistics import Effect, effect, paired, verdicts
from tapip3d_lite.validate import check_names

JUDGED = ("APD3D_none_dynamic", "AJ3D_none")  # first, second
Results = Mapping[str, Mapping[int, Mapping[str, Any]]]  # row → seed → what its file holds
Seeds = Mapping[int, Mapping[str, Any]]
TITLES = {"APD3D_none_dynamic": "APD3D, moving points", "AJ3D_none": "AJ3D"}
_COSTS = {  # title, unit, digits
    "parameters": ("parameters (M)", 1e6, 3),
    "multiply_adds": ("multiply-adds (M)", 1e6, 3),
    "step_ms": ("step (ms)", 1, 0),
    "steps": ("steps", 1, 0),
}


@dataclass(frozen=True)
class Table:
    """Rows as dictionaries; printed as Markdown, which a notebook shows as a table.

    Attributes:
        rows: name, seeds, costs, failure; under each metric the mean with its interval, the difference and its verdict.
        against: the row that the others are compared with.
        metrics: in the order in which they judge.
        notes: what a reader must know beside the numbers.
        claims: the paper's, see `claims.judge`.
    """

    rows: list[dict[str, Any]]
    against: str
    metrics: tuple[str, ...]
    notes: list[str] = field(default_factory=list)
    claims: list[dict[str, Any]] = field(default_factory=list)

    def __str__(self) -> str:
        head, last = ["row", "seeds"], ["smallest difference that each comparison would see", ""]
        for metric in self.metrics:
            head += [TITLES.get(metric, metric), f"minus {self.against}", "verdict"]
            seen = [row[metric]["difference"]["seen"] for row in self.rows if "difference" in row[metric]]
            seen = [x for x in seen if not math.isnan(x)]
            last += ["", f"{max(seen):.3f}" if seen else "–", ""]
        head += [title for title, *_ in _COSTS.values()]
        cells = [*map(self._cells, self.rows), [*last, *[""] * len(_COSTS)]]
        return "\n\n".join([markdown_table(head, cells), *self.notes])

    def _repr_markdown_(self) -> str:
        return str(self)

    def _cells(self, row: dict[str, Any]) -> list[str]:
        cells = [row["row"], "–" if row["seeds"] is None else str(row["seeds"])]
        for one in (row[metric] for metric in self.metrics):
            cells += [shown(one), shown(one.get("difference"), "+"), one.get("verdict", "")]
        costs = [(row[name], unit, digits) for name, (_, unit, digits) in _COSTS.items()]
        return cells + ["–" if x is None else f"{x / unit:.{digits}f}" for x, unit, digits in costs]

    def to_dict(self) -> dict[str, Any]:
        """Everything in plain values; NaN as None."""
        return _without_nan(asdict(self))


def compare(results: Results, against: str, metrics: Sequence[str]) -> Table:
    """The table of some results.

    Args:
        results: of all rows, in their order.
        against: the row that the others are compared with.
        metrics: that judge; one family, over which Holm's correction goes.

    Raises:
        ValueError: an unknown row or metric, or no scores at all.
    """
    check_names("table: against", [against], results)
    scored = {name: _scored(seeds) for name, seeds in results.items()}
    known = {name for seeds in scored.values() for x in seeds.values() for one in x["scores"].values() for name in one}
    if not known:
        raise ValueError("table: no row has scores yet; run the study first")
    check_names("table: metric", metrics, known)
    rows, compared, effects, base = [], [], [], scored[against]
    for name, seeds in scored.items():
        failed = next((x["failed"] for x in results[name].values() if "failed" in x), None)
        rows.append({"row": name, "seeds": len(seeds) if _drawn(seeds) else None, "failed": failed, **_costs(seeds)})
        for metric in metrics:
            rows[-1][metric] = asdict(effect(matrix(seeds, metric), _drawn(seeds)) if seeds else Effect(math.nan))
            if name != against and (found := difference(seeds, base, metric)):
                compared.append(rows[-1][metric])
                effects.append(found)
    for one, found, verdict in zip(compared, effects, verdicts(effects), strict=True):
        one |= {"difference": asdict(found), "verdict": verdict}
    return Table(rows, against, tuple(metrics), _notes(rows, results, against))


def difference(ours: Seeds, theirs: Seeds, metric: str) -> Effect | None:
    """The mean of one row's scores minus another's, paired by clip and common seed; None where there is none."""
    ours, theirs = _scored(ours), _scored(theirs)
    one, other = _common(ours, theirs)
    drawn = _drawn(ours) or _drawn(theirs)
    return paired(matrix(ours, metric, one), matrix(theirs, metric, other), drawn) if one else None


def gaps_by_clip(
    results: Results, one: str, other: str, metric: str, seed: int | None = None
) -> list[tuple[str, float]]:
    """The clips with the difference of two rows, greatest first; the mean over seeds where none is named.

    Raises:
        ValueError: an unknown row, or rows that have no scores with the same seed.
    """
    check_names("row", (one, other), results)
    both = [_scored(results[row]) for row in (one, other)]
    pairs = [pair for pair in zip(*_common(*both), strict=True) if seed is None or seed in pair]
    if not pairs:
        raise ValueError(f"{one!r} and {other!r} have no scores with the same seed; run the study first")
    means = [matrix(x, metric, some).mean(0) for x, some in zip(both, zip(*pairs, strict=True), strict=True)]
    names = sorted(both[0][pairs[0][0]]["scores"])
    gaps = [(name, float(gap)) for name, gap in zip(names, means[0] - means[1], strict=True) if not math.isnan(gap)]
    return sorted(gaps, key=lambda pair: -abs(pair[1]))


def _scored(seeds: Seeds) -> Seeds:
    return {seed: x for seed, x in seeds.items() if "scores" in x}


def _drawn(seeds: Seeds) -> bool:
    """Whether a row was trained, so that its seeds are drawn from many."""
    return any(x["training"] for x in seeds.values())


def _common(one: Seeds, other: Seeds) -> tuple[list[int], list[int]]:
    """The seeds of each that are compared: equal ones; a tracker that was not trained stands beside every seed."""
    if not one or not other:
        return [], []
    trained = [set(x) for x in (one, other) if _drawn(x)]
    common = sorted(set.intersection(*trained)) if trained else [0]
    return tuple(common if _drawn(x) else [0] * len(common) for x in (one, other))


def matrix(seeds: Seeds, metric: str, some: Sequence[int] | None = None) -> np.ndarray:
    """A metric (S, C) of one row by seed and clip, in the order of their names; NaN where it is undefined."""
    found = [seeds[seed]["scores"] for seed in (seeds if some is None else some)]
    return np.array([[scores[clip].get(metric) for clip in sorted(scores)] for scores in found], float)  # None: NaN


def _costs(seeds: Seeds) -> dict[str, float | None]:
    values = {name: [x["costs"][name] for x in seeds.values() if name in x["costs"]] for name in _COSTS}
    return {name: float(np.median(x)) if x else None for name, x in values.items()}


def _notes(rows: Sequence[dict[str, Any]], results: Results, against: str) -> list[str]:
    notes = [f"**{row['row']}** failed: {row['failed']}" for row in rows if row["failed"]]
    codes = {x.get("code") for seeds in results.values() for x in seeds.values()}
    if len(codes) > 1:
        notes.append(f"The rows were made by {len(codes)} versions of the code.")
    minutes = [row["steps"] * row["step_ms"] / 60_000 for row in rows if row["steps"]]
    devices = {x["device"] for seeds in results.values() for x in seeds.values() if x.get("training") and "device" in x}
    if minutes and devices:
        where = " or ".join(sorted(devices)).replace("cpu", "one core").replace("cuda", "a shared GPU")
        notes.append(f"A training took {min(minutes):.1f} to {max(minutes):.1f} minutes on {where}.")
    return [
        *notes,
        f"Differences to {against}, paired by seed and clip, with 95 % intervals over seeds and clips. A verdict counts "
        "all comparisons of the table (Holm); the last row is for one comparison alone, at 80 % power. Multiply-adds "
        "are for each query and frame, the encoder's share included.",
    ]


def shown(one: Mapping[str, float] | None, sign: str = "", digits: int = 3) -> str:
    """`mean [low, high]`; a dash where it is undefined."""
    if one is None or math.isnan(one["mean"]):
        return "" if one is None else "–"
    bounds = "" if math.isnan(one["low"]) else f" [{one['low']:{sign}.{digits}f}, {one['high']:{sign}.{digits}f}]"
    return f"{one['mean']:{sign}.{digits}f}{bounds}"


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _without_nan(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(one) for one in value]
    return None if isinstance(value, float) and math.isnan(value) else value
