"""What was tried to make the tracker learn better, each change alone: a page, from the scores of every training.

`python -m tests.tried > tapip3d_lite/weights/tried.md` writes it. The changes that do not pay are not in the tree, but in
its history; these train and score all rows again:

    git worktree add ../trials bae8f53 && cd ../trials
    python trials/run.py --prepare          # 240 clips of 64 x 64 pixels, an encoder trained by matching, its features
    python trials/run.py --steps 1000 --jobs 2
"""

from __future__ import annotations

import json
from pathlib import Path

from tapip3d_lite.evaluation.evaluate import markdown_table
from tapip3d_lite.lab.table import Table, compare

DATA = Path(__file__).parent / "data" / "tried.json"
ROWS = {
    "standard": "AdamW, gradients through one update at a time, the average of the last weights",
    "last weights": "the same trainings, without the average (`--average 0`)",
    "muon": "Muon for the matrices inside blocks (`--optimizer muon`)",
    "grad2": "gradients through two updates; not through Fourier features finer than degree 3, nor through pixels",
    "velocity": "a window's new frames start with constant velocity in place of the last position",
    "match": "first estimates start at the most similar cell (soft-argmax within 8 cells), where that is clear",
    "timebias": "a learnt bias for each distance in time in place of the absolute embedding",
    "scalars": "learnt factors of the residual and of the input before each part of the updater",
    "zeroinit": "the updater's output projections start at zero",
    "laplace": "a predicted spread: the likelihood of a Laplace distribution in place of the error",
    "decay0": "cautious weight decay (only where it agrees with the step) that falls to zero",
    "bf16": "bfloat16 by autocast",
    "static": "zero motion",
    "klt": "Lucas-Kanade",
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
    return "\n\n".join([
        "# What was tried to make the tracker learn better", text, markdown_table(["row", "what"], list(map(list, ROWS.items()))),
        str(first), str(second),
    ])  # fmt: skip


if __name__ == "__main__":
    print(page())
