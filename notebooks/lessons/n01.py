"""Lesson 01: from RGB-D to point maps and feature clouds; what its notebook uses, and where its functions go."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from lessons.checker import check
from lessons.guesses import reveal
from lessons.milestone import milestone
from lessons.n01_cells import CELL_EXERCISES
from lessons.n01_exercises import CAMERA_EXERCISES, random_extrinsics, random_intrinsics
from lessons.n01_figures import (
    cells_from_the_side,
    cells_in_space,
    from_the_side,
    image_and_depth,
    levels_from_above,
    lines_over_pixels,
    slip_over_depth,
    two_liftings,
)
from lessons.pictures import pipeline, show
from lessons.progress import collect, in_use, progress, reset
from lessons.widgets import explore
from tapip3d_lite.geometry import pixel_grid
from tapip3d_lite.model.cloud import Level

__all__ = [
    "EXERCISES",
    "cells_from_the_side",
    "cells_in_space",
    "check",
    "collect",
    "explore",
    "from_the_side",
    "image_and_depth",
    "in_use",
    "levels_from_above",
    "lines_over_pixels",
    "milestone",
    "parts",
    "pipeline",
    "progress",
    "random_extrinsics",
    "random_intrinsics",
    "reset",
    "reveal",
    "show",
    "slip_over_depth",
    "two_liftings",
]

EXERCISES = CAMERA_EXERCISES + CELL_EXERCISES


KEPT = ("tapip3d_lite.model.spaces:Space.lift",)  # lesson 02 lifts into the world without this lesson's `to_world`


def parts(use: Callable[[str], Callable[..., object]]) -> dict[str, object]:
    """Where the lesson's functions stand in the tracker: all that it knows of a scene goes through them."""
    lift, to_world = use("01.unproject"), use("01.to_world")
    pick, cloud = use("01.nearest_cells"), use("01.cloud")

    def point_map(depths: Tensor, intrinsics: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        height, width = depths.shape[-2:]
        grid = pixel_grid(height, width, depths).reshape(-1, 2).numpy()
        points = lift(grid, depths.reshape(-1, height * width).numpy(), intrinsics.reshape(-1, 3, 3).numpy())
        if extrinsics is not None:
            points = to_world(points, extrinsics.reshape(-1, 4, 4).numpy())
        return torch.as_tensor(np.asarray(points), dtype=depths.dtype).reshape(*depths.shape, 3)

    def feature_cloud(features: Tensor, points: Tensor, valid: Tensor, levels: int) -> list[Level]:
        rows = torch.cat([points, valid[..., None].to(points.dtype)], -1)  # (B, T, H, W, 4)
        frames = zip(features.flatten(0, 1), rows.flatten(0, 1), strict=True)
        clouds = [cloud(maps, pixels, levels, pick) for maps, pixels in frames]
        found = []
        for pairs in zip(*clouds, strict=True):
            maps, pixels = (torch.stack(x).unflatten(0, features.shape[:2]) for x in zip(*pairs, strict=True))
            found.append(Level(maps, pixels[..., :3], pixels[..., 3] > 0))
        return found

    return {
        "tapip3d_lite.model.spaces:point_map": point_map,
        "tapip3d_lite.model.tracker:feature_cloud": feature_cloud,
    }
