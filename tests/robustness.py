"""What happens to a tracker outside the benchmark's clean clips: `python -m tests.robustness --tracker lite static klt`.

A picture that slides at a constant speed; wrong poses, poor depth, soft and grey images and frozen depth on clips of
`moving-camera`, each against the same clips as they are, paired; poor sensors and wrong poses after `steady_clip`; the
share of hidden frames called visible; what other image sizes, fewer updates and bfloat16 cost and save. Results go to a
JSON file, which an interrupted run continues, a Markdown page (for `card --also`) and a figure.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure
from tqdm import tqdm

import tapip3d_lite as t3d
from tapip3d_lite.clip import Clip
from tapip3d_lite.evaluation.benchmark import show
from tapip3d_lite.evaluation.evaluate import markdown_table
from tapip3d_lite.evaluation.intervals import bootstrap_interval, paired_difference
from tapip3d_lite.evaluation.lite_splits import COUNT, benchmark_clips
from tapip3d_lite.files import write_text
from tapip3d_lite.geometry import unproject
from tapip3d_lite.lab.conditions import under
from tapip3d_lite.measures import flawed_on_purpose

SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)  # pixels a frame, of 128
RUNS: dict[str, dict] = {
    "as it is": {},  # once more, right beside the others, since seconds are compared
    "one update": {"iterations": 1},
    "two updates": {"iterations": 2},
    "four updates": {"iterations": 4},
    "two updates, 128x128 pixels": {"iterations": 2, "size": (128, 128)},  # what the weights before these ran with
    "bfloat16": {"autocast": True},
    "one way": {"bidirectional": False},
    **{f"{side}x{side} pixels": {"size": (side, side)} for side in (96, 128, 192, 256)},
}
FAST = "slide 4, two updates"
DISTANCE, FOCAL, SIDE = 5.0, 128.0, 128
METRICS = ("AJ3D_none", "APD3D_none", "AJ3D_none_dynamic", "APD3D_none_dynamic", "OA")


def grey(clip: Clip, _seed: int) -> Clip:
    images = [cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB) for image in clip.video]
    return replace(clip, video=np.stack(images))


def flawed(condition: dict) -> Callable[[Clip, int], Clip]:
    """A condition of the laboratory."""
    return lambda clip, seed: under(clip, condition, seed)


CONDITIONS: dict[str, Callable[[Clip, int], Clip]] = {
    "as it is": flawed({}),
    **{f"poses wrong by {degrees:g}°": flawed({"poses": degrees}) for degrees in (0.5, 1.0, 2.0)},
    "depth scale flickers by 2 %": flawed({"flicker": 0.02}),
    "depth noise of 1 %": flawed({"noise": 0.01}),
    "depth noise of 5 %": flawed({"noise": 0.05}),
    "half of the depth missing": flawed({"dropout": 0.5}),
    "images blurred by 2 px": flawed({"blur": 2.0}),
    "grey images": grey,
    "frozen depth": flawed({"frozen": "depths"}),
}


def steadied(change: Callable[[Clip, int], Clip]) -> Callable[[Clip, int], Clip]:
    # Its own truth will do: scores are in camera coordinates, where steadying leaves it.
    return lambda clip, seed: t3d.steady_clip(change(clip, seed))


STEADIED = ("drift", "sensor")  # splits of the benchmark
JITTER = ("as it is", "poses", "depth scale", "depth noise")
CONDITIONS |= {f"{name}, steadied": steadied(CONDITIONS[name]) for name in CONDITIONS if name.startswith(JITTER)}


def sliding_picture(speed: float, seed: int, frames: int) -> tuple[Clip, np.ndarray]:
    """A random picture on a wall that slides at `speed` pixels a frame; the clip with 36 queries, and its step (2,) in metres."""
    rng = np.random.default_rng(seed)
    wall = sum(
        cv2.resize(rng.random((k, k, 3), np.float32), (512, 512), interpolation=cv2.INTER_CUBIC) * k**-0.35
        for k in (4, 8, 16, 32, 64, 128)
    )
    wall = 255 * (wall - wall.min()) / (wall.max() - wall.min())
    angle = rng.uniform(0, 2 * np.pi)
    step = speed * np.array([np.cos(angle), np.sin(angle)])
    video = []
    for t in range(frames):
        shift = np.float32([[1, 0, 192 - t * step[0]], [0, 1, 192 - t * step[1]]])
        image = cv2.warpAffine(wall, shift, (SIDE, SIDE), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        video.append(image.round().clip(0, 255).astype(np.uint8))
    k = np.array([[FOCAL, 0, (SIDE - 1) / 2], [0, FOCAL, (SIDE - 1) / 2], [0, 0, 1]], np.float32)
    side = np.linspace(32, 96, 6)
    uv = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    places = unproject(uv, np.full(len(uv), DISTANCE), k)
    queries = np.concatenate([np.zeros((len(uv), 1)), places], -1).astype(np.float32)
    depths = np.full((frames, SIDE, SIDE), DISTANCE, np.float32)
    cameras = np.repeat(k[None], frames, 0), np.repeat(np.eye(4, dtype=np.float32)[None], frames, 0)
    return Clip(np.stack(video), depths, *cameras, queries=queries), step * DISTANCE / FOCAL


def followed(tracker: object, speed: float, seeds: int = 3, **options: object) -> dict[str, float]:
    """The median share of the motion that points have made after 7 frames, and after 31 where the picture stays in view."""
    frames = 32 if speed <= 1 else 8
    shares = []
    for seed in range(seeds):
        clip, step = sliding_picture(speed, seed, frames)
        moved = tracker.track(clip, **options).xyz - clip.queries[:, 1:]
        shares.append(np.median(moved[..., :2] @ step / (step @ step), axis=1))  # (T,) in frames of motion
    mean = np.mean(shares, 0)
    return {str(t): float(mean[t] / t) for t in (7, 31) if t < frames}


def falsely_visible(pred: t3d.Tracks, clip: Clip) -> dict[str, float]:
    """The share of truly hidden frames from the query on that are called visible, of all points and of moving ones."""
    hidden = ~clip.tracks.visible & (np.arange(len(clip))[:, None] >= clip.queries[:, 0])
    moving = hidden & clip.tracks.dynamic
    return {
        name: float(pred.visible[mask].mean()) if mask.any() else math.nan
        for name, mask in (("hidden_visible", hidden), ("hidden_visible_dynamic", moving))
    }


def scored(tracker: object, clip: Clip, autocast: bool = False, **options: object) -> dict[str, float]:
    start = time.process_time()
    with flawed_on_purpose(), torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        pred = tracker.track(clip, **options)
    seconds = time.process_time() - start
    scores = t3d.evaluate(pred, clip)
    return {name: scores[name] for name in METRICS} | falsely_visible(pred, clip) | {"seconds": seconds}


def measure(names: list[str], count: int, out: Path) -> dict:
    """Fill in what `out` lacks: `results[tracker][measurement]`, of one clip each for the conditions and sizes."""
    results = json.loads(out.read_text()) if out.exists() else {}
    clips = benchmark_clips("moving-camera", count)
    jobs: dict[str, Callable] = {f"slide {speed:g}": partial(followed, speed=speed) for speed in SPEEDS}
    jobs[f"run {FAST}"] = partial(followed, speed=4.0, iterations=2)
    for index, clip in enumerate(clips):
        for name, change in CONDITIONS.items():
            jobs[f"{name} {index}"] = lambda t, c=clip, f=change, i=index: scored(t, f(c, i))
        for name, options in RUNS.items():
            jobs[f"run {name} {index}"] = lambda t, c=clip, o=options: scored(t, c, **o)
    for split in STEADIED:
        for index, clip in enumerate(benchmark_clips(split)):
            jobs[f"{split} {index}"] = lambda t, c=clip: scored(t, c)
            jobs[f"{split}, steadied {index}"] = lambda t, c=clip: scored(t, t3d.steady_clip(c))
    for name in names:
        tracker, mine = t3d.load_tracker(name), results.setdefault(name, {})
        todo = [job for job in jobs if job not in mine and (hasattr(tracker, "config") or not job.startswith("run"))]
        for job in tqdm(todo, desc=name):
            mine[job] = jobs[job](tracker)
            write_text(out, json.dumps(results, indent=1) + "\n")
    return results


def page(results: dict, count: int) -> str:
    """The Markdown page."""

    def scores(name: str, what: str, metric: str, count: int = count) -> list[float]:
        found = [results[name].get(f"{what} {index}", {}).get(metric) for index in range(count)]
        return [math.nan if x is None else x for x in found]

    names, frames = list(results), ("7", "31")
    rows = [
        [f"{s:g}", *(f"{results[n][f'slide {s:g}'][t]:.2f}" if t in results[n][f"slide {s:g}"] else "" for n in names for t in frames)]
        for s in SPEEDS
    ]  # fmt: skip
    head = ["pixels a frame", *(f"{name}, after {t} frames" for name in names for t in frames)]
    parts = ["## Beyond clean clips"]
    parts += ["Share of a sliding picture's motion that points follow (median of 36 points, mean of three pictures):"]
    parts += [markdown_table(head, rows)]
    fast = {name: results[name][f"run {FAST}"]["7"] for name in names if f"run {FAST}" in results[name]}
    parts += (
        [f"With two updates: {', '.join(f'{n} {x:.2f}' for n, x in fast.items())} at 4 pixels a frame."] if fast else []
    )
    parts += [f"The first {count} clips of `moving-camera`, changed; paired differences to the same clips as they are:"]
    rows = []
    for name in names:
        for what in CONDITIONS:
            own = [show(bootstrap_interval(scores(name, what, m))) for m in METRICS[:2]]
            pairs = [[scores(name, x, m) for x in (what, "as it is")] for m in METRICS[:2]]
            rows.append([name, what, *own, *(show(paired_difference(*pair), "+") for pair in pairs)])
    parts += [markdown_table(["tracker", "condition", *METRICS[:2], "AJ3D_none lost", "APD3D_none lost"], rows)]
    parts += ["Splits of the benchmark, as they are and after `steady_clip`, and what that gains:"]
    rows = []
    for split in STEADIED:
        for name in names:
            two = [[scores(name, f"{split}{how}", m, COUNT) for how in (", steadied", "")] for m in METRICS[:4]]
            rows.append([split, name, *(show(bootstrap_interval(after)) for after, _ in two)])
            rows[-1] += [show(paired_difference(*pair), "+") for pair in two[:2]]
    parts += [markdown_table(["split", "tracker", *METRICS[:4], *(f"{m} gained" for m in METRICS[:2])], rows)]
    parts += ["Truly hidden frames, from the query on, that are called visible:"]
    shares = ("hidden_visible", "hidden_visible_dynamic")
    rows = [[n, *(show(bootstrap_interval(scores(n, "as it is", m))) for m in shares)] for n in names]
    parts += [markdown_table(["tracker", "all points", "moving points"], rows)]
    parts += [
        "The same clips (128x128) tracked otherwise; differences and processor seconds a clip, side by side in one run:"
    ]
    rows = []
    for name in (name for name in names if f"run {next(iter(RUNS))} 0" in results[name]):
        for what in RUNS:
            pairs = [[scores(name, f"run {x}", m) for x in (what, "as it is")] for m in METRICS[:2]]
            seconds = np.mean(scores(name, f"run {what}", "seconds"))
            rows.append([name, what, *(show(paired_difference(*pair), "+") for pair in pairs), f"{seconds:.1f}"])
    parts += [markdown_table(["tracker", "how", *(f"{m} gained" for m in METRICS[:2]), "seconds"], rows)]
    parts += ["## Where it fails", *(failures(results[name], name, scores) for name in names[:1])]
    return "\n\n".join(parts) + "\n"


def failures(mine: dict, name: str, scores: Callable[[str, str, str], list[float]]) -> str:
    """What costs a tracker much, in words; the same numbers as above."""
    as_it_is, lost = np.nanmean(scores(name, "as it is", "AJ3D_none")), {}
    for what in CONDITIONS:
        lost[what] = as_it_is - np.nanmean(scores(name, what, "AJ3D_none"))
    much = [f"{what} ({-loss:+.3f})" for what, loss in sorted(lost.items(), key=lambda x: -x[1]) if loss > 0.05]
    slides = {speed: mine[f"slide {speed:g}"]["7"] for speed in SPEEDS}
    slow = [f"{speed:g} pixels a frame ({share:.2f})" for speed, share in slides.items() if share < 0.8]
    seen = np.nanmean(scores(name, "as it is", "hidden_visible"))
    lines = [f"`{name}` loses more than 0.05 AJ3D by: {'; '.join(much)}."] if much else []
    lines += [f"It follows less than 0.8 of a picture's motion after 7 frames at {'; '.join(slow)}."] if slow else []
    return "\n".join(f"- {line}" for line in [*lines, f"It calls {seen:.1%} of the truly hidden frames visible."])


def figure(results: dict) -> Figure:
    """Share of the motion followed after 7 frames over the speed."""
    fig = Figure(figsize=(6, 3.6), layout="constrained")
    ax = fig.add_subplot()
    for name, color in zip(results, matplotlib.color_sequences["tab10"], strict=False):
        ax.plot(SPEEDS, [results[name][f"slide {s:g}"]["7"] for s in SPEEDS], "o-", color=color, label=name)
    ax.set(xscale="log", xlabel="the picture slides by … pixels a frame", ylabel="share followed after 7 frames")
    ax.set_xticks(SPEEDS, [f"{s:g}" for s in SPEEDS])
    ax.axhline(1, color="0.6", linewidth=0.8)
    ax.legend(frameon=False)
    return fig


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tracker", nargs="+", default=["lite", "static", "klt"], help="names or weights files")
    parser.add_argument("--clips", type=int, default=16, help="of moving-camera")
    parser.add_argument("--out", type=Path, default=Path("robustness.json"), help="also .md and .png beside it")
    options = parser.parse_args()
    results = measure(options.tracker, options.clips, options.out)
    write_text(options.out.with_suffix(".md"), page(results, options.clips))
    t3d.figures.save_png(figure(results), options.out.with_suffix(".png"))
    print(page(results, options.clips))


if __name__ == "__main__":
    main()
