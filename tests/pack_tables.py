"""Copy the tables of the paper, as `lab run` made them in `runs`, to where the library ships them: `python -m tests.pack_tables`.

Scores by clip of every row, and of its first seed the weights (16 bits) and the learning curve. All weights together have
30 MB, so that those of `learner`'s own rows and of the budget `gpu` stay behind.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import tapip3d_lite as t3d
from tapip3d_lite.files import read_json, write_text
from tapip3d_lite.lab.papers import PAPER, TABLES, open_study
from tapip3d_lite.training.run_folder import read_log

_EVERY = 10  # steps of the learning curve, beside those with held-out scores
_NO_WEIGHTS = {"learner", "n2n, gpu"}


def pack(name: str, folder: Path, budget: str | None = None) -> list[str]:
    """Copy one table; the rows that have no scores yet."""
    study, _ = open_study(name, accept_code=True, budget=budget)
    results, plan = study.results(), study.plan
    missing = [row for row, seeds in results.items() if not any("scores" in one for one in seeds.values())]
    if missing:
        return missing
    source, plan.folder = plan.folder, folder / plan.folder.name
    shutil.rmtree(plan.folder, ignore_errors=True)
    plan.folder.mkdir(parents=True)
    shutil.copy(source / "study.json", plan.folder)  # with the code that made the results, which need not be today's
    for row, seeds in results.items():
        for seed, one in seeds.items():
            training = one["training"]
            if training:  # the same recipe has other weights on another device
                one = {**one, "training": f"{one['device']}-{training}"}
            write_text(plan.result(plan.rows[row], seed), json.dumps(one, separators=(",", ":")) + "\n")
            if training and seed == 0:
                old, new = (plan.store / "trainings" / training, folder / "store" / "trainings" / one["training"])
                copy_training(old, new, plan.folder.name not in _NO_WEIGHTS)
    print(f"{source} → {plan.folder}: {len(results)} rows")
    return []


def copy_training(old: Path, new: Path, weights: bool) -> None:
    """Copy a training's learning curve, and maybe its weights."""
    kept = [x for i, x in enumerate(read_log(old)) if not i % _EVERY or any(name.startswith("val_") for name in x)]
    write_text(new / "log.jsonl", "".join(json.dumps(line) + "\n" for line in kept))
    if weights:
        tracker = t3d.load_tracker(old / "weights.safetensors", fast=False)
        t3d.save_weights(tracker, new / "weights.safetensors", half=True)


def main() -> None:
    for name, budget in [*((name, None) for name in TABLES), ("n2n", "gpu")]:
        if missing := pack(name, PAPER, budget):
            print(f"{name}: stays as it is shipped, if it is; no scores of {', '.join(missing)}")
    used = {read_json(path)["training"] for path in PAPER.glob("*/results/*.json")}
    for folder in (PAPER / "store" / "trainings").iterdir():
        if folder.name not in used:
            shutil.rmtree(folder)
    files = [path for path in PAPER.rglob("*") if path.is_file()]
    weights = [path.stat().st_size for path in files if path.suffix == ".safetensors"]
    print(f"{len(files)} files, {sum(path.stat().st_size for path in files) / 1e6:.1f} MB in {PAPER}")
    print(f"{len(weights)} weights, {sum(weights) / 1e6:.1f} MB, the largest {max(weights) / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
