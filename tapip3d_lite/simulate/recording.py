"""A roll-out that can be filmed again: what physics and the camera did, kept without the pictures.

Physics may differ in the last digits between machines and MuJoCo's versions, and soon in everything; what a body looks
like does not. So a recording holds the bodies' states and the cameras, and of the scene only what remakes it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from tapip3d_lite.files import load_npz, save_npz
from tapip3d_lite.simulate.config import SimulationConfig

_ARRAYS = ("states", "intrinsics", "extrinsics", "pixels")


@dataclass(frozen=True)
class Recording:
    """One simulated clip before it is filmed.

    Attributes:
        seed, attempt: remake the scene (shapes, textures, light).
        config: as the clip was made with.
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


def save_recordings(
    path: str | Path, recordings: Sequence[Recording], extras: Sequence[Mapping[str, np.ndarray]] | None = None
) -> None:
    """Write recordings to one npz, each with some arrays beside it."""
    arrays = {}
    for index, recording in enumerate(recordings):
        about = {"seed": recording.seed, "attempt": recording.attempt, "config": asdict(recording.config)}
        own = {name: getattr(recording, name) for name in _ARRAYS} | {"about": np.array(json.dumps(about))}
        beside = extras[index] if extras else {}
        arrays |= {f"{index:03d}/{name}": value for name, value in (own | dict(beside)).items()}
    save_npz(path, arrays)


def load_recordings(path: str | Path) -> list[tuple[Recording, dict[str, np.ndarray]]]:
    """Read what `save_recordings` wrote: recordings in their order, each with the arrays beside it.

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
        raise ValueError(f"{path}: not a file of recordings ({error}); write it with save_recordings") from error


def _unpack(group: dict[str, np.ndarray]) -> tuple[Recording, dict[str, np.ndarray]]:
    about = json.loads(str(group.pop("about")))
    arrays = {name: group.pop(name) for name in _ARRAYS}
    return Recording(about["seed"], about["attempt"], SimulationConfig(**about["config"]), **arrays), group
