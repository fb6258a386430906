"""Lesson 09: a variant of one's own from twenty lines to evidence; the learner's functions inside parts of the library's tracker."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch

import tapip3d_lite as t3d
from lessons.checker import check
from lessons.guesses import reveal
from lessons.milestone import CLIP, Use, plugged, report
from lessons.n09_cells import cells_figure, picked, shares_figure
from lessons.n09_evidence import evidence, hearing
from lessons.n09_exercises import EXERCISES
from lessons.n09_parts import Blind, NearAndAlike, Ripple, SoftMisses, Vote, errors
from lessons.pictures import pipeline, show
from lessons.place import folder
from lessons.progress import collect, in_use, progress, reset
from lessons.verdict import Verdict
from lessons.widgets import explore
from tapip3d_lite.lab import BUDGETS, Budget, Study, Variant
from tapip3d_lite.model.frames import Frames, frames_from_clip
from tapip3d_lite.training.data import SamplingConfig
from tapip3d_lite.training.loss import Truth

__all__ = [
    "EXERCISES",
    "Blind",
    "budget",
    "cells_figure",
    "check",
    "collect",
    "errors",
    "evidence",
    "explore",
    "folder",
    "hearing",
    "in_use",
    "milestone",
    "new_study",
    "parts",
    "picked",
    "pipeline",
    "progress",
    "reset",
    "reveal",
    "shares_figure",
    "show",
]

_SMALL = {
    "image_size": (64, 64), "window": 8, "stride": 4, "levels": 2, "neighbors": 9, "feature_dim": 32, "token_dim": 32,
    "context_head_dim": 32, "offset_dim": 32, "hidden": 64, "heads": 4, "head_dim": 16, "iterations": 2,
    "time_depth": 2, "space_depth": 1, "virtual_tracks": 4,
}  # fmt: skip


def budget(steps: int, clips: int = 40, held_out: int = 12) -> Budget:
    """The laboratory's clips and recipe with a smaller tracker, fewer clips and fewer points: about 50 ms a step on an idle core."""
    lab = BUDGETS["lab"]
    options = {"clips": clips, "steps": steps, "matching_steps": max(20, steps // 2), "average": max(1, steps // 8)}
    options |= {"evaluate_every": max(1, steps // 2), "validation": 2, "save_every": 500}
    recipe = replace(lab.recipe, tracker=_SMALL, sampling=SamplingConfig(tracks=24), **options)
    return replace(lab, recipe=recipe, held_out=held_out, points=48)


def new_study(folder: Path, name: str, rows: list[Variant], **options: object) -> Study:
    """A study in `folder / name` that begins anew, since a class of a notebook has no file to tell two versions apart.

    Clips and encoder in `folder / "store"`, which do not depend on rows, are kept.
    """
    for old in (folder / name, folder / "store" / "trainings"):
        shutil.rmtree(old, ignore_errors=True)
    return Study(folder / name, rows, store=folder / "store", **options)


def parts(use: Use) -> dict[str, object]:
    """The learner's functions inside the lesson's parts, which the library's tracker is made of."""
    places = {"most_alike": "alike", "vote": "vote", "mixed": "mixed", "soft_misses": "misses"}
    return {f"lessons.n09_parts:{place}": use(f"09.{name}") for place, name in places.items()}


def milestone(*lessons: str) -> Verdict:
    """Track a clip with a tracker of the lesson's four parts, once with the learner's functions inside them.

    Passed: each function is the learner's, the tracker or its loss called each, and neither tracks nor loss differ.
    """
    calls: dict[str, int] = {}
    with plugged(lessons or ("09",), calls):
        mine = _numbers()
    apart = float(np.abs(mine - _reference()).max())
    opening = (
        f"{len(calls)} functions in four parts of a tracker, which is not trained: tracks of one clip, and its loss"
    )
    return report(calls, apart < 1e-4, opening, f"largest difference from the reference: {apart:.6f}")


def _numbers() -> np.ndarray:
    """Tracks (metres) and losses of a random tracker on a few frames, in double precision."""
    clip = t3d.load_clip(CLIP).cut(0, 8)
    clip = replace(clip, tracks=clip.tracks.select(slice(0, None, 12)), queries=None)
    switches = {"neighborhood": NearAndAlike, "context": Vote, "updater": Ripple}
    config = t3d.TrackerConfig.preset("lite", **_SMALL | switches | {"image_size": clip.size, "levels": 3})
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        tracker = t3d.Tracker(config).double()
        torch.nn.init.normal_(tracker.updater.head.weight, std=0.02)  # so that points move
    frames = frames_from_clip(clip)
    frames = Frames(*(x.double() for x in (frames.rgb, frames.depths, frames.intrinsics, frames.extrinsics)))
    queries = torch.from_numpy(clip.queries).double()[None]
    truth = Truth(
        torch.from_numpy(clip.tracks.xyz).double()[None],
        torch.from_numpy(clip.tracks.visible)[None],
        queries[..., 0].long(),
    )
    loss, found = SoftMisses(), []
    with torch.no_grad():
        for step in tracker.steps(frames, queries):
            position, visibility = loss(step, truth, config.iterations)
            found += [step.xyz.numpy().ravel(), [float(1e3 * position), float(visibility)]]
    return np.concatenate(found)


_reference = cache(_numbers)
