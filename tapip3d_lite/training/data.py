"""What a tracker is trained on: which clips, which part of a clip, which of its points, in which coordinates.

Paper: appendix (training data). Everything that is drawn for step s comes from a generator seeded by (seed, s), so a
run that is continued draws what it would have drawn.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from tapip3d_lite.clip import Clip, load_clip
from tapip3d_lite.files import atomic_path, load_npz
from tapip3d_lite.model.cloud import quantile_roi
from tapip3d_lite.model.encoder import Encoder
from tapip3d_lite.model.frames import Frames, frames_from_clip, resize_clip
from tapip3d_lite.simulate import SimulationConfig, simulate_dataset
from tapip3d_lite.simulate.seeds import TRAINING, VALIDATION
from tapip3d_lite.training.loss import Truth


def training_config(seed: int) -> SimulationConfig:
    """The training clip of a seed: all cameras, with and without occluder and sky, slow and fast, 12 or 24 fps."""
    rng = np.random.default_rng([7, seed])
    return SimulationConfig(
        fps=float(rng.choice([12.0, 12.0, 24.0])),
        camera=("static", "linear", "arc", "handheld")[seed % 4],
        handheld=float(rng.uniform(0.3, 2.5)),
        arc=(15.0, 120.0),
        occluder=bool(rng.random() < 0.35),
        sky=bool(rng.random() < 0.2),
        same_texture=bool(rng.random() < 0.15),
        speed=float(rng.uniform(0.7, 1.6)),
        drop=float(rng.uniform(0.8, 1.8)),
        moving=(3, 12),
        tracks=384,
    )


def large_training_config(seed: int) -> SimulationConfig:
    """The same clip at the size of the paper's model, with more points."""
    return replace(training_config(seed), size=(384, 512), tracks=768)


def training_clips(
    folder: str | Path, count: int, progress: bool = True, workers: int | None = None, large: bool = False
) -> list[Path]:
    """The paths of the first `count` training clips, 128x128 or `large`; those that are missing are simulated."""
    if not 0 < count <= len(TRAINING):
        raise ValueError(f"training_clips: count must be in [1, {len(TRAINING)}], got {count}")
    config = large_training_config if large else training_config
    return simulate_dataset(folder, count, config, TRAINING.start, workers, progress)


def validation_clips(folder: str | Path, count: int, progress: bool = True) -> list[Clip]:
    """Held-out clips of the same kind, never trained on; at 12 fps, 64 tracks each."""
    paths = simulate_dataset(folder, count, _validation_config, VALIDATION.start, None, progress)
    return [load_clip(path) for path in paths]


def _validation_config(seed: int) -> SimulationConfig:
    return SimulationConfig(camera=("static", "linear", "arc", "handheld")[seed % 4], tracks=64)


@dataclass(frozen=True)
class Batch:
    """B clips of equal length with their truth.

    Attributes:
        frames: (B, T), with colours as bytes until `to` has brought them to a device; black where features are given.
        queries: (B, N, 4).
        truth: of the same tracks.
        dynamic: (B, N) bool, points on bodies that move in the world.
        roi: depths (near, far), each (B, 1, 1, 1), that count for the scale.
        features: (B, T, C, h, w) of a frozen encoder, or None.
        names: which clips these are.
    """

    frames: Frames
    queries: Tensor
    truth: Truth
    dynamic: Tensor
    roi: tuple[Tensor, Tensor]
    features: Tensor | None
    names: tuple[str, ...]

    def to(self, device: torch.device | str) -> Batch:
        """The batch on a device, ready to be tracked."""
        batch = self.map(lambda x: x.to(device))
        features = None if batch.features is None else batch.features.float()
        rgb = batch.frames.rgb
        rgb = rgb.float() / 255 if rgb.dtype == torch.uint8 else rgb
        return replace(batch, frames=replace(batch.frames, rgb=rgb), features=features)

    def map(self, change: Callable[[Tensor], Tensor]) -> Batch:
        """The batch with every tensor changed, always in the same order."""
        frames, truth = (
            type(part)(*(change(getattr(part, f.name)) for f in fields(part))) for part in (self.frames, self.truth)
        )
        features = None if self.features is None else change(self.features)
        roi = tuple(change(x) for x in self.roi)
        return Batch(frames, change(self.queries), truth, change(self.dynamic), roi, features, self.names)


def make_batch(clips: list[Clip], features: list[Tensor] | None = None) -> Batch:
    """Stack clips with as many frames and tracks each.

    Args:
        clips: with tracks, at the model's image size.
        features: of each clip (T, C, h, w), if they exist.
    """
    video, *others = (
        torch.from_numpy(np.stack([getattr(clip, name) for clip in clips]))
        for name in ("video", "depths", "intrinsics", "extrinsics")
    )
    frames = Frames(video.movedim(-1, 2), *others)
    tracks = [clip.tracks for clip in clips]
    queries = torch.stack([torch.from_numpy(x.queries) for x in tracks])
    xyz, visible = (torch.stack([torch.from_numpy(getattr(x, name)) for x in tracks]) for name in ("xyz", "visible"))
    still = [np.zeros(x.queries.shape[0], bool) if x.dynamic is None else x.dynamic for x in tracks]
    near, far = zip(*(quantile_roi(x) for x in frames.depths), strict=True)
    roi = tuple(torch.tensor(x).view(-1, 1, 1, 1) for x in (near, far))
    return Batch(
        frames,
        queries,
        Truth(xyz, visible, queries[..., 0].long()),
        torch.from_numpy(np.stack(still)),
        roi,
        None if features is None else torch.stack(features),
        tuple(clip.name for clip in clips),
    )


class FeatureCache:
    """Features of whole clips by a frozen encoder, as half floats in files that are made when first asked for."""

    def __init__(self, folder: str | Path, encoder: Encoder, size: tuple[int, int]) -> None:
        self.folder, self.encoder, self.size = Path(folder), encoder, size

    def check_room(self, clips: Sequence[Path]) -> None:
        """ValueError, with the sizes, where the disk is too small for the features of these clips."""
        maps = self.encoder.head.out_channels * math.prod(side // self.encoder.stride for side in self.size)
        frames = len(load_npz(clips[0], skip=("video", "tracks", "visible"))["depths"])
        missing = sum(not (self.folder / f"{clip.stem}.npy").exists() for clip in clips)
        needed, free = missing * frames * maps * 2, shutil.disk_usage(self.folder.parent).free
        if needed > free:
            raise ValueError(
                f"train: the features of {missing} clips take {needed / 1e9:.1f} GB in {self.folder}, where "
                f"{free / 1e9:.1f} GB are free; use fewer clips, another folder, or train the encoder along"
            )

    @torch.no_grad()
    def path(self, clip: Path) -> Path:
        """The file (T, C, h, w) float16 of one clip."""
        path = self.folder / f"{clip.stem}.npy"
        if not path.exists():
            device = next(self.encoder.parameters()).device
            frames = frames_from_clip(resize_clip(load_clip(clip, points=False), self.size), device=device)
            features = self.encoder(frames.rgb)[0]
            with atomic_path(path) as temporary:
                np.save(temporary, features.half().cpu().numpy())
        return path

    def frames(self, clip: Path, index: np.ndarray) -> Tensor:
        """Features (len(index), C, h, w) float32 of some frames."""
        stored = np.load(self.path(clip), mmap_mode="r")
        return torch.from_numpy(stored[index]).float()
