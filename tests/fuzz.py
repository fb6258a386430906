"""Damaged files of every kind that the library reads: `python -m tests.fuzz --mutants 100000 --seed 3`.

Each mutant of a small good file is read in a child process of bounded memory and time. It must be read, or refused by a
ValueError; any other error, a crash, a hang or a wish for memory is printed with its number, which makes it again
(`--only NUMBER`). Files are changed byte by byte, their numbers and words are exchanged for awkward ones, and what lies
inside a zip is changed before it is packed anew, so that mutants get past the checksums.
"""

from __future__ import annotations

import argparse
import io
import json
import multiprocessing
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import warnings
import zipfile
from collections import Counter
from pathlib import Path

import numpy as np
import torch

import tapip3d_lite as t3d
from tapip3d_lite.evaluation.benchmark import load_results, save_results
from tapip3d_lite.files import load_objects, map_npy
from tapip3d_lite.lab.papers import open_study
from tapip3d_lite.official import read_checkpoint
from tapip3d_lite.saved import read_saved
from tapip3d_lite.simulate import dataset
from tapip3d_lite.training.recipe import TrainConfig
from tapip3d_lite.training.run_folder import read_log
from tests.tiny import SIZES

SECONDS, MEGABYTES = 20, 1024  # of computing, and of memory beside what the program takes, for one mutant
AWKWARD = (
    b'0 -1 1 2 1e3 -0.5 NaN Infinity 1e999 99999999999999999999 "x" "" null true [] {} [1,2] {"a":1} \'O\' \xff'.split()
)


def seeds(folder: Path) -> dict[str, Path]:
    """Write a good file of each kind; where it stands in a folder of others, that is the kind's own."""
    places = {kind: folder / kind for kind in READERS}
    for place in places.values():
        place.mkdir(parents=True)
    clip = t3d.simulate_clip(0, frames=2, size=(16, 16), tracks=4, moving=(1, 1), resting=(0, 0))
    clip.save(places["clip"] / "x.npz")
    clip.tracks.save(places["tracks"] / "x.npz")
    t3d.save_weights(t3d.Tracker(t3d.TrackerConfig.preset("lite", **SIZES)), places["weights"] / "x.safetensors")
    values = {"a": ["${b}", 1.5], "model": {"image_size": [32, 32]}}
    torch.save({"cfg": values, "weight": {"b": torch.ones(3, 2)}, "n": np.float32(1)}, places["checkpoint"] / "x.pth")
    state = {"model": {"a": torch.ones(2)}, "step": 3, "position": 3.0, "seconds": 1.0, "optimizer": {"state": {}}}
    torch.save(state, places["state"] / "x.pt")
    (places["recipe"] / "x.json").write_text(json.dumps(TrainConfig().to_dict(), indent=1))
    save_results(places["results"] / "x.json", {"lite": {"slow": {"slow-00": {"AJ3D": 0.5, "OA": float("nan")}}}})
    dataset._claim(places["dataset"], t3d.SimulationConfig())
    study = {"rows": {"n2n": {}, "p2n": {"context": "p2n", "lr": 1e-4}}, "seeds": 1, "budget": "lab"}
    (places["study"] / "x.json").write_text(json.dumps(study))
    line = {"step": 1, "position": 1.0, "stage": "tracking", "loss": 0.5, "apd": None, "lr": 1e-4, "seconds": 2.0}
    (places["log"] / "log.jsonl").write_text((json.dumps(line) + "\n") * 3)
    np.save(places["features"] / "x.npy", np.ones((2, 40, 30), np.float16))
    np.save(places["objects"] / "x.npy", {"a": np.arange(300.0), "b": [1, "x"]}, allow_pickle=True)
    for kind in ("poses", "settings"):
        shutil.rmtree(places[kind])
        t3d.save_clip(clip, places[kind])
    names = {"poses": "poses.txt", "settings": "clip.json"}
    return {kind: place / names[kind] if kind in names else next(place.iterdir()) for kind, place in places.items()}


READERS = {
    "clip": t3d.load_clip,
    "tracks": t3d.load_tracks,
    "weights": t3d.load_weights,
    "checkpoint": read_checkpoint,
    "state": read_saved,
    "recipe": TrainConfig.read,
    "results": load_results,
    "dataset": lambda path: dataset._claim(path.parent, t3d.SimulationConfig()),
    "study": lambda path: (shutil.rmtree(path.parent / "runs", True), open_study(str(path), False)),
    "log": read_log,
    "features": lambda path: np.array(map_npy(path)),
    "objects": lambda path: load_objects(path, io.BytesIO(path.read_bytes())),
    "poses": lambda path: t3d.load_clip(path.parent),
    "settings": lambda path: t3d.load_clip(path.parent),
}


def mutant(data: bytes, rng: np.random.Generator) -> bytes:
    """A damaged copy."""
    if data[:2] == b"PK" and rng.random() < 0.7:
        return _repacked(data, rng)
    for _ in range(rng.choice(4, p=(0, 0.6, 0.2, 0.2))):
        data = _words(data, rng) if rng.random() < 0.5 else _bytes(data, rng)
    return data


def _bytes(data: bytes, rng: np.random.Generator) -> bytes:
    at, length = int(rng.integers(len(data) + 1)), int(rng.integers(1, 9))
    part, other = data[at : at + length], int(rng.integers(len(data) + 1))
    new = [
        rng.bytes(len(part)), b"", part * 2, bytes(x ^ 1 << int(rng.integers(8)) for x in part), b"\0" * len(part),
        b"\xff" * len(part), data[other : other + length], part + bytes(int(rng.integers(1, 2000))),
    ][rng.integers(8)]  # fmt: skip
    return data[:at] if rng.random() < 0.05 else data[:at] + new + data[at + length :]


def _words(data: bytes, rng: np.random.Generator) -> bytes:
    """One number or quoted word becomes an awkward one, another of the file's, or is left out."""
    found = list(
        re.finditer(rb"-?\d[\d.e+-]*|\"[^\"\n]*\"|'[^'\n]*'|\b(?:null|true|false|None|True|False)\b", data[:20000])
    )
    if not found:
        return _bytes(data, rng)
    a, b = (found[int(rng.integers(len(found)))] for _ in range(2))
    new = [AWKWARD[rng.integers(len(AWKWARD))], b[0], b""][rng.choice(3, p=(0.7, 0.2, 0.1))]
    return data[: a.start()] + new + data[a.end() :]


def _repacked(data: bytes, rng: np.random.Generator) -> bytes:
    """The same zip with one member changed, left out, renamed or twice the size."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as source, zipfile.ZipFile(buffer, "w") as target:
        chosen = int(rng.integers(len(source.namelist())))
        for i, name in enumerate(source.namelist()):
            content, kind = source.read(name), rng.random() if i == chosen else 1.0
            if kind < 0.8:
                content = _words(content, rng) if kind < 0.3 else _bytes(content, rng)
            if kind < 0.85:
                target.writestr(name, content)
            elif kind < 0.9:
                target.writestr(name[::-1], content)
            elif kind == 1.0:
                target.writestr(name, content)
    return buffer.getvalue()


def work(numbers: range, seed: int, pipe: object) -> None:
    """A child process: say which mutant is next, then what became of it."""

    def late(*_: object) -> None:
        raise TimeoutError(f"more than {SECONDS} s")

    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        good = seeds(Path(name))
        contents = {kind: path.read_bytes() for kind, path in good.items()}
        for kind, path in good.items():
            READERS[kind](path)
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + MEGABYTES * 2**20,) * 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        signal.signal(signal.SIGPROF, late)
        for number in numbers:
            kind = [*READERS][number % len(READERS)]
            pipe.send(number)
            good[kind].write_bytes(mutant(contents[kind], np.random.default_rng([seed, number])))
            signal.setitimer(signal.ITIMER_PROF, SECONDS)
            try:
                READERS[kind](good[kind])
                outcome = "read"
            except ValueError as error:
                outcome = "refused" if str(error) else "refused without a word"
            except BaseException as error:
                outcome = f"{type(error).__name__}: {error}"
            signal.setitimer(signal.ITIMER_PROF, 0)
            pipe.send(outcome)
    pipe.send(None)


def fuzz(numbers: range, seed: int) -> tuple[dict[str, Counter], dict[int, str]]:
    """How many mutants of each kind were read and refused; and what became of all others, by number."""
    counts, others, context = {kind: Counter() for kind in READERS}, {}, multiprocessing.get_context("spawn")
    while numbers:
        pipe, end = context.Pipe()
        child, number = context.Process(target=work, args=(numbers, seed, end)), None
        child.start()
        end.close()
        try:
            while (number := pipe.recv()) is not None:
                outcome = pipe.recv()
                counts[[*READERS][number % len(READERS)]][outcome if outcome in ("read", "refused") else "other"] += 1
                if outcome not in ("read", "refused"):
                    others[number] = outcome
            child.join()
            break
        except EOFError:
            child.join()
            if number is None:
                raise
            counts[[*READERS][number % len(READERS)]]["other"] += 1
            others[number] = f"the process ended with {child.exitcode}"
            numbers = numbers[numbers.index(number) + 1 :]
    return counts, others


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mutants", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, help="the number of one mutant")
    options = parser.parse_args()
    start = time.monotonic()
    numbers = range(options.mutants) if options.only is None else range(options.only, options.only + 1)
    counts, others = fuzz(numbers, options.seed)
    print("| file | mutants | read | refused | anything else |\n|---|---|---|---|---|")
    for kind, count in [*counts.items(), ("all", sum(counts.values(), Counter()))]:
        print(f"| {kind} | {count.total()} | {count['read']} | {count['refused']} | {count['other']} |")
    print(f"{time.monotonic() - start:.0f} s, seed {options.seed}, at most {MEGABYTES} MB and {SECONDS} s each")
    for number, outcome in others.items():
        print(f"{number} ({[*READERS][number % len(READERS)]}): {outcome[:300]}")
    return 1 if others else 0


if __name__ == "__main__":
    sys.exit(main())
