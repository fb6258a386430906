"""The work of a study: train the encoder, train a row, score it; and who does it, this process or several at once."""

from __future__ import annotations

import contextlib
import errno
import json
import multiprocessing
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from tapip3d_lite.clip import Clip
from tapip3d_lite.evaluation.baselines import TrackerLike
from tapip3d_lite.evaluation.evaluate import evaluate
from tapip3d_lite.files import locked, write_text
from tapip3d_lite.lab.budgets import Budget, Data, judged_clip, trusted_recipe
from tapip3d_lite.lab.conditions import under
from tapip3d_lite.lab.train import make_trainer
from tapip3d_lite.lab.variant import Variant
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.model.weights import save_weights
from tapip3d_lite.simulate.dataset import leave_interrupts
from tapip3d_lite.trackers import load_tracker
from tapip3d_lite.training.run_folder import read_log

STOPPED, _FULL = "stopped", "the disk is full"
Tell = Callable[[int], None]  # says how many steps of a job are done
Stop = Callable[[], bool]


@dataclass(frozen=True)
class Job:
    """A training with the rows that are scored by it; plain values, so that another process can do it.

    Attributes:
        name: for messages.
        folder: of the training; None: the rows' trackers are given.
        recipe: as a dictionary.
        encoder: folder of the encoder that is taken over; None: this job trains it.
        rows: (row as a dictionary with its name, file of its scores, what stands in it beside the scores).
        budget: as a dictionary.
    """

    name: str
    folder: Path | None
    recipe: dict[str, Any] | None
    encoder: Path | None
    rows: tuple[tuple[dict[str, Any], Path, dict[str, Any]], ...]
    data: Data
    budget: dict[str, Any]
    device: str = "cpu"

    @property
    def custom(self) -> list[Any]:
        """Custom parts of the recipe."""
        return [] if self.recipe is None else trusted_recipe(self.recipe).custom

    @property
    def steps(self) -> int:
        """Steps of the training."""
        if self.recipe is None:
            return 0
        return self.recipe["steps"] if self.encoder else self.recipe["matching_steps"]


def do(job: Job, tell: Tell, stop: Stop) -> str:
    """Do a job in this process: `"done"`, or `"stopped"`, from where the same job goes on exactly."""
    if job.folder is not None:
        job.folder.mkdir(parents=True, exist_ok=True)
        with _alone(job.folder, stop) as alone:
            if not alone or not _trained(job, tell, stop):
                return STOPPED
    clips = [judged_clip(path, Budget.from_dict(job.budget)) for path in job.data.held_out] if job.rows else []
    for values, file, facts in job.rows:
        if stop():
            return STOPPED
        row = Variant(**values)
        tracker = tracker_of(row, job.folder, job.device, job.custom)
        scores = score(tracker, row, clips)
        costs = track_costs(tracker, clips[0], row.options()) | (step_costs(job.folder) if job.folder else {})
        write_text(file, json.dumps({**facts, "device": job.device, "costs": costs, "scores": scores}, indent=1) + "\n")
    return "done"


def _trained(job: Job, tell: Tell, stop: Stop) -> bool:
    """Train, or go on, until the weights are there; False where it was stopped."""
    weights = job.folder / "weights.safetensors"
    if not weights.exists():
        recipe, budget = trusted_recipe(job.recipe), Budget.from_dict(job.budget)
        watched = [judged_clip(path, budget) for path in job.data.watched] if job.encoder else []
        options = {"device": job.device, "resume": True, "encoder": job.encoder}
        trainer = make_trainer(job.folder, recipe, job.data.train, watched, **options)
        first = job.encoder is None  # the encoder's job ends with the first stage

        def halt() -> bool:
            tell(trainer.step)
            return stop() or (first and not trainer.schedule.matching)

        if trainer.schedule.matching or not first:
            trainer.run(halt, progress=False)
        if first and not trainer.schedule.matching:
            save_weights(trainer.average, weights)
    if weights.exists():
        tell(job.steps)
    return weights.exists()


def tracker_of(row: Variant, folder: Path | str | None, device: str = "cpu", custom: Sequence[Any] = ()) -> TrackerLike:
    """A row's tracker, given or from the folder of its training, with the fields that the row changes after it.

    `custom` are the row's own parts, which the weights may name.
    """
    path = row.given if folder is None else Path(folder) / "weights.safetensors"
    tracker = load_tracker(path, device, parts=list(custom))
    changed = row.test_fields()
    if not changed:
        return tracker
    if not isinstance(tracker, Tracker):
        raise ValueError(f"row {row.name!r}: {row.given} has no {', '.join(changed)}; only a learnt tracker has")
    other = Tracker(tracker.config.replace(**changed))
    other.load_state_dict(tracker.state_dict())
    return other.to(device).eval()


def score(tracker: TrackerLike, row: Variant, clips: Sequence[Clip]) -> dict[str, dict[str, float | None]]:
    """Scores by clip under the row's condition; None where one is undefined."""
    scores = {}
    for index, clip in enumerate(clips):
        seen = under(clip, row.degrade, index)
        found = evaluate(tracker.track(seen, **row.options()), seen)
        scores[clip.name] = {name: None if value != value else round(value, 6) for name, value in found.items()}
    return scores


def track_costs(tracker: TrackerLike, clip: Clip, options: dict[str, Any]) -> dict[str, float]:
    """Parameters, and multiply-adds for each query and frame of a call of `track`, its encoder included."""
    if not isinstance(tracker, Tracker):
        return {}
    with FlopCounterMode(display=False) as counter:
        tracker.track(clip, **options)
    count = counter.get_total_flops() / 2 / len(clip) / len(clip.queries)
    return {"parameters": sum(p.numel() for p in tracker.parameters()), "multiply_adds": round(count)}


def step_costs(folder: Path) -> dict[str, float]:
    """Steps of a training, and the median time of one in milliseconds."""
    seconds = [0.0, *(line["seconds"] for line in read_log(folder))]
    taken = [b - a for a, b in pairwise(seconds)]
    return {"steps": len(taken), "step_ms": round(1000 * statistics.median(taken), 2)}


def probe(job: Job, folder: Path) -> tuple[float, float]:
    """Seconds and floating-point operations of a training step (the median, the mean), tried in a folder of its own."""
    recipe = trusted_recipe({**job.recipe, "steps": 8, "short": 0.0, "validation": 0, "save_every": 100})
    trainer = make_trainer(folder, recipe, job.data.train, device=job.device, encoder=job.encoder)
    steps = trainer.steps()
    with FlopCounterMode(display=False) as counter:
        seconds = [next(steps)["seconds"] for _ in range(3)]
    seconds = [*seconds[-1:], *(line["seconds"] for line in steps)]
    taken = statistics.median(b - a for a, b in pairwise(seconds))
    return taken, counter.get_total_flops() / 3


def do_all(jobs: Sequence[Job], processes: int, tell: Callable[[str, int], None], stop: Stop) -> dict[str, str]:
    """Do jobs, at most so many at once; what became of each: `"done"`, `"stopped"`, or one line that says what failed.

    A job that fails, or whose process dies, leaves the others alone. A full disk stops all: ValueError.
    """
    ended, running, waiting, context = {}, {}, list(jobs), multiprocessing.get_context("spawn")
    if processes == 1:
        for job in jobs:
            ended[job.name] = STOPPED if stop() else _unless_full(_tried(job, partial(tell, job.name), stop))
        return ended
    try:
        while waiting or running:
            if stop():
                ended |= {job.name: STOPPED for job in waiting}
                waiting = []
                for connection in running:
                    with contextlib.suppress(OSError):
                        connection.send(STOPPED)
            while waiting and len(running) < processes:
                ours, theirs = context.Pipe()
                process = context.Process(target=_in_process, args=(waiting[0], theirs), daemon=True)
                running[ours] = process, waiting.pop(0)
                process.start()
                theirs.close()
            for connection in wait(list(running), 0.2):
                process, job = running[connection]
                outcome = _heard(connection, process)
                if isinstance(outcome, int):
                    tell(job.name, outcome)
                    continue
                process.join()
                del running[connection]
                ended[job.name] = _unless_full(outcome)
    finally:
        for connection, (process, _) in running.items():  # after a second Ctrl-C, or where the disk is full
            process.terminate()
            process.join()
            connection.close()
    return ended


def _in_process(job: Job, connection: Any) -> None:
    """A worker process: whatever the parent sends, and its end, is a wish to stop."""
    leave_interrupts()

    def say(what: int | str) -> None:
        with contextlib.suppress(OSError):  # there is no parent any more
            connection.send(what)

    say(_tried(job, say, connection.poll))


def _heard(connection: Any, process: Any) -> int | str:
    """What a worker says: steps done, or how the job ended, which a dead one cannot say."""
    try:
        return connection.recv()
    except (EOFError, OSError):
        process.join()
        killed = f"by signal {-process.exitcode}, e.g. out of memory" if process.exitcode < 0 else "with an error"
        return f"its process ended {killed}"


def _tried(job: Job, tell: Tell, stop: Stop) -> str:
    """What became of a job; one thread does it, so that several at once leave each other alone, and sums have one order."""
    threads, told = torch.get_num_threads(), [0.0]

    def now_and_then(steps: int) -> None:
        if time.monotonic() - told[0] > 0.3 or steps == job.steps:
            told[0] = time.monotonic()
            tell(steps)

    torch.set_num_threads(1)
    try:
        return do(job, now_and_then, stop)
    except Exception as error:  # whatever a custom part raises
        full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)
        return _FULL if full else f"{type(error).__name__}: {error}".splitlines()[0]
    finally:
        torch.set_num_threads(threads)


def _unless_full(outcome: str) -> str:
    if outcome == _FULL:
        raise ValueError(f"Study: {_FULL}; make room and run it again: what was saved is kept, and it goes on there")
    return outcome


@contextlib.contextmanager
def _alone(folder: Path, stop: Stop) -> Iterator[bool]:
    """Wait until no other process works in a folder; a lock that its death releases. False where it was stopped."""
    with contextlib.ExitStack() as held:
        while True:
            try:
                held.enter_context(locked(folder / ".job", "Study: a training"))
                break
            except ValueError:
                if stop():
                    yield False
                    return
                time.sleep(0.2)
        yield True
