"""The sample clips: which seeds and settings they come from. `python3 run.py samples` writes them again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lessons.tool import ToolParser
from tapip3d_lite.clip import Clip
from tapip3d_lite.figures import overview, save_png
from tapip3d_lite.files import atomic_path
from tapip3d_lite.formats import load_clip
from tapip3d_lite.simulate.settings import SimulationConfig
from tapip3d_lite.simulate.simulator import simulate_clip


@dataclass(frozen=True)
class Sample:
    """A sample clip: its seed, its settings, and what it is for."""

    seed: int
    purpose: str
    config: SimulationConfig


SAMPLES = {
    "static_camera": Sample(
        102, "The control: without camera motion, world and camera space are alike.", SimulationConfig(camera="static")
    ),
    "arc": Sample(
        100, "The camera sweeps a quarter turn and more: what world space cancels.", SimulationConfig(arc=(90, 120))
    ),
    "handheld": Sample(
        103, "A running hand: jerky paths in the image.", SimulationConfig(camera="handheld", handheld=2.5)
    ),
    "fast_fall": Sample(
        102,
        "Bodies thrown hard and from high up, with motion blur: large steps from frame to frame.",
        SimulationConfig(camera="linear", drop=2.0, speed=1.8, moving=(6, 8), motion_blur=True),
    ),
    "long_occlusion": Sample(
        16,
        "Bodies stay hidden behind a block for long, then come back.",
        SimulationConfig(camera="linear", occluder=True, moving=(5, 8), resting=(0, 3), speed=1.4),
    ),
    "same_texture": Sample(
        103,
        "Bodies of one texture side by side: 2D windows mix neighbours, 3D neighbourhoods do not.",
        SimulationConfig(camera="linear", same_texture=True, moving=(6, 8), resting=(4, 6)),
    ),
    "open_sky": Sample(104, "No backdrop: the sky's depth is 0, that is invalid.", SimulationConfig(sky=True)),
    "stereo_pair": Sample(
        100,
        "A right view 0.2 m beside (`video_right`, `stereo_baseline`): depth from stereo matching.",
        SimulationConfig(camera="handheld", stereo_baseline=0.2, size=(96, 128)),
    ),
    "long_clip": Sample(
        105,
        "48 frames at 24 fps: several sliding windows.",
        SimulationConfig(frames=48, fps=24.0, size=(96, 96), arc=(60, 100)),
    ),
}


def write_samples(folder: str | Path = "data_samples") -> list[Path]:
    """Simulate all `SAMPLES` and write them to a folder, with a README that says what each is for.

    To keep the files small, depths are rounded to 16 bits of mantissa: a relative error of at most 8e-6.

    Args:
        folder: made if missing; files of the same names are replaced.

    Returns:
        The paths of the clips.
    """
    folder, paths, rows = Path(folder), [], []
    for name, sample in SAMPLES.items():
        clip = simulate_clip(sample.seed, sample.config)
        clip = replace(clip, name=name, depths=round_mantissa(clip.depths, 16))
        paths.append(folder / f"{name}.npz")
        clip.save(paths[-1])
        rows.append(_row(sample, clip, paths[-1]))
    with atomic_path(folder / "README.md") as temporary:
        temporary.write_text(_HEAD + "\n".join(rows) + "\n", encoding="utf-8")
    return paths


def write_picture(folder: str | Path = "data_samples") -> Path:
    """Draw true tracks of the clip `arc` in a folder of samples over its frames and depth, as the project's README shows."""
    clip, path = load_clip(Path(folder) / "arc.npz"), Path(folder) / "picture.png"
    save_png(overview(clip, clip.tracks.select(slice(0, None, 3))), path)
    return path


def round_mantissa(values: np.ndarray, bits: int) -> np.ndarray:
    """Round float32 values to `bits` (1 to 22) bits of mantissa: relative error at most 2^-(bits + 1); 0 stays 0."""
    drop = np.uint32(23 - bits)
    raw = values.astype(np.float32).view(np.uint32) + (np.uint32(1) << (drop - np.uint32(1)))
    return ((raw >> drop) << drop).view(np.float32)


_HEAD = """# Sample clips

Simulated with exact depth, cameras, 3D tracks and visibility; all motion is rigid, lengths are metres. Read one with
`tapip3d_lite.load_clip(path)`; write all of them again with `python3 run.py samples`. Depths are rounded to 16
bits of mantissa (relative error at most 8e-6) to keep the files small. Pictures and text are ours (Apache-2.0).

"Dynamic" is the share of tracks on bodies that move in the world; "hidden" is the share of their points that are out
of sight for six frames or more on end between two frames in which they are seen.

| clip | what for | seed | frames | size (H×W) | MB | dynamic | hidden |
|---|---|---|---|---|---|---|---|
"""


def _row(sample: Sample, clip: Clip, path: Path) -> str:
    height, width = clip.size
    share, megabytes = clip.tracks.dynamic.mean(), path.stat().st_size / 1e6
    hidden = (longest_gap(clip.tracks.visible[:, clip.tracks.dynamic]) >= 6).mean()
    return (
        f"| `{path.name}` | {sample.purpose} | {sample.seed} | {len(clip)} | {height}×{width} "
        f"| {megabytes:.2f} | {share:.0%} | {hidden:.0%} |"
    )


def longest_gap(visible: np.ndarray) -> np.ndarray:
    """The longest run of hidden frames (N,) between two visible ones, from visible (T, N) bool."""
    longest, last = np.zeros(visible.shape[1], int), np.full(visible.shape[1], -1)
    for t, seen in enumerate(visible):
        gap = np.where(seen & (last >= 0), t - last - 1, 0)
        longest, last = np.maximum(longest, gap), np.where(seen, t, last)
    return longest


def main(argv: Sequence[str] | None = None) -> None:
    """Write all sample clips, their README and the picture."""
    parser = ToolParser("samples", "Write the sample clips, their table and a picture of one again from their seeds.")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[2] / "data_samples", help="their folder")
    out = parser.parse_args(argv).out
    with parser.complaints():
        count = len(write_samples(out))
        write_picture(out)
    print(f"wrote {count} clips, their table and a picture to {out}")


if __name__ == "__main__":
    main()
