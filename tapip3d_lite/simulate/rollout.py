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
    """One simulated clip before it is rendered.

    Attributes:
        seed, attempt: seed the random generator that draws the scene (shapes, textures, light).
        config: the clip's configuration.
        states: (T, S, nq) float64, MuJoCo's generalised positions at S instants around each frame.
        intrinsics: (3, 3) float32, pixels.
        extrinsics: (T, S, 4, 4) float32, world to camera.
        pixels: (N, 3) int16 rows (t, v, u) of the queries.
    """

    seed: int
    attempt: int
    config: SimulationConfig
    states: np.ndarray
    intrinsics: np.ndarray
    extrinsics: np.ndarray
    pixels: np.ndarray


def save_rollouts(
    path: str | Path, rollouts: Sequence[Rollout], extras: Sequence[Mapping[str, np.ndarray]] | None = None
) -> None:
    """Write rollouts to one npz, each with further arrays."""
    arrays = {}
    for index, rollout in enumerate(rollouts):
        about = {"seed": rollout.seed, "attempt": rollout.attempt, "config": asdict(rollout.config)}
        own = {name: getattr(rollout, name) for name in _ARRAYS} | {"about": np.array(json.dumps(about))}
        further = extras[index] if extras else {}
        arrays |= {f"{index:03d}/{name}": value for name, value in (own | dict(further)).items()}
    save_npz(path, arrays)


def load_rollouts(path: str | Path) -> list[tuple[Rollout, dict[str, np.ndarray]]]:
    """Read what `save_rollouts` wrote: rollouts in their order, each with its further arrays.

    Raises:
        ValueError: not such a file.
    """
    groups: dict[str, dict[str, np.ndarray]] = {}
    for key, value in load_npz(path).items():
        group, _, name = key.partition("/")
        groups.setdefault(group, {})[name] = value
    try:
        return [_unpack(dict(groups[key])) for key in sorted(groups)]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: not a file of rollouts ({error}); write it with save_rollouts") from error


def _unpack(group: dict[str, np.ndarray]) -> tuple[Rollout, dict[str, np.ndarray]]:
    about = json.loads(str(group.pop("about")))
    arrays = {name: group.pop(name) for name in _ARRAYS}
    return Rollout(about["seed"], about["attempt"], SimulationConfig(**about["config"]), **arrays), group
