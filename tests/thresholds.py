"""Scores over `visible_threshold`, on the clips that trainings are watched by: `python -m tests.thresholds --size 128 160`.

A tracker's probability is that of the image size it was trained at; for another one, or another number of updates, this
finds the threshold. One tracking gives all rows. The benchmark's clips are not looked at.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

import tapip3d_lite as t3d
from tapip3d_lite.evaluation.evaluate import markdown_table
from tapip3d_lite.training.data import validation_clips

METRICS = ("AJ3D_none", "APD3D_none", "AJ3D_none_dynamic", "APD3D_none_dynamic", "OA")
THRESHOLDS = np.linspace(0.2, 0.6, 9)


def rows(tracker: object, clips: list[t3d.Clip], side: int) -> list[list[str]]:
    """Mean scores at each threshold."""
    scores = np.zeros((len(clips), len(THRESHOLDS), len(METRICS)))
    for i, clip in enumerate(clips):
        pred = tracker.track(clip, clip.tracks.queries, size=(side, side), visible_threshold=0.0)
        sure = 1 / (1 + np.exp(-pred.visible_logits.astype(np.float64)))
        for j, threshold in enumerate(THRESHOLDS):
            found = t3d.evaluate(replace(pred, visible=pred.visible & (sure >= threshold)), clip)
            scores[i, j] = [found[name] for name in METRICS]
    means = np.nanmean(scores, 0)
    return [
        [f"{side}x{side}", f"{x:.2f}", *(f"{v:.3f}" for v in row)] for x, row in zip(THRESHOLDS, means, strict=True)
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tracker", default="lite", help="name or weights file")
    parser.add_argument("--size", nargs="+", type=int, default=[160])
    parser.add_argument("--clips", type=int, default=24)
    parser.add_argument("--folder", type=Path, default=Path("runs/validation"), help="clips are simulated into it")
    options = parser.parse_args()
    tracker, clips = t3d.load_tracker(options.tracker), validation_clips(options.folder, options.clips)
    found = [row for side in options.size for row in rows(tracker, clips, side)]
    print(markdown_table(["size", "visible from", *METRICS], found))


if __name__ == "__main__":
    main()
