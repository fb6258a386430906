"""The clips of the Lite benchmark: stored as rollouts, rendered on first use and compared with fingerprints.

Beside the three splits of the benchmark stand four hard ones: bodies that creep (`slow`), wrong poses (`drift`), a poor
depth sensor (`sensor`), and tall images (`portrait`).

The files in `lite_benchmark/` hold the results of the physics, so that every machine scores the same clips; each clip's
fingerprint reveals a change of the renderer that would silently change the scores.
"""

from __future__ import annotations

import os
import tempfile
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
from tqdm import tqdm

from tapip3d_lite.clip import Clip
from tapip3d_lite.files import digest
from tapip3d_lite.formats import load_clip
from tapip3d_lite.simulate import Rollout, render_clip
from tapip3d_lite.simulate.dataset import run_jobs
from tapip3d_lite.simulate.degrade import SensorConfig, degrade, wrong_poses
from tapip3d_lite.simulate.rollout import load_rollouts

FOLDER = Path(__file__).parent / "lite_benchmark"
SPLITS = ("static-camera", "moving-camera", "occlusion")
HARD = ("slow", "drift", "sensor", "portrait")
DRIFT = (0.25, 0.5, 1.0, 2.0)  # degrees of pose error, clip by clip
ALL = (*SPLITS, *HARD)
COUNT = 16
Job = tuple[Path, str, Rollout, dict[str, np.ndarray]]  # file in the cache, name, what to render, fingerprint
SLACK = {"tracks": 2, "depths": 4, "visible": 0, "video": 4}  # millimetres, millimetres, bits, grey levels


def check_request(split: str, count: int | None) -> None:
    """Raise ValueError for a split that is none of `ALL`, or fewer of its clips than one."""
    if split not in ALL:
        raise ValueError(f"split: expected one of {', '.join(ALL)}, got {split!r}; choose one of them")
    if count is not None and count < 1:
        raise ValueError(f"count: expected at least 1, got {count}; leave it out for all clips")


def split_file(split: str) -> Path:
    """Where a split's rollouts are stored."""
    return FOLDER / ("hard" if split in HARD else "") / f"{split}.npz"


def flawed(clip: Clip, split: str, index: int) -> Clip:
    """A rendered clip of a split with what reality does to it: wrong poses in `drift`, a poor sensor in `sensor`."""
    if split == "drift":
        return wrong_poses(clip, DRIFT[index % len(DRIFT)], seed=index)
    if split == "sensor":
        return degrade(clip, SensorConfig.draw(np.random.default_rng([1, index]), share=0.6), seed=index)
    return clip


def fingerprint(clip: Clip) -> dict[str, np.ndarray]:
    """A few thousand numbers that identify a clip: tracks and depths in millimetres, colours, visibility."""
    some = (slice(None, None, 8), slice(4, None, 8), slice(4, None, 8))
    return {
        "tracks": np.rint(1000 * clip.tracks.xyz[::8, ::2]).astype(np.int16),
        "depths": np.rint(1000 * clip.depths[some]).astype(np.int16),
        "visible": np.packbits(clip.tracks.visible),
        "video": clip.video[some],
    }


def differences(clip: Clip, stored: dict[str, np.ndarray]) -> list[str]:
    """What differs between a clip and a fingerprint, apart from rounding and a hundredth of pixels, at edges of bodies."""
    found = []
    for name, now in fingerprint(clip).items():
        if now.shape != stored[name].shape:
            found.append(f"{name}: shape {now.shape} in place of {stored[name].shape}")
            continue
        other = (np.abs(now.astype(int) - stored[name].astype(int)) > SLACK[name]).mean()
        if other > 0.01:
            found.append(f"{name}: {other:.1%} of the values differ")
    return found


def benchmark_clips(split: str, count: int | None = None, progress: bool = True) -> list[Clip]:
    """The clips of a split, or only the first `count`, named `<split>-<index>`.

    They are rendered on first use by all cores (a script that calls this needs the usual `if __name__ == "__main__":`),
    then read from a cache of 1 MB a clip: `$XDG_CACHE_HOME/tapip3d_lite/benchmark`, by default under `~/.cache`,
    or the temporary folder where that cannot be written.

    Raises:
        ValueError: unknown split, bad count, or rendered clips that differ from the fingerprints.
    """
    check_request(split, count)
    path, cache = split_file(split), _cache()
    # Cached clips depend on the rollouts, the renderer's source, and versions of its packages.
    sources = sorted((Path(__file__).parents[1] / "simulate").glob("*.py"))
    key = digest(*(file.read_bytes() for file in (path, *sources)), f"{version('mujoco')} {version('numpy')}")
    jobs = [
        (cache / f"{split}-{index:02d}-{key}.npz", f"{split}-{index:02d}", rollout, marks)
        for index, (rollout, marks) in enumerate(load_rollouts(path)[:count])
    ]
    clips = {job[1]: _cached(job) for job in jobs}
    missing = [job for job in jobs if clips[job[1]] is None]
    with tqdm(total=len(missing), desc="rendering", unit="clip", disable=not (progress and missing)) as bar:
        for _ in run_jobs(_render, missing):
            bar.update()
    return [clips[job[1]] or load_clip(job[0]) for job in jobs]


def _cache() -> Path:
    """The folder of rendered clips; where nobody's home can be written, under that of temporary files."""
    try:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tapip3d_lite" / "benchmark"
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
    except (RuntimeError, OSError):  # no home, or one that cannot be written
        pass
    return Path(tempfile.gettempdir()) / "tapip3d_lite" / "benchmark"


def _cached(job: Job) -> Clip | None:
    """The clip from the cache, or None where it is absent, damaged or differs from its fingerprint."""
    try:
        clip = load_clip(job[0])
    except ValueError:
        return None
    return clip if clip.tracks is not None and not differences(clip, job[3]) else None


def _render(job: Job) -> None:
    """Render one clip into the cache."""
    path, name, rollout, marks = job
    split, _, index = name.rpartition("-")
    clip = replace(flawed(render_clip(rollout), split, int(index)), name=name)
    wrong = differences(clip, marks)
    if wrong:
        raise ValueError(
            f"benchmark clip {name}: the clip rendered here is not the benchmark's ({'; '.join(wrong)}); "
            "scores would not be comparable; use the versions of mujoco and tapip3d_lite that the benchmark was made with"
        )
    clip.save(path)
    for old in path.parent.glob(f"{name}-*.npz"):  # rendered by an earlier version
        if old != path:
            old.unlink(missing_ok=True)
