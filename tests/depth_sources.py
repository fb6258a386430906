"""What each source of depth is worth: `python -m tests.depth_sources --tracker lite --clips 8`.

Clips of the Lite benchmark, filmed with a second camera beside the first; their true depth, a sensor's, that of stereo
matching and that of sparse points, as lesson 10 makes them, each as it is and filtered: error of the depth, and scores of the tracker on it,
paired with those on true depth. Results go to a JSON file, which an interrupted run continues, and a Markdown page.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

import tapip3d_lite as t3d
from lessons.n10_sources import BASELINE, SHARE, depth_errors, filmed_twice, sensor, sparse, stereo
from tapip3d_lite.clip import Clip
from tapip3d_lite.evaluation.benchmark import show
from tapip3d_lite.evaluation.evaluate import markdown_table
from tapip3d_lite.evaluation.intervals import bootstrap_interval, paired_difference
from tapip3d_lite.evaluation.lite_splits import split_file
from tapip3d_lite.files import write_text
from tapip3d_lite.simulate.rollout import load_rollouts

METRICS = ("AJ3D", "APD3D")
ERRORS = ("AbsRel", "within 5 %", "known")  # as `depth_errors` gives them

Source = Callable[[Clip, int], np.ndarray]


def scattered(clip: Clip, seed: int) -> np.ndarray:
    """The pixels that `sparse` knows, without what it spreads."""
    shown = np.random.default_rng(seed).random(clip.depths.shape) < SHARE
    return np.where(shown, clip.depths, np.float32(0))


def filtered(source: Source) -> Source:
    return lambda clip, seed: t3d.filter_depth(source(clip, seed))


SOURCES: dict[str, Source] = {
    "true": lambda clip, _: clip.depths,
    "sensor": sensor,
    "stereo": stereo,
    f"sparse ({SHARE:.0%}), densified": sparse,
    f"sparse ({SHARE:.0%}) as it is": scattered,
}
RAW = list(SOURCES)
SOURCES |= {f"{name}, filtered": filtered(SOURCES[name]) for name in RAW[:-1]}


def measure(name: str, split: str, count: int, out: Path) -> dict:
    """Fill in what `out` lacks: `results[source index]`."""
    results, tracker = json.loads(out.read_text()) if out.exists() else {}, t3d.load_tracker(name)
    rollouts = [rollout for rollout, _ in load_rollouts(split_file(split))[:count]]
    for index, rollout in enumerate(tqdm(rollouts, desc="clips")):
        todo = [source for source in SOURCES if f"{source} {index}" not in results]
        if not todo:
            continue
        clip = filmed_twice(rollout)
        for source in tqdm(todo, desc="sources", leave=False):
            depths = SOURCES[source](clip, index)
            scores = t3d.evaluate(tracker.track(replace(clip, depths=depths)), clip)
            results[f"{source} {index}"] = dict(zip(ERRORS, depth_errors(depths, clip.depths), strict=True))
            results[f"{source} {index}"] |= {m: scores[m] for m in METRICS}
            write_text(out, json.dumps(results, indent=1) + "\n")
    return results


def page(results: dict, name: str, split: str, count: int) -> str:
    def column(source: str, what: str) -> list[float]:
        return [results[f"{source} {index}"][what] for index in range(count)]

    rows = []
    for raw in RAW:
        for source in (raw, f"{raw}, filtered"):
            if source in SOURCES:
                depth = [f"{np.mean(column(source, what)):.3f}" for what in ERRORS]
                own = [show(bootstrap_interval(column(source, m))) for m in METRICS]
                lost = [show(paired_difference(column(source, m), column("true", m)), "+") for m in METRICS]
                rows.append([source, *depth, *own, *lost])
    head = ["depth", *ERRORS, *METRICS, *(f"{m} against true depth" for m in METRICS)]
    return f"`{name}` on the first {count} clips of `{split}`, baseline {BASELINE} m:\n\n{markdown_table(head, rows)}\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tracker", default="lite", help="name or weights file")
    parser.add_argument("--split", default="moving-camera")
    parser.add_argument("--clips", type=int, default=8)
    parser.add_argument("--out", type=Path, default=Path("depth_sources.json"), help="also .md beside it")
    options = parser.parse_args()
    results = measure(options.tracker, options.split, options.clips, options.out)
    text = page(results, options.tracker, options.split, options.clips)
    write_text(options.out.with_suffix(".md"), text)
    print(text)


if __name__ == "__main__":
    main()
