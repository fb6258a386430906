"""The work of a study: train the encoder, train a row, score it; and who does it, this process or several at once."""

from __future__ import annotations

import contextlib
import errno
import json
import multiprocessing
import statistics
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from tapip3d_lite.clip import Clip
from tapip3d_lite.evaluation.baselines import TrackerLike
from tapip3d_lite.evaluation.evaluate import evaluate
from tapip3d_lite.files import write_text
from tapip3d_lite.lab.budgets import Budget, Data, judged_clip
from tapip3d_lite.lab.conditions import under
from tapip3d_lite.lab.train import make_trainer
from tapip3d_lite.lab.variant import Variant
from tapip3d_lite.measures import flawed_on_purpose
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.model.weights import save_weights
from tapip3d_lite.simulate.dataset import leave_interrupts
from tapip3d_lite.trackers import load_tracker
from tapip3d_lite.training.recipe import TrainConfig
from tapip3d_lite.training.run_folder import read_log

STOPPED, _FULL = "stopped", "the disk is full"
Tell = Callable[[int], None]  # says how many steps of a job are done
Stop = Callable[[], bool]


@dataclass(frozen=True)
class Job:
    """A training with the rows that are scored by it.

    Attributes:
        name: for messages.
        folder: of the training; None: the rows' trackers are given.
        recipe: of the training.
        encoder: folder of the encoder that is taken over; None: this job trains it.
        rows: (row, file of its scores, what stands in it beside the scores).
    """

    name: str
    folder: Path | None
    recipe: TrainConfig | None
    encoder: Path | None
    rows: tuple[tuple[Variant, Path, dict[str, Any]], ...]
    data: Data
    budget: Budget
    device: str = "cpu"

    @property
    def steps(self) -> int:
        """Steps of the training."""
        return 0 if self.recipe is None else self.recipe.steps if self.encoder else self.recipe.matching_steps


def do(job: Job, tell: Tell, stop: Stop) -> str:
    """Do a job in this process: `"done"`, or `"stopped"`, from where the same job goes on exactly."""
    if job.folder is not None and not _trained(job, tell, stop):
        return STOPPED
    clips = [judged_clip(path, job.budget) for path in job.data.held_out] if job.rows else []
    for row, file, facts in job.rows:
        if stop():
            return STOPPED
        tracker = tracker_of(row, job.folder, job.device, job.recipe.custom if job.recipe else ())
        scores = score(tracker, row, clips)
        costs = track_costs(tracker, clips[0], row.options()) | (step_costs(job.folder) if job.folder else {})
        write_text(file, json.dumps({**facts, "device": job.device, "costs": costs, "scores": scores}, indent=1) + "\n")
    return "done"


def _trained(job: Job, tell: Tell, stop: Stop) -> bool:
    """Train, or go on, until the weights are there; False where it was stopped."""
    weights = job.folder / "weights.safetensors"
    if not weights.exists():
        watched = [judged_clip(path, job.budget) for path in job.data.watched] if job.encoder else []
        options = {"device": job.device, "resume": True, "encoder": job.encoder}
        trainer = make_trainer(job.folder, job.recipe, job.data.train, watched, **options)
        first = job.encoder is None  # the encoder's job ends with the first stage

        def halt() -> bool:
            tell(int(trainer.schedule.position))
            return stop() or (first and not trainer.schedule.matching)

        if trainer.schedule.matching or not first:
            trainer.run(halt, progress=False)
            if job.recipe.minutes and trainer.step == 1:
                raise ValueError(f"{job.recipe.minutes:g} minutes fit no step: one takes {trainer.seconds:.2g} seconds")
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


@flawed_on_purpose()
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
    count = _counted(tracker, clip, options)["Global"] / 2 / len(clip) / len(clip.queries)
    return {"parameters": sum(p.numel() for p in tracker.parameters()), "multiply_adds": round(count)}


def step_flops(recipe: TrainConfig) -> float:
    """Floating-point operations of a training step, about: three times those of its forward pass.

    A stored encoder costs none. The mean over the recipe's lengths of examples and numbers of updates.
    """

    def forward(frames: int, iterations: int) -> float:
        camera = np.array([[width, 0, (width - 1) / 2], [0, width, (height - 1) / 2], [0, 0, 1]], np.float32)
        cameras = np.repeat(camera[None], frames, 0), np.repeat(np.eye(4, dtype=np.float32)[None], frames, 0)
        queries = np.tile(np.float32([0, 0, 0, 1]), (recipe.sampling.tracks, 1))
        flat = np.ones((frames, height, width), np.float32)
        clip = Clip(np.zeros((*flat.shape, 3), np.uint8), flat, *cameras, queries)
        of = _counted(tracker, clip, {"support_grid": 0, "iterations": iterations})
        return of["Global"] - (0 if recipe.train_encoder else of[type(tracker.encoder).__name__])

    tracker = Tracker(recipe.tracker_config()).eval()
    height, width = tracker.config.image_size
    (few, many), (least, most) = recipe.frames, recipe.iterations
    start, rest = forward(few, least), [forward(s, m) for s in {few, many} for m in {least, most}]
    return 3 * recipe.batch * (recipe.short * start + (1 - recipe.short) * statistics.mean(rest))


def _counted(tracker: Tracker, clip: Clip, options: dict[str, Any]) -> dict[str, int]:
    """Floating-point operations of a call of `track`, by the module that does them; `"Global"`: all."""
    tracker.requires_grad_(False)  # the counter would ask views of parameters, which have no history here, for theirs
    with FlopCounterMode(display=False) as counter:
        tracker.track(clip, **options)
    return {part: sum(counts.values()) for part, counts in counter.get_flop_counts().items()}


def step_costs(folder: Path) -> dict[str, float]:
    """Steps of a training, and the median time of one in milliseconds."""
    seconds = [0.0, *(line["seconds"] for line in read_log(folder))]
    taken = [b - a for a, b in pairwise(seconds)]
    return {"steps": len(taken), "step_ms": round(1000 * statistics.median(taken), 2)}


def do_all(jobs: Sequence[Job], processes: int, tell: Callable[[str, int], None], stop: Stop) -> dict[str, str]:
    """Do jobs, at most so many at once; what became of each: `"done"`, `"stopped"`, or one line that says what failed.

    A job that fails, or whose process dies, leaves the others alone. A full disk stops all: ValueError.
    """
    ended: dict[str, str] = {}

    def halt() -> bool:
        return stop() or _FULL in ended.values()

    def one(job: Job) -> None:
        work = _tried if processes == 1 else _elsewhere
        ended[job.name] = STOPPED if halt() else work(job, partial(tell, job.name), halt)

    if processes == 1:
        for job in jobs:
            one(job)
    else:
        with ThreadPoolExecutor(processes) as threads:  # each waits for a process
            list(threads.map(one, jobs))
    if _FULL in ended.values():
        raise ValueError(f"Study: {_FULL}; make room and run it again: what was saved is kept, and it goes on there")
    return ended


def _elsewhere(job: Job, tell: Tell, stop: Stop) -> str:
    """What became of a job in a process of its own, which says steps done, and at last how the job ended."""
    context, asked = multiprocessing.get_context("spawn"), False
    ours, theirs = context.Pipe()
    process = context.Process(target=_in_process, args=(job, theirs), daemon=True)
    process.start()
    theirs.close()
    try:
        while True:
            if stop() and not asked:
                asked = True
                ours.send(STOPPED)
            if ours.poll(0.2):
                said = ours.recv()
                if isinstance(said, str):
                    return said
                tell(said)
    except (EOFError, OSError):  # a dead one says nothing
        process.join()
        killed = f"by signal {-process.exitcode}, e.g. out of memory" if process.exitcode < 0 else "with an error"
        return f"its process ended {killed}"
    finally:
        process.join()


def _in_process(job: Job, connection: Any) -> None:
    """A worker process: whatever the parent sends, and its end, is a wish to stop."""
    leave_interrupts()

    def say(what: int | str) -> None:
        with contextlib.suppress(OSError):  # there is no parent any more
            connection.send(what)

    say(_tried(job, say, connection.poll))


def _tried(job: Job, tell: Tell, stop: Stop) -> str:
    """What became of a job; one thread does it, so that several at once leave each other alone, and sums have one order."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return do(job, tell, stop)
    except Exception as error:  # whatever a custom part raises
        full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)
        return _FULL if full else f"{type(error).__name__}: {error}".splitlines()[0]
    finally:
        torch.set_num_threads(threads)
