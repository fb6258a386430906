"""What was tried to make the tracker learn better, and what does not work: a page, from the scores of every training.

`python -m tests.tried > tapip3d_lite/weights/tried.md` writes it. The changes that do not pay are not in the tree, but in
its history; these train and score all rows again:

    git worktree add ../trials bae8f53 && cd ../trials
    python trials/run.py --prepare          # 240 clips of 64 x 64 pixels, an encoder trained by matching, its features
    python trials/run.py --rows standard muon grad2 velocity match timebias scalars zeroinit laplace decay0 bf16 --jobs 2

(the row `muon-zeroinit` was added to `ROWS` there: `{"trial": {"muon": 1.0, "zeroinit": "updater"}}`)

and `python -m tests.tried --runs ../trials/trials/runs` here takes their scores over into `tests/data/tried.json`.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tapip3d_lite.evaluation.evaluate import markdown_table
from tapip3d_lite.files import write_text
from tapip3d_lite.lab.papers import open_study
from tapip3d_lite.lab.table import Table, compare

METRICS = ("APD3D_none_dynamic", "AJ3D_none", "OA")
DATA = Path(__file__).parent / "data" / "tried.json"
ROWS = {
    "standard": "AdamW, gradients through one update at a time, the average of the last weights",
    "last weights": "the same trainings, without the average (`--average 0`)",
    "muon": "Muon for the matrices inside blocks (`--optimizer muon`)",
    "zeroinit": "the updater's output projections start at zero (part of `--start aligned`)",
    "muon-zeroinit": "both",
    "grad2": "gradients through two updates; not through Fourier features finer than degree 3, nor through pixels",
    "velocity": "a window's new frames start with constant velocity in place of the last position",
    "match": "first estimates start at the most similar cell (soft-argmax within 8 cells), where that is clear",
    "timebias": "a learnt bias for each distance in time in place of the absolute embedding",
    "scalars": "learnt factors of the residual and of the input before each part of the updater",
    "laplace": "a predicted spread: the likelihood of a Laplace distribution in place of the error",
    "decay0": "cautious weight decay (only where it agrees with the step) that falls to zero",
    "bf16": "bfloat16 by autocast",
    "static": "zero motion",
    "klt": "Lucas-Kanade",
}


def gathered(runs: Path) -> dict[str, dict[int, dict[str, Any]]]:
    """What `compare` takes, from a folder with `<row>-<seed>/scores.json` and `baselines.json`, in the order of `ROWS`."""
    found: dict[str, dict[int, dict[str, Any]]] = {row: {} for row in ROWS}
    for row in ROWS:
        for path in sorted(runs.glob(f"{row}-[0-9]/scores.json")):
            one = json.loads(path.read_text())
            costs = {name: one[name] for name in ("parameters", "steps")} | {
                "step_ms": round(1000 * one["cpu_step"], 2)
            }
            entry = {"training": path.parent.name, "costs": costs}
            found[row][one["seed"]] = entry | {"scores": by_clip(one["names"], one["average"])}
            if row == "standard":
                found["last weights"][one["seed"]] = entry | {"scores": by_clip(one["names"], one["last"])}
    for row, scores in json.loads((runs / "baselines.json").read_text()).items():
        found[row][0] = {"training": None, "costs": {}, "scores": by_clip(one["names"], scores)}
    return found


def by_clip(names: Sequence[str], scores: Mapping[str, Sequence[float]]) -> dict[str, dict[str, float | None]]:
    """Scores by clip and metric, None where one is undefined, of lists by metric."""
    rows = [[round(scores[metric][i], 5) for metric in METRICS] for i in range(len(names))]
    return {
        n: {m: None if x != x else x for m, x in zip(METRICS, row, strict=True)}
        for n, row in zip(names, rows, strict=True)
    }


def table(metric: str = "APD3D_none_dynamic") -> Table:
    """Each row against `standard`, paired by seed and clip."""
    found = json.loads(DATA.read_text())
    rows = {row: {int(seed): one for seed, one in seeds.items()} for row, seeds in found.items()}
    return compare(rows, "standard", (metric,))


def page() -> str:
    first, second = table(), table("AJ3D_none")
    steps = next(row["steps"] for row in first.rows if row["steps"])
    text = (
        f"Each change alone, in a small tracker (0.9 M parameters, 64×64 pixels) that trains for {steps:.0f} steps on 240 clips "
        "with one frozen encoder; scored on 32 other clips of 16 frames, three windows. Steps are timed in processor "
        "milliseconds. `python -m tests.tried` makes this page from `tests/data/tried.json`, and says how to train it all "
        "again. What is not shown to help is not in the library."
    )
    later = (
        "Each with three seeds, 1,500 steps at the budget `lab`, and 80 clips. `--start aligned` begins with attention that "
        "compares looks and hands on displacements. A random start of the same recipe tracks nearly as well and has not "
        "learnt to look: without colours it loses next to nothing, so that no comparison of parts that look could be made "
        "with it. `python -m tapip3d_lite lab table learner` prints this table."
    )
    return "\n\n".join([
        "# What was tried to make the tracker learn better", text, markdown_table(["row", "what"], list(map(list, ROWS.items()))),
        str(first), str(second), "# What the laboratory's trackers start from", later,
        str(open_study("learner", shipped=True)[0].table("aligned, Muon")),
    ])  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=Path, help="take the scores over from the trials' folder first")
    options = parser.parse_args()
    if options.runs:
        write_text(DATA, json.dumps(gathered(options.runs), separators=(",", ":")) + "\n")
    print(page())


if __name__ == "__main__":
    main()
