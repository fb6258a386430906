"""What was tried to make the tracker learn better, each change alone: the table, from the scores of every training.

`python -m tests.tried` prints it. The changes themselves are not in the tree, but in its history: `TRIALS` is a commit
with the code of all of them, and two commands there train and score the rows again, which `tests/data/tried.json` keeps.
"""

from __future__ import annotations

import json
from pathlib import Path

from tapip3d_lite.lab.table import Table, compare

TRIALS = "bae8f53"
DATA = Path(__file__).parent / "data" / "tried.json"


def table() -> Table:
    """Each row against `standard`, paired by seed and clip."""
    found = {row: {int(seed): x for seed, x in seeds.items()} for row, seeds in json.loads(DATA.read_text()).items()}
    return compare(found, "standard", ("APD3D_none_dynamic", "AJ3D_none"))


if __name__ == "__main__":
    print(table())
