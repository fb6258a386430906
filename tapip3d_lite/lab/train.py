"""Training with held-out scores: `make_trainer` for a program, `train` for the command `python -m tapip3d_lite train`."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import distributed

from tapip3d_lite.clip import Clip
from tapip3d_lite.evaluation.evaluate import evaluate, mean_scores
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.training.data import training_clips, training_config, validation_clips
from tapip3d_lite.training.recipe import TrainConfig, initial_weights
from tapip3d_lite.training.run_folder import RunFolder, check_folder
from tapip3d_lite.training.trainer import Trainer
from tapip3d_lite.validate import check_depths, check_device

_SCORES = ("AJ3D_none", "APD3D_none", "OA", "AJ3D_none_dynamic", "APD3D_none_dynamic", "APD3D_none_static")


def held_out_scores(clips: Sequence[Clip]) -> Callable[[Tracker], dict[str, float]]:
    """A function that gives a tracker's mean scores on held-out clips in world space, with names that begin `val_`.

    Args:
        clips: with true tracks; not trained on. If none says which points move, there are no scores of these.

    Raises:
        ValueError: a clip without true tracks.
    """
    for clip in clips:
        evaluate(clip.tracks, clip)  # what cannot be scored is refused now, not in the middle of a training

    def validate(tracker: Tracker) -> dict[str, float]:
        scores = mean_scores([evaluate(tracker.track(clip, clip.tracks.queries), clip) for clip in clips])
        return {f"val_{name}": round(scores[name], 4) for name in _SCORES if name in scores}

    return validate


def make_trainer(
    folder: str | Path, config: TrainConfig, clips: Sequence[Path], validation: Sequence[Clip] = (), **options: Any
) -> Trainer:
    """A trainer that also scores the tracker on held-out clips, every `config.evaluate_every` steps.

    `validation` are held-out clips with true tracks; without any the tracker is not scored. All other arguments
    (`options`: `device`, `resume`, `workers`, `compiled`, `encoder`) and the errors are those of `Trainer`.
    """
    for clip in validation:
        check_depths(clip.depths, config.tracker_config().window)
    return Trainer(folder, config, clips, held_out_scores(validation) if validation else None, **options)


def train(
    out: Path,
    config: TrainConfig,
    data: Path | None,
    resume: bool,
    device: str,
    workers: int | None = None,
    compiled: bool = False,
    allow: Sequence[str] = (),
) -> tuple[bool, str]:
    """Run one training in the folder `out`, with options as the command's; errors are a ValueError, as `Trainer`'s are.

    With `resume` the folder's own recipe is used; custom parts that it names must be allowed anew, by `config`, which
    names them too, or by modules that may be imported (`allow`): a folder is trusted no more than weights are. Missing clips are simulated in `data`, by default `out / "clips"`. By
    default a CPU has no worker processes, since it needs its cores for the training itself.

    Returns:
        Whether the training is finished, and a message for the user.
    """
    recipe, data = out / "config.json", data or out / "clips"
    if resume and not recipe.exists():
        raise ValueError(f"train: {out} holds no training to go on with; check the path, or leave --resume out")
    if resume:
        config = TrainConfig.read(recipe, [*allow, *config.custom])
    _refuse_at_once(config, device, workers, compiled)
    if workers is None:
        cores = (os.cpu_count() or 2) // int(os.environ.get("LOCAL_WORLD_SIZE", 1))
        workers = 0 if device == "cpu" else max(1, cores - 2)
    large = config.tracker_config().image_size > (128, 128)
    with _processes(device) as is_main:
        held_out = []
        if is_main:
            check_folder(out, config, resume)
            training_clips(data / "train", config.clips, large=large)
            held_out = validation_clips(data / "validation", config.validation) if config.validation else []
            RunFolder(out, config, resume)  # checked, and made, once for all processes
        _wait()
        clips = training_clips(data / "train", config.clips, progress=False, large=large)  # all are there
        if device == "cuda" and config.precision == "bfloat16":
            torch.set_float32_matmul_precision("high")  # TF32, for what is left in float32
        options = {"device": device, "resume": True, "workers": workers, "compiled": compiled}
        trainer = make_trainer(out, config, clips, held_out, **options)
        with interruptible() as stop:
            finished = trainer.run(stop)
        _wait()  # for the main process, which writes the weights
    if finished:
        return True, f"finished: {out / 'weights.safetensors'}"
    done = f"step {trainer.step} of {config.total}" if config.minutes is None else f"step {trainer.step}"
    return False, f"stopped and saved at {done}; continue with --resume"


def _refuse_at_once(config: TrainConfig, device: str, workers: int | None, compiled: bool) -> None:
    """Raise ValueError for what would fail only once the clips are simulated, or hours later."""
    check_device(device)
    if compiled and not device.startswith("cuda"):
        raise ValueError("train: only a GPU gains from compiling; add --device cuda, or leave --compiled out")
    if (workers or 0) < 0:
        raise ValueError(f"train: workers must not be negative, got {workers}")
    if config.frames[1] > (there := training_config(0).frames):
        raise ValueError(f"TrainConfig.frames: the simulated clips have {there} frames, got {config.frames}")
    if config.init is not None:
        initial_weights(config)


@contextlib.contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Yield a function that is true after the first Ctrl-C, so that a step is completed; the second one interrupts."""
    signals = []

    def handle(number: int, frame: object) -> None:
        if signals:
            raise KeyboardInterrupt
        signals.append(number)

    try:
        before = signal.signal(signal.SIGINT, handle)
    except ValueError:  # not the main thread, e.g. a notebook's
        yield lambda: False
        return
    try:
        yield lambda: bool(signals)
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def _processes(device: str) -> Iterator[bool]:
    """Join the processes that torchrun started, if it did; yields whether this is the main one."""
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
