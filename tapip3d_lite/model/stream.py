"""Tracking while frames come in: push frames, get each window's tracks as soon as it is complete.

    push(frame t):  at t + 1 = S, S + S/2, … one window is solved, then its first half forgotten

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
from tapip3d_lite.model.windows import Scene, State, Step, to_world
from tapip3d_lite.queries import near_origin, shifted, support_queries
from tapip3d_lite.validate import as_array, checked, floats


class Stream:
    """Tracks of queries over frames that come in one by one; queries may be added and dropped on the way.

    Args:
        tracker: in evaluation mode.
        queries: (N, 4) rows (t, x, y, z), world; t counts pushed frames and may lie in the future.
        space: as for `track`.
        iterations: M, the config's if None.
        support_grid: side of a grid of extra queries on the first frame that are tracked along and left out of the results.
        depth_roi: depths (near, far) that count for the scale; None: all. It cannot be found from the whole clip here.
        visible_threshold: probability from which a point counts as visible; the config's if None.
        watch: called with every update.
        keep: `finish` returns the tracks of all frames; False: of the last window, and memory does not grow.

    Attributes:
        queries: (N, 4) all rows given so far.
        followed: which of them `push` returns the tracks of, in this order: all but those that were dropped.

    Raises:
        ValueError: queries that are no (N, 4) rows with whole frame numbers, or a bad option.
    """

    @checked
    def __init__(
        self,
        tracker: nn.Module,
        queries: np.ndarray,
        space: Any = None,
        iterations: int | None = None,
        support_grid: int = 0,
        depth_roi: str | tuple[float, float] | None = None,
        visible_threshold: float | None = None,
        watch: Callable[[Step], None] | None = None,
        keep: bool = True,
    ) -> None:
        self.threshold = check_options(tracker, space, depth_roi, visible_threshold, support_grid)
        if isinstance(depth_roi, str):
            raise ValueError(
                f"depth_roi: a stream does not know the whole clip's depths, so {depth_roi!r} cannot work; give (near, far) or None"
            )
        if iterations is not None and iterations < 1:
            raise ValueError(f"iterations: expected at least 1, got {iterations}")
        self.tracker, self.space, self.roi = tracker, tracker.resolve_space(space), depth_roi
        self.iterations = tracker.config.iterations if iterations is None else iterations
        self.grid, self.watch, self.keep = support_grid, watch, keep
        self.window: list[tuple[Frames, Tensor]] = []  # the frames from `state.first` on, with their features
        self.support: list[Neighbors] = []
        self.seen, self.length, self.begin = 0, None, 0  # frames pushed; real ones, once finished; of `past`
        self.queries, self.past = np.zeros((0, 4), np.float32), np.zeros((0, 0, 5), np.float32)  # x, y, z, v, visible
        self.shift = np.zeros(3)  # of the world, once there is a frame
        self.frame_size: tuple[int, int] | None = None
        self.numbers = np.zeros(0, int)  # of the columns: rows of `queries`, or -1 for the support grid's
        self.rows = torch.zeros(1, 0, 4, device=next(tracker.parameters()).device)
        nothing = self.rows.new_zeros(1, tracker.config.window, 0, 3)
        self.state = State(nothing, nothing[..., 0], nothing[:, 0], self.rows[..., 0].long())
        self.known = self.rows[0, :, 0] > 0  # (N,) columns whose neighbourhood is collected
        self.add(queries)

    @property
    def followed(self) -> np.ndarray:  # noqa: D102 (above)
        return self.numbers[self.numbers >= 0]

    def add(self, queries: np.ndarray) -> np.ndarray:
        """Follow further queries (n, 4) from the next window on; returns their numbers (n,), the rows of `self.queries`.

        ValueError for rows as above, or in frames that are forgotten already: the last S / 2 are not.
        """
        self._check_open()
        rows = floats("queries", queries, (None, 4), finite=True, far=True)
        wrong = (rows[:, 0] < self.state.first) | (rows[:, 0] != np.rint(rows[:, 0]))
        if wrong.any():
            raise ValueError(
                f"queries: t must be a whole frame number from {self.state.first} on, got {rows[wrong][0, 0]:g} in (t, x, y, z)"
            )
        numbers = len(self.queries) + np.arange(len(rows))
        self.queries = np.concatenate([self.queries, rows])
        self._enter(shifted(rows, self.shift), numbers)
        return numbers

    def drop(self, numbers: np.ndarray) -> None:
        """Follow these queries no longer: `finish` holds them at their query, hidden, from then on.

        ValueError for numbers that are not followed.
        """
        self._check_open()
        if not np.isin(numbers, self.followed).all():
            raise ValueError(f"drop: expected numbers of {self.followed.tolist()}, got {numbers!r}"[:500])
        left = torch.from_numpy(np.flatnonzero(~np.isin(self.numbers, numbers))).to(self.rows.device)
        s, self.rows, self.known = self.state, self.rows[:, left], self.known[left]
        self.numbers = self.numbers[left.cpu().numpy()]
        self.state = State(s.coords[:, :, left], s.logits[:, :, left], s.queries[:, left], s.times[:, left], s.first)
        self.support = [near.pick(left[left < near.center.shape[1]]) for near in self.support]

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
            ValueError: arrays that do not fit, as for `Clip`, or the stream is finished.
        """
        self._check_open()
        each = ("image", image), ("depth", depth), ("intrinsics", intrinsics), ("extrinsics", extrinsics)
        clip = Clip(*(as_array(f"push: {name}", value)[None] for name, value in each))
        if self.frame_size not in (None, clip.size):
            raise ValueError(f"push: expected a frame of {self.frame_size} (H, W) as before, got {clip.size}")
        self.frame_size = clip.size
        clip, self.shift = near_origin(clip, self.shift if self.seen else None)
        clip = resize_clip(clip, self.tracker.config.image_size, self.tracker.config.as_released)
        frames = frames_from_clip(clip, device=self.rows.device)
        if self.seen == 0:
            self.space = fitted(self.space, frames)
            self.rows[0] = torch.from_numpy(shifted(self.queries[self.numbers], self.shift))
            grid = support_queries(clip, self.grid) if self.grid else self.queries[:0]
            self._enter(grid, np.full(len(grid), -1))
        with torch.no_grad():
            return self._push(frames, self.tracker.encoder(frames.rgb))

    @torch.no_grad()
    def finish(self) -> Tracks:
        """The last frame is repeated to complete a window, as offline; returns the tracks of all queries over all frames.

        Where a query was not followed it stays at its place, hidden.
        """
        if self.length is None:
            self.length, size = self.seen, self.tracker.config.window
            while self.length and (self.seen < size or self.seen % (size // 2) or bool(self._new(self.seen).any())):
                self._push(*self.window[-1])
        past = self.past[: self.length - self.begin] if self.length else np.zeros((0, len(self.queries), 5), np.float32)
        return Tracks(past[..., :3], past[..., 4], self.queries, past[..., 3])

    def _enter(self, rows: np.ndarray, numbers: np.ndarray) -> None:
        """Columns for further rows (n, 4)."""
        more, s = torch.from_numpy(rows).to(self.rows)[None], self.state
        blank = more.new_zeros(1, s.coords.shape[1], len(rows), 3)
        coords, logits = torch.cat([s.coords, blank], 2), torch.cat([s.logits, blank[..., 0]], 2)
        queries, times = torch.cat([s.queries, blank[:, 0]], 1), torch.cat([s.times, more[..., 0].long()], 1)
        self.state = State(coords, logits, queries, times, s.first)
        self.numbers, self.rows = np.concatenate([self.numbers, numbers]), torch.cat([self.rows, more], 1)
        self.known = torch.cat([self.known, more[0, :, 0] < 0])

    def _check_open(self) -> None:
        if self.length is not None:
            raise ValueError("stream: this stream is finished; begin another one: tracker.stream(queries)")

    def _new(self, stop: int) -> Tensor:
        return ~self.known & (self.state.times[0] < stop)

    def _push(self, frames: Frames, features: Tensor) -> Tracks | None:
        self.window.append((frames, features))
        self.seen += 1
        if len(self.window) < self.tracker.config.window:
            return None
        state, half = self.state, len(self.window) // 2
        parts = ([getattr(f, name) for f, _ in self.window] for name in Frames.__annotations__)
        frames, features = Frames(*(torch.cat(x, 1) for x in parts)), torch.cat([x for _, x in self.window], 1)
        if bool((state.times < self.seen).any()):
            scene = self.tracker.scene(frames, features, self.space, self.roi, state.first)
            self._collect(scene)
            for step in self.tracker.solve(scene, self.support, state, self.iterations):
                if self.watch is not None:
                    self.watch(step)
        tracks = self._tracks(frames)
        self._remember(tracks)
        self.window, state.first = self.window[half:], state.first + half
        state.coords[:, :half], state.logits[:, :half] = state.coords[:, half:].clone(), state.logits[:, half:].clone()
        return tracks

    def _collect(self, scene: Scene) -> None:
        """Start the tracks that this window is the first to contain, and collect the neighbourhoods of their queries."""
        state, new = self.state, self._new(self.seen).nonzero()[:, 0]
        if not len(new):
            return
        rows = self.rows[:, new] - self.rows.new_tensor([state.first, 0, 0, 0])
        fresh = State.start(rows, scene.frames, self.space, 1)
        state.coords[:, :, new], state.logits[:, :, new] = fresh.coords, fresh.logits
        state.queries[:, new], self.known[new] = fresh.queries, True
        found, old = self.tracker.support(scene, rows, fresh.queries), self.support or [None] * len(scene.levels)
        self.support = [_grown(*pair, new, len(self.numbers)) for pair in zip(old, found, strict=True)]

    def _tracks(self, frames: Frames) -> Tracks:
        """Of the window's frames, as far as they are known."""
        mine, first = self.numbers >= 0, self.state.first  # without the support grid
        queries, logits = self.queries[self.numbers[mine]], self.state.logits[0].cpu().numpy()[:, mine]
        xyz = to_world(self.state.coords, frames, self.space)[0].cpu().numpy()[:, mine]
        seen_by = (x[0].cpu().numpy() for x in (frames.intrinsics, frames.extrinsics))
        begun = np.arange(first, self.seen)[:, None] >= queries[:, 0]  # there is no pass backward
        visible = visibility(logits, self.threshold, xyz, *seen_by, begun, self.tracker.config)
        future = queries[:, 0] >= self.seen  # known to the world, but not yet to a camera
        return Tracks(np.where(future[:, None], queries[:, 1:], xyz + self.shift), visible, queries, logits)

    def _remember(self, tracks: Tracks) -> None:
        """Write a window's tracks over what the one before said; room doubles, so that it is seldom made anew."""
        self.begin = 0 if self.keep else self.state.first
        stop, (length, count), total = self.seen - self.begin, self.past.shape[:2], len(self.queries)
        if not self.keep or stop > length or total > count:
            room = np.zeros((length if stop <= length else stop * (1 + self.keep), total, 5), self.queries.dtype)
            room[..., :3] = self.queries[:, 1:]
            room[: self.keep * length, :count] = self.past[: self.keep * length]
            self.past = room
        values = [tracks.xyz, tracks.visible_logits[..., None], tracks.visible[..., None]]
        self.past[self.state.first - self.begin : stop, self.followed] = np.concatenate(values, -1)


def _grown(old: Neighbors | None, found: Neighbors, new: Tensor, count: int) -> Neighbors:
    """Room for the neighbourhoods of all columns, with the old ones and those found for the new ones."""

    def filled(name: str) -> Tensor | None:
        if (x := getattr(found, name)) is None:
            return None
        room = x.new_zeros(1, count, *x.shape[2:])
        if old is not None:
            room[:, : old.center.shape[1]] = getattr(old, name)
        room[:, new] = x
        return room

    return Neighbors(*map(filled, ("features", "points", "center", "indices")))
