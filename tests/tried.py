"""What was tried to make the tracker learn better, each change alone: the table, from the scores of every training.

`python -m tests.tried` prints it. The changes that do not pay are not in the tree, but in its history; these train and
score all rows again:

    git worktree add ../trials bae8f53 && cd ../trials
    python trials/run.py --prepare          # 240 clips of 64 x 64 pixels, an encoder trained by matching, its features
    python trials/run.py --steps 1000 --jobs 2
"""

from __future__ import annotations

import json
from pathlib import Path

from tapip3d_lite.lab.table import Table, compare

DATA = Path(__file__).parent / "data" / "tried.json"


def table(metric: str = "APD3D_none_dynamic") -> Table:
    """Each row against `standard`, paired by seed and clip."""
    found = json.loads(DATA.read_text())
    rows = {row: {int(seed): one for seed, one in seeds.items()} for row, seeds in found.items()}
    return compare(rows, "standard", (metric,))


if __name__ == "__main__":
    print(table(), table("AJ3D_none"), sep="\n\n")
