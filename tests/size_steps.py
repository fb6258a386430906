"""How the budget `lab` was chosen: sizes of the tracker by steps of its training, and what each of them uses.

`python -m tests.size_steps --jobs 2` trains one seed of each in `runs/sizes` (an hour on two cores), and takes the scores
over into `tests/data/sizes.json`; `python -m tests.size_steps` makes the page `tapip3d_lite/lab/sizes.md` from them.
"""

from __future__ import annotations

import argparse
import json
from itertools import product
from pathlib import Path

import numpy as np

from tapip3d_lite import lab
from tapip3d_lite.evaluation.evaluate import markdown_table
from tapip3d_lite.files import write_text
from tapip3d_lite.lab.statistics import paired
from tapip3d_lite.lab.table import Results, matrix, shown

METRIC = "APD3D_none_dynamic"
DATA = Path(__file__).parent / "data" / "sizes.json"
PAGE = Path(lab.__file__).parent / "sizes.md"
SIZES = {"narrow": {"hidden": 48, "head_dim": 12}, "lab": {}, "wide": {"hidden": 192, "head_dim": 48}}
STEPS = (375, 750, 1500)
SEEN = {"": {}, ", grey": {"grey": True}, ", frozen": {"frozen": "depths"}}


def rows() -> list[lab.Variant]:
    """Every size after every number of steps, as it is, without colours, and with the depth of its first frame for all."""
    found = []
    for (size, fields), steps, (name, degrade) in product(SIZES.items(), STEPS, SEEN.items()):
        found.append(lab.Variant(f"{size}, {steps}{name}", steps=steps, degrade=degrade or None, **fields))
    return [*found, *(lab.Variant(name, tracker=name) for name in ("static", "klt"))]


def kept(results: Results) -> Results:
    """What the page needs of a study's results."""
    return {
        row: {
            seed: {
                "costs": one["costs"],
                "scores": {clip: {METRIC: scores[METRIC]} for clip, scores in one["scores"].items()},
            }
            for seed, one in seeds.items()
        }
        for row, seeds in results.items()
    }


def page(results: Results) -> str:
    """The scores, and what is lost without colours, without moving depth, and beside Lucas-Kanade's tracker."""

    def minus(one: str, other: str) -> str:
        gap = paired(matrix(results[one], METRIC), matrix(results[other], METRIC), drawn=False)
        return shown({"mean": gap.mean, "low": gap.low, "high": gap.high}, "+")

    cells = []
    for size, steps in product(SIZES, STEPS):
        name = f"{size}, {steps}"
        costs, score = results[name][0]["costs"], np.nanmean(matrix(results[name], METRIC))
        minutes = costs["steps"] * costs["step_ms"] / 60_000
        cells.append([
            size, f"{costs['parameters'] / 1e6:.2f}", str(steps), f"{minutes:.1f}", f"{score:.3f}",
            minus(f"{name}, grey", name), minus(f"{name}, frozen", name), minus(name, "klt"), minus(name, "static"),
        ])  # fmt: skip
    head = ["size", "parameters (M)", "steps", "minutes on one core", "APD3D, moving points"]
    head += ["grey video", "frozen depth", "minus klt", "minus static"]
    clips = len(results["klt"][0]["scores"])
    text = (
        f"One training of each, and intervals of 95 % over the {clips} held-out clips alone, since there is one seed; that of "
        "`lab table n2n` has three. A setting answers questions about features only where grey video costs something, about "
        "depth only where frozen depth does, and about tracking only where the tracker beats `klt` and `static`. "
        "`python -m tests.size_steps` makes this page."
    )
    return "\n\n".join(["# Sizes and steps: how the budget `lab` was chosen", text, markdown_table(head, cells)]) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--jobs", type=int, help="train what is missing first, so many at once")
    options = parser.parse_args()
    if options.jobs:
        study = lab.Study("runs/sizes", rows(), seeds=1, budget="lab", store="runs/store", accept_code=True)
        if not study.run(options.jobs):
            raise SystemExit("stopped and saved; the same command goes on")
        write_text(DATA, json.dumps(kept(study.results()), separators=(",", ":")) + "\n")
    results = {
        row: {int(seed): one for seed, one in seeds.items()} for row, seeds in json.loads(DATA.read_text()).items()
    }
    write_text(PAGE, page(results))
    print(PAGE)


if __name__ == "__main__":
    main()
