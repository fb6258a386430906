"""Sliding windows: which frames are solved together, and what a window starts from.

Paper: section 3.4 ("sliding windows"); half of every window is known from the one before.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from tapip3d_lite.model.frames import Frames


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
        still = coords[:, None].expand(-1, count, -1, -1).clone()
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
        source = torch.arange(start, stop, device=columns.device).clamp(max=start + half - 1)
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
