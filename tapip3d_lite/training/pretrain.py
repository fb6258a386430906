"""Pretraining of the encoder by matching: a surface point should have the same feature in any two frames.

Ours; it replaces the paper's initialisation from CoTracker3's encoder. The loss is InfoNCE: a point's feature in one
frame is compared with every cell of the other frame, and the target is a small Gaussian around the true place, so that
the similarities also say where between the cells' centres the point is. It takes minutes, and a tracker that starts from
such features learns to follow motion in fewer steps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tapip3d_lite.clip import Clip
from tapip3d_lite.formats.arrays import clip_arrays
from tapip3d_lite.geometry import pixel_grid, project
from tapip3d_lite.model.blocks import constant
from tapip3d_lite.model.encoder import Encoder
from tapip3d_lite.model.weights import read_weights
from tapip3d_lite.training.augment import AugmentConfig, augment
from tapip3d_lite.training.data import pick_frames
from tapip3d_lite.validate import check_range, check_state, check_types

_ENOUGH = 16  # points that two frames should share
_NEAR = 2.5  # radius in cells, around the true place, of the cells whose mean gives a point's place


@dataclass(frozen=True)
class MatchingConfig:
    """How the encoder is pretrained.

    Attributes:
        pairs: number of pairs of frames in a step (of each process).
        points: greatest number of points of a pair.
        gap: greatest distance of the two frames.
        levels: pyramid levels at which features are compared; each has half the weight of the one before.
        spread: standard deviation of the target around the true place, in cells.
        place: weight of the distance, in cells, between the true place and the mean of the cells around it, weighted by
            their similarities. This teaches the place within a cell.
        jitter: strength of random brightness and contrast, drawn for each frame (without `augment`).
        lr, weight_decay, clip_norm: of AdamW with one cycle.

    Raises:
        ValueError: a number outside its range.
    """

    pairs: int = 1
    points: int = 128
    gap: int = 12
    levels: int = 4
    spread: float = 0.5
    place: float = 1.0
    jitter: float = 0.2
    lr: float = 1e-3
    weight_decay: float = 1e-4
    clip_norm: float = 1.0

    def __post_init__(self) -> None:
        check_types(self)
        check_range(self, 1, 1e5, "pairs", "points", "gap", "levels")
        check_range(self, 1e-12, math.inf, "spread", "clip_norm")
        check_range(self, 1e-12, 1e3, "lr")
        check_range(self, 0, math.inf, "place", "jitter", "weight_decay")


@dataclass(frozen=True)
class FramePair:
    """Two frames, and the places of the same points in both.

    Attributes:
        rgb: (2, 3, H, W) colours in [0, 1].
        uv: (2, N, 2) pixels.
    """

    rgb: Tensor
    uv: Tensor

    def to(self, device: torch.device | str) -> FramePair:
        """The pair on another device."""
        return FramePair(self.rgb.to(device), self.uv.to(device))


def draw_pair(
    path: Path,
    rng: np.random.Generator,
    config: MatchingConfig,
    size: tuple[int, int],
    augmentation: AugmentConfig | None = None,
) -> FramePair:
    """Draw two frames, resized to (H, W), of a stored clip with tracks, and points that are visible in both.

    The tracker's augmentation is used where enough points stay visible; without one the frames are only mirrored, and
    their brightness and contrast changed by `jitter`. Frames that share no point are a ValueError.
    """
    clip, points = _two_frames(path, rng, config.gap, size)
    if not len(points):
        raise ValueError("no point is visible in both of two consecutive frames")
    if augmentation is not None:
        changed = augment(clip, rng, augmentation)
        left = np.flatnonzero(changed.tracks.visible.all(0))
        clip, points = (changed, left) if len(left) >= min(_ENOUGH, len(points)) else (clip, points)
    chosen = rng.permutation(points)[: config.points]
    uv = project(clip.tracks.xyz[:, chosen], clip.intrinsics, clip.extrinsics)[0].astype(np.float32)
    rgb = np.ascontiguousarray(clip.video.transpose(0, 3, 1, 2)).astype(np.float32) / 255
    if augmentation is None:
        rgb, uv = _vary(rgb, uv, rng, config.jitter)
    return FramePair(torch.from_numpy(rgb), torch.from_numpy(uv))


def _vary(rgb: np.ndarray, uv: np.ndarray, rng: np.random.Generator, jitter: float) -> tuple[np.ndarray, np.ndarray]:
    """Mirror both frames in the same way, and change brightness and contrast of each; fast enough for a CPU."""
    for axis in (0, 1):  # u, v
        if rng.random() < 0.5:
            uv[..., axis] = rgb.shape[3 - axis] - 1 - uv[..., axis]
            rgb = np.flip(rgb, 3 - axis)
    contrast = 1 + jitter * rng.uniform(-1, 1, (2, 3, 1, 1)) * (rng.random((2, 1, 1, 1)) < 0.5)
    brightness = 0.25 * jitter * rng.uniform(-1, 1, (2, 1, 1, 1))
    return np.clip(rgb * contrast + brightness, 0, 1).astype(np.float32), uv


def _two_frames(path: Path, rng: np.random.Generator, gap: int, size: tuple[int, int]) -> tuple[Clip, np.ndarray]:
    """Frames at most `gap` apart, less where they share too few points, and the points visible in both."""
    arrays = clip_arrays(path)
    available = len(arrays["depths"])
    while True:
        distance = min(int(rng.integers(1, gap + 1)), available - 1)
        first = int(rng.integers(available - distance))
        clip = pick_frames(arrays, rng.permutation([first, first + distance]), size)
        both = np.flatnonzero(clip.tracks.visible.all(0))
        if len(both) >= _ENOUGH or gap == 1:
            return clip, both
        gap = max(gap // 2, 1)


def matching_loss(encoder: nn.Module, pairs: Sequence[FramePair], config: MatchingConfig) -> tuple[Tensor, Tensor]:
    """InfoNCE over all cells of the other frame, plus the distance of the place that the similarities near it give.

    Means over P pairs, whose frames the encoder maps from (P, 2, 3, H, W) to (P, 2, C, h, w), of the loss and of the
    share of points whose most similar cell of the finest level is within 1.5 cells of the true place.
    """
    maps = encoder(torch.stack([pair.rgb for pair in pairs]))
    with torch.autocast(maps.device.type, enabled=False):
        losses = [_pair_loss(two, pair, config) for two, pair in zip(maps, pairs, strict=True)]
    return tuple(torch.stack(values).mean() for values in zip(*losses, strict=True))


def _pair_loss(maps: Tensor, pair: FramePair, config: MatchingConfig) -> tuple[Tensor, Tensor]:
    total = right = torch.zeros((), device=pair.uv.device)
    size = constant((float(pair.rgb.shape[3]), float(pair.rgb.shape[2])), pair.uv)
    for level in range(config.levels):
        maps = F.avg_pool2d(maps, 2) if level else maps
        height, width = maps.shape[-2:]
        if min(height, width) < 2:  # a small image has no more levels
            break
        cells = pair.uv * constant((float(width), float(height)), pair.uv) / size
        scores = _similarity(maps, cells[0])
        places = pixel_grid(height, width, like=pair.uv).flatten(0, 1)  # (h w, 2), row by row
        apart = (places - cells[1][:, None]).square().sum(-1)  # (N, h w)
        target = (-apart / (2 * config.spread**2)).softmax(-1)
        loss = -(target * scores.log_softmax(-1)).sum(-1).mean()
        if config.place:
            near = scores.masked_fill(apart > _NEAR**2, -1e4).softmax(-1)
            loss = loss + config.place * (near @ places - cells[1]).norm(dim=-1).mean()
        total = total + loss / 2**level
        if level == 0:
            right = (apart.gather(1, scores.argmax(-1)[:, None]) < 1.5**2).float().mean()
    return total, right


def _similarity(maps: Tensor, cells: Tensor) -> Tensor:
    """Similarity (N, h w) of the features at cells (N, 2) of the first map to every cell of the second; maps (2, C, h, w)."""
    height, width = maps.shape[-2:]
    normed = F.layer_norm(maps.movedim(1, -1), maps.shape[1:2])  # as the tracker's tokens are
    grid = cells / constant((width - 1.0, height - 1.0), cells) * 2 - 1
    source = normed[:1].movedim(-1, 1)
    own = F.grid_sample(source, grid[None, None], align_corners=True, padding_mode="border")[0, :, 0].T  # (N, C)
    return own @ normed[1].flatten(0, 1).T / maps.shape[1] ** 0.5


def take_encoder(encoder: Encoder, folder: str | Path) -> None:
    """Load the encoder of a finished training's folder; ValueError where it is of other sizes."""
    stored, own = read_weights(Path(folder) / "weights.safetensors")[0], encoder.state_dict()
    stored = {name: stored[f"encoder.{name}"] for name in own if f"encoder.{name}" in stored}
    check_state(stored, own)
    encoder.load_state_dict(stored)
