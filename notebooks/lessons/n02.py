"""Lesson 02: coordinate spaces, what is left of a motion in each, and how right poses must be."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from lessons.checker import check
from lessons.guesses import reveal
from lessons.milestone import Use, milestone
from lessons.n02_exercises import EXERCISES
from lessons.n02_figures import gains, gravity_peak, motion_fit, noise_curves, paths_in_spaces
from lessons.n02_measures import accelerations, heights, peak, print_table, ratio
from lessons.n02_straightness import (
    SPACES,
    bend,
    fit_windows,
    from_space,
    line_through,
    rotations,
    stays_in_view,
    to_space,
    windows,
)
from lessons.pictures import pipeline, show
from lessons.progress import collect, in_use, progress, reset
from lessons.widgets import explore
from tapip3d_lite.geometry import invert, point_map, project

__all__ = [
    "EXERCISES",
    "SPACES",
    "accelerations",
    "bend",
    "check",
    "collect",
    "explore",
    "fit_windows",
    "from_space",
    "gains",
    "gravity_peak",
    "heights",
    "in_use",
    "line_through",
    "milestone",
    "motion_fit",
    "noise_curves",
    "parts",
    "paths_in_spaces",
    "peak",
    "pipeline",
    "print_table",
    "progress",
    "ratio",
    "reset",
    "reveal",
    "rotations",
    "show",
    "stays_in_view",
    "to_space",
    "windows",
]


def parts(use: Use) -> dict[str, object]:
    """The learner's re-basing as the tracker's spaces: `world`, `camera` and `first` differ in nothing but the anchor.

    From camera coordinates to the world the anchor is the inverse of the pose, from the world to the first camera it
    is that camera's pose, and so on.
    """
    rebase = _for_tensors(use("02.rebase"))

    def lift_to_world(self: Any, depths: Any, intrinsics: Any, extrinsics: Any) -> Any:
        return _maps(rebase, point_map(depths, intrinsics), invert(extrinsics))

    def lift_to_first(self: Any, depths: Any, intrinsics: Any, extrinsics: Any) -> Any:
        return _maps(rebase, point_map(depths, intrinsics), self.anchor @ invert(extrinsics))

    def first_from_world(self: Any, xyz: Any, intrinsics: Any, extrinsics: Any) -> Any:
        return rebase(xyz, extrinsics, self.anchor)[0]

    def first_to_world(self: Any, coords: Any, intrinsics: Any, extrinsics: Any, depths: Any) -> Any:
        return rebase(coords, extrinsics, invert(self.anchor))[0]

    def first_to_pixels(self: Any, coords: Any, intrinsics: Any, extrinsics: Any) -> Any:
        return project(coords, intrinsics, rebase(coords, extrinsics, self.anchor)[1])[0]

    def camera_from_world(self: Any, xyz: Any, intrinsics: Any, extrinsics: Any) -> Any:
        return rebase(xyz, extrinsics, extrinsics)[0]

    def camera_to_world(self: Any, coords: Any, intrinsics: Any, extrinsics: Any, depths: Any) -> Any:
        return rebase(coords, extrinsics, invert(extrinsics))[0]

    spaces = "tapip3d_lite.model.spaces"
    return {
        f"{spaces}:Space.lift": lift_to_world,
        f"{spaces}:First.lift": lift_to_first,
        f"{spaces}:First.from_world": first_from_world,
        f"{spaces}:First.to_world": first_to_world,
        f"{spaces}:First.to_pixels": first_to_pixels,
        f"{spaces}:Camera.from_world": camera_from_world,
        f"{spaces}:Camera.to_world": camera_to_world,
    }


def _maps(rebase: Callable, maps: torch.Tensor, anchors: torch.Tensor) -> torch.Tensor:
    """Point maps (..., H, W, 3) through anchors (..., 4, 4)."""
    points = maps.flatten(-3, -2)
    return rebase(points, anchors, anchors)[0].reshape(maps.shape)


def _for_tensors(rebase: Callable) -> Callable:
    """A function of arrays (T, N, 3), (T, 4, 4), (T, 4, 4) for tensors with any leading axes that broadcast."""

    def rebased(points: torch.Tensor, *poses: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        lead = torch.broadcast_shapes(points.shape[:-2], *(pose.shape[:-2] for pose in poses))
        many = [x.expand(*lead, *x.shape[-2:]) for x in (points, *poses)]
        moved = rebase(*(x.reshape(-1, *x.shape[-2:]).numpy() for x in many))
        return tuple(
            torch.as_tensor(np.asarray(new)).reshape(old.shape) for new, old in zip(moved, many[:2], strict=True)
        )

    return rebased
