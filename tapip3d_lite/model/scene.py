"""What the tracker knows and says: `Scene` before any query, `Window` when one is being solved, `Step` after an update.

Paper: section 3.2 (the scene as a spatio-temporal feature cloud).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from tapip3d_lite.model.cloud import Level, Normalizer
from tapip3d_lite.model.frames import Frames
from tapip3d_lite.model.neighbors import Neighbors


@dataclass(frozen=True)
class Scene:
    """What is known about some frames before any query is asked.

    Attributes:
        frames: T posed RGB-D frames.
        points: (B, T, H, W, 3), in the trajectories' space.
        valid: (B, T, H, W) bool: depth known and inside the region of interest.
        levels: the feature cloud.
        space: the trajectories' space.
        start: which frame of the clip is the first.
    """

    frames: Frames
    points: Tensor
    valid: Tensor
    levels: list[Level]
    space: Any
    start: int = 0

    def cut(self, start: int, stop: int) -> Scene:
        """Frames [start, stop)."""
        levels = [level.cut(start, stop) for level in self.levels]
        points, valid = self.points[:, start:stop], self.valid[:, start:stop]
        return Scene(self.frames.cut(start, stop), points, valid, levels, self.space, self.start + start)


@dataclass(frozen=True)
class Step:
    """The state of one window after one update.

    Attributes:
        start: the window's first frame.
        iteration: 0..M-1.
        coords: (B, S, n, 3) in the trajectories' space; carries the gradient of this iteration only.
        logits: (B, S, n) visibility.
        columns: (n,) which of the N tracks these are.
        active: (B, n) bool, which of them belong to this window.
        scene: the window's S frames.
    """

    start: int
    iteration: int
    coords: Tensor
    logits: Tensor
    columns: Tensor
    active: Tensor
    scene: Scene

    @property
    def xyz(self) -> Tensor:
        """(B, S, n, 3) in the world."""
        return to_world(self.coords, self.scene.frames, self.scene.space)


@dataclass(frozen=True)
class Window:
    """One window, in normalised coordinates and ready to be updated.

    Attributes:
        scene: its S frames, in original units.
        norm: from original to normalised coordinates.
        levels: L levels of the cloud, prepared by the context, with normalised points.
        kept: L times (B, n, ...), what the context remembers of the queries.
        active: (B, n) bool, tracks that exist, or None if all do.
        columns: (n,) which of all tracks these are, and
        support: L times (B, n, 1 + K, ...) their neighbourhoods in the query frame, normalised: for those who look on.
        ready: what the tracker's fast form made of `kept`, once a window.
    """

    scene: Scene
    norm: Normalizer
    levels: list[Level]
    kept: list[Tensor]
    active: Tensor | None = None
    columns: Tensor | None = None
    support: list[Neighbors] | None = None
    ready: dict[Any, list] = field(default_factory=dict, repr=False)


def to_world(coords: Tensor, frames: Frames, space: Any) -> Tensor:
    """Trajectories (B, T, N, 3) of a space in world coordinates."""
    with torch.autocast(coords.device.type, enabled=False):
        return space.to_world(coords, frames.intrinsics, frames.extrinsics, frames.depths)
