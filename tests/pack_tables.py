"""Copy the tables of the paper, as `lab run` made them in `runs`, to where the library ships them: `python -m tests.pack_tables`.

Scores by clip of every row, and of its first seed the weights (16 bits) and the learning curve.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import tapip3d_lite as t3d
from tapip3d_lite.files import write_text
from tapip3d_lite.lab.papers import PAPER, TABLES, open_study
from tapip3d_lite.training.run_folder import read_log

_EVERY = 10  # steps of the learning curve, beside those with held-out scores


def pack(name: str, folder: Path) -> list[str]:
    """Copy one table; the rows that have no scores yet."""
    study, _ = open_study(name, accept_code=True)
    results, plan = study.results(), study.plan
    missing = [row for row, seeds in results.items() if not any("scores" in one for one in seeds.values())]
    if missing:
        return missing
    plan.folder, source = folder / name, plan.folder
    plan.folder.mkdir(parents=True)
    shutil.copy(source / "study.json", plan.folder)  # with the code that made the results, which need not be today's
    for row, seeds in results.items():
        for seed, one in seeds.items():
            write_text(plan.result(plan.rows[row], seed), json.dumps(one, separators=(",", ":")) + "\n")
        if training := seeds[0]["training"]:
            old, new = plan.store / "trainings" / training, folder / "store" / "trainings" / training
            t3d.save_weights(
                t3d.load_tracker(old / "weights.safetensors", fast=False), new / "weights.safetensors", half=True
            )
            kept = [
                x for i, x in enumerate(read_log(old)) if not i % _EVERY or any(name.startswith("val_") for name in x)
            ]
            write_text(new / "log.jsonl", "".join(json.dumps(line) + "\n" for line in kept))
    print(f"{source} → {plan.folder}: {len(results)} rows")
    return []


def main() -> None:
    shutil.rmtree(PAPER, ignore_errors=True)
    for name in TABLES:
        if missing := pack(name, PAPER):
            print(f"{name}: left out, no scores of {', '.join(missing)}")
    files = [path for path in PAPER.rglob("*") if path.is_file()]
    print(f"{len(files)} files, {sum(path.stat().st_size for path in files) / 1e6:.1f} MB in {PAPER}")


if __name__ == "__main__":
    main()
