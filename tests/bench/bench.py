"""`bench`: what the savings are worth, against straightforward forms of the same computation, side by side.

Paper: section 4 (run time; k-NN and N2N attention take nearly all of it). Weights are random: time does not depend on
them, and neither does the proof that results are equal.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from tapip3d_lite.clip import Clip
from tapip3d_lite.model.cloud import feature_cloud
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.frames import frames_from_clip, resize_clip
from tapip3d_lite.model.neighbors import knn
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.model.windows import window_ends
from tapip3d_lite.simulate import simulate_clip
from tapip3d_lite.speed.box_knn import BlockTree
from tapip3d_lite.training.backward import saving_backward
from tapip3d_lite.training.loss import LossConfig, Truth
from tests.bench.rows import Row, compared, table
from tests.bench.timing import extra_memory, own_clock, side_by_side, stages

__all__ = ["PARTS", "Row", "bench", "table"]
SLOW, FAST, SHORT, COMPILED = "straightforward", "fast", "fast, bf16", "fast, bf16, compiled"
KEPT = "fast, features kept"  # of the frozen encoder, as `train` does by default
OFFSETS = "the offsets' MLP, part of context"  # which both ways compute alike


def make_tracker(preset: str = "lite", fast: bool = True, **changes: Any) -> Tracker:
    """A tracker with random weights; `fast=False`: the definition step by step, and brute-force neighbours."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        tracker = Tracker(TrackerConfig.preset(preset, **changes)).eval()
    tracker.fast = tracker.neighborhood.fast = tracker.encoder.fast = fast
    return tracker


def make_clip(frames: int, tracks: int, size: tuple[int, int]) -> Clip:
    """A simulated clip with true tracks, rendered at half the size, which is enough to measure speed."""
    clip = simulate_clip(seed=0, frames=frames, size=(size[0] // 2, size[1] // 2), tracks=tracks)
    larger = resize_clip(clip, size)
    cameras = larger.intrinsics, larger.extrinsics
    return Clip(larger.video, larger.depths, *cameras, queries=clip.queries, tracks=clip.tracks)


def tracking(clip: Clip, tracker: Tracker, bf16: bool = False, device: str = "cpu") -> Callable[[], Any]:
    """A function that tracks the clip's queries once; frames are made beforehand."""
    frames, queries = frames_from_clip(clip, device=device), torch.from_numpy(clip.queries)[None].to(device)

    @torch.no_grad()
    def run() -> tuple[Tensor, Tensor]:
        with torch.autocast(device, torch.bfloat16, enabled=bf16):
            result = tracker(frames, queries)
        return (result[0].cpu(), result[1].cpu()) if device != "cpu" else result

    return run


def bench_model(
    quick: bool = False, rounds: int = 3, counts: Sequence[int] = (128, 512, 1024), iterations: int = 6
) -> Iterator[Row]:
    """(a) The paper's model on 16 frames: straightforward, fast, and fast in bfloat16; by stage, with peak memory."""
    size, counts, iterations = ((96, 128), [16], 1) if quick else ((384, 512), counts, iterations)
    changes = {"image_size": size, "iterations": iterations} | ({"levels": 2} if quick else {})
    trackers = {way: make_tracker("paper", way != SLOW, **changes) for way in (SLOW, FAST, SHORT)}
    for count in counts:
        clip, case = make_clip(16, count, size), f"{count} queries" + ", 1 iteration" * (iterations == 1)
        spent: dict[str, dict[str, list[float]]] = {}
        results: dict[str, Any] = {}
        runs = {w: partial(_by_stage, tracking(clip, t, w == SHORT), t, w, spent, results) for w, t in trackers.items()}
        # Without a warm-up: the larger ones take minutes.
        seconds = side_by_side(runs, rounds if count <= 128 else -(-rounds // 3), warm=False, clock=own_clock())
        exact, values = results[SLOW][0], {}
        for way in (FAST, SHORT):
            error = (results[way][0] - exact).norm(dim=-1).flatten()
            values[way] = {"median difference": float(error.median()), "largest difference": float(error.max())}
        for way, tracker in trackers.items() if count == 512 or quick else ():
            grown = extra_memory(_ready_model, count, size, changes, tracker.fast, way == SHORT)
            if grown is not None:
                values.setdefault(way, {})["MiB"] = grown[0]
        yield from compared("model", case, seconds, **values)
        for stage, times in spent.items():
            yield from compared("model", f"{case}: {stage}", times)


def _by_stage(run: Callable, tracker: Tracker, way: str, spent: dict, results: dict) -> None:
    names = {"encoder": "encoder", "k-NN": "neighborhood", "context": "context", "updater": "updater"}
    parts = {stage: getattr(tracker, name) for stage, name in names.items()}
    inner = {f"offsets {level}": part for level, part in enumerate(tracker.context.embed.offsets)}
    clock = own_clock()
    start = clock()
    with stages(parts | inner, clock) as seconds:
        results[way] = run()
    total = clock() - start
    offsets = sum(seconds.pop(name) for name in inner)
    rest = total - sum(seconds.values())
    for stage, time in (seconds | {"the rest": rest, OFFSETS: offsets}).items():
        spent.setdefault(stage, {}).setdefault(way, []).append(time)


def _ready_model(count: int, size: tuple[int, int], changes: dict, fast: bool, bf16: bool) -> Callable[[], Any]:
    tracker = make_tracker("paper", fast, **(changes | {"iterations": 1}))  # memory does not depend on their number
    return tracking(make_clip(16, count, size), tracker, bf16)


def bench_knn(quick: bool = False, rounds: int = 5) -> Iterator[Row]:
    """(b) Nearest neighbours, K = 32: trees of boxes, brute force, torch's cdist and topk, SciPy's cKDTree."""
    frames, count, height, width, levels = (4, 256, 48, 64, 2) if quick else (16, 1024, 96, 128, 4)
    clip = make_clip(frames, count, (4 * height, 4 * width))
    points, queries = torch.from_numpy(clip.points())[None], torch.from_numpy(clip.tracks.xyz)
    known = torch.ones(points.shape[:-1], dtype=torch.bool)
    cloud = feature_cloud(torch.zeros(1, frames, 1, height, width), points, known, levels)
    total: dict[str, list[float]] = {}
    for level in cloud:
        maps = level.points[0].contiguous()
        seconds = side_by_side(_knn_ways(queries, maps, 32), rounds, clock=own_clock())
        yield from compared("k-NN", f"maps {maps.shape[1]}x{maps.shape[2]}", _best_first(seconds))
        total = {
            way: [a + b for a, b in zip(times, total.get(way, [0] * rounds), strict=True)]
            for way, times in seconds.items()
        }
    yield from compared("k-NN", "all maps", _best_first(total))


def _best_first(seconds: dict[str, list[float]]) -> dict[str, list[float]]:
    others = [way for way in seconds if way in ("cKDTree", "cdist + topk")]
    best = min(others, key=lambda way: np.median(seconds[way]))
    return {best: seconds[best]} | seconds


def _knn_ways(queries: Tensor, maps: Tensor, count: int) -> dict[str, Callable[[], Any]]:
    flat = maps.flatten(1, 2)

    def others() -> list[Tensor]:
        return [torch.cdist(x, y).topk(count, largest=False).indices for x, y in zip(queries, flat, strict=True)]

    ways: dict[str, Callable[[], Any]] = {"cdist + topk": others}
    try:
        from scipy.spatial import cKDTree
    except ImportError:  # needed for nothing else, and `bench` says that the row is missing
        pass
    else:
        pairs = list(zip(queries.numpy(), flat.numpy(), strict=True))
        ways["cKDTree"] = lambda: [cKDTree(y).query(x, count, workers=torch.get_num_threads()) for x, y in pairs]
    return ways | {
        "brute force": lambda: knn(queries, flat, count),
        "trees of boxes": lambda: BlockTree.build(maps).knn(queries, count),
    }


def bench_training(quick: bool = False, rounds: int = 5) -> Iterator[Row]:
    """(c) Forward and backward pass of one training step of `lite`."""
    size, count, frames = ((64, 64), 32, 8) if quick else ((128, 128), 128, 12)
    clip = make_clip(frames, count, size)
    truth = (torch.from_numpy(x)[None] for x in (clip.tracks.xyz, clip.tracks.visible, clip.queries[:, 0].astype(int)))
    truth, queries = Truth(*truth), torch.from_numpy(clip.queries)[None]

    def step(tracker: Tracker, features: Tensor | None = None) -> None:
        tracker.zero_grad()
        saving_backward(tracker, frames_from_clip(clip), queries, truth, LossConfig(), features=features)

    trackers = {way: make_tracker("lite", way == FAST, image_size=size).train() for way in (SLOW, FAST)}
    runs = {way: partial(step, tracker) for way, tracker in trackers.items()}
    with torch.no_grad():
        runs[KEPT] = partial(step, trackers[FAST], trackers[FAST].encoder(frames_from_clip(clip).rgb))
    seconds = side_by_side(runs, rounds, clock=own_clock())
    yield from compared("training step", f"lite, {frames} frames, {count} queries", seconds)


def bench_scaling(quick: bool = False, rounds: int = 3) -> Iterator[Row]:
    """(d) How the time of `lite` grows with queries N, frames T, neighbours K and the image's side."""
    base = {"N": 16, "T": 8, "K": 12, "side": 64} if quick else {"N": 64, "T": 16, "K": 12, "side": 128}
    sweeps = {"N": [16, 64, 256, 1024], "T": [8, 16, 32, 64], "K": [4, 8, 12, 16], "side": [64, 128, 192, 256]}
    for name, values in sweeps.items():
        runs = {}
        for value in values[: 2 if quick else None]:
            now = base | {name: value}
            tracker = make_tracker(image_size=(now["side"],) * 2, neighbors=now["K"])
            runs[f"{name} = {value}"] = tracking(make_clip(now["T"], now["N"], tracker.config.image_size), tracker)
        case = ", ".join(f"{key} = {value}" for key, value in base.items() if key != name)
        for way, seconds in side_by_side(runs, rounds, clock=own_clock()).items():
            yield Row("scaling", case, way, seconds)


def bench_memory(quick: bool = False, rounds: int = 1) -> Iterator[Row]:
    """(f) Peak memory of `track` with `lite` as clips grow longer, both directions in time, 2,048 queries."""
    count, lengths = (64, [8, 16]) if quick else (2048, [38, 75, 150, 300])
    for frames in lengths:
        for way, kept in (("features kept", 2**40), ("streamed", 0)):
            grown = extra_memory(_ready_track, frames, count, kept)
            if grown is not None:
                values = {"MiB": grown[0], "frames": frames}
                yield Row("memory", f"{frames} frames, {count} queries", way, [grown[1]], values=values)


def _ready_track(frames: int, count: int, kept: int) -> Callable[[], Any]:
    from tapip3d_lite.model import track as inference

    inference._KEPT = kept
    tracker, clip = make_tracker(iterations=1), make_clip(frames, count, (128, 128))
    return lambda: tracker.track(clip)


def bench_gpu(quick: bool = False, rounds: int = 5, device: str = "cuda", backend: str = "inductor") -> Iterator[Row]:
    """(e) Frames per second of the paper's model on a GPU, 1,024 queries and 32 frames, and the card's two limits.

    The limit of arithmetic is all operations at the measured rate of a large matrix product; that of bandwidth is
    reading every neighbour's token once an update at the measured rate of a copy. Real runs can reach neither.
    """
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
    rate, bandwidth = _card(device, rounds, 512 if quick else 8192)
    config = trackers[FAST].config
    windows = len(list(window_ends(frames, config.window)))
    tokens = windows * config.iterations * config.window * count * config.levels * config.neighbors * config.token_dim
    seconds, values = side_by_side(runs, rounds), {}
    for way, times in seconds.items():
        time = float(np.median(times))
        values[way] = {
            "FPS": frames / time,
            "TFLOP/s": counter.get_total_flops() / time / 1e12,
            "times the limit of arithmetic": time / (counter.get_total_flops() / rate),
            "times the limit of bandwidth": time / (tokens * (4 if way == FAST else 2) / bandwidth),
        }
    yield from compared("gpu", f"{frames} frames, {count} queries", seconds, **values)


def _card(device: str, rounds: int, side: int) -> tuple[float, float]:
    """What a device can do: operations a second of a matrix product, bytes a second read by a copy.

    The product is in bf16 or float32, whichever is faster: not every processor multiplies bf16 in hardware.
    """
    wide = torch.randn(side, side, device=device)
    other, half = torch.empty_like(wide), wide.bfloat16()
    short = torch.empty_like(half)
    runs = {
        "bf16": lambda: torch.mm(half, half, out=short)[0, 0].item(),  # asking for a number waits for the GPU
        "float32": lambda: torch.mm(wide, wide, out=other)[0, 0].item(),
        "copy": lambda: [other.copy_(wide) for _ in range(16)][-1][0, 0].item(),
    }
    least = {way: min(times) for way, times in side_by_side(runs, rounds).items()}
    return 2 * side**3 / min(least["bf16"], least["float32"]), 16 * wide.nbytes / least["copy"]


PARTS: dict[str, Callable[..., Iterator[Row]]] = {
    "model": bench_model,
    "iteration": partial(bench_model, counts=(128,), iterations=1),
    "knn": bench_knn,
    "training": bench_training,
    "scaling": bench_scaling,
    "gpu": bench_gpu,
    "memory": bench_memory,
}


def bench(parts: Iterable[str] = tuple(PARTS), quick: bool = False, rounds: int | None = None) -> Iterator[Row]:
    """Measure parts of the bench, row by row.

    Args:
        parts: names in `PARTS`.
        quick: small sizes, about a minute in all.
        rounds: how often each way is measured, taking turns; each part's own default if None.

    Raises:
        ValueError: an unknown part, or no round.
    """
    unknown = sorted(set(parts) - set(PARTS))
    if unknown or (rounds is not None and rounds < 1):
        raise ValueError(f"bench: expected parts among {', '.join(PARTS)} and rounds >= 1, got {unknown}, {rounds}")
    for part in parts:
        yield from PARTS[part](quick, **({} if rounds is None else {"rounds": rounds}))
