"""`Rollout`: the result of the physics, from which the same clip can be rendered on every machine.

Physics differs in the last digits between machines and between versions of MuJoCo, and small differences grow with
every contact; shapes and textures do not depend on them. So a rollout holds the bodies' states and the cameras, and of
the scene only the numbers that draw it again.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from tapip3d_lite.files import load_npz, save_npz
from tapip3d_lite.simulate.settings import SimulationConfig

_ARRAYS = ("states", "intrinsics", "extrinsics", "pixels")


@dataclass(frozen=True)
class Rollout:
    """One simulated clip before it is rendered."""

    seed: int  # with `attempt` it seeds the random generator that draws the scene (shapes, textures, light)
    attempt: int
    config: SimulationConfig
    states: np.ndarray  # (T, S, nq) float64, MuJoCo's generalised positions at S instants around each frame
    intrinsics: np.ndarray  # (3, 3) float32, pixels
    extrinsics: np.ndarray  # (T, S, 4, 4) float32, world to camera
    pixels: np.ndarray  # (N, 3) int16 rows (t, v, u) of the queries


def save_rollouts(path: str | Path, rollouts: Sequence[Rollout], extras: Sequence[Mapping[str, np.ndarray]]) -> None:
    """Write rollouts to one npz, each with further arrays."""
    arrays = {}
    for index, (rollout, further) in enumerate(zip(rollouts, extras, strict=True)):
        about = {"seed": rollout.seed, "attempt": rollout.attempt, "config": asdict(rollout.config)}
        own = {name: getattr(rollout, name) for name in _ARRAYS} | {"about": np.array(json.dumps(about))}
        arrays |= {f"{index:03d}/{name}": value for name, value in {**own, **further}.items()}
    save_npz(path, arrays)


def load_rollouts(path: str | Path) -> list[tuple[Rollout, dict[str, np.ndarray]]]:
    """Read what `save_rollouts` wrote: rollouts in their order, each with its further arrays; ValueError if another file."""
    groups: dict[str, dict[str, np.ndarray]] = {}
    for key, value in load_npz(path).items():
        group, _, name = key.partition("/")
        groups.setdefault(group, {})[name] = value
    try:
        return [_unpack(groups[key]) for key in sorted(groups)]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: not a file of rollouts ({error}); write it with save_rollouts") from error


def _unpack(group: dict[str, np.ndarray]) -> tuple[Rollout, dict[str, np.ndarray]]:
    about = json.loads(str(group.pop("about")))
    about["config"] = SimulationConfig(**about["config"])
    return Rollout(**about, **{name: group.pop(name) for name in _ARRAYS}), group
