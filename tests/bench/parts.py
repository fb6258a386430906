"""The parts of the bench: each yields rows that compare ways of computing the same.

Weights are random: neither time nor the differences between the ways depend on them. The paper's section on run time
finds that k-NN and N2N attention take nearly all of it.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from lessons.backward_ways import plain_backward, saving_backward
from lessons.saved_bytes import SavedBytes
from tapip3d_lite.clip import Clip
from tapip3d_lite.model import track as inference
from tapip3d_lite.model.cloud import feature_cloud
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.frames import frames_from_clip, resize_clip
from tapip3d_lite.model.neighbors import knn
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.simulate import simulate_clip
from tapip3d_lite.speed.box_knn import BlockTree
from tapip3d_lite.training.data import training_clips
from tapip3d_lite.training.loss import LossConfig, Truth
from tapip3d_lite.training.recipe import TrainConfig
from tapip3d_lite.training.trainer import Trainer
from tests.bench.report import Row, compared
from tests.bench.timing import extra_memory, own_clock, side_by_side, stages

SLOW, FAST, SHORT, COMPILED = "straightforward", "fast", "fast, bf16", "fast, bf16, compiled"
KEPT = "fast, features kept"  # of the frozen encoder, as `train` does by default
MODULES = {"encoder": "encoder", "k-NN": "neighborhood", "context": "context", "updater": "updater"}
Rows, Runs = Iterator[Row], dict[str, Callable[[], Any]]


def make_tracker(preset: str = "lite", fast: bool = True, **changes: Any) -> Tracker:
    """A tracker with random weights; `fast=False`: the clear form, and brute-force neighbours."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return Tracker(TrackerConfig.preset(preset, **changes), fast).eval()


def make_clip(frames: int, tracks: int, size: tuple[int, int]) -> Clip:
    """A simulated clip with true tracks, rendered at half the size, which is enough to measure speed."""
    clip = simulate_clip(seed=0, frames=frames, size=(size[0] // 2, size[1] // 2), tracks=tracks)
    return replace(resize_clip(clip, size), queries=clip.queries, tracks=clip.tracks)


def tracking(clip: Clip, tracker: Tracker, bf16: bool = False, device: str = "cpu") -> Callable[[], Tensor]:
    """A function that tracks the clip's queries once, from frames that are there already."""
    frames, queries = frames_from_clip(clip, device=device), torch.from_numpy(clip.queries)[None].to(device)

    @torch.no_grad()
    def run() -> Tensor:
        with torch.autocast(device, torch.bfloat16, enabled=bf16):
            return tracker(frames, queries)[0].cpu()

    return run


def bench_model(
    quick: bool = False, rounds: int = 3, counts: Sequence[int] = (128, 512, 1024), iterations: int = 6
) -> Rows:
    """The paper's model on 16 frames: straightforward, fast, and fast in bfloat16; by stage, with peak memory."""
    size, counts, iterations = ((96, 128), [16], 1) if quick else ((384, 512), counts, iterations)
    changes = {"image_size": size, "iterations": iterations} | ({"levels": 2} if quick else {})
    trackers = {way: make_tracker("paper", way != SLOW, **changes) for way in (SLOW, FAST, SHORT)}
    for count in counts:
        clip, case = make_clip(16, count, size), f"{count} queries" + ", 1 iteration" * (iterations == 1)
        runs = {way: tracking(clip, tracker, way == SHORT) for way, tracker in trackers.items()}
        spent, results = {way: [] for way in runs}, {}
        for _ in range(rounds if count <= 128 else -(-rounds // 3)):  # without a warm-up: the larger take minutes
            for way, run in runs.items():
                results[way], seconds = _by_stage(run, trackers[way])
                spent[way].append(seconds)
        values: dict[str, dict[str, float]] = {way: {} for way in runs}
        for way in (FAST, SHORT):
            error = (results[way] - results[SLOW]).norm(dim=-1).flatten()
            values[way] = {"median difference": float(error.median()), "largest difference": float(error.max())}
        for way in runs if count == 512 or quick else ():
            grown = extra_memory(_ready_model, count, size, changes, way)
            values[way] |= {} if grown is None else {"MiB": grown[0]}
        for stage in spent[SLOW][0]:
            seconds = {way: [spent_once[stage] for spent_once in spent[way]] for way in runs}
            yield from compared("model", case + stage, seconds, None if stage else values)


def _by_stage(run: Callable[[], Tensor], tracker: Tracker) -> tuple[Tensor, dict[str, float]]:
    calls = {f": {stage}": (getattr(tracker, name), "forward") for stage, name in MODULES.items()}
    with stages(calls, own_clock(), rest=": the rest", whole="") as seconds:
        result = run()
    return result, seconds


def _ready_model(count: int, size: tuple[int, int], changes: dict, way: str) -> Callable[[], Any]:
    changes = changes | {"iterations": 1}  # memory does not depend on their number
    tracker = make_tracker("paper", way != SLOW, **changes)
    return tracking(make_clip(16, count, size), tracker, way == SHORT)


def bench_knn(quick: bool = False, rounds: int = 5) -> Rows:
    """Nearest neighbours, K = 32: trees of boxes, brute force, torch's cdist and topk, SciPy's cKDTree."""
    frames, count, height, width, levels = (4, 256, 48, 64, 2) if quick else (16, 1024, 96, 128, 4)
    clip = make_clip(frames, count, (4 * height, 4 * width))
    points, queries = torch.from_numpy(clip.points())[None], torch.from_numpy(clip.tracks.xyz)
    known = torch.ones(points.shape[:-1], dtype=torch.bool)
    cloud = feature_cloud(torch.zeros(1, frames, 1, height, width), points, known, levels)
    cases = {}
    for level in cloud:
        maps = level.points[0].contiguous()
        cases[f"maps {maps.shape[1]}x{maps.shape[2]}"] = side_by_side(_knn_ways(queries, maps), rounds, own_clock())
    ways = [*next(iter(cases.values()))]
    cases["all maps"] = {way: np.sum([case[way] for case in cases.values()], 0).tolist() for way in ways}
    for name, seconds in cases.items():
        yield from compared("k-NN", name, seconds, than=min(ways[:-2], key=lambda way: np.median(seconds[way])))
    if "cKDTree" not in ways:
        yield Row("k-NN", "cKDTree was not measured: SciPy is not installed")


def _knn_ways(queries: Tensor, maps: Tensor, count: int = 32) -> Runs:
    """Others' ways first, then ours."""
    flat = maps.flatten(1, 2)
    pairs = list(zip(queries, flat, strict=True))
    ways: Runs = {"cdist + topk": lambda: [torch.cdist(x, y).topk(count, largest=False).indices for x, y in pairs]}
    try:
        from scipy.spatial import cKDTree
    except ImportError:  # nothing else needs it
        pass
    else:
        workers = torch.get_num_threads()
        ways["cKDTree"] = lambda: [cKDTree(y.numpy()).query(x.numpy(), count, workers=workers) for x, y in pairs]
    ours = {"brute force": lambda: knn(queries, flat, count)}
    return ways | ours | {"trees of boxes": lambda: BlockTree.build(maps).knn(queries, count)}


def example(clip: Clip) -> tuple[Any, Tensor, Truth, LossConfig]:
    """Frames, queries, truth and loss of a clip, as the backward passes take them."""
    truth = clip.tracks.xyz, clip.tracks.visible, clip.queries[:, 0].astype(int)
    queries = torch.from_numpy(clip.queries)[None]
    return frames_from_clip(clip), queries, Truth(*(torch.from_numpy(x)[None] for x in truth)), LossConfig()


def bench_training(quick: bool = False, rounds: int = 5) -> Rows:
    """Forward and backward pass of one training step of `lite`."""
    size, count, frames = ((64, 64), 32, 8) if quick else ((128, 128), 128, 12)
    trackers = {way: make_tracker(fast=way == FAST, image_size=size).train() for way in (SLOW, FAST)}
    for tracker in trackers.values():
        tracker.encoder.requires_grad_(False)
    case = example(make_clip(frames, count, size))
    runs: Runs = {way: partial(saving_backward, tracker, *case) for way, tracker in trackers.items()}
    with torch.no_grad():
        runs[KEPT] = partial(runs[FAST], features=trackers[FAST].encoder(case[0].rgb))
    seconds = side_by_side(runs, rounds, own_clock())
    yield from compared("training", f"step of lite, {frames} frames, {count} queries", seconds)


def bench_step(quick: bool = False, rounds: int = 10) -> Rows:
    """Where the time of a training's first steps goes, and the bytes that backward keeps by two ways."""
    sizes = {"image_size": (64, 64), "levels": 2} if quick else {}
    changes = {"tracker": sizes, "matching_steps": 0, "validation": 0, "save_every": 10**9}
    for encoder in (False, True):
        with tempfile.TemporaryDirectory() as folder:
            clips = training_clips(Path(folder) / "clips", 2, progress=False, workers=1)
            config = TrainConfig.recipe(train_encoder=encoder, **changes)
            spent = step_split(Trainer(Path(folder) / "run", config, clips), rounds)
        whole = np.median([once["whole step"] for once in spent])
        for name in spent[0]:
            seconds = [once[name] for once in spent]
            values = {"share": float(np.median(seconds) / whole)}
            yield Row("step", "lite, encoder trained" if encoder else "lite", name, seconds, values)
    tracker, tracks = make_tracker(**sizes).train(), 16 if quick else 48
    tracker.encoder.requires_grad_(False)
    for updates, windows in [(1, 1), (2, 1), (1, 2)] if quick else [(1, 1), (2, 1), (4, 1), (6, 1), (1, 2), (1, 4)]:
        frames = (windows + 1) * tracker.config.window // 2
        case = example(simulate_clip(frames=frames, tracks=tracks, size=tracker.config.image_size))
        for way, backward in (("saving", saving_backward), ("plain", plain_backward)):
            tracker.zero_grad()
            with SavedBytes() as memory:
                backward(tracker, *case, iterations=updates)
            yield Row("step", f"M = {updates}, windows: {windows}", way, values={"MB kept": memory.most / 1e6})


def step_split(trainer: Trainer, steps: int, warm: int = 3) -> list[dict[str, float]]:
    """Seconds of the parts of each tracking step after the first `warm`, which also encode clips and keep features."""
    tracker = trainer.tracker
    calls = {
        "data": (trainer, "example"),
        "windows' support": (tracker, "window"),
        "backward": (torch.autograd, "backward"),  # `Tensor.backward` calls it, too
        "optimiser": (trainer.optimizer, "step"),
        **{stage: (getattr(tracker, name), "forward") for stage, name in MODULES.items()},
    }
    rows = []
    for _ in range(steps + warm):
        with stages(calls, own_clock(), rest="loss and the rest", whole="whole step") as seconds:
            trainer._one_step()
        rows.append(seconds)
    return rows[warm:]


def bench_scaling(quick: bool = False, rounds: int = 3) -> Rows:
    """How the time of `lite` grows with queries N, frames T, neighbours K and the image's side."""
    base = {"N": 16, "T": 8, "K": 12, "side": 64} if quick else {"N": 64, "T": 16, "K": 12, "side": 128}
    sweeps = {"N": [16, 64, 256, 1024], "T": [8, 16, 32, 64], "K": [4, 8, 12, 16], "side": [64, 128, 192, 256]}
    for name, values in sweeps.items():
        runs = {}
        for value in values[: 2 if quick else None]:
            now = base | {name: value}
            tracker = make_tracker(image_size=(now["side"],) * 2, neighbors=now["K"])
            runs[f"{name} = {value}"] = tracking(make_clip(now["T"], now["N"], tracker.config.image_size), tracker)
        case = ", ".join(f"{key} = {value}" for key, value in base.items() if key != name)
        for way, seconds in side_by_side(runs, rounds, own_clock()).items():
            yield Row("scaling", case, way, seconds)


def bench_memory(quick: bool = False, rounds: int = 1) -> Rows:
    """Peak memory of `track` with `lite` as clips grow longer, both directions in time, 2,048 queries."""
    count, lengths = (64, [16]) if quick else (2048, [38, 75, 150, 300])
    for frames in lengths:
        for way, kept in (("features kept", 2**40), ("streamed", 0)):
            grown = extra_memory(_ready_track, frames, count, kept)
            if grown is not None:
                values = {"frames": frames, "MiB": grown[0]}
                yield Row("memory", f"{frames} frames, {count} queries", way, [grown[1]], values)


def _ready_track(frames: int, count: int, kept: int) -> Callable[[], Any]:
    inference._KEPT = kept
    tracker, clip = make_tracker(iterations=1), make_clip(frames, count, (128, 128))
    return lambda: tracker.track(clip)


def bench_gpu(quick: bool = False, rounds: int = 5, device: str = "cuda", backend: str = "inductor") -> Rows:
    """Frames and operations a second of the paper's model on a GPU, 1,024 queries and 32 frames."""
    if device == "cuda" and not torch.cuda.is_available():
        yield Row("gpu", "skipped: torch sees no CUDA device")
        return
    size, frames, count = ((64, 96), 8, 8) if quick else ((384, 512), 32, 1024)
    changes = {"image_size": size} | ({"levels": 1, "window": 8, "iterations": 1} if quick else {})
    trackers = {way: make_tracker("paper", **changes).to(device) for way in (FAST, SHORT, COMPILED)}
    for part in (trackers[COMPILED].encoder, trackers[COMPILED].updater):
        part.compile(backend=backend)
    clip = make_clip(frames, count, size)
    runs = {way: tracking(clip, tracker, way != FAST, device) for way, tracker in trackers.items()}
    with FlopCounterMode(display=False) as counter:
        runs[FAST]()
    seconds = side_by_side(runs, rounds)
    rates = {"FPS": frames, "TFLOP/s": counter.get_total_flops() / 1e12}
    values = {way: {name: x / np.median(times) for name, x in rates.items()} for way, times in seconds.items()}
    yield from compared("gpu", f"{frames} frames, {count} queries", seconds, values)


PARTS: dict[str, Callable[..., Rows]] = {
    "model": bench_model,
    "iteration": partial(bench_model, counts=(128,), iterations=1),
    "knn": bench_knn,
    "training": bench_training,
    "step": bench_step,
    "scaling": bench_scaling,
    "gpu": bench_gpu,
    "memory": bench_memory,
}
