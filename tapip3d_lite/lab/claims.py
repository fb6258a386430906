"""What the paper says of a table's rows, beside what a study found: agree, undecided or disagree.

A claim is the sign of a difference between two rows in one metric. It is decided as every other difference is: its
interval, after Holm's correction over all claims of the table, must exclude 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

from tapip3d_lite.evaluation.evaluate import markdown_table
from tapip3d_lite.lab.statistics import holm
from tapip3d_lite.lab.table import TITLES, Results, Table, difference, shown

METRICS = ("AJ3D", "APD3D", "OA")
CLAIM_HEAD = ("claim", "metric", "paper, %", "ours, %", "verdict")


def with_claims(table: Table, results: Results, paper: Mapping[str, Any]) -> Table:
    """The table, and the paper's numbers and claims beside ours.

    `paper` holds `source`, where the numbers stand; `rows`, for each row AJ3D, APD3D and OA in percent, None where one is
    not at hand; `pairs`, (row, the row that it is compared with).
    """
    claims = judge(results, paper, table.metrics)
    text = f"The paper's numbers ({' / '.join(METRICS)}, %; {paper['source']}) and claims, beside ours:"
    rows = [[name, " / ".join("–" if x is None else f"{x:.1f}" for x in one)] for name, one in paper["rows"].items()]
    parts = [text, markdown_table(["row", "paper"], rows)]
    if claims:
        parts.append(markdown_table(CLAIM_HEAD, claim_cells(claims)))
    return replace(table, claims=claims, notes=[*parts, *table.notes])


def claim_cells(claims: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Claims as rows of a Markdown table under `CLAIM_HEAD`."""
    cells = []
    for claim in claims:
        a, b = claim["paper"]
        ours = shown({name: 100 * value for name, value in claim["ours"].items()}, "+", 1)
        pair = f"{claim['row']} minus {claim['against']}"
        cells.append([pair, TITLES.get(claim["metric"], claim["metric"]), f"{a - b:+.1f}", ours, claim["verdict"]])
    return cells


def judge(results: Results, paper: Mapping[str, Any], metrics: Sequence[str]) -> list[dict[str, Any]]:
    """The paper's differences and ours, an entry for each pair and metric of which both have scores.

    Each of our metrics is held against the paper's that its name begins with.
    """
    found, effects = [], []
    for one, other in paper["pairs"]:
        for metric in metrics:
            column = next((i for i, name in enumerate(METRICS) if metric.startswith(name)), None)
            theirs = [None if column is None else paper["rows"][row][column] for row in (one, other)]
            ours = difference(results[one], results[other], metric)
            if None in theirs or ours is None or math.isnan(ours.mean):
                continue
            found.append({"row": one, "against": other, "metric": metric, "paper": theirs, "ours": asdict(ours)})
            effects.append(ours)
    for claim, p in zip(found, holm([one.p for one in effects]), strict=True):
        claim["verdict"] = beside(claim["paper"][0] - claim["paper"][1], claim["ours"]["mean"], p)
    return found


def beside(theirs: float, ours: float, p: float) -> str:
    """What a study says of a claim, by the paper's difference, ours, and our p-value after Holm's correction."""
    if theirs == 0 or not p <= 0.05:
        return "undecided"
    return "agree" if theirs * ours > 0 else "disagree"
