"""The support side: each query's own neighbourhood, in the frame where it was asked.

Paper: section 3.3. It is collected once a call, in un-normalised coordinates; only offsets are re-normalised later.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from tapip3d_lite.model.cloud import Level
from tapip3d_lite.model.neighbors import Neighbors
from tapip3d_lite.model.scene import Scene


def query_support(
    neighborhood: Callable[..., Neighbors], scene: Scene, times: Tensor, coords: Tensor
) -> list[Neighbors]:
    """Neighbourhoods of queries, the query itself first.

    Args:
        neighborhood: as `neighbors.KNearest`.
        scene: T frames.
        times: (B, N) int64 query frames.
        coords: (B, N, 3) queries in the scene's space.

    Returns:
        For each level (B, N, 1 + K, ...): row 0 is the query, with the bilinear feature at its pixel and index -1.
    """
    if coords.is_cuda:
        return _at_once(neighborhood, scene, times, coords)
    groups = []  # (frame, columns queried there in any batch element, their cells' pixels)
    for frame in times.unique().tolist():
        columns = (times == frame).any(0).nonzero()[:, 0]
        here = scene.frames.cut(frame, frame + 1)
        uv = scene.space.to_pixels(coords[:, None, columns], here.intrinsics, here.extrinsics)
        groups.append((frame, columns, uv))
    return [_level_support(neighborhood, level, scene.frames.size, groups, times, coords) for level in scene.levels]


def _at_once(neighborhood: Callable[..., Neighbors], scene: Scene, times: Tensor, coords: Tensor) -> list[Neighbors]:
    """All queries in all frames, of which each query's own is kept: T times the work, T times fewer calls for a GPU."""
    frames, (batch, count) = scene.frames, times.shape
    everywhere = coords[:, None].expand(-1, len(frames), -1, -1)
    uv = scene.space.to_pixels(everywhere, frames.intrinsics, frames.extrinsics)
    row = torch.arange(batch, device=coords.device)[:, None], times, torch.arange(count, device=coords.device)
    return [
        _level_at_once(neighborhood, level, everywhere, level.cells(uv, frames.size), row, coords)
        for level in scene.levels
    ]


def _level_at_once(
    neighborhood: Callable[..., Neighbors],
    level: Level,
    everywhere: Tensor,
    cells: Tensor,
    row: tuple[Tensor, Tensor, Tensor],
    coords: Tensor,
) -> Neighbors:
    near = neighborhood(level, everywhere, cells)
    own = bilinear(level.features.flatten(0, 1), cells.flatten(0, 1)).unflatten(0, (len(coords), -1))[:, :, :, None]
    center = near.center.unsqueeze(-2)
    features, points = torch.cat([own, near.features], 3)[row], torch.cat([center, near.points], 3)[row]
    if near.indices is None:
        return Neighbors(features, points, coords, None)
    indices = near.indices[row]
    return Neighbors(features, points, coords, torch.cat([torch.full_like(indices[..., :1], -1), indices], -1))


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
        near = neighborhood(here, coords[:, None, columns], cells)
        center = near.center[:, 0, :, None]
        own = bilinear(here.features[:, 0], cells[:, 0])[:, :, None]
        new = torch.cat([own, near.features[:, 0]], 2), torch.cat([center, near.points[:, 0]], 2)
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


def bilinear(grid: Tensor, cells: Tensor) -> Tensor:
    """Interpolate a grid (B, h, w, C) at cells (B, N, 2) = (column, row), clamped to the border; (B, N, C)."""
    height, width, channels = grid.shape[1:]
    x, y = cells[..., 0].clamp(0, width - 1), cells[..., 1].clamp(0, height - 1)
    left, top = x.floor().clamp(max=max(width - 2, 0)), y.floor().clamp(max=max(height - 2, 0))
    right, bottom = (left + 1).clamp(max=width - 1), (top + 1).clamp(max=height - 1)
    a, b = (x - left).unsqueeze(-1), (y - top).unsqueeze(-1)
    flat = grid.flatten(1, 2)

    def at(row: Tensor, column: Tensor) -> Tensor:
        index = (row * width + column).long().unsqueeze(-1)
        return flat.gather(1, index.expand(-1, -1, channels))

    upper = at(top, left) * (1 - a) + at(top, right) * a
    lower = at(bottom, left) * (1 - a) + at(bottom, right) * a
    return upper * (1 - b) + lower * b
