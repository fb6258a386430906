"""`python -m tapip3d_lite train`: make the clips, train, stop cleanly on Ctrl-C, say what came out."""

from __future__ import annotations

import contextlib
import json
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from torch import distributed

from tapip3d_lite.training.config import TrainConfig
from tapip3d_lite.training.data import training_clips, validation_clips
from tapip3d_lite.training.journal import Journal
from tapip3d_lite.training.trainer import Trainer


def train(
    out: Path,
    config: TrainConfig,
    data: Path | None,
    resume: bool,
    device: str,
    workers: int | None = None,
    compiled: bool = False,
    progress: bool = True,
) -> tuple[bool, str]:
    """Run one training in a folder.

    Args:
        out: the training's folder.
        config: the recipe; with `resume` the folder's own recipe is used instead.
        data: folder of the clips, shared by trainings; `out / "clips"` if None. Missing clips are simulated.
        resume: continue.
        device: `"cpu"` or `"cuda"`.
        workers: see `Trainer`; None: none on a CPU, which they would take from training, else cores less two.
        compiled: see `Trainer`.
        progress: show bars.

    Returns:
        Whether it is finished, and what to tell the user.

    Raises:
        ValueError: see `Trainer`; also for a GPU that is not there, or compiling without one.
    """
    recipe = Path(out) / "config.json"
    if resume and recipe.exists():
        config = TrainConfig.from_dict(json.loads(recipe.read_text()))
    data = Path(out) / "clips" if data is None else Path(data)
    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError("train: torch sees no CUDA device; leave --device out to train on the CPU")
    if compiled and device != "cuda":
        raise ValueError("train: only a GPU gains from compiling; add --device cuda, or leave --compiled out")
    if workers is None:
        cores = (os.cpu_count() or 2) // int(os.environ.get("LOCAL_WORLD_SIZE", 1))
        workers = 0 if device == "cpu" else max(1, cores - 2)
    large = config.tracker_config().image_size > (128, 128)
    with _processes(device) as leads:
        progress = progress and leads
        if leads:
            clips = training_clips(data / "train", config.clips, progress, large=large)
            held_out = validation_clips(data / "validation", config.validation, progress) if config.validation else []
            Journal(out, config, resume)  # refuses, or founds the folder, once for all processes
        _wait()
        if not leads:
            clips, held_out = training_clips(data / "train", config.clips, False, large=large), []
        if device == "cuda" and config.precision == "bfloat16":
            torch.set_float32_matmul_precision("high")  # TF32, for what is left in float32
        trainer = Trainer(out, config, clips, held_out, device, True, workers, compiled)
        with interruptible() as stop:
            finished = trainer.run(stop, progress=progress)
        _wait()  # for the leader, which writes the weights
    if finished:
        return True, f"finished: {Path(out) / 'weights.safetensors'}"
    return False, f"stopped and saved at step {trainer.step} of {config.total}; continue with --resume"


@contextlib.contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Turn the first Ctrl-C into a wish to stop, so that a step is never cut in two; the second one interrupts."""
    wishes = []

    def handle(number: int, frame: object) -> None:
        if wishes:
            raise KeyboardInterrupt
        wishes.append(number)

    try:
        before = signal.signal(signal.SIGINT, handle)
    except ValueError:  # not the main thread, e.g. a notebook's
        yield lambda: False
        return
    try:
        yield lambda: bool(wishes)
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def _processes(device: str) -> Iterator[bool]:
    """Join the processes that torchrun started, if it did; yields whether this one leads."""
    if "RANK" not in os.environ:
        yield True
        return
    if device == "cuda":
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    distributed.init_process_group("nccl" if device == "cuda" else "gloo")
    try:
        yield distributed.get_rank() == 0
    finally:
        distributed.destroy_process_group()


def _wait() -> None:
    if distributed.is_initialized():
        distributed.barrier()
