"""Mistakes planted into clips, and the verdicts of `check_clip`: `python -m tests.mix_ups --clips 200` prints them as a table.

Each row of `MIX_UPS` says what is done to a good clip and what `check` must answer: the findings' names, or, where such a
clip is refused or mended when it is built, the words of that error or warning.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace

import cv2
import numpy as np

import tapip3d_lite as t3d
from lessons.n10_measure import SUSPECTS, depth
from tapip3d_lite.clip import Clip
from tapip3d_lite.geometry import invert
from tapip3d_lite.simulate.degrade import SensorConfig, degrade

SENSOR = SensorConfig(
    flicker=0.004, noise=0.01, grain=0.001, step=0.001, flying=0.3, shadow=1.5, dropout=0.05, blur=0.4
)
FLIP = np.diag([1, -1, -1, 1]).astype(np.float32)


def planted(name: str) -> tuple[Callable[[Clip], Clip], str]:
    """The row of a mistake that lesson 10 plants, too."""
    return SUSPECTS[name], name


def pose(change: Callable) -> Callable[[Clip], Clip]:
    return lambda clip: replace(clip, extrinsics=change(clip.extrinsics))


def lens(change: Callable) -> Callable[[Clip], Clip]:
    """Change (fx, fy, cx, cy) of a clip of size (H, W)."""

    def plant(clip: Clip) -> Clip:
        k = clip.intrinsics.copy()
        k[:, [0, 1, 0, 1], [0, 1, 2, 2]] = np.transpose(change(k[:, [0, 1, 0, 1], [0, 1, 2, 2]].T, *clip.size))
        return replace(clip, intrinsics=k)

    return plant


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """(w, x, y, z) of a rotation matrix."""
    turn = cv2.Rodrigues(rotation.astype(np.float64))[0][:, 0]
    half = np.linalg.norm(turn) / 2
    return np.array([np.cos(half), *(np.sin(half) * turn / max(2 * half, 1e-12))])


def matrix(q: np.ndarray) -> np.ndarray:
    """The rotation matrix of a unit quaternion (w, x, y, z)."""
    w, x, y, z = q
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def rotations(change: Callable) -> Callable[[np.ndarray], np.ndarray]:
    def plant(poses: np.ndarray) -> np.ndarray:
        poses = poses.copy()
        poses[:, :3, :3] = [change(r) for r in poses[:, :3, :3]]
        return poses

    return plant


def travel(poses: np.ndarray, factor: float) -> np.ndarray:
    return poses * np.array([[1, 1, 1, factor]] * 3 + [[1, 1, 1, 1]], np.float32)


def lost(poses: np.ndarray) -> np.ndarray:
    poses = poses.copy()
    poses[len(poses) // 2 :][:2] = np.eye(4)
    return poses


def dropped(poses: np.ndarray) -> np.ndarray:
    kept = np.delete(poses, len(poses) // 2, 0)
    return np.concatenate([kept, kept[-1:]])


def drifting(poses: np.ndarray) -> np.ndarray:
    rng, share = np.random.default_rng(0), np.linspace(0, 1, len(poses))
    axis, path = (x / np.linalg.norm(x) for x in rng.normal(size=(2, 3)))
    error = np.repeat(np.eye(4)[None], len(poses), 0)
    error[:, :3, :3] = [cv2.Rodrigues(0.15 * x * axis)[0] for x in share]
    error[:, :3, 3] = 0.5 * share[:, None] * path
    return (error @ poses).astype(np.float32)


def moved(by: int, *keys: str) -> Callable[[Clip], Clip]:
    """Frame t gets what frame t + `by` has of some arrays."""

    def plant(clip: Clip) -> Clip:
        arrays = {key: getattr(clip, key)[:-by] for key in ("video", "depths", "intrinsics", "extrinsics")}
        return replace(clip, extras={}, **(arrays | {key: getattr(clip, key)[by:] for key in keys}))

    return plant


def relative(clip: Clip) -> Clip:
    factors = np.exp(np.random.default_rng(0).normal(0, 0.3, len(clip)))
    return replace(clip, depths=clip.depths * factors[:, None, None])


def marked(value: float) -> Callable[[Clip], Clip]:
    """A value that stands for unknown: at the pixels without depth, and on the upper eighth of the image."""

    def plant(clip: Clip) -> Clip:
        depths = np.where(clip.depths > 0, clip.depths, value)
        depths[:, : clip.size[0] // 8] = value
        return replace(clip, depths=depths)

    return plant


def far(clip: Clip) -> Clip:
    place = np.eye(4, dtype=np.float32)
    place[:3, 3] = 800, 600, 10
    return replace(clip, extrinsics=clip.extrinsics @ place)


MIX_UPS: dict[str, tuple[Callable[[Clip], Clip], str]] = {
    "camera to world": planted("camera_to_world"),
    "OpenGL axes": (pose(lambda x: FLIP @ x), "opengl_axes"),
    "both": (pose(lambda x: invert(FLIP @ x)), "camera_to_world+opengl_axes"),
    "millimetres": planted("depth_in_millimetres"),
    "camera to world, millimetres": (lambda c: pose(invert)(SUSPECTS["depth_in_millimetres"](c)), "camera_to_world+depth_in_millimetres"),
    "poses in millimetres": (pose(lambda x: travel(x, 1000)), "poses_in_millimetres"),
    "decimetres": (depth(lambda d: d * 10), "depth_scale"),
    "divided by 5000 for 1000": (depth(lambda d: d / 5), "depth_scale"),
    "TUM's factor 5000 forgotten": (depth(lambda d: d * 5000), "depth_scale"),
    "relative depth, scaled per clip": (depth(lambda d: 0.37 * d), "depth_scale"),
    "relative depth, scaled per frame": (relative, "depth_scale_per_frame"),
    "relative depth, affine": (depth(lambda d: 0.3 * d + 1), "affine_depth"),
    "disparity": planted("disparity"),
    "disparity, affine": (depth(lambda d: 10 / d + 0.5), "disparity"),
    "ray length": planted("ray_length"),
    "65.535 m for unknown": (marked(65.535), "stand_in_depth"),
    "1e4 for the sky": (marked(1e4), "lie beyond"),
    "65504 for the sky": (marked(65504), "lie beyond"),
    "1e10 for the sky": (marked(1e10), "lie beyond"),
    "infinity for the sky": (marked(np.inf), "at infinity"),
    "K normalised": (lens(lambda k, h, w: [k[0] / w, k[1] / h, (k[2] + 0.5) / w, (k[3] + 0.5) / h]), "normalised_intrinsics"),
    "K transposed": (lambda c: replace(c, intrinsics=c.intrinsics.swapaxes(1, 2)), "transpose it"),
    "K skewed below the diagonal": (lambda c: replace(c, intrinsics=c.intrinsics + 9 * np.eye(3, k=-1, dtype=np.float32)), "transpose it"),
    "K of another size": (lens(lambda k, h, w: 3 * k), "intrinsics_of_another_size"),
    "focal length 30 % too long": planted("focal_length"),
    "focal length 30 % too short": (lens(lambda k, h, w: [0.7 * k[0], 0.7 * k[1], k[2], k[3]]), "focal_length"),
    "cx and cy swapped, landscape for portrait": (lens(lambda k, h, w: [k[1], k[0], k[3], k[2]]), "principal_point_swapped"),
    "quaternion order": (pose(rotations(lambda r: matrix(np.roll(quaternion(r), 1)))), "quaternion_order"),
    "quaternion order, reversed": (pose(rotations(lambda r: matrix(np.roll(quaternion(r), -1)))), "quaternion_order"),
    "quaternion order, camera to world": (pose(lambda x: invert(rotations(lambda r: matrix(np.roll(quaternion(r), 1)))(invert(x)))), "quaternion_order"),
    "rotation transposed": (pose(rotations(np.transpose)), "rotation_transposed"),
    "rotations not orthonormal": (pose(rotations(lambda r: r * 1.0005)), "not orthonormal"),
    "poses shuffled": (pose(lambda x: x[np.random.default_rng(1).permutation(len(x))]), "poses_shuffled"),
    "poses late by 3 frames": (moved(3, "video", "depths", "intrinsics"), "poses_shifted_in_time"),
    "one pose dropped": (pose(dropped), "pose_missing"),
    "poses of two frames lost": (pose(lost), "poses_lost"),
    "poses drifting": (pose(drifting), "poses_drift"),
    "no poses: all are the first one": (pose(lambda x: np.repeat(x[:1], len(x), 0)), "poses_at_rest"),
    "video mirrored": planted("colour_mirrored"),
    "video and depth mirrored": (lambda c: replace(c, video=c.video[:, :, ::-1], depths=c.depths[:, :, ::-1]), "clip_mirrored"),
    "colour early by 3 frames": (moved(3, "video"), "colour_shifted_in_time"),
    "depth early by 3 frames": (moved(3, "depths"), "depth_shifted_in_time"),
    "colour and depth from different places": (lambda c: replace(c, video=c.extras["video_right"], extras={}), "unregistered"),
    "world 1 km away": (far, "far_world"),
}  # fmt: skip


# Steady motion around a point or along a line does not show that poses come late: the world only moves as a whole.
SHAKEN = {"poses late by 3 frames", "one pose dropped", "depth early by 3 frames", "colour early by 3 frames"}


def good(
    seed: int, camera: str | None = None, sensor: SensorConfig | None = SENSOR, frames: int = 16, shake: float = 1.0
) -> Clip:
    """A good clip, as a sensor would give it, without queries and tracks; every third shows the open sky."""
    camera = camera or ("arc", "linear", "handheld", "static")[seed % 4]
    size = ((96, 128), (128, 96), (128, 128))[seed % 3]
    clip = t3d.simulate_clip(
        seed, camera=camera, size=size, frames=frames, sky=seed % 3 == 0, occluder=seed % 7 == 0, tracks=8, stereo_baseline=0.15,
        handheld=shake
    )  # fmt: skip
    clip = replace(clip, queries=None, tracks=None)
    return clip if sensor is None else degrade(clip, sensor, seed)


def verdict(clip: Clip, plant: Callable[[Clip], Clip] = lambda clip: clip) -> str:
    """What a user hears: the findings' names, or the words of an error; of a warning where it is all there is."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            names = "+".join(finding.name for finding in t3d.check_clip(plant(clip)))
        except ValueError as error:
            return f"refused: {error}"
    return names or " ".join(f"warned: {warning.message}" for warning in said)


def alarms(count: int) -> Iterator[tuple[str, str, int]]:
    """(kind, verdict, seed) of good clips: four camera motions; exact depth, a usual sensor's, or one drawn for training."""
    for seed in range(count):
        kind = ("exact", "sensor", "poor sensor")[seed // 4 % 3]
        drawn = SensorConfig.draw(np.random.default_rng(seed), share=0.5)
        sensor = {"exact": None, "sensor": SENSOR, "poor sensor": drawn}[kind]
        clip = good(9000 + seed, sensor=sensor, frames=(12, 24)[seed % 2])
        yield f"{('arc', 'linear', 'handheld', 'static')[(9000 + seed) % 4]}, {kind}", verdict(clip), 9000 + seed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clips", type=int, default=200, help="good clips that must raise no alarm")
    parser.add_argument(
        "--seeds", type=int, nargs="*", default=[501, 502], help="clips into which mistakes are planted"
    )
    options = parser.parse_args()
    steady = [good(seed, camera=("arc", "linear")[seed % 2 == 0]) for seed in options.seeds]
    shaken = [good(seed, camera="handheld", shake=2.0) for seed in options.seeds]
    print("| mix-up | right verdict | verdicts |\n|---|---|---|")
    named = 0
    for name, (plant, wanted) in MIX_UPS.items():
        found = [verdict(clip, plant) for clip in (shaken if name in SHAKEN else steady)]
        right = [wanted == x or ((" " in wanted or " " in x) and wanted in x) for x in found]
        named += all(right)
        shown = ["right" if ok else (x or "nothing") for ok, x in zip(right, found, strict=True)]
        print(f"| {name} | {wanted} | {', '.join(shown)} |", flush=True)
    print(f"\n{named} of {len(MIX_UPS)} mix-ups have the right verdict on all {len(steady)} clips", flush=True)
    start, kinds, false = time.process_time(), Counter(), []
    for kind, found, seed in alarms(options.clips):
        kinds[kind] += 1
        false += [f"{kind}, seed {seed}: {found}"] * bool(found)
    print("\n".join(f"{count} good clips, {kind}" for kind, count in sorted(kinds.items())))
    print(
        f"{len(false)} false alarms on {options.clips} good clips ({time.process_time() - start:.0f} s)",
        *false,
        sep="\n",
    )


if __name__ == "__main__":
    main()
