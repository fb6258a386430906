"""The tracker: sliding windows of iterative updates over a persistent feature cloud.

    F = encoder(rgb);  cloud = (F, lift(depth, K, E))                       features with 3D points, at L levels
    in each window, M times:
        tau_{m+1}, v_{m+1} = (tau_m, v_m) + updater(token(tau_m, v_m, N2N(support, cloud around tau_m)))        (3)

Paper: section 3.2, equations 2 and 3. `Tracker.steps` is the whole method: the loop over windows, and in `solve` the
loop over the updates of one. `forward`, `track`, `stream` and the training only collect what it yields.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.model import track
from tapip3d_lite.model.blocks import constant, time_embedding
from tapip3d_lite.model.cloud import Normalizer, feature_cloud
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.encoder import Encoder
from tapip3d_lite.model.frames import Frames
from tapip3d_lite.model.neighbors import Neighbors
from tapip3d_lite.model.registry import make_module, make_space
from tapip3d_lite.model.spaces import fitted
from tapip3d_lite.model.stream import Stream
from tapip3d_lite.model.trial import match_start
from tapip3d_lite.model.updater import token_width, trajectory_tokens
from tapip3d_lite.model.windows import Scene, State, Step, Window, query_support, to_world, window_ends

_CHUNK = 2**25  # floats of context tokens that exist at once without gradient: 128 MiB
_CPU_CHUNK = 2**21  # on a CPU 8 MiB are twice as fast, since temporaries stay in the cache


class Tracker(nn.Module):
    """Tracks any points of a posed RGB-D video in 3D.

    Args:
        config: sizes and switches.
        fast: use the fast form of each part that has one (`model.registry`); the numbers are the same.

    Attributes:
        sync_free: do the same operations whatever the values are, without checking them: every track joins every
            window, masked where it does not belong. Then nothing waits for a GPU, and a CUDA graph can hold a whole step.
    """

    sync_free: bool = False
    trial: dict[str, Any] = {}  # noqa: RUF012

    def __init__(self, config: TrackerConfig, fast: bool = True) -> None:
        super().__init__()
        self.config = config
        self.space = make_space(config.space)
        self.encoder = Encoder(config)
        self.neighborhood = make_module("neighborhood", config, fast=fast)
        self.context = make_module("context", config, fast=fast)
        inputs = token_width(self.context.width, config.levels, config.use_uv)
        self.updater = make_module("updater", config, inputs, fast=fast)
        self.register_buffer("time", time_embedding(config.window, inputs), persistent=False)

    def forward(
        self, frames: Frames, queries: Tensor, watch: Callable[[Step], None] | None = None, **options: Any
    ) -> tuple[Tensor, Tensor]:
        """Track forward in time.

        Args:
            frames: T frames at the config's image size.
            queries: (B, N, 4) rows (t, x, y, z), world.
            watch: called with every update.
            options: as for `steps`.

        Returns:
            xyz (B, T, N, 3), world, and visibility logits (B, T, N). Before a query's first window, and in clips of
            at most S / 2 frames, the query's position and 0.
        """
        space = fitted(self.resolve_space(options.get("space")), frames)
        state = State.start(queries, frames, space, self.config.window // 2)
        for step in self.steps(frames, queries, state=state, **(options | {"space": space})):
            if watch is not None:
                watch(step)
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
        on_window: Callable[[Window], Window] | None = None,
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
            on_window: changes each window before its updates, e.g. to detach what they share.
        """
        config, iterations = self.config, self.config.iterations if iterations is None else iterations
        self._check(frames, iterations)
        if queries.shape[1] == 0:
            return
        space = fitted(self.resolve_space(space), frames)
        features = self.encoder(frames.rgb) if features is None else features
        state = State.start(queries, frames, space, config.window // 2, not self.sync_free) if state is None else state
        scene = self.scene(frames, features, space, depth_roi)
        support = self.support(scene, queries, state.queries)
        for stop in window_ends(len(scene.frames), config.window):
            window = scene.cut(stop - config.window, stop)
            yield from self.solve(window, support, state, iterations, active, on_window)

    def solve(
        self,
        scene: Scene,
        support: list[Neighbors],
        state: State,
        iterations: int,
        active: Tensor | None = None,
        on_window: Callable[[Window], Window] | None = None,
    ) -> Iterator[Step]:
        """Update the tracks of one window M times, yield each update, then write the result into `state`.

        Args:
            scene: the window's S frames; `scene.start` says where in the clip they lie.
            support: L times (B, N, 1 + K, ...), from `support`, of all tracks.
            state: trajectories, read at the start and overwritten at the end.
            iterations: M.
            active: (B, N) bool, as for `steps`.
            on_window: as for `steps`.
        """
        start, stop = scene.start, scene.start + len(scene.frames)
        columns, mask = state.members(stop, active, self.sync_free)  # (n,), (B, n)
        if not len(columns):
            return
        coords, logits = state.initial(start, stop, columns, self.trial.get("velocity", 0.0))  # (B, S, n, 3), (B, S, n)
        if "match" in self.trial:
            coords = self._matched(scene, support, state, columns, coords)
        window = self.window(scene, [near.pick(columns) for near in support], mask, columns)
        window = window if on_window is None else on_window(window)
        coords = window.norm.normalize(coords)
        for iteration in range(iterations):
            # Nothing flows back from one iteration into the one before.
            coords, logits = self.update(window, coords, logits)
            yield Step(start, iteration, window.norm.restore(coords), logits, columns, mask, scene, self._spread)
            if not (self.trial.get("grad2") and (iterations - 1 - iteration) % 2):
                coords, logits = coords.detach(), logits.detach()
        state.write(start, stop, columns, mask, window.norm.restore(coords), logits)

    def _matched(
        self, scene: Scene, support: list[Neighbors], state: State, columns: Tensor, coords: Tensor
    ) -> Tensor:
        frame = torch.arange(len(scene.frames), device=coords.device)[None, :, None]  # (1, S, 1)
        times = (state.times[:, columns] - scene.start)[:, None]  # (B, 1, n)
        half = len(scene.frames) // 2
        known = (times < half) & (scene.start > 0)  # which the window before has solved
        free = (frame != times) & (~known | (frame >= half))
        own = support[0].features[:, columns, 0]
        return match_start(scene, own, coords, free, self.trial["match"])

    def scene(
        self, frames: Frames, features: Tensor, space: Any, depth_roi: tuple[float, float] | None, start: int = 0
    ) -> Scene:
        """Lift T frames with features (B, T, C, h, w) to a feature cloud in `space`, padded to whole half windows.

        `start` says which frame of the clip is the first; `depth_roi` as for `steps`.
        """
        with torch.autocast(frames.depths.device.type, enabled=False):
            half = self.config.window // 2
            padding = -len(frames) % half
            frames = frames.pad(half)
            if padding:
                features = torch.cat([features, features[:, -1:].expand(-1, padding, -1, -1, -1)], 1)  # (B, T, …)
            points = space.lift(frames.depths, frames.intrinsics, frames.extrinsics)  # (B, T, H, W, 3)
            known = inside = frames.depths > 0
            if depth_roi is not None:
                inside = known & (frames.depths >= depth_roi[0]) & (frames.depths <= depth_roi[1])
            levels = feature_cloud(features.to(points.dtype), points, known, self.config.levels)
            return Scene(frames, points, inside, levels, space, start)

    def support(self, scene: Scene, queries: Tensor, coords: Tensor) -> list[Neighbors]:
        """The neighbourhoods of queries (B, N, 4) in their frames, un-normalised: L times (B, N, 1 + K, ...).

        `coords` (B, N, 3) are the queries in the scene's space, and its frames must reach to the last one's. The first
        row of each neighbourhood is the query itself, with index -1.
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
        norm = Normalizer.fit(scene.points, scene.valid, config.norm_mode, config.norm_scale, not self.sync_free)
        cloud = [replace(level, points=norm.normalize(level.points)) for level in scene.levels]
        levels = [self.context.prepare(i, level) for i, level in enumerate(cloud)]
        support = [near.normalized(norm) for near in support]
        kept = [self.context.describe(i, near) for i, near in enumerate(support)]
        if not self.sync_free and bool(active.all()):
            active = None
        return Window(scene, norm, levels, kept, active, columns, support)

    def update(self, window: Window, coords: Tensor, logits: Tensor) -> tuple[Tensor, Tensor]:
        """Update one window's trajectories once (equation 3): normalised coords (B, S, n, 3) and logits (B, S, n)."""
        frames, kind = window.scene.frames, self.trial.get("grad2")
        from_coords, from_logits = coords, logits
        if kind == "residual":
            coords, logits = coords.detach(), logits.detach()
        with torch.autocast(coords.device.type, enabled=False):
            uv = window.scene.space.to_pixels(window.norm.restore(coords), frames.intrinsics, frames.extrinsics)
        uv = uv.detach() if kind == "smooth" else uv
        evidence = self.evidence(window, coords, uv)  # (B, S, n, L * width)
        pixels = uv if self.config.use_uv else None
        tokens = trajectory_tokens(coords, logits, evidence, pixels, frames.size, self.time)  # (B, S, n, token width)
        delta = self.updater(tokens, window.active).to(coords.dtype)  # (B, S, n, 4 or 5): dx, dy, dz, dv
        free = constant(tuple(getattr(window.scene.space, "free_axes", (1.0, 1.0, 1.0))), delta)
        self._spread = delta[..., 5:] if "spread" in self.trial else None
        return from_coords + delta[..., :3] * free, from_logits + delta[..., 3]

    def evidence(self, window: Window, coords: Tensor, uv: Tensor) -> Tensor:
        """Collect each estimate's neighbourhood and compare it with the query's, at all levels: (B, S, n, L * width).

        Estimates are `coords` (B, S, n, 3), normalised, which lie at pixels `uv` (B, S, n, 2).
        """
        batch, frames, count = coords.shape[:3]
        floats = batch * frames * self.config.neighbors * self.config.token_dim * 4  # of one track
        budget = _CPU_CHUNK if coords.device.type == "cpu" else _CHUNK
        step = count if torch.is_grad_enabled() else max(1, budget // floats)
        chunks = []
        for rows in (slice(i, i + step) for i in range(0, count, step)):
            outputs = []
            for i, (level, kept) in enumerate(zip(window.levels, window.kept, strict=True)):
                cells = level.cells(uv[:, :, rows], self.config.image_size)
                near = self.neighborhood(level, coords[:, :, rows], cells)  # (B, S, rows, K, ...)
                outputs.append(self.context(i, kept if step >= count else kept[:, rows], near))
            chunks.append(torch.cat(outputs, -1))  # (B, S, rows, L * width)
        return torch.cat(chunks, 2)

    def track(self, clip: Clip, queries: Any = None, **options: Any) -> Tracks:
        """Track points of one clip; `model.track.track` lists the options."""
        return track.track(self, clip, queries, **options)

    def stream(self, queries: Any, **options: Any) -> Stream:
        """Track while frames come in: `push` each, then `finish`; `model.stream.Stream` lists the options."""
        return Stream(self, queries, **options)

    def resolve_space(self, space: Any) -> Any:
        """The space that a name, a class or an object stands for; the tracker's own for None."""
        space = self.space if space is None else space
        return make_space(space) if isinstance(space, str | type) else space

    def _check(self, frames: Frames, iterations: int) -> None:
        if frames.size != self.config.image_size:
            raise ValueError(
                f"frames: expected images of {self.config.image_size}, got {frames.size}; use frames_from_clip(clip, size)"
            )
        if iterations < 1:
            raise ValueError(f"iterations: expected at least 1, got {iterations}")
