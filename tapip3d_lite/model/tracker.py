"""The tracker: sliding windows of iterative updates over a persistent feature cloud.

Paper: section 3 and figure 2. `Tracker.steps` is the whole method; `forward` and `track` only collect its results.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.model import inference
from tapip3d_lite.model.cloud import Level, Normalizer, feature_cloud
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.encoder import Encoder
from tapip3d_lite.model.fourier import time_embedding
from tapip3d_lite.model.frames import Frames
from tapip3d_lite.model.neighbors import Neighbors
from tapip3d_lite.model.parts import make_module, make_space
from tapip3d_lite.model.support import query_support
from tapip3d_lite.model.tokens import token_width, trajectory_tokens
from tapip3d_lite.model.windows import State, window_ends

_CHUNK = 2**25  # floats of context tokens that exist at once without gradient: 128 MiB

__all__ = ["Scene", "Step", "Tracker", "TrackerConfig"]


@dataclass(frozen=True)
class Scene:
    """What is known about some frames before any query is asked.

    Attributes:
        frames: T posed RGB-D frames.
        points: (B, T, H, W, 3), in the trajectories' space.
        valid: (B, T, H, W) bool: depth known and inside the region of interest.
        levels: the feature cloud.
        space: the trajectories' space.
    """

    frames: Frames
    points: Tensor
    valid: Tensor
    levels: list[Level]
    space: Any

    def cut(self, start: int, stop: int) -> Scene:
        """Frames [start, stop)."""
        levels = [level.cut(start, stop) for level in self.levels]
        return Scene(
            self.frames.cut(start, stop), self.points[:, start:stop], self.valid[:, start:stop], levels, self.space
        )


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


class Tracker(nn.Module):
    """Tracks any points of a posed RGB-D video in 3D."""

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
        space = make_space(options.get("space") or self.space)
        state = State.start(queries, frames, space, self.config.window // 2)
        for _ in self.steps(frames, queries, state=state, **options):
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
        """
        config, iterations = self.config, self.config.iterations if iterations is None else iterations
        self._check(frames, queries, iterations)
        space, half = make_space(space or self.space), config.window // 2
        features = self.encoder(frames.rgb) if features is None else features
        state = State.start(queries, frames, space, half) if state is None else state
        scene = self.scene(frames, features, space, depth_roi)
        support = self.support(scene, queries, state.queries)
        for stop in window_ends(len(scene.frames), config.window):
            start = stop - config.window
            columns, mask = state.members(stop, active)
            if not len(columns):
                continue
            coords, logits = state.initial(start, stop, columns)
            window, chosen = scene.cut(start, stop), [_select(level, columns) for level in support]
            updates = self.refine(window, chosen, coords, logits, mask, iterations)
            for iteration, (coords, logits) in enumerate(updates):
                yield Step(start, iteration, coords, logits, columns, mask, window)
            state.write(start, stop, columns, mask, coords.detach(), logits.detach())

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
            levels = feature_cloud(features.float(), points, known, self.config.levels)
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

    def refine(
        self,
        window: Scene,
        support: list[Neighbors],
        coords: Tensor,
        logits: Tensor,
        active: Tensor,
        iterations: int,
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Update the trajectories of one window M times (equation 1).

        Args:
            window: S frames.
            support: L times (B, n, 1 + K, ...), from `support`.
            coords: (B, S, n, 3) initial trajectories in the window's space.
            logits: (B, S, n) initial visibility.
            active: (B, n) bool, tracks that exist.
            iterations: M.

        Yields:
            coords and logits after each update; nothing flows back from one iteration into the one before.
        """
        norm = Normalizer.fit(window.points, window.valid, self.config.norm_mode, self.config.norm_scale)
        levels = [
            self.context.prepare(i, Level(x.features, norm.normalize(x.points), x.valid))
            for i, x in enumerate(window.levels)
        ]
        kept = [self.context.describe(i, _normalize(x, norm)) for i, x in enumerate(support)]
        mask = None if bool(active.all()) else active
        x = norm.normalize(coords)
        for _ in range(iterations):
            x, logits = x.detach(), logits.detach()
            with torch.autocast(x.device.type, enabled=False):
                uv = window.space.to_pixels(norm.restore(x), window.frames.intrinsics, window.frames.extrinsics)
            evidence = self.evidence(levels, kept, x, uv)
            pixels = uv if self.config.use_uv else None
            tokens = trajectory_tokens(x, logits, evidence, pixels, window.frames.size, self.time)
            delta = self.updater(tokens, mask).float()
            x, logits = x + delta[..., :3], logits + delta[..., 3]
            yield norm.restore(x), logits

    def evidence(self, levels: list[Level], kept: list[Tensor], coords: Tensor, uv: Tensor) -> Tensor:
        """Collect each estimate's neighbourhood and compare it with the query's, at all levels.

        Args:
            levels: L prepared levels with normalised points.
            kept: L times (B, n, ...), from the context's `describe`.
            coords: (B, S, n, 3) normalised.
            uv: (B, S, n, 2) pixels.

        Returns:
            (B, S, n, L * width).
        """
        floats = coords.shape[0] * coords.shape[1] * self.config.neighbors * self.config.token_dim * 4
        step = coords.shape[2] if torch.is_grad_enabled() else max(1, _CHUNK // floats)
        chunks = []
        for part in torch.arange(coords.shape[2], device=coords.device).split(step):
            rows = slice(int(part[0]), int(part[-1]) + 1)
            outputs = []
            for i, (level, keep) in enumerate(zip(levels, kept, strict=True)):
                cells = uv[:, :, rows] * cell_scale(level, self.config.image_size).to(uv.device)
                near = self.neighborhood(level, coords[:, :, rows], cells)
                outputs.append(self.context(i, keep[:, rows], near))
            chunks.append(torch.cat(outputs, -1))
        return torch.cat(chunks, 2)

    def track(self, clip: Clip, queries: Any = None, **options: Any) -> Tracks:
        """Track points of one clip; see `inference.track` for the options."""
        return inference.track(self, clip, queries, **options)

    def _check(self, frames: Frames, queries: Tensor, iterations: int) -> None:
        if frames.size != self.config.image_size:
            raise ValueError(
                f"frames: expected images of {self.config.image_size}, got {frames.size}; use frames_from_clip(clip, size)"
            )
        if queries.ndim != 3 or queries.shape[0] != len(frames.depths) or queries.shape[2] != 4:
            raise ValueError(
                f"queries: expected ({len(frames.depths)}, N, 4) rows (t, x, y, z), got {tuple(queries.shape)}"
            )
        if iterations < 1:
            raise ValueError(f"iterations: expected at least 1, got {iterations}")


def to_world(coords: Tensor, frames: Frames, space: Any) -> Tensor:
    """Trajectories (B, T, N, 3) of a space in world coordinates."""
    with torch.autocast(coords.device.type, enabled=False):
        return space.to_world(coords, frames.intrinsics, frames.extrinsics, frames.depths)


def cell_scale(level: Level, size: tuple[int, int]) -> Tensor:
    """(2,) cells per pixel, (w / W, h / H); the features' convention, without a half-cell shift."""
    height, width = level.points.shape[2:4]
    return torch.tensor([width / size[1], height / size[0]], dtype=torch.float32)


def _select(support: Neighbors, columns: Tensor) -> Neighbors:
    parts = support.features, support.points, support.center, support.indices
    return Neighbors(*(None if x is None else x[:, columns] for x in parts))


def _normalize(support: Neighbors, norm: Normalizer) -> Neighbors:
    return Neighbors(support.features, norm.normalize(support.points), norm.normalize(support.center), support.indices)
