"""Trackers without learning, to compare with: zero motion, and pyramidal Lucas-Kanade lifted by depth.

Both take the arguments of the learnt tracker's `track`, so that one call serves all; those that concern the model
alone (`space`, `iterations`, `support_grid`, `depth_roi`, `visible_threshold`) have no meaning here and change nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.geometry import project, unproject
from tapip3d_lite.queries import resolve_queries


@dataclass(frozen=True)
class StaticTracker:
    """Nothing moves in the world: every point stays at its query.

    A point counts as visible where it projects inside the image and no surface stands in front of it.

    Attributes:
        slack: relative depth difference up to which the surface at the pixel still is the point.
    """

    slack: float = 0.05

    def track(self, clip: Clip, queries: np.ndarray | None = None, **_model_only: object) -> Tracks:
        """Tracks of `queries` (N, 4), or of the clip's own queries, or of a grid."""
        queries = resolve_queries(clip, queries)
        xyz = np.repeat(queries[None, :, 1:], len(clip), 0)
        uv, z = project(xyz, clip.intrinsics, clip.extrinsics)
        surface, inside = _depth_at(clip, uv)
        free = (surface == 0) | (z <= surface * (1 + self.slack))
        return Tracks(xyz, inside & (z > 0) & free, queries)


@dataclass(frozen=True)
class KltTracker:
    """OpenCV's pyramidal Lucas-Kanade in the image, lifted by depth, with a forward-backward check for visibility.

    From its query frame each point is followed forward and backward in time, frame by frame. A point is lost where
    the way back misses its start by more than `tolerance`, where it leaves the image, or where its depth jumps.
    Between two visible frames the path is interpolated in 3D; before the first and after the last it stays put.

    Attributes:
        window: side of the Lucas-Kanade window in pixels.
        levels: pyramid levels above the image.
        tolerance: largest forward-backward error in pixels.
        jump: largest relative change of depth from frame to frame.
    """

    window: int = 9
    levels: int = 3
    tolerance: float = 1.5
    jump: float = 0.1

    def track(self, clip: Clip, queries: np.ndarray | None = None, **_model_only: object) -> Tracks:
        """Tracks of `queries` (N, 4), or of the clip's own queries, or of a grid."""
        queries = resolve_queries(clip, queries)
        start = queries[:, 0].astype(int)
        gray = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in clip.video]
        uv = np.zeros((len(clip), len(queries), 2), np.float32)
        z = np.zeros((len(clip), len(queries)), np.float32)
        alive = np.zeros(z.shape, bool)
        first_uv, first_z = project(queries[:, None, 1:], clip.intrinsics[start], clip.extrinsics[start])
        own = np.arange(len(queries))
        uv[start, own], z[start, own], alive[start, own] = first_uv[:, 0], first_z[:, 0], True
        for step, frames in ((1, range(len(clip) - 1)), (-1, range(len(clip) - 1, 0, -1))):
            for t in frames:
                begun = start <= t if step == 1 else start >= t
                self._advance(clip, gray, t, t + step, np.flatnonzero(alive[t] & begun), uv, z, alive)
        world = unproject(uv, z, clip.intrinsics, clip.extrinsics)
        world[start, own] = queries[:, 1:]
        return Tracks(_filled(world, alive), alive, queries)

    def _advance(
        self,
        clip: Clip,
        gray: list,
        t: int,
        s: int,
        which: np.ndarray,
        uv: np.ndarray,
        z: np.ndarray,
        alive: np.ndarray,
    ) -> None:
        """Follow the points `which` from frame t to its neighbour s, and mark those that arrive."""
        if not len(which):
            return
        options = {"winSize": (self.window, self.window), "maxLevel": self.levels}
        here = np.ascontiguousarray(uv[t, which])
        there, found, _ = cv2.calcOpticalFlowPyrLK(gray[t], gray[s], here, None, **options)
        back, found_back, _ = cv2.calcOpticalFlowPyrLK(gray[s], gray[t], there, None, **options)
        depth, inside = _steadiest_depth(clip, s, there, z[t, which])
        steady = np.abs(depth - z[t, which]) <= self.jump * z[t, which]
        returned = np.linalg.norm(back - here, axis=-1) <= self.tolerance
        kept = (found[:, 0] & found_back[:, 0]).astype(bool) & returned & inside & steady
        uv[s, which[kept]], z[s, which[kept]], alive[s, which[kept]] = there[kept], depth[kept], True


def _depth_at(clip: Clip, uv: np.ndarray, frames: list[int] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Depth at the nearest pixel (T, N), 0 outside, and whether (T, N) the pixel is inside the image."""
    height, width = clip.size
    nearest = np.rint(np.nan_to_num(uv, nan=-1e6, posinf=-1e6, neginf=-1e6)).clip(-1, 1e6).astype(int)
    inside = ((nearest >= 0) & (nearest < (width, height))).all(-1)
    t = np.arange(len(clip)) if frames is None else np.array(frames)
    u, v = np.where(inside[..., None], nearest, 0).transpose(2, 0, 1)
    return np.where(inside, clip.depths[t[:, None], v, u], 0), inside


def _steadiest_depth(clip: Clip, frame: int, uv: np.ndarray, before: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the 3 x 3 depths around each pixel (N, 2) the one nearest to `before` (N,): at a silhouette the nearest
    pixel often belongs to what lies behind.
    """
    steps = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), -1).reshape(9, 1, 2)
    _, inside = _depth_at(clip, uv[None], frames=[frame])
    around = np.concatenate([_depth_at(clip, (uv + step)[None], frames=[frame])[0] for step in steps])
    around = np.where(around > 0, around, np.inf)
    best = np.abs(around - before).argmin(0)
    return around[best, np.arange(len(uv))], inside[0]


def _filled(world: np.ndarray, alive: np.ndarray) -> np.ndarray:
    """Positions (T, N, 3) with the frames that are not alive interpolated linearly in time, held at the ends."""
    time, filled = np.arange(len(world)), world.copy()
    for n in np.flatnonzero(~alive.all(0)):
        known = alive[:, n]
        for axis in range(3):
            filled[:, n, axis] = np.interp(time, time[known], world[known, n, axis])
    return filled
