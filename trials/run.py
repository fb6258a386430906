"""Train rows that differ from `standard` in one option each, from one data set, encoder and feature store.

    python trials/run.py --prepare                                       clips, encoder and features, once
    python trials/run.py --rows standard muon … --seeds 0 1 2 --steps 1000 --jobs 2     (no --rows: all of ROWS)
    python trials/run.py --list

Each run is a folder runs/<row>-<seed>, continued from its checkpoint after a kill; it is done when scores.json is there.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROWS: dict[str, dict] = {
    "standard": {},
    "muon": {"trial": {"muon": 1.0}},  # factor of AdamW's learning rate; update RMS matched to AdamW's
    "grad2": {"trial": {"grad2": "smooth"}},
    "grad2-residual": {"trial": {"grad2": "residual"}},
    "grad2-full": {"trial": {"grad2": "full"}},
    "velocity": {"trial": {"velocity": 1.0}},
    "velocity-half": {"trial": {"velocity": 0.5}},
    "match": {"trial": {"match": 8}},
    "match-global": {"trial": {"match": 0}},
    "timebias": {"trial": {"timebias": "instead"}},
    "timebias-beside": {"trial": {"timebias": "beside"}},
    "scalars": {"trial": {"scalars": 0.0}},
    "scalars-0.1": {"trial": {"scalars": 0.1}},
    "zeroinit": {"trial": {"zeroinit": "updater"}},
    "zeroinit-all": {"trial": {"zeroinit": "all"}},
    "laplace": {"trial": {"spread": "one"}},
    "mixture": {"trial": {"spread": "mixture"}},
    "soften": {"loss": {"soften": 2.0}},
    "decay0": {"trial": {"cautious": 0.3}},
    "bf16": {"precision": "bfloat16"},
    # tuning, meant for one seed each
    "muon-0.3": {"trial": {"muon": 0.3}},
    "muon-3": {"trial": {"muon": 3.0}},
    "muon-10": {"trial": {"muon": 10.0}},
    "decay0-0.03": {"trial": {"cautious": 0.03}},
    "decay0-1": {"trial": {"cautious": 1.0}},
    "lr-0.5": {"lr": 0.75e-3},  # is the standard row's own rate right?
    "lr-2": {"lr": 3e-3},
}
TUNING = ("muon-0.3", "muon-3", "muon-10", "decay0-0.03", "decay0-1", "lr-0.5", "lr-2")
DEFAULT = [row for row in ROWS if row not in TUNING]


def one(row: str, seed: int, steps: int, out: Path) -> None:
    """Train and score one row with one seed, in this process."""
    folder = out / f"{row}-{seed}"
    if (folder / "scores.json").exists():
        return
    import numpy as np
    import setting
    import torch

    from tapip3d_lite.files import write_text
    from tapip3d_lite.training.loss import LossConfig
    from tapip3d_lite.training.run_folder import read_log
    from tapip3d_lite.training.trainer import Trainer

    torch.set_num_threads(1)
    changes = json.loads(json.dumps(ROWS[row]))
    if "loss" in changes:
        changes["loss"] = LossConfig(**({"visibility": 0.5} | changes["loss"]))
    trainer = Trainer(folder, setting.recipe(seed, steps, **changes), setting.training_paths(), resume=True)
    times, before = folder / "cpu.txt", time.process_time()
    for line in trainer.steps():
        now = time.process_time()
        with open(times, "a") as file:
            file.write(f"{line['step']} {now - before:.5f}\n")
        before = time.process_time()
        if line["step"] % 100 == 0:
            print(f"{row}-{seed} step {line['step']} loss {line['loss']:.4f}", flush=True)
    lines = [x.split() for x in times.read_text().splitlines()]
    spent = {x[0]: x[1] for x in lines if len(x) == 2}  # a step done twice counts once
    cpu = [float(x) for x in spent.values()]
    seconds = np.diff([x["seconds"] for x in read_log(folder)], prepend=0.0)
    clips = setting.held_out()
    result = {
        "row": row, "seed": seed, "steps": steps, "changes": ROWS[row],
        "code": subprocess.run(["git", "-C", str(setting.CODE), "rev-parse", "--short", "HEAD"], capture_output=True,
                               text=True).stdout.strip(),
        "parameters": sum(p.numel() for p in trainer.tracker.parameters()),
        "cpu_step": float(np.sort(cpu)[: max(1, int(0.95 * len(cpu)))].mean()),  # steps have one or two windows
        "cpu_median": float(np.median(cpu)),
        "wall_median": float(np.median(seconds)),
        "names": [clip.name for clip in clips],
        "average": score(trainer.average.eval(), clips),
        "last": score(trainer.tracker.eval(), clips),
    }  # fmt: skip
    write_text(folder / "scores.json", json.dumps(result, indent=1) + "\n")
    print(f"{row}-{seed} done", flush=True)


def score(tracker, clips) -> dict[str, list[float]]:
    """Scores of each clip, by name; "@0.5" where points are visible from probability 0.5 on instead of the model's own."""
    from dataclasses import replace

    import numpy as np

    from tapip3d_lite.evaluation.evaluate import evaluate

    own, table = getattr(getattr(tracker, "config", None), "visible_threshold", None), []
    for clip in clips:
        options = {} if own is None else {"support_grid": 0, "visible_threshold": 0.5}
        pred = tracker.track(clip, clip.queries, **options)
        scores = evaluate(pred, clip)
        if own is not None:
            strict = pred.visible & (1 / (1 + np.exp(-pred.visible_logits.astype(np.float64))) >= own)
            named = evaluate(replace(pred, visible=strict), clip)
            scores = named | {f"{name}@0.5": value for name, value in scores.items()}
        table.append(scores)
    return {name: [float(scores.get(name, np.nan)) for scores in table] for name in table[0]}


def baselines(out: Path) -> None:
    """Scores of zero motion and of Lucas-Kanade on the same clips."""
    import setting

    from tapip3d_lite.files import write_text
    from tapip3d_lite.trackers import load_tracker

    if not (out / "baselines.json").exists():
        clips = setting.held_out()
        found = {name: score(load_tracker(name), clips) for name in ("static", "klt")}
        write_text(out / "baselines.json", json.dumps(found, indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", nargs="+", default=DEFAULT, choices=list(ROWS), metavar="ROW")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--nice", type=int, default=10)
    parser.add_argument("--out", type=Path, default=HERE / "runs")
    parser.add_argument("--one", nargs=2, metavar=("ROW", "SEED"))
    parser.add_argument("--baselines", action="store_true")
    parser.add_argument("--prepare", action="store_true")
    parser.add_argument("--list", action="store_true")
    a = parser.parse_args()
    a.out.mkdir(parents=True, exist_ok=True)
    if a.list:
        for name, changes in ROWS.items():
            print(f"{name:16}{changes}{'   (tuning)' if name in TUNING else ''}")
    elif a.prepare:
        import setting

        setting.prepare()
    elif a.one:
        one(a.one[0], int(a.one[1]), a.steps, a.out)
    elif a.baselines:
        baselines(a.out)
    else:
        launch(a)


def launch(a: argparse.Namespace) -> None:
    """Run all rows of a seed before the next seed's, `jobs` at a time, each in its own process."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    command = ["nice", "-n", str(a.nice), sys.executable, str(HERE / "run.py"), "--out", str(a.out)]
    jobs = [(f"{row}-{seed}", ["--steps", str(a.steps), "--one", row, str(seed)]) for seed in a.seeds for row in a.rows]
    waiting = [(n, c) for n, c in jobs if not (a.out / n / "scores.json").exists()]
    if not (a.out / "baselines.json").exists():
        waiting.insert(0, ("baselines", ["--baselines"]))
    total, running, failed = len(waiting), {}, []
    started = time.time()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("terminated; the same command continues"))
    try:
        while waiting or running:
            while waiting and len(running) < a.jobs:
                name, options = waiting.pop(0)
                log = open(a.out / f"{name}.txt", "a")  # noqa: SIM115
                running[name] = subprocess.Popen([*command, *options], stdout=log, stderr=log, env=environment)
            time.sleep(1)
            for name in [n for n, process in running.items() if process.poll() is not None]:
                if running.pop(name).returncode:
                    failed.append(name)
                done = total - len(waiting) - len(running)
                minutes = (time.time() - started) / 60
                state = "FAILED, see its .txt" if name in failed else "done"
                print(f"[{minutes:6.1f} min] {done}/{total} {name} {state}", flush=True)
    finally:
        for process in running.values():
            process.terminate()
    if failed:
        sys.exit(f"failed: {' '.join(failed)}; the same command tries them again")


if __name__ == "__main__":
    main()
