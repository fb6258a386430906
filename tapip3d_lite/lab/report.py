"""A study's report: Markdown with figures, and everything in it as JSON; and the widget that looks into a study."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import ipywidgets as widgets
from matplotlib.figure import Figure

from tapip3d_lite.evaluation.evaluate import markdown_table
from tapip3d_lite.figures import png_bytes, save_png
from tapip3d_lite.figures.comparisons import cost_figure, forest_figure
from tapip3d_lite.figures.curves import Line, learning_curves
from tapip3d_lite.files import write_text
from tapip3d_lite.lab.table import TITLES, Results, Table, gaps_by_clip


def write_report(
    folder: Path,
    table: Table,
    results: Results,
    logs: Mapping[str, Sequence[Line]],
    plan: Mapping[str, Any],
    worst: int = 5,
) -> Path:
    """Write `report.md`, `report.json` and figures into a folder; returns the first.

    `logs` are those of a training of each row, as far as there are any, `plan` what the study was made with, `worst` how
    many clips of each pair to list.
    """
    metric = table.metrics[0]
    title = TITLES.get(metric, metric)
    rows = [row for row in table.rows if not math.isnan(row[metric]["mean"])]
    figures = {"intervals": forest_figure({x["row"]: x[metric] for x in rows}, table.against, title)}
    if any(row["multiply_adds"] for row in rows):
        points = {x["row"]: (x["multiply_adds"] / 1e6, x[metric]) for x in rows if x["multiply_adds"]}
        figures["costs"] = cost_figure(points, "multiply-adds for each query and frame (M)", title)
    if logs:
        figures["curves"] = learning_curves(list(logs.items()))
    gaps = {x["row"]: gaps_by_clip(results, x["row"], table.against, metric) for x in rows if x["row"] != table.against}
    cells = [[name, *(f"{clip} {gap:+.3f}" for clip, gap in some[:worst])] for name, some in gaps.items()]
    head = [f"minus {table.against}", *(f"{rank + 1}." for rank in range(max([len(x) - 1 for x in cells], default=0)))]
    parts = [f"# {', '.join(plan['rows'])}", str(table)]
    parts += [f"![{name}]({name}.png)" for name in figures]
    if cells:
        parts += [f"Clips on which rows differ most ({title}, mean over seeds):", markdown_table(head, cells)]
    parts += ["## Made with", f"```json\n{json.dumps({k: v for k, v in plan.items() if k != 'code'}, indent=1)}\n```"]
    for name, figure in figures.items():
        save_png(figure, folder / f"{name}.png")
    content = {"table": table.to_dict(), "gaps": gaps, "plan": plan, "results": results}
    write_text(folder / "report.json", json.dumps(content, indent=1) + "\n")
    write_text(folder / "report.md", "\n\n".join(parts) + "\n")
    return folder / "report.md"


def explorer(rows: Sequence[str], seeds: int, clips: int, draw: Callable[..., Figure]) -> widgets.Widget:
    """Choices of two rows, a seed and a rank, above the picture that `draw` makes of them."""
    one = widgets.Dropdown(options=rows, value=rows[0], description="row")
    other = widgets.Dropdown(options=rows, value=rows[-1], description="other")
    rank = widgets.IntSlider(0, 0, clips - 1, description="rank", continuous_update=False)
    seed = widgets.IntSlider(0, 0, seeds - 1, description="seed", continuous_update=False)
    picture, words = widgets.Image(format="png"), widgets.Label()

    def show(_: Any = None) -> None:
        try:
            picture.value, words.value = png_bytes(draw(one.value, other.value, rank.value, seed.value)), ""
        except ValueError as error:
            words.value = str(error)

    for choice in (one, other, rank, seed):
        choice.observe(show, "value")
    show()
    return widgets.VBox([widgets.HBox([one, other]), widgets.HBox([rank, seed]), words, picture])
