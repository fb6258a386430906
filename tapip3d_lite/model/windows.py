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
        if queries.ndim != 3 or queries.shape[0] != len(frames.depths) or queries.shape[2] != 4:
            raise ValueError(
                f"queries: expected ({len(frames.depths)}, N, 4) rows (t, x, y, z), got {tuple(queries.shape)}"
            )
        times = queries[..., 0].long()
        if check and bool(((times < 0) | (times >= len(frames))).any()):
            raise ValueError(
                f"queries: t must be in [0, {len(frames) - 1}], got {int(times.min())}..{int(times.max())}"
            )
        batch = torch.arange(len(queries), device=queries.device)[:, None]
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

    def initial(self, start: int, stop: int, columns: Tensor) -> tuple[Tensor, Tensor]:
        """What a window starts from: its first half as it is, then that half's last frame repeated.

        Tracks queried in the second half have no history yet and start at their query in all frames.
        """
        half = (stop - start) // 2
        source = torch.arange(start, stop, device=columns.device).clamp(max=start + half - 1)  # (S,)
        coords, logits = self.coords[:, source][:, :, columns], self.logits[:, source][:, :, columns]
        known = (self.times[:, columns] < start + half)[:, None]  # (B, 1, n)
        coords = torch.where(known[..., None], coords, self.queries[:, None, columns])
        return coords, torch.where(known, logits, 0)

    def write(self, start: int, stop: int, columns: Tensor, active: Tensor, coords: Tensor, logits: Tensor) -> None:
        """Overwrite the window's frames, the overlap with the window before included."""
        mask = active[:, None]
        old = self.coords[:, start:stop, columns], self.logits[:, start:stop, columns]
        self.coords[:, start:stop, columns] = torch.where(mask[..., None], coords, old[0])
        self.logits[:, start:stop, columns] = torch.where(mask, logits, old[1])


def query_support(
    neighborhood: Callable[..., Neighbors], scene: Scene, times: Tensor, coords: Tensor
) -> list[Neighbors]:
    """Neighbourhoods of queries, the query itself first.

    Args:
        neighborhood: as `neighbors.KNearest.forward`.
        scene: T frames.
        times: (B, N) int64 query frames.
        coords: (B, N, 3) queries in the scene's space.

    Returns:
        For each level (B, N, 1 + K, ...): row 0 is the query, with the bilinear feature at its pixel and index -1.
    """
    groups = []  # (frame, columns queried there in any batch element, their cells' pixels)
    for frame in times.unique().tolist():
        columns = (times == frame).any(0).nonzero()[:, 0]
        here = scene.frames.cut(frame, frame + 1)
        uv = scene.space.to_pixels(coords[:, None, columns], here.intrinsics, here.extrinsics)
        groups.append((frame, columns, uv))
    return [_level_support(neighborhood, level, scene.frames.size, groups, times, coords) for level in scene.levels]


def _level_support(
    neighborhood: Callable[..., Neighbors],
    level: Level,
    size: tuple[int, int],
    groups: list,
    times: Tensor,
    coords: Tensor,
) -> Neighbors:
    features = points = indices = None
    for frame, columns, uv in groups:
        here = level.cut(frame, frame + 1)
        cells = level.cells(uv, size)
        near = neighborhood(here, coords[:, None, columns], cells)  # (B, 1, n, K, ...)
        center = near.center[:, 0, :, None]  # (B, n, 1, 3)
        own = bilinear(here.features[:, 0], cells[:, 0])[:, :, None]  # (B, n, 1, C)
        new = torch.cat([own, near.features[:, 0]], 2), torch.cat([center, near.points[:, 0]], 2)  # (B, n, 1 + K, ...)
        mine = (times[:, columns] == frame)[..., None, None]  # (B, n, 1, 1)
        features = _merge(features, columns, mine, new[0], coords)
        points = _merge(points, columns, mine, new[1], coords)
        if near.indices is not None:
            rows = torch.cat([torch.full_like(near.indices[:, 0, :, :1], -1), near.indices[:, 0]], 2)
            indices = _merge(indices, columns, mine[..., 0], rows, coords)
    return Neighbors(features, points, coords, indices)


def _merge(total: Tensor | None, columns: Tensor, mine: Tensor, new: Tensor, coords: Tensor) -> Tensor:
    if total is None:
        total = new.new_zeros(*coords.shape[:2], *new.shape[2:])
    total[:, columns] = torch.where(mine, new, total[:, columns])
    return total
