"""Lesson 10: your own clip, from a folder on disk to tracks; the learner's functions where the library reads and measures."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

import tapip3d_lite as t3d
from lessons import n10_measure
from lessons.checker import check
from lessons.guesses import reveal
from lessons.milestone import CLIP, Use, plugged, report
from lessons.n10_exercises import EXERCISES
from lessons.n10_figures import (
    costs_chart,
    errors_figure,
    matched_figure,
    paths_figure,
    picks_figure,
    remedies_chart,
    sources_figure,
)
from lessons.n10_folder import LATE, SCALE, listing, stamps, stored, write_recording
from lessons.n10_measure import (
    SUSPECTS,
    error_map,
    fingerprint,
    misfit,
    places,
    planted,
    step_errors,
    undone,
    without_points,
)
from lessons.n10_sources import (
    BASELINE,
    SHARE,
    benchmark_clips,
    depth_errors,
    disparities,
    pair,
    sensor,
    sparse,
    stereo,
)
from lessons.pictures import pipeline, show
from lessons.progress import collect, in_use, progress, reset
from lessons.verdict import Verdict
from lessons.widgets import PointPicker
from tapip3d_lite.formats import layouts

__all__ = [
    "BASELINE",
    "EXERCISES",
    "LATE",
    "SCALE",
    "SHARE",
    "SUSPECTS",
    "PointPicker",
    "benchmark_clips",
    "check",
    "collect",
    "costs_chart",
    "depth_errors",
    "disparities",
    "error_map",
    "errors_figure",
    "fingerprint",
    "in_use",
    "listing",
    "matched_figure",
    "milestone",
    "misfit",
    "pair",
    "parts",
    "paths_figure",
    "picks_figure",
    "pipeline",
    "places",
    "planted",
    "progress",
    "remedies_chart",
    "reset",
    "reveal",
    "sensor",
    "show",
    "sources_figure",
    "sparse",
    "stamps",
    "step_errors",
    "stereo",
    "stored",
    "undone",
    "without_points",
    "write_recording",
]

Array = np.ndarray
_read_list = layouts._stamped  # the library's, while the learner's pairs stand in its place


def parts(use: Use) -> dict[str, object]:
    """The learner's units and pairs where `load_clip` reads a folder, their check where `stereo_depth` matches, two measures."""
    units, partners, agreed = use("10.units"), use("10.partners"), use("10.stereo")

    def read_depth(path: Path, scale: float, no_depth: float) -> Array:
        return np.asarray(units(stored(path), scale, no_depth), np.float32)

    def stamped(path: Path) -> list[tuple[float, str]]:
        """Only lines that have a partner; those of depth at their colour frame's time."""
        color, depth = (_read_list(path.with_name(name)) for name in ("rgb.txt", "depth.txt"))
        pairs = partners(*(np.array([time for time, _ in rows]) for rows in (color, depth)), 0.02)
        if path.name == "rgb.txt":
            return [color[i] for i, _ in pairs]
        return [(color[i][0], depth[j][1]) for i, j in pairs]

    def matched(left: Array, right: Array, most: int) -> Array:
        depth = np.asarray(agreed(*disparities(left, right, most), 1.0, 1.0), np.float32)
        return np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)

    return {
        "tapip3d_lite.formats.folders:read_depth": read_depth,
        "tapip3d_lite.formats.layouts:_stamped": stamped,
        "tapip3d_lite.depth:_matched": matched,
        "lessons.n10_measure:carried": use("10.carried"),
        "lessons.n10_measure:path_error": use("10.path"),
    }


def milestone(*lessons: str, tracker: str = "lite") -> Verdict:
    """Read a folder, track it, measure it and match a pair, with the learner's functions in the library's places.

    Passed: each function is the learner's, each was called, and no number differs from the library's.
    """
    calls: dict[str, int] = {}
    with plugged(lessons or ("10",), calls):
        mine = _numbers(tracker)
    library = _library(tracker)
    same = mine.shape == library.shape
    apart = float(np.abs(mine - library).max()) if same else np.inf
    opening = f"{len(calls)} functions at work; a folder read, tracked by {tracker} and measured, and a pair matched"
    return report(calls, apart < 1e-4, opening, f"largest difference from the library's numbers: {apart:.6f}")


def _numbers(tracker: str) -> Array:
    """Depths and tracks of a folder (metres), its misfit, the error of its estimated path, depth of a stereo pair."""
    source = t3d.load_clip(CLIP).cut(0, 8)
    with tempfile.TemporaryDirectory() as home:
        write_recording(replace(source, depths=sensor(source, 0)), Path(home) / "desk")
        clip = t3d.load_clip(Path(home) / "desk")
    tracks = t3d.load_tracker(tracker).track(clip, t3d.grid_queries(clip, 5), support_grid=0)
    found = t3d.estimate_poses(clip)
    two = t3d.load_clip(CLIP.with_name("stereo_pair.npz")).cut(0, 1)
    depth = t3d.stereo_depth(two.video, two.extras["video_right"], two.intrinsics, BASELINE)
    measured = [misfit(clip, gap) for gap in (1, 3)]
    return np.concatenate(
        [
            clip.depths.ravel(),
            tracks.xyz.ravel(),
            depth.ravel(),
            measured,
            [n10_measure.path_error(places(found), places(clip))],
        ]
    )


_library = cache(_numbers)
