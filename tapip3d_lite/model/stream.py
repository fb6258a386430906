"""Tracking while frames come in: push frames, get each window's tracks as soon as it is complete.

    push(frame t):  the S newest frames are kept;  at t + 1 = S, S + S/2, … one window is solved

Paper: section 3.2. Sliding windows look S frames ahead and no further, so nothing else of the video is needed. The
result equals the offline tracker's forward pass on the same frames.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.model.frames import Frames, frames_from_clip, resize_clip
from tapip3d_lite.model.neighbors import Neighbors
from tapip3d_lite.model.spaces import fitted
from tapip3d_lite.model.track import check_options, visibility
from tapip3d_lite.model.windows import Scene, State, Step
from tapip3d_lite.queries import support_queries
from tapip3d_lite.validate import floats


class Stream:
    """Tracks of queries that are known in advance, over frames that are not.

    Args:
        tracker: in evaluation mode.
        queries: (N, 4) rows (t, x, y, z), world; t counts pushed frames and may lie in the future.
        space: as for `track`.
        iterations: M, the config's if None.
        support_grid: side of a grid of extra queries on the first frame that are tracked along and left out of the results.
        depth_roi: depths (near, far) that count for the scale; None: all. It cannot be found from the whole clip here.
        visible_threshold: probability from which a point counts as visible; the config's if None.
        watch: called with every update.

    Raises:
        ValueError: queries that are no (N, 4) rows with whole frame numbers, or a bad option.
    """

    def __init__(
        self,
        tracker: nn.Module,
        queries: np.ndarray,
        space: Any = None,
        iterations: int | None = None,
        support_grid: int = 0,
        depth_roi: tuple[float, float] | None = None,
        visible_threshold: float | None = None,
        watch: Callable[[Step], None] | None = None,
    ) -> None:
        threshold = check_options(tracker, space, depth_roi, visible_threshold, support_grid)
        if isinstance(depth_roi, str):
            raise ValueError(
                f"depth_roi: a stream does not know the whole clip's depths, so {depth_roi!r} cannot work; give (near, far) or None"
            )
        if iterations is not None and iterations < 1:
            raise ValueError(f"iterations: expected at least 1, got {iterations}")
        self.tracker, self.space, self.roi = tracker, tracker.resolve_space(space), depth_roi
        self.iterations = tracker.config.iterations if iterations is None else iterations
        self.threshold, self.grid, self.watch = threshold, support_grid, watch
        self.queries = _checked(queries)
        self._begin(self.queries)
        self.window: list[tuple[Frames, Tensor]] = []  # the last S frames with their features
        self.cameras: list[tuple[Tensor, Tensor, Tensor]] = []  # intrinsics, extrinsics, depth of every frame
        self.support: list[Neighbors] = []
        self.seen = 0

    def push(
        self, image: np.ndarray, depth: np.ndarray, intrinsics: np.ndarray, extrinsics: np.ndarray
    ) -> Tracks | None:
        """Take one frame.

        Args:
            image: (H, W, 3) uint8.
            depth: (H, W); 0 = unknown.
            intrinsics: (3, 3).
            extrinsics: (4, 4) world to camera.

        Returns:
            When a window is complete the tracks of its S frames, the last one being this frame; else None. Frames of
            the overlap with the window before are returned again, improved.

        Raises:
            ValueError: arrays that do not fit, as for `Clip`.
        """
        clip = Clip(image[None], depth[None], np.asarray(intrinsics)[None], np.asarray(extrinsics)[None])
        clip = resize_clip(clip, self.tracker.config.image_size, self.tracker.config.as_released)
        frames = frames_from_clip(clip, device=self.rows.device)
        if self.seen == 0:
            self.space = fitted(self.space, frames)
            grid = support_queries(clip, self.grid) if self.grid else self.queries[:0]
            self._begin(np.concatenate([self.queries, grid]))
        with torch.no_grad():
            return self._push(frames, self.tracker.encoder(frames.rgb))

    @torch.no_grad()
    def finish(self) -> Tracks:
        """The last frame is repeated to complete a window, as offline; returns the tracks of all frames."""
        real, size = self.seen, self.tracker.config.window
        while self.seen and (self.seen < size or self.seen % (size // 2)):
            self._push(*self.window[-1])
        return self._tracks(0, real)

    def _begin(self, rows: np.ndarray) -> None:
        """Trajectories of no frames yet, of queries (N, 4) and the support grid's."""
        self.rows = torch.from_numpy(rows).to(next(self.tracker.parameters()).device)[None]  # (1, N, 4)
        nothing = self.rows.new_zeros(1, 0, len(rows), 3)
        self.state = State(nothing, nothing[..., 0], nothing.new_zeros(1, len(rows), 3), self.rows[..., 0].long())

    def _push(self, frames: Frames, features: Tensor) -> Tracks | None:
        state, size = self.state, self.tracker.config.window
        flat = getattr(self.space, "free_axes", (1.0, 1.0, 1.0))[2] == 0
        depth = frames.depths if flat else frames.depths[..., :1, :1].clone()  # only flat spaces need it once lifted
        self.cameras.append((frames.intrinsics, frames.extrinsics, depth))
        arriving = state.times[0] == self.seen
        if bool(arriving.any()):
            mine = self.rows[:, None, arriving, 1:]  # (1, 1, n, 3)
            state.queries[:, arriving] = self.space.from_world(mine, frames.intrinsics, frames.extrinsics)[:, 0]
            state.coords[:, :, arriving] = state.queries[:, None, arriving]
        state.coords = torch.cat([state.coords, state.queries[:, None]], 1)  # (1, T, N, 3)
        state.logits = torch.cat([state.logits, state.coords.new_zeros(1, 1, self.rows.shape[1])], 1)
        self.window = [*self.window[-(size - 1) :], (frames, features)]
        self.seen += 1
        if self.seen < size or (self.seen - size) % (size // 2):
            return None
        return self._solve(self.seen - size, self.seen)

    def _solve(self, start: int, stop: int) -> Tracks:
        if bool((self.state.times < stop).any()):
            parts = ([getattr(f, name) for f, _ in self.window] for name in Frames.__annotations__)
            frames, features = Frames(*(torch.cat(x, 1) for x in parts)), torch.cat([x for _, x in self.window], 1)
            scene = self.tracker.scene(frames, features, self.space, self.roi, start)
            self._add_support(scene, start, stop)
            for step in self.tracker.solve(scene, self.support, self.state, self.iterations):
                if self.watch is not None:
                    self.watch(step)
        return self._tracks(start, stop)

    def _add_support(self, scene: Scene, start: int, stop: int) -> None:
        """Collect the neighbourhoods of queries that this window is the first to contain."""
        half = self.tracker.config.window // 2
        times = self.state.times[0]
        new = ((times < stop) & (times >= (0 if start == 0 else stop - half))).nonzero()[:, 0]
        if not len(new):
            return
        rows = self.rows[:, new].clone()
        rows[..., 0] -= start
        found = self.tracker.support(scene, rows, self.state.queries[:, new])
        if not self.support:
            self.support = [_empty(near, len(times)) for near in found]
        for whole, near in zip(self.support, found, strict=True):
            for name in ("features", "points", "center", "indices"):
                if getattr(near, name) is not None:
                    getattr(whole, name)[:, new] = getattr(near, name)

    def _tracks(self, start: int, stop: int) -> Tracks:
        count, state = len(self.queries), self.state  # without the support grid
        logits = state.logits[0, start:stop, :count].cpu().numpy()
        xyz, visible = np.zeros((stop - start, count, 3), np.float32), logits > 0
        if stop > start:
            cameras = [torch.cat(parts, 1) for parts in zip(*self.cameras[start:stop], strict=True)]
            with torch.autocast(self.rows.device.type, enabled=False):
                xyz = self.space.to_world(state.coords[:, start:stop, :count], *cameras)[0].cpu().numpy()
            begun = np.arange(start, stop)[:, None] >= self.queries[:, 0]  # there is no pass backward
            seen_by = (x[0].cpu().numpy() for x in cameras[:2])
            visible = visibility(logits, self.threshold, xyz, *seen_by, begun, self.tracker.config)
        future = self.queries[:, 0] >= self.seen  # known to the world, but not yet to a camera
        return Tracks(np.where(future[:, None], self.queries[:, 1:], xyz), visible, self.queries, logits)


def _checked(queries: Any) -> np.ndarray:
    rows = floats("queries", queries, (None, 4), finite=True)
    wrong = (rows[:, 0] < 0) | (rows[:, 0] != np.rint(rows[:, 0]))
    if wrong.any():
        raise ValueError(f"queries: t is a whole frame number from 0 on, got {rows[wrong][0, 0]:g} in (t, x, y, z)")
    return rows


def _empty(near: Neighbors, count: int) -> Neighbors:
    def room(x: Tensor | None) -> Tensor | None:
        return None if x is None else x.new_zeros(1, count, *x.shape[2:])

    return Neighbors(room(near.features), room(near.points), room(near.center), room(near.indices))
