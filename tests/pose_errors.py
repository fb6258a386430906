"""How well cameras are found from colour and depth: `python -m tests.pose_errors` prints a page.

Each clip of the Lite benchmark loses its poses but for the first frame's; `estimate_poses` finds them again. On `sensor`
depth and colour are a sensor's. Errors as for TUM RGB-D (Sturm et al., 2012):

    ATE   root mean square of the distances between true and found camera centres, after the rigid motion that fits best
    RPE   of the motion from each frame to the next, found against true: root mean square of its length and its angle
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from tqdm import tqdm

import tapip3d_lite as t3d
from lessons import n10_measure
from lessons.n10_exercises import path
from tapip3d_lite.evaluation.benchmark import benchmark_clips, show
from tapip3d_lite.evaluation.evaluate import markdown_table
from tapip3d_lite.evaluation.intervals import bootstrap_interval
from tapip3d_lite.geometry import invert

SPLITS = ("static-camera", "moving-camera", "occlusion", "slow", "sensor", "portrait")
COLUMNS = {"ATE (cm)": 100, "RPE (cm)": 100, "RPE (degrees)": 1}


def centres_apart(found: np.ndarray, truth: np.ndarray) -> float:
    """ATE of cameras (T, 4, 4), world to camera, in units of the scene."""
    return float(path(*(invert(x.astype(np.float64))[:, :3, 3] for x in (found, truth))))


def steps_apart(found: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """RPE of cameras (T, 4, 4): length in units of the scene, angle in degrees."""
    angle, length = n10_measure.steps_apart(found, truth)
    return float(np.sqrt((length**2).mean())), float(np.sqrt((angle**2).mean()))


def measure(split: str, count: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Errors (clips, 3) of the poses found, and of a camera that is taken to rest; clips without an answer."""
    found, resting, failed = [], [], 0
    for clip in tqdm(benchmark_clips(split, count), desc=split):
        still = np.repeat(clip.extrinsics[:1], len(clip), 0)
        try:
            poses = t3d.estimate_poses(replace(clip, extrinsics=still, queries=None, tracks=None)).extrinsics
        except ValueError:
            failed += 1
            continue
        for rows, guess in ((found, poses), (resting, still)):
            rows.append([centres_apart(guess, clip.extrinsics), *steps_apart(guess, clip.extrinsics)])
    return np.array(found), np.array(resting), failed


def page(splits: list[str], count: int) -> str:
    head, rows = ["split", "poses", *COLUMNS, "clips without an answer"], []
    for split in splits:
        found, resting, failed = measure(split, count)
        for name, values in (("found", found), ("camera at rest", resting)):
            cells = [show(bootstrap_interval(factor * values[:, i])) for i, factor in enumerate(COLUMNS.values())]
            rows.append([split, name, *cells, str(failed) if name == "found" else ""])
    text = "Means over clips with 95 % intervals. `camera at rest` is the control: the first frame's pose for all."
    return f"# Poses from colour and depth\n\n{markdown_table(head, rows)}\n\n{text}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--split", nargs="+", default=list(SPLITS), choices=SPLITS)
    parser.add_argument("--clips", type=int, default=16, help="of each split")
    options = parser.parse_args()
    print(page(options.split, options.clips))


if __name__ == "__main__":
    main()
