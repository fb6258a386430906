"""Make `evaluation/lite_benchmark/*.npz`, the stored clips of the Lite benchmark: `python -m tests.make_benchmark [split …]`.

For maintainers only: the physics is simulated again, so every score of the benchmark changes with it.
"""

from __future__ import annotations

import sys

from tapip3d_lite.evaluation.lite_splits import ALL, COUNT, fingerprint, flawed, split_file
from tapip3d_lite.simulate import SimulationConfig, render_clip, simulate_rollout
from tapip3d_lite.simulate.rollout import save_rollouts
from tapip3d_lite.simulate.seeds import BENCHMARK


def split_config(split: str, index: int) -> SimulationConfig:
    """The settings of a split's clip; its seed is `split_seed`."""
    if split == "static-camera":
        return SimulationConfig(camera="static")
    if split == "moving-camera":
        return SimulationConfig(camera=("linear", "arc", "handheld")[index % 3], handheld=2.0)
    camera = ("static", "linear", "arc", "handheld")[index % 4]
    if split == "slow":
        return SimulationConfig(camera=camera, fps=(100.0, 170.0, 300.0)[index % 3])
    if split == "portrait":
        return SimulationConfig(camera=camera, handheld=2.0, size=(160, 96))
    if split in ("drift", "sensor"):
        return SimulationConfig(camera=camera, handheld=2.0)
    return SimulationConfig(camera=camera, occluder=True, moving=(8, 12), resting=(2, 6), speed=1.4)


def split_seed(split: str, index: int) -> int:
    """The seed of a split's clip: the splits take successive seeds from a thousand each."""
    return BENCHMARK.start + 1000 * ALL.index(split) + index


def write_split(split: str) -> None:
    rollouts = [simulate_rollout(split_seed(split, index), split_config(split, index)) for index in range(COUNT)]
    clips = [flawed(render_clip(rollout), split, index) for index, rollout in enumerate(rollouts)]
    split_file(split).parent.mkdir(exist_ok=True)
    save_rollouts(split_file(split), rollouts, [fingerprint(clip) for clip in clips])


if __name__ == "__main__":
    for split in sys.argv[1:] or ALL:
        write_split(split)
