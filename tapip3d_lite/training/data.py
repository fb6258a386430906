"""What a tracker is trained on: which clips, which frames and points of a clip, and how they become a batch.

Paper: appendix (training). Tracks that are visible in at least a fifth of the frames; queries in the first visible
frame, one in four in a random visible frame; half of the clips are played backward. The paper's clips are Kubric's;
ours are simulated.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.files import atomic_path, digest, load_npz, map_npy
from tapip3d_lite.formats import load_clip
from tapip3d_lite.formats.arrays import clip_arrays
from tapip3d_lite.geometry import in_image
from tapip3d_lite.model.cloud import quantile_roi
from tapip3d_lite.model.encoder import Encoder
from tapip3d_lite.model.frames import Frames, frames_from_clip, resize_clip
from tapip3d_lite.simulate import SimulationConfig, simulate_dataset
from tapip3d_lite.simulate.degrade import log_uniform
from tapip3d_lite.simulate.seeds import TRAINING, VALIDATION
from tapip3d_lite.training.loss import Truth
from tapip3d_lite.validate import check_range, check_types, floats, video_frames


def training_config(seed: int) -> SimulationConfig:
    """The settings of a seed's training clip: any camera, with or without occluder and sky, thrown or creeping bodies.

    Slow motion comes from the frame rate: at 240 frames a second a rolling ball creeps.
    """
    rng = np.random.default_rng([7, seed])
    slow = log_uniform(rng, (24.0, 300.0))
    return SimulationConfig(
        fps=float(rng.choice([12.0, 12.0, 24.0, slow])),
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
    """The same settings at the image size of the paper's model, with more points."""
    return replace(training_config(seed), size=(384, 512), tracks=768)


def training_clips(
    folder: str | Path, count: int, progress: bool = True, workers: int | None = None, large: bool = False
) -> list[Path]:
    """The paths of the first `count` training clips, 128x128 or `large`; missing ones are simulated."""
    if not 0 < count <= len(TRAINING):
        raise ValueError(f"training_clips: count must be in [1, {len(TRAINING)}], got {count}")
    config = large_training_config if large else training_config
    return simulate_dataset(folder, count, config, TRAINING.start, workers, progress)


def validation_clips(folder: str | Path, count: int, progress: bool = True) -> list[Clip]:
    """Held-out clips with other seeds than any training clip; at 12 fps, 64 tracks each."""
    paths = simulate_dataset(folder, count, _validation_config, VALIDATION.start, None, progress)
    return [load_clip(path) for path in paths]


def _validation_config(seed: int) -> SimulationConfig:
    return SimulationConfig(camera=("static", "linear", "arc", "handheld")[seed % 4], tracks=64)


@dataclass(frozen=True)
class SamplingConfig:
    """Which points of a clip are tracked, and from which frame on.

    Attributes:
        tracks: N, number of tracks.
        seen: a point must be visible in at least this share of the example's frames.
        anywhere: share of the queries in a random frame that shows the point; the others are in the first such frame.
        backward: share of the examples that are played backward.

    Raises:
        ValueError: no tracks, or a share outside [0, 1].
    """

    tracks: int = 48
    seen: float = 0.2
    anywhere: float = 0.25
    backward: float = 0.5

    def __post_init__(self) -> None:
        check_types(self)
        check_range(self, 1, 1e5, "tracks")
        check_range(self, 0, 1, "seen", "anywhere", "backward")


def true_tracks(arrays: Mapping[str, np.ndarray], index: Any = slice(None)) -> tuple[np.ndarray, np.ndarray]:
    """Positions (T, N, 3) in some frames of a stored clip, NaN where unknown, and which are visible, in the image."""
    xyz, visible, *cameras = (arrays[name][index] for name in ("tracks", "visible", "intrinsics", "extrinsics"))
    xyz = np.where(np.isfinite(xyz).all(-1, keepdims=True), xyz, np.nan)
    return xyz, visible.astype(bool) & in_image(xyz, *cameras, arrays["depths"].shape[1:])


def usable_starts(visible: np.ndarray, wanted: int, seen: float) -> np.ndarray:
    """Where in (T, N) `wanted` consecutive frames may begin: in a share `seen` of them some point is visible."""
    if wanted > len(visible):
        raise ValueError(f"{len(visible)} frames, but an example has up to {wanted}; lower `frames`")
    total = np.cumsum(np.pad(visible, ((1, 0), (0, 0))), 0)
    starts = np.flatnonzero(((total[wanted:] - total[:-wanted]) / wanted >= max(seen, 1 / wanted)).any(1))
    if not len(starts):
        raise ValueError(f"no track is visible, inside the image, in {seen:.0%} of any {wanted} frames; lower `seen`")
    return starts


def fault(path: Path, lengths: Iterable[int], seen: float) -> str | None:
    """Why examples of these lengths cannot be drawn from a clip, or None; of images and depths only the sizes are read."""
    try:
        arrays = clip_arrays(path, outline=("video", "depths"))
        if not {"tracks", "visible"} <= arrays.keys():
            raise ValueError("no `tracks` and `visible`; a training needs true tracks, so leave this clip out")
        video, xyz = video_frames(arrays["video"]), arrays["tracks"]
        floats("depths", arrays["depths"], video.shape[:3], like="video (T, H, W, 3)")
        tracks = Tracks(xyz, arrays["visible"], np.zeros((*xyz.shape[1:2], 4)), dynamic=arrays.get("dynamic"))
        pixel, cameras = (video[:, :1, :1], np.ones((len(video), 1, 1))), (arrays["intrinsics"], arrays["extrinsics"])
        Clip(*pixel, *cameras, np.empty((0, 4)), tracks, fps=float(arrays["fps"]))  # which checks the rest
        xyz, visible = true_tracks(arrays)
        if wrong := np.count_nonzero(tracks.visible & np.isnan(xyz[..., 0])):
            raise ValueError(f"tracks: {wrong} positions are NaN where `visible` is true; set it false there")
        for wanted in lengths:
            usable_starts(visible, wanted, seen)
    except ValueError as error:
        return f"{path}: {str(error).removeprefix(f'{path}: ')}"
    return None


def draw_frames(arrays: dict[str, np.ndarray], rng: np.random.Generator, n: int, config: SamplingConfig) -> np.ndarray:
    """Draw n consecutive frames of a stored clip that show enough of a point, maybe from last to first: indices (n,)."""
    starts = usable_starts(true_tracks(arrays)[1], n, config.seen)
    index = starts[rng.integers(len(starts))] + np.arange(n)
    return index[::-1].copy() if rng.random() < config.backward else index


def query_rows(xyz: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Query rows (N, 4) of tracks xyz (T, N, 3) at frames times (N,)."""
    return np.concatenate([times[:, None], xyz[times, np.arange(len(times))]], -1).astype(np.float32)


def sample_tracks(clip: Clip, rng: np.random.Generator, config: SamplingConfig) -> Clip:
    """Draw N of a clip's tracks and the frames of their queries.

    Where fewer than N are visible in enough frames, some appear more than once; where none is, it is a ValueError.
    """
    visible = clip.tracks.visible
    good = np.flatnonzero(visible.mean(0) >= max(config.seen, 1 / len(visible)))
    if not len(good):
        raise ValueError(
            f"sample_tracks: {clip.name!r} shows no track in {config.seen:.0%} of its frames; lower `seen`"
        )
    extra = rng.choice(good, max(config.tracks - len(good), 0))
    chosen = rng.choice(np.concatenate([good, extra]), config.tracks, replace=False)
    visible = visible[:, chosen]
    times = visible.argmax(0)
    for n in np.flatnonzero(rng.random(config.tracks) < config.anywhere):
        times[n] = rng.choice(np.flatnonzero(visible[:, n]))
    picked = clip.tracks.select(chosen)
    queries = query_rows(picked.xyz, times)
    return replace(clip, queries=queries, tracks=replace(picked, queries=queries))


def pick_frames(arrays: Mapping[str, np.ndarray], index: np.ndarray, size: tuple[int, int]) -> Clip:
    """A clip of some frames (T,) of a stored clip's arrays, in any order, with the tracks that are visible in them.

    Each query is in the first visible frame. Images are resized to `size` (H, W); without "video" they are black.
    """
    frames = {name: arrays[name][index] for name in ("depths", "intrinsics", "extrinsics")}
    video = arrays["video"][index] if "video" in arrays else np.zeros((*frames["depths"].shape, 3), np.uint8)
    xyz, visible = true_tracks(arrays, index)
    kept = visible.any(0)
    xyz, visible = xyz[:, kept], visible[:, kept]
    dynamic = arrays["dynamic"][kept] if "dynamic" in arrays else None
    tracks = Tracks(xyz, visible, query_rows(xyz, visible.argmax(0)), dynamic=dynamic)
    clip = Clip(video, **frames, tracks=tracks, name=str(arrays["name"]), fps=float(arrays["fps"]))
    if size == clip.size:
        return clip
    resized = resize_clip(clip, size)
    return replace(clip, video=resized.video, depths=resized.depths, intrinsics=resized.intrinsics)


@dataclass(frozen=True)
class Batch:
    """B clips of equal length with their true tracks.

    Attributes:
        frames: (B, T) frames; colours are bytes until `to` moves them to a device, and black where features are given.
        queries: (B, N, 4) rows (t, x, y, z), world.
        truth: of the same tracks.
        dynamic: (B, N) bool, points on bodies that move in the world.
        roi: depths (near, far), each (B, 1, 1, 1), between which points count for the normalisation scale.
        features: (B, T, C, h, w) of a frozen encoder, or None.
        names: of the clips.
        iterations: M, updates of each window in this step; None: the tracker's own number.
    """

    frames: Frames
    queries: Tensor
    truth: Truth
    dynamic: Tensor
    roi: tuple[Tensor, Tensor]
    features: Tensor | None
    names: tuple[str, ...]
    iterations: int | None = None

    def to(self, device: torch.device | str) -> Batch:
        """The batch on a device, with colours, which alone are bytes, as float32 in [0, 1]."""
        return self.map(lambda x: x.to(device).float() / 255 if x.dtype == torch.uint8 else x.to(device))

    def map(self, change: Callable[[Tensor], Tensor]) -> Batch:
        """The batch with every tensor replaced by `change` of it, always in the same order."""
        frames, truth = (type(part)(*map(change, vars(part).values())) for part in (self.frames, self.truth))
        queries, dynamic, roi = change(self.queries), change(self.dynamic), tuple(map(change, self.roi))
        features = None if self.features is None else change(self.features)
        return Batch(frames, queries, truth, dynamic, roi, features, self.names, self.iterations)


def make_batch(clips: list[Clip], features: list[Tensor] | None = None, iterations: int | None = None) -> Batch:
    """Stack clips that have equally many frames and tracks, at the model's image size.

    `features` (T, C, h, w) are those of each clip, where they are already known; `iterations` is M of the step.
    """

    def stack(arrays: Iterable[np.ndarray]) -> Tensor:
        array = np.stack(list(arrays))
        return torch.from_numpy(array.astype(np.float32) if array.dtype == np.float64 else array)

    tracks, names = [clip.tracks for clip in clips], tuple(clip.name for clip in clips)
    frames = [stack(getattr(clip, x) for clip in clips) for x in ("video", "depths", "intrinsics", "extrinsics")]
    frames = Frames(frames[0].movedim(-1, 2), *frames[1:])
    queries, xyz, visible = (stack(getattr(x, name) for x in tracks) for name in ("queries", "xyz", "visible"))
    dynamic = stack(np.zeros(len(x.queries), bool) if x.dynamic is None else x.dynamic for x in tracks)
    truth, features = Truth(xyz, visible, queries[..., 0].long()), None if features is None else torch.stack(features)
    roi = tuple(torch.tensor(x).view(-1, 1, 1, 1) for x in zip(*map(quantile_roi, frames.depths), strict=True))
    return Batch(frames, queries, truth, dynamic, roi, features, names, iterations)


class FeatureCache:
    """Features of whole clips by a frozen encoder, stored as float16 files that are written when first needed.

    A file is named by its clip's content, since clips in two folders may bear one name.
    """

    def __init__(self, folder: str | Path, encoder: Encoder, size: tuple[int, int]) -> None:
        self.folder, self.encoder, self.size = Path(folder), encoder, size
        self._paths: dict[Path, Path] = {}

    def check_room(self, clips: Sequence[Path]) -> None:
        """Raise a ValueError with the sizes if the features of these clips do not fit on the disk."""
        maps = self.encoder.head.out_channels * math.prod(side // self.encoder.stride for side in self.size)
        missing = [clip for clip in clips if not self._path(clip).exists()]
        frames = sum(len(load_npz(clip, ("video", "tracks", "visible"), ("depths",))["depths"]) for clip in missing)
        needed, free = frames * maps * 2, shutil.disk_usage(self.folder.parent).free
        if needed > free:
            raise ValueError(
                f"train: the features of {len(missing)} clips take {needed / 1e9:.1f} GB in {self.folder}, where "
                f"{free / 1e9:.1f} GB are free; use fewer clips, another folder, or train the encoder along"
            )

    def _path(self, clip: Path) -> Path:
        if clip not in self._paths:
            self._paths[clip] = self.folder / f"{clip.stem}-{digest(clip.read_bytes())}.npy"
        return self._paths[clip]

    @torch.no_grad()
    def frames(self, clip: Path, index: np.ndarray) -> Tensor:
        """Features (len(index), C, h, w) float32 of some frames of a clip, which is encoded if there is no file yet."""
        path = self._path(clip)
        if not path.exists():
            device = next(self.encoder.parameters()).device
            frames = frames_from_clip(resize_clip(load_clip(clip, points=False), self.size), device=device)
            features = self.encoder(frames.rgb)[0]
            with atomic_path(path) as temporary:
                np.save(temporary, features.half().cpu().numpy())
        return torch.from_numpy(map_npy(path)[index]).float()
