"""The tracker: sliding windows of iterative updates over a persistent feature cloud.

Paper: section 3 and figure 2. `Tracker.steps` is the whole method; `forward` and `track` only collect its results.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.model import inference
from tapip3d_lite.model.cloud import Normalizer, feature_cloud
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.constants import constant
from tapip3d_lite.model.contexts import N2N
from tapip3d_lite.model.encoder import Encoder
from tapip3d_lite.model.fast import get_ready
from tapip3d_lite.model.fourier import time_embedding
from tapip3d_lite.model.frames import Frames
from tapip3d_lite.model.neighbors import Neighbors
from tapip3d_lite.model.parts import make_module, make_space
from tapip3d_lite.model.scene import Scene, Step, Window, to_world
from tapip3d_lite.model.spaces import fitted
from tapip3d_lite.model.stream import Stream
from tapip3d_lite.model.support import query_support
from tapip3d_lite.model.tokens import token_width, trajectory_tokens
from tapip3d_lite.model.windows import State, window_ends

_CHUNK = 2**25  # floats of context tokens that exist at once without gradient: 128 MiB
_CPU_CHUNK = 2**21  # there 8 MiB are twice as fast, since temporaries stay in the cache

__all__ = ["Tracker", "TrackerConfig"]


class Tracker(nn.Module):
    """Tracks any points of a posed RGB-D video in 3D.

    Attributes:
        fast: compute N2N by `fast.Ready`, which gives the same numbers as the clear form in `contexts` sooner, in
            pieces that fit a CPU's cache.
        steady: do the same operations whatever the values are, without checking them: every track joins every window,
            masked where it does not belong. Then nothing waits for a GPU, and a CUDA graph can hold a whole step.
    """

    fast: bool = True
    steady: bool = False

    def __init__(self, config: TrackerConfig) -> None:
        super().__init__()
        self.config = config
        self.space = make_space(config.space)
        self.encoder = Encoder(config)
        self.neighborhood = make_module("neighborhood", config)
        self.context = make_module("context", config)
        inputs = token_width(self.context.width, config.levels, config.use_uv)
        self.updater = make_module("updater", config, inputs)
        self.register_buffer("time", time_embedding(config.window, inputs), persistent=False)

    def forward(self, frames: Frames, queries: Tensor, **options: Any) -> tuple[Tensor, Tensor]:
        """Track forward in time.

        Args:
            frames: T frames at the config's image size.
            queries: (B, N, 4) rows (t, x, y, z), world.
            options: as for `steps`.

        Returns:
            xyz (B, T, N, 3), world, and visibility logits (B, T, N). Before a query's first window, and in clips of
            at most S / 2 frames, the query's position and 0.
        """
        space = fitted(make_space(options.get("space") or self.space), frames)
        state = State.start(queries, frames, space, self.config.window // 2)
        for _ in self.steps(frames, queries, state=state, **(options | {"space": space})):
            pass
        count = len(frames)
        return to_world(state.coords[:, :count], frames, space), state.logits[:, :count]

    def steps(
        self,
        frames: Frames,
        queries: Tensor,
        *,
        active: Tensor | None = None,
        iterations: int | None = None,
        space: Any = None,
        depth_roi: tuple[float, float] | None = None,
        features: Tensor | None = None,
        state: State | None = None,
        share: Callable[[Window], Window] = lambda window: window,
    ) -> Iterator[Step]:
        """Yield every update of every window; the caller may backpropagate each at once (`retain_graph=True`).

        Args:
            frames: T frames at the config's image size.
            queries: (B, N, 4) rows (t, x, y, z), world.
            active: (B, N) bool, False for rows that only fill up a batch. None: all are tracks.
            iterations: M, the config's if None.
            space: another space than the config's.
            depth_roi: depths (near, far) that count for the scale; None: all valid ones.
            features: (B, T, C, h, w) from `self.encoder`, if they exist already.
            state: trajectories, which are updated in place; made from the queries if None.
            share: called with each window before its updates, for a caller that has its own way with what they share.
        """
        config, iterations = self.config, self.config.iterations if iterations is None else iterations
        self._check(frames, iterations)
        if queries.shape[1] == 0:
            return
        space, half = fitted(make_space(space or self.space), frames), config.window // 2
        features = self.encoder(frames.rgb) if features is None else features
        state = State.start(queries, frames, space, half, not self.steady) if state is None else state
        scene = self.scene(frames, features, space, depth_roi)
        support = self.support(scene, queries, state.queries)
        for stop in window_ends(len(scene.frames), config.window):
            start = stop - config.window
            columns, mask = state.members(stop, active, self.steady)
            if not len(columns):
                continue
            coords, logits = state.initial(start, stop, columns)
            cut = scene.cut(start, stop)
            window = share(self.window(cut, [near.pick(columns) for near in support], mask, columns))
            coords = window.norm.normalize(coords)
            for iteration in range(iterations):
                # Nothing flows back from one iteration into the one before.
                coords, logits = self.update(window, coords, logits)
                yield Step(start, iteration, window.norm.restore(coords), logits, columns, mask, cut)
                coords, logits = coords.detach(), logits.detach()
            state.write(start, stop, columns, mask, window.norm.restore(coords), logits)

    def scene(self, frames: Frames, features: Tensor, space: Any, depth_roi: tuple[float, float] | None) -> Scene:
        """Lift frames to a feature cloud; frames and features are padded to whole half windows."""
        with torch.autocast(frames.depths.device.type, enabled=False):
            half = self.config.window // 2
            padding = -len(frames) % half
            frames = frames.pad(half)
            if padding:
                features = torch.cat([features, features[:, -1:].expand(-1, padding, -1, -1, -1)], 1)
            points = space.lift(frames.depths, frames.intrinsics, frames.extrinsics)
            known = inside = frames.depths > 0
            if depth_roi is not None:
                inside = known & (frames.depths >= depth_roi[0]) & (frames.depths <= depth_roi[1])
            levels = feature_cloud(features.to(points.dtype), points, known, self.config.levels)
            return Scene(frames, points, inside, levels, space)

    def support(self, scene: Scene, queries: Tensor, coords: Tensor) -> list[Neighbors]:
        """The queries' neighbourhoods, at each level, in un-normalised coordinates.

        Args:
            scene: all frames up to the last query's.
            queries: (B, N, 4), of which only t is read.
            coords: (B, N, 3), the queries in the scene's space.

        Returns:
            L times (B, N, 1 + K, ...); the first row is the query itself, with index -1.
        """
        with torch.autocast(coords.device.type, enabled=False):
            return query_support(self.neighborhood, scene, queries[..., 0].long(), coords)

    def window(self, scene: Scene, support: list[Neighbors], active: Tensor, columns: Tensor | None = None) -> Window:
        """Normalise one window and let the context prepare it.

        Args:
            scene: S frames.
            support: L times (B, n, 1 + K, ...), from `support`.
            active: (B, n) bool, tracks that exist.
            columns: (n,) which of all tracks these are; only looked at from outside.
        """
        config = self.config
        norm = Normalizer.fit(scene.points, scene.valid, config.norm_mode, config.norm_scale, not self.steady)
        cloud = [replace(level, points=norm.normalize(level.points)) for level in scene.levels]
        levels = [self.context.prepare(i, level) for i, level in enumerate(cloud)]
        support = [near.normalized(norm) for near in support]
        kept = [self.context.describe(i, near) for i, near in enumerate(support)]
        if not self.steady and bool(active.all()):
            active = None
        return Window(scene, norm, levels, kept, active, columns, support)

    def update(self, window: Window, coords: Tensor, logits: Tensor) -> tuple[Tensor, Tensor]:
        """Update the trajectories of one window once (equation 1).

        Args:
            window: from `window`.
            coords: (B, S, n, 3) normalised.
            logits: (B, S, n) visibility.

        Returns:
            The new coords and logits.
        """
        frames = window.scene.frames
        with torch.autocast(coords.device.type, enabled=False):
            uv = window.scene.space.to_pixels(window.norm.restore(coords), frames.intrinsics, frames.extrinsics)
        evidence = self.evidence(window, coords, uv)
        pixels = uv if self.config.use_uv else None
        tokens = trajectory_tokens(coords, logits, evidence, pixels, frames.size, self.time)
        delta = self.updater(tokens, window.active).to(coords.dtype)
        moves = constant(tuple(getattr(window.scene.space, "moves", (1.0, 1.0, 1.0))), delta)
        return coords + delta[..., :3] * moves, logits + delta[..., 3]

    def evidence(self, window: Window, coords: Tensor, uv: Tensor) -> Tensor:
        """Collect each estimate's neighbourhood and compare it with the query's, at all levels.

        Args:
            window: from `window`.
            coords: (B, S, n, 3) normalised.
            uv: (B, S, n, 2) pixels.

        Returns:
            (B, S, n, L * width).
        """
        count, config = coords.shape[2], self.config
        floats = coords.shape[0] * coords.shape[1] * config.neighbors * config.token_dim * 4
        budget = min(_CHUNK, _CPU_CHUNK) if self.fast and coords.device.type == "cpu" else _CHUNK
        step = count if torch.is_grad_enabled() else max(1, budget // floats)
        ready, chunks = self.ready(window), []
        for rows in (slice(i, i + step) for i in range(0, count, step)):
            outputs = []
            part = ready if step >= count else [kept[:, rows] for kept in ready]
            for i, (level, kept) in enumerate(zip(window.levels, part, strict=True)):
                near = self.neighborhood(level, coords[:, :, rows], level.cells(uv[:, :, rows], config.image_size))
                outputs.append(self.context(i, kept, near))
            chunks.append(torch.cat(outputs, -1))
        return torch.cat(chunks, 2)

    def ready(self, window: Window) -> list:
        """What the context remembers of the queries, in its fast form where it has one."""
        if not (self.fast and isinstance(self.context, N2N)):
            return window.kept
        mode = torch.is_grad_enabled()
        if mode not in window.ready:
            window.ready[mode] = get_ready(self.context, window.kept)
        return window.ready[mode]

    def track(self, clip: Clip, queries: Any = None, **options: Any) -> Tracks:
        """Track points of one clip; see `inference.track` for the options."""
        return inference.track(self, clip, queries, **options)

    def stream(self, queries: Any, **options: Any) -> Stream:
        """Track while frames come in: `push` each, then `finish`; see `stream.Stream` for the options."""
        return Stream(self, queries, **options)

    def _check(self, frames: Frames, iterations: int) -> None:
        if frames.size != self.config.image_size:
            raise ValueError(
                f"frames: expected images of {self.config.image_size}, got {frames.size}; use frames_from_clip(clip, size)"
            )
        if iterations < 1:
            raise ValueError(f"iterations: expected at least 1, got {iterations}")
