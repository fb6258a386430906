"""What lesson 02 makes of many clips: ratios with intervals, a table, and a peak among accelerations."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lessons.n02_straightness import SPACES
from tapip3d_lite.clip import Clip
from tapip3d_lite.geometry import transform

_FALL = -9.81  # m/s², upwards


def ratio(values: Mapping[str, np.ndarray], space: str = "camera", draws: int = 2000, seed: int = 0) -> np.ndarray:
    """Geometric mean over clips of bend(space) / bend(world), and the ends of a 95 % bootstrap interval over clips.

    Args:
        values: space to mean bends (clips,).
        space: the one to compare with the world.
        draws: of the bootstrap.
        seed: of the bootstrap.
    """
    logs = np.log(values[space] / values["world"])
    means = np.random.default_rng(seed).choice(logs, (draws, len(logs))).mean(-1)
    return np.exp([logs.mean(), *np.quantile(means, [0.025, 0.975])])


def print_table(title: str, table: Mapping[str, Mapping[str, np.ndarray]], with_ratio: bool = True) -> None:
    """Print mean bends, a row for each kind of camera, a column for each space."""
    print(f"{title:<32}" + "".join(f"{s:>9}" for s in SPACES) + ("    camera / world [95 %]" if with_ratio else ""))
    for kind, row in table.items():
        line = f"{kind:<32}" + "".join(f"{row[s].mean():9.2f}" for s in SPACES)
        print(line + ("    {:.3f} [{:.3f}, {:.3f}]".format(*ratio(row)) if with_ratio else ""))
    print()


def heights(xyz: np.ndarray, extrinsics: np.ndarray, space: str) -> np.ndarray:
    """Heights (T, N) of world points (T, N, 3) in the coordinates of "world", or in those of "camera".

    A camera may look down, so its up is not -y: it is the mean over frames of the world's up, seen from the camera.
    """
    if space == "world":
        return xyz[..., 2]
    up = extrinsics[:, :3, 2].mean(0)
    return transform(xyz, extrinsics) @ (up / np.linalg.norm(up))


def accelerations(clip: Clip, space: str) -> np.ndarray:
    """Upward accelerations in m/s² of a clip's moving points in "world" or "camera", from second differences."""
    points, poses = clip.tracks.xyz[:, clip.tracks.dynamic].astype(float), clip.extrinsics.astype(float)
    return np.diff(heights(points, poses, space), n=2, axis=0).ravel() * clip.fps**2


def peak(groups: list[np.ndarray], draws: int = 1000, seed: int = 0) -> np.ndarray:
    """Accelerations within 0.5 m/s² of free fall, over their mean number two m/s² to either side; with 95 % interval.

    Args:
        groups: one array for each clip.
        draws: of the bootstrap over clips.
        seed: of the bootstrap.
    """
    near, above, below = np.array(
        [[np.mean(np.abs(a - _FALL - off) < 0.5) for a in groups] for off in (0, 2, -2)]
    )  # (clips,) each
    picks = np.random.default_rng(seed).integers(0, len(groups), (draws, len(groups)))
    found = [2 * near[p].mean() / (above[p].mean() + below[p].mean()) for p in (np.arange(len(groups)), *picks)]
    return np.array([found[0], *np.quantile(found[1:], [0.025, 0.975])])
