"""Lesson 10: a recording on disk as a depth camera's recorder leaves it, written from a simulated clip; and a look into it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from tapip3d_lite.clip import Clip
from tapip3d_lite.files import write_text
from tapip3d_lite.geometry import invert

START = 1305031102.0  # seconds since 1970
SCALE = 5000  # whole numbers of a depth image in a metre
LATE = 0.011  # seconds by which a depth image comes after its colour image
_MISSED = (4, 15)  # depth images that the recorder lost


def write_recording(clip: Clip, folder: Path, seed: int = 0) -> list[int]:
    """Write a clip into an empty folder in TUM RGB-D's layout, with clocks that differ and two depth images lost.

    Returns:
        The frames that have all three: colour, depth, pose.
    """
    rng, kept = np.random.default_rng(seed), [t for t in range(len(clip)) if t not in _MISSED]
    times = START + np.arange(len(clip)) / clip.fps + rng.uniform(0, 0.002, len(clip))
    poses = invert(clip.extrinsics.astype(np.float64))
    for t, image in enumerate(clip.video):
        _put(folder / "rgb" / f"{times[t]:.6f}.png", image[..., ::-1])
    for t in kept:
        whole = np.rint(clip.depths[t].astype(np.float64) * SCALE)
        whole = np.where(whole < 65535, whole, 0).astype(np.uint16)  # farther than 16 bits reach is unknown
        _put(folder / "depth" / f"{times[t] + LATE:.6f}.png", whole)
    rows = [f"{times[t]:.6f} rgb/{times[t]:.6f}.png" for t in range(len(clip))]
    write_text(folder / "rgb.txt", "\n".join(["# time, file", *rows]) + "\n")
    rows = [f"{times[t] + LATE:.6f} depth/{times[t] + LATE:.6f}.png" for t in kept]
    write_text(folder / "depth.txt", "\n".join(["# time, file", *rows]) + "\n")
    rows = []
    for time, pose in zip(times, poses, strict=True):
        numbers = " ".join(f"{x:.9f}" for x in (*pose[:3, 3], *quaternion(pose[:3, :3])))
        rows.append(f"{time:.6f} {numbers}")
    write_text(folder / "groundtruth.txt", "\n".join(["# time tx ty tz qx qy qz qw", *rows]) + "\n")
    lens = clip.intrinsics[0].astype(np.float64)
    write_text(folder / "intrinsics.txt", f"{lens[0, 0]:.9g} {lens[1, 1]:.9g} {lens[0, 2]:.9g} {lens[1, 2]:.9g}\n")
    return kept


def _put(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image)


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """x, y, z, w of a rotation (3, 3)."""
    turn = cv2.Rodrigues(rotation)[0][:, 0]
    angle = float(np.linalg.norm(turn))
    return np.array([*(np.sin(angle / 2) * turn / max(angle, 1e-12)), np.cos(angle / 2)])


def listing(folder: Path, most: int = 3) -> str:
    """What a folder holds: each text file with its first lines, each folder with its first files."""
    lines = []
    for item in sorted(folder.iterdir(), key=lambda x: (x.is_file(), x.name)):
        if item.is_dir():
            names = sorted(x.name for x in item.iterdir())
            lines.append(f"{item.name}/  {len(names)} files: {', '.join(names[:2])}, …")
        else:
            text = item.read_text(encoding="utf-8").splitlines()
            lines.append(f"{item.name}  {len(text)} {'line' if len(text) == 1 else 'lines'}")
            lines += [f"    {line[:84]}{' …' if len(line) > 84 else ''}" for line in text[:most]]
    return "\n".join(lines)


def stamps(path: Path) -> tuple[np.ndarray, list[Path]]:
    """Times (n,), float64 seconds, and files of a list of frames."""
    rows = [line.split() for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    return np.array([float(time) for time, _ in rows]), [path.parent / name for _, name in rows]


def stored(path: Path) -> np.ndarray:
    """The whole numbers (H, W) uint16 of a depth image."""
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
