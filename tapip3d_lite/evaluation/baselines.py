"""Baselines without learning: zero motion, and pyramidal Lucas-Kanade lifted by depth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import cv2
import numpy as np

from tapip3d_lite.bundle import there_and_back
from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.geometry import project, unproject
from tapip3d_lite.queries import near_origin, resolve_queries, shifted
from tapip3d_lite.validate import checked


class TrackerLike(Protocol):
    """Any tracker, learnt or not; the options are those of `model.track.track`."""

    def track(self, clip: Clip, queries: np.ndarray | None = None, **options: Any) -> Tracks:
        """3D tracks of `queries` (N, 4), of the clip's own queries, or of a grid on the first frame."""


class Baseline:
    """Takes the arguments of a learnt tracker's `track`, ignores those that concern only the model, and calls `_follow`."""

    @checked
    def track(
        self,
        clip: Clip,
        queries: np.ndarray | None = None,
        space: str | None = None,
        iterations: int | None = None,
        support_grid: int | None = None,
        bidirectional: bool = True,
        depth_roi: str | tuple[float, float] | None = None,
        visible_threshold: float | None = None,
        size: tuple[int, int] | None = None,
        crop: tuple[int, int, int, int] | None = None,
        progress: bool = False,
    ) -> Tracks:
        """Tracks of `queries` (N, 4), or of the clip's own queries, or of a grid.

        With `bidirectional=False` Lucas-Kanade holds a point still and counts it as hidden before its query.
        """
        queries, (near, shift) = resolve_queries(clip, queries), near_origin(clip)
        found = self._follow(near, shifted(queries, shift), bidirectional)
        return replace(found, xyz=found.xyz + shift, queries=queries)


@dataclass(frozen=True)
class StaticTracker(Baseline):
    """Zero motion in the world: every point stays at its query.

    A point counts as visible where it projects inside the image and the depth map shows a surface there, neither in
    front of it (it is hidden) nor behind it (whatever the query lay on has moved away).

    Attributes:
        slack: relative depth difference up to which the surface at the pixel counts as the point.
    """

    slack: float = 0.02

    def _follow(self, clip: Clip, queries: np.ndarray, _bidirectional: bool) -> Tracks:
        xyz = np.repeat(queries[None, :, 1:], len(clip), 0)
        uv, z = project(xyz, clip.intrinsics, clip.extrinsics)
        surface, inside = _depth_at(clip, uv, np.arange(len(clip)))
        return Tracks(xyz, inside & (z > 0) & (np.abs(z - surface) <= self.slack * z), queries)


@dataclass(frozen=True)
class KltTracker(Baseline):
    """OpenCV's pyramidal Lucas-Kanade in the image, lifted by depth, with a forward-backward check for visibility.

    From its query frame each point is followed forward and backward in time, frame by frame. The search starts where
    the point would be if it had stood still in the world since it was last seen. It is lost where the way back misses
    its start by more than `tolerance`, where it leaves the image, or where the depth found is another surface's. A
    lost point is looked for again in every later frame. Between two visible frames the path is interpolated in 3D;
    before the first and after the last the point stays put.

    Attributes:
        window: side of the Lucas-Kanade window in pixels.
        levels: pyramid levels above the image.
        tolerance: largest forward-backward error in pixels.
        jump: largest relative change of depth, apart from the camera's motion, since the point was last seen.
    """

    window: int = 9
    levels: int = 2
    tolerance: float = 1.0
    jump: float = 0.1

    def _follow(self, clip: Clip, queries: np.ndarray, bidirectional: bool) -> Tracks:
        paths = _Paths(clip, queries)
        for step in (1, -1) if bidirectional else (1,):
            last = paths.start.copy()  # (N,) the frame where each point was last seen in this direction
            for t in range(len(clip))[::step][1:]:
                self._advance(paths, t, last, step * (t - paths.start) > 0)
        return Tracks(_filled(paths.world, paths.seen), paths.seen, paths.queries)

    def _advance(self, paths: _Paths, t: int, last: np.ndarray, begun: np.ndarray) -> None:
        """Look in frame t for all points (N,) whose query frame lies behind, from where each was `last` seen."""
        camera = paths.clip.intrinsics[t], paths.clip.extrinsics[t]
        options = {"winSize": (self.window, self.window), "maxLevel": self.levels}
        still, z = project(paths.world[last, np.arange(len(last))], *camera)
        surface, inside = _nearest_depth(paths.clip, t, still, z)
        # A lost point can reappear only where a surface has its depth; a point seen in the last frame may have moved.
        possible = begun & (z > 0) & ((last == t - 1) | (last == t + 1) | (inside & self._same(surface, z)))
        for origin in np.unique(last[possible]):
            which = np.flatnonzero(possible & (last == origin))
            here, guess = paths.uv[origin, which], still[which].astype(np.float32)
            there, returned = there_and_back(paths.gray[origin], paths.gray[t], here, guess, self.tolerance, **options)
            depth, inside = _nearest_depth(paths.clip, t, there, z[which])
            kept = returned & inside & self._same(depth, z[which])
            if abs(origin - t) > 1:  # after a gap a large correction is more often another point than this one
                kept &= np.linalg.norm(there - still[which], axis=-1) <= 2 * self.tolerance
            found = which[kept]
            paths.uv[t, found], paths.seen[t, found], last[found] = there[kept], True, t
            paths.world[t, found] = unproject(there[kept], depth[kept], *camera)

    def _same(self, depth: np.ndarray, expected: np.ndarray) -> np.ndarray:
        return np.abs(depth - expected) <= self.jump * expected


class _Paths:
    """The tracks found so far: pixels `uv` (T, N, 2), `world` (T, N, 3) and `seen` (T, N), from the queries outward."""

    def __init__(self, clip: Clip, queries: np.ndarray) -> None:
        shape = len(clip), len(queries)
        self.clip, self.queries, self.start = clip, queries, queries[:, 0].astype(int)
        self.gray = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in clip.video]
        self.uv, self.world = np.zeros((*shape, 2), np.float32), np.zeros((*shape, 3), np.float32)
        self.seen = np.zeros(shape, bool)
        at = self.start, np.arange(len(queries))
        uv, _ = project(queries[:, None, 1:], clip.intrinsics[self.start], clip.extrinsics[self.start])
        self.uv[at], self.world[at], self.seen[at] = uv[:, 0], queries[:, 1:], True


def _depth_at(clip: Clip, uv: np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth at the pixel nearest to uv (F, N, 2) in `frames` (F,), 0 outside; and whether (F, N) it is inside."""
    height, width = clip.size
    nearest = np.rint(np.nan_to_num(uv, nan=-1e6, posinf=-1e6, neginf=-1e6)).clip(-1, 1e6).astype(int)
    inside = ((nearest >= 0) & (nearest < (width, height))).all(-1)
    u, v = np.where(inside[..., None], nearest, 0).transpose(2, 0, 1)
    return np.where(inside, clip.depths[frames[:, None], v, u], 0), inside


def _nearest_depth(clip: Clip, frame: int, uv: np.ndarray, expected: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the 3 x 3 depths around each pixel (N, 2) the one nearest to `expected` (N,), and whether the pixel is inside.

    At a silhouette the pixel itself often belongs to what lies behind.
    """
    steps = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), -1).reshape(9, 1, 2)
    around, inside = _depth_at(clip, uv + steps, np.full(9, frame))  # (9, N)
    around = np.where(around > 0, around, np.inf)
    best = np.abs(around - expected).argmin(0)
    return around[best, np.arange(len(uv))], inside[4]  # the middle one


def _filled(world: np.ndarray, alive: np.ndarray) -> np.ndarray:
    """Positions (T, N, 3) with the frames that are not alive interpolated linearly in time, held at the ends."""
    time, filled = np.arange(len(world)), world.copy()
    for n in np.flatnonzero(~alive.all(0)):
        known = alive[:, n]
        for axis in range(3):
            filled[:, n, axis] = np.interp(time, time[known], world[known, n, axis])
    return filled
