"""Lesson 09's parts of one's own, as the notebook writes them: a neighbourhood, a context, an updater, a loss; and a control."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lessons.n09_exercises import ALIKE, MISSES, MIXED, VOTE
from tapip3d_lite.geometry import RASTER
from tapip3d_lite.model.cloud import Level
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.n2n import Context
from tapip3d_lite.model.neighbors import KNearest, Neighbors, bilinear, gather
from tapip3d_lite.model.windows import Step
from tapip3d_lite.training.loss import LossConfig, Truth, compared

most_alike, vote, mixed, soft_misses = (x.reference for x in (ALIKE, VOTE, MIXED, MISSES))


class NearAndAlike(KNearest):
    """The K cells nearest in 3D, and the K of the frame most alike to what lies at the estimate."""

    def forward(self, level: Level, coords: Tensor, cells: Tensor) -> Neighbors:
        """As `KNearest.forward`, with 2 K neighbours."""
        near = super().forward(level, coords, cells)
        maps, points = level.features.flatten(0, 1), level.points.flatten(2, 3).flatten(0, 1)  # (F, h, w, C), (F, P, 3)
        own = bilinear(maps, cells.flatten(0, 1))  # (F, N, C)
        alike = most_alike(own, maps.flatten(1, 2), level.valid.flatten(2).flatten(0, 1), self.count)
        more = [gather(x, alike).unflatten(0, coords.shape[:2]) for x in (maps.flatten(1, 2), points)]
        indices = torch.cat([near.indices, alike.unflatten(0, coords.shape[:2])], -1)
        features, points = (torch.cat(pair, -2) for pair in zip((near.features, near.points), more, strict=True))
        return Neighbors(features, points, coords, indices)


class Vote(Context):
    """Where cells that look like the query lie; a linear layer makes a token of it."""

    def __init__(self, config: TrackerConfig) -> None:
        super().__init__()
        self.width = config.token_dim
        self.looks = nn.ModuleList(nn.Linear(config.feature_dim, config.feature_dim) for _ in range(config.levels))
        self.token = nn.Linear(5 + config.feature_dim, config.token_dim)

    def describe(self, index: int, support: Neighbors) -> Tensor:
        """The query's own feature (B, N, C)."""
        return support.features[..., 0, :]

    def forward(self, index: int, kept: Tensor, near: Neighbors) -> Tensor:
        """As `Context.forward`."""
        said = vote(self.looks[index](kept), near.features, near.offsets)  # (B, S, N, 5)
        return self.token(torch.cat([said, kept[:, None].expand(*said.shape[:3], -1)], -1))


class Ripple(nn.Module):
    """An updater of three layers, in which a frame hears of the two beside it; tracks do not meet."""

    def __init__(self, config: TrackerConfig, inputs: int) -> None:
        super().__init__()
        width = config.hidden
        self.input, self.head = nn.Linear(inputs, width), nn.Linear(width, 4)
        self.kernels = nn.Parameter(torch.tensor([0.25, 0.5, 0.25])[None, :, None].repeat(3, 1, width))
        self.layers = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width))
            for _ in range(3)
        )
        nn.init.normal_(self.head.weight, std=1e-3)

    def forward(self, tokens: Tensor, active: Tensor | None = None) -> Tensor:
        """As `Transformer.forward`: corrections (B, S, N, 4)."""
        x = self.input(tokens).transpose(1, 2)  # (B, N, S, U)
        for kernel, layer in zip(self.kernels, self.layers, strict=True):
            x = x + layer(mixed(x, kernel))
        return self.head(x).transpose(1, 2)


class SoftMisses(LossConfig):
    """What APD counts, made smooth, in place of the distance."""

    def __init__(self) -> None:
        super().__init__(visibility=0.5)

    def __call__(self, step: Step, truth: Truth, iterations: int) -> tuple[Tensor, Tensor]:
        """As `LossConfig.__call__`."""
        _, visibility = super().__call__(step, truth, iterations)
        weight = 10 * self.scale * self.discount ** (iterations - 1 - step.iteration)
        return weight * soft_misses(*errors(step, truth)), visibility


class Blind(Context):
    """The control: a context that sees nothing."""

    def __init__(self, config: TrackerConfig) -> None:
        super().__init__()
        self.width = config.token_dim

    def forward(self, index: int, kept: Tensor, near: Neighbors) -> Tensor:
        """Zeros (B, S, N, D)."""
        return near.features.new_zeros(*near.features.shape[:3], self.width)


def errors(step: Step, truth: Truth) -> tuple[Tensor, Tensor]:
    """Errors (B, S, N) of an update in pixels of a raster of 256, and which of them count."""
    target, _, counted, depth, focal = compared(step, truth)
    away = (step.xyz - target).square().sum(-1).add(1e-12).sqrt()  # of an exact estimate, too, there is a gradient
    return away / depth.clamp(min=0.1) * focal * RASTER / min(step.scene.frames.size), counted
