"""A folder of simulated clips: written by all cores, one file a seed, continued after an interruption."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tqdm import tqdm

from tapip3d_lite.files import locked, read_json, write_text
from tapip3d_lite.simulate.settings import SimulationConfig
from tapip3d_lite.simulate.simulator import simulate_clip
from tapip3d_lite.validate import changed

DESCRIPTION = "dataset.json"
Recipe = Callable[[int], SimulationConfig]  # the configuration for a seed; at a module's top level: workers import it


def simulate_dataset(
    out: str | Path,
    count: int,
    config: SimulationConfig | Recipe | None = None,
    first_seed: int = 0,
    workers: int | None = None,
    progress: bool = True,
) -> list[Path]:
    """Write clips with the seeds first_seed ... first_seed + count - 1 into a folder.

    Clips that are there already are kept, so an interrupted run continues where it stopped and a larger `count` adds
    clips. Files appear only when complete. `dataset.json` holds the configuration. A script that calls this with
    several workers needs the usual `if __name__ == "__main__":`.

    Args:
        out: the folder; made if missing. Only one process may write to it at a time.
        count: number of clips.
        config: what they contain, or a function that returns it for each seed; default values if None.
        first_seed: non-negative.
        workers: processes; None for one per core.
        progress: show a bar.

    Returns:
        The paths of all `count` clips, in the order of their seeds.

    Raises:
        ValueError: bad number, or the folder holds clips of another configuration, or another process writes to it.
        BrokenProcessPool: as for `run_jobs`; the same call goes on.
    """
    processes = 1 if workers is None else workers
    for name, value, low in (("count", count, 1), ("first_seed", first_seed, 0), ("workers", processes, 1)):
        if not isinstance(value, int) or not low <= value <= 10**9:
            raise ValueError(
                f"simulate_dataset: {name} must be a whole number of at least {low}, at most 1e9, got {value!r}"
            )
    config, folder = config or SimulationConfig(), Path(out)
    _claim(folder, config)
    jobs = [(folder / f"clip_{seed:06d}.npz", seed, config) for seed in range(first_seed, first_seed + count)]
    missing = [job for job in jobs if not job[0].exists()]
    if missing:
        with (
            locked(folder / ".lock", "simulate_dataset: the folder"),
            tqdm(total=count, initial=count - len(missing), unit="clip", disable=not progress) as bar,
        ):
            for leftover in folder.glob(".clip_*.npz"):
                leftover.unlink(missing_ok=True)
            for _ in run_jobs(_write, missing, workers):
                bar.update()
    return [job[0] for job in jobs]


def run_jobs(function: Callable[[Any], Any], jobs: Sequence[Any], workers: int | None = None) -> Iterator[Any]:
    """Yield a function's result for each job as it is done: in this process, or by several workers in any order.

    The function stands at the top level of a module, since workers import it. `workers=None` is one per core. A job is a
    tuple that begins with the path that it writes.

    Raises:
        BrokenProcessPool: a worker was killed or could not start, and which jobs were at work; what was done is kept.
    """
    workers = min(workers or os.cpu_count() or 1, len(jobs))
    if workers <= 1:
        yield from map(function, jobs)
        return
    pool, futures = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), leave_interrupts), {}
    try:
        for job in jobs:  # begun in this order
            futures[pool.submit(function, job)] = job[0].stem
        for future in as_completed(list(futures)):
            yield future.result()
            del futures[future]
    except BrokenProcessPool:
        raise BrokenProcessPool(
            f"a worker process ended at work on {', '.join([*futures.values()][:workers])}: killed, e.g. for lack of memory (use "
            'fewer workers), or unable to start (a script needs `if __name__ == "__main__":`); what was done is kept, try again'
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)  # after those at work


def leave_interrupts(worker: int = 0) -> None:
    """Make a worker process ignore Ctrl-C, which its parent receives too; the parent then ends its workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _claim(folder: Path, config: SimulationConfig | Recipe) -> None:
    """Write the folder's description, or check that it is the same."""
    path, description = folder / DESCRIPTION, _describe(config)
    if path.exists():
        stored = read_json(path, lambda x: dict(x.get("simulation", x)))
        wanted = json.loads(json.dumps(description.get("simulation", description)))  # with lists for tuples
        if different := changed(stored, wanted):
            raise ValueError(
                f"simulate_dataset: {path} describes clips of another configuration: {different}; "
                "use the same settings or another folder"
            )
    elif any(folder.glob("clip_*.npz")):
        raise ValueError(f"simulate_dataset: {folder} holds clips but no {DESCRIPTION}; choose another folder")
    else:
        write_text(path, json.dumps(description, indent=2) + "\n")


def _describe(config: SimulationConfig | Recipe) -> dict:
    """What distinguishes this configuration from others; of a recipe its name and its values for a few seeds."""
    if isinstance(config, SimulationConfig):
        return {"simulation": asdict(config)}
    examples = {str(seed): asdict(config(seed)) for seed in range(4)}
    return {"recipe": f"{config.__module__}.{config.__qualname__}", "examples": examples}


def _write(job: tuple[Path, int, SimulationConfig | Recipe]) -> None:
    path, seed, config = job
    simulate_clip(seed, config if isinstance(config, SimulationConfig) else config(seed)).save(path)
