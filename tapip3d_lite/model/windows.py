"""Sliding windows: which frames are solved together, from what a window starts, and each query's own neighbourhood.

    windows  [e - S, e),  e = S, S + S/2, …        the next window starts S/2 frames later
    start    tau_t = result of the window before (first half), its last frame repeated (second half)
    support  the neighbourhood of each query in its own frame, collected once a call

Paper: section 3.2. `Scene` is known before any query, `Window` when one is being solved, `Step` after an update,
`State` holds all trajectories between windows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from tapip3d_lite.model.cloud import Level, Normalizer
from tapip3d_lite.model.frames import Frames
from tapip3d_lite.model.neighbors import Neighbors, bilinear

Neighborhood = Callable[..., Neighbors]  # as `KNearest.forward`


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
    spread: Tensor | None = None  # trial: (B, S, n, 1 or 2)

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
        kept: L times (B, n, ...), what the context remembers of the queries, see `n2n.Context.describe`.
        active: (B, n) bool, tracks that exist, or None if all do.
        columns: (n,) which of all tracks these are, and
        support: L times (B, n, 1 + K, ...) their neighbourhoods in the query frame, normalised: for those who look on.
    """

    scene: Scene
    norm: Normalizer
    levels: list[Level]
    kept: list[Any]
    active: Tensor | None = None
    columns: Tensor | None = None
    support: list[Neighbors] | None = None


def to_world(coords: Tensor, frames: Frames, space: Any) -> Tensor:
    """Trajectories (B, T, N, 3) of a space in world coordinates."""
    with torch.autocast(coords.device.type, enabled=False):
        return space.to_world(coords, frames.intrinsics, frames.extrinsics, frames.depths)


def window_ends(frames: int, window: int) -> range:
    """Frames after the last of each window: S, S + S/2, ...; none if there are at most S/2 frames."""
    return range(window, frames + 1, window // 2)


@dataclass
class State:
    """All trajectories so far, in their space and its original units.

    Attributes:
        coords: (B, T', N, 3), T' padded to whole half windows; starts as the query's position everywhere.
        logits: (B, T', N), starts as 0.
        queries: (B, N, 3) the queries in the trajectories' space.
        times: (B, N) int64 query frames.
    """

    coords: Tensor
    logits: Tensor
    queries: Tensor
    times: Tensor

    @classmethod
    def start(cls, queries: Tensor, frames: Frames, space: Any, multiple: int, check: bool = True) -> State:
        """Trajectories that stand still at their queries (B, N, 4), given in the world; `check` their frames or not."""
        clips = len(frames.depths)
        if queries.ndim != 3 or queries.shape[0] != clips or queries.shape[2] != 4:
            raise ValueError(f"queries: expected ({clips}, N, 4) rows (t, x, y, z), got {tuple(queries.shape)}")
        times = queries[..., 0].long()
        if check and bool(((times < 0) | (times >= len(frames))).any()):
            raise ValueError(f"queries: t must be in [0, {len(frames) - 1}], got {times.min()}..{times.max()}")
        batch = torch.arange(len(queries), device=queries.device)[:, None]  # (B, 1)
        with torch.autocast(queries.device.type, enabled=False):
            cameras = frames.intrinsics[batch, times], frames.extrinsics[batch, times]  # (B, N, ...)
            coords = space.from_world(queries[..., None, 1:], *cameras)[:, :, 0]
        count = len(frames) + -len(frames) % multiple
        still = coords[:, None].expand(-1, count, -1, -1).clone()  # (B, N, 3) -> (B, T', N, 3)
        return cls(still, still.new_zeros(still.shape[:3]), coords, times)

    def members(self, stop: int, active: Tensor | None, all_columns: bool = False) -> tuple[Tensor, Tensor]:
        """Tracks of the window that ends before frame `stop`: those queried before it.

        Returns:
            columns (n,), the tracks that any batch element has, or all; and active (B, n) bool, which really exist.
        """
        inside = self.times < stop
        inside = inside if active is None else inside & active
        if all_columns:
            return torch.arange(inside.shape[1], device=inside.device), inside
        columns = inside.any(0).nonzero()[:, 0]
        return columns, inside[:, columns]

    def initial(self, start: int, stop: int, columns: Tensor, velocity: float = 0.0) -> tuple[Tensor, Tensor]:
        """What a window starts from: its first half as it is, then that half's last frame repeated.

        Tracks queried in the second half have no history yet and start at their query in all frames.
        """
        half = (stop - start) // 2
        source = torch.arange(start, stop, device=columns.device).clamp(max=start + half - 1)  # (S,)
        coords, logits = self.coords[:, source][:, :, columns], self.logits[:, source][:, :, columns]
        known = (self.times[:, columns] < start + half)[:, None]  # (B, 1, n)
        if velocity and start:
            from tapip3d_lite.model.trial import extrapolate

            coords = extrapolate(coords, self.times[:, columns] - start, half, velocity)
        coords = torch.where(known[..., None], coords, self.queries[:, None, columns])
        return coords, torch.where(known, logits, 0)

    def write(self, start: int, stop: int, columns: Tensor, active: Tensor, coords: Tensor, logits: Tensor) -> None:
        """Overwrite the window's frames, the overlap with the window before included."""
        mask = active[:, None]  # (B, 1, n)
        old = self.coords[:, start:stop, columns], self.logits[:, start:stop, columns]
        self.coords[:, start:stop, columns] = torch.where(mask[..., None], coords, old[0])
        self.logits[:, start:stop, columns] = torch.where(mask, logits, old[1])


def query_support(neighborhood: Neighborhood, scene: Scene, times: Tensor, coords: Tensor) -> list[Neighbors]:
    """Neighbourhoods of queries, each in the frame where it was asked: for each level (B, N, 1 + K, ...).

    The query frames `times` (B, N) are int64, `coords` (B, N, 3) the queries in the scene's space.
    """
    supports = []
    for level in scene.levels:
        whole: dict[str, Tensor] = {}
        for frame in times.unique().tolist():
            columns = (times == frame).any(0).nonzero()[:, 0]  # (n,) asked here in any batch element
            mine = times[:, columns] == frame  # (B, n)
            here = scene.cut(frame, frame + 1), level.cut(frame, frame + 1)
            near = around_queries(neighborhood, *here, coords[:, columns])
            for name in ("features", "points", "indices"):
                if getattr(near, name) is not None:
                    new = getattr(near, name)[:, 0]  # (B, n, 1 + K, ...)
                    total = whole.setdefault(name, new.new_zeros(*times.shape, *new.shape[2:]))
                    fits = mine.view(*mine.shape, *[1] * (new.ndim - 2))  # (B, n, 1, ...)
                    total[:, columns] = torch.where(fits, new, total[:, columns])
        supports.append(Neighbors(**whole, center=coords))
    return supports


def around_queries(neighborhood: Neighborhood, scene: Scene, level: Level, coords: Tensor) -> Neighbors:
    """Neighbourhoods (B, T, N, 1 + K, ...) of queries (B, N, 3) in each of T frames, the query itself first.

    That first row has the bilinear feature at the query's pixel and index -1.
    """
    frames = scene.frames
    coords = coords[:, None].expand(-1, len(frames), -1, -1)  # (B, T, N, 3)
    cells = level.cells(scene.space.to_pixels(coords, frames.intrinsics, frames.extrinsics), frames.size)
    near = neighborhood(level, coords, cells)  # (B, T, N, K, ...)
    own = bilinear(level.features.flatten(0, 1), cells.flatten(0, 1)).unflatten(0, coords.shape[:2])  # (B, T, N, C)
    features = torch.cat([own.unsqueeze(3), near.features], 3)  # (B, T, N, 1 + K, C)
    points = torch.cat([near.center.unsqueeze(3), near.points], 3)  # (B, T, N, 1 + K, 3)
    first = None if near.indices is None else torch.full_like(near.indices[..., :1], -1)
    return Neighbors(features, points, coords, None if first is None else torch.cat([first, near.indices], 3))
