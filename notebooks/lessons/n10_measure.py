"""Lesson 10: how well a clip's parts fit together, mistakes planted into it, and how far estimated cameras are off."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from lessons.n10_exercises import CARRIED, PATH
from tapip3d_lite.clip import Clip
from tapip3d_lite.geometry import invert, point_map
from tapip3d_lite.measures import agreement, curvature, reduced
from tapip3d_lite.mistakes import CATALOGUE, Case, shifted

carried, path_error = CARRIED.reference, PATH.reference  # in the milestone the learner's stand here


def error_map(clip: Clip, t: int, s: int, carry: Callable | None = None) -> np.ndarray:
    """Relative depth errors (H, W) of frame t's pixels in frame s, by `carry`, an answer to `10.carried`."""
    poses = clip.extrinsics[[t, s]].astype(np.float64)
    depths = clip.depths[[t, s]].astype(np.float64)
    return (carry or carried)(*depths, clip.intrinsics[t].astype(np.float64), *poses)


def misfit(clip: Clip, gap: int, carry: Callable | None = None, starts: int = 4) -> float:
    """The lower quartile of the errors between frames that are `gap` apart: what rests, and is seen in both."""
    maps = [error_map(clip, t, t + gap, carry) for t in np.linspace(0, len(clip) - 1 - gap, starts).astype(int)]
    found = np.concatenate([one[np.isfinite(one)] for one in maps])
    return float(np.quantile(np.minimum(found, 1), 0.25)) if found.size else 1.0


def fingerprint(clip: Clip, carry: Callable | None = None) -> dict[str, float]:
    """Six numbers by which mistakes can be told: none looks at a truth.

    `near`, `far`: misfit of neighbouring frames, and of frames half the clip apart. `colour`: the library's colour
    error. `bend`: second differences of 1/z in thousandths, 0 on planes. `depth`: the middle depth. `travel`: how far
    the camera moves from frame to frame.
    """
    known = clip.depths[clip.depths > 0]
    return {
        "near": misfit(clip, 1, carry),
        "far": misfit(clip, len(clip) // 2, carry),
        "colour": agreement(reduced(clip)).colour,
        "bend": 1000 * curvature(clip)[0],
        "depth": float(np.median(known)),
        "travel": float(np.linalg.norm(np.diff(places(clip), axis=0), axis=-1).mean()),
    }


def depth(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Clip], Clip]:
    """A mistake that changes depths (T, H, W), where they are known."""
    return lambda clip: replace(clip, depths=np.where(clip.depths > 0, change(np.maximum(clip.depths, 1e-6)), 0))


def _rays(clip: Clip) -> Clip:
    lengths = np.linalg.norm(point_map(np.ones_like(clip.depths), clip.intrinsics), axis=-1)
    return replace(clip, depths=clip.depths * lengths)


def _longer(clip: Clip) -> Clip:
    return replace(clip, intrinsics=clip.intrinsics * np.float32([[1.3, 1, 1], [1, 1.3, 1], [1, 1, 1]]))


SUSPECTS: Mapping[str, Callable[[Clip], Clip]] = {
    "camera_to_world": lambda clip: replace(clip, extrinsics=invert(clip.extrinsics)),
    "depth_in_millimetres": depth(lambda d: d * 1000),
    "disparity": depth(lambda d: 1 / d),
    "ray_length": _rays,
    "focal_length": _longer,
    "poses_shifted_in_time": lambda clip: shifted(clip, 3, "extrinsics"),
    "colour_mirrored": lambda clip: replace(clip, video=clip.video[:, :, ::-1]),
}


def planted(clip: Clip, seed: int) -> tuple[Clip, str]:
    """A clip with one of the mistakes of `SUSPECTS`, drawn by a seed; and its name, not to be looked at."""
    name = str(np.random.default_rng(seed).choice(list(SUSPECTS)))
    return SUSPECTS[name](without_points(clip)), name


def without_points(clip: Clip) -> Clip:
    """A clip without queries and tracks, as a recording is."""
    return replace(clip, queries=None, tracks=None)


def undone(clip: Clip) -> dict[str, tuple[float, float]]:
    """The library's depth and colour error of a clip once each suspect is undone; `"as it is"` first."""
    small, found = reduced(clip), {}
    before = agreement(small)
    found["as it is"] = before.depth, before.colour
    for name in SUSPECTS:
        tries = [agreement(fix(small)) for fix, _ in CATALOGUE[name].undo(Case(small))]
        best = min(tries, key=lambda one: one.badness(), default=before)
        found[name] = best.depth, best.colour
    return found


def places(clip: Clip) -> np.ndarray:
    """Where the camera is: (T, 3) float64 in the world."""
    return invert(clip.extrinsics.astype(np.float64))[:, :3, 3]


def step_errors(clip: Clip, truth: Clip) -> tuple[np.ndarray, np.ndarray]:
    """How far the camera's motion from frame to frame is off: degrees (T - 1,), and metres (T - 1,)."""
    return steps_apart(clip.extrinsics, truth.extrinsics)


def steps_apart(poses: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`step_errors` of extrinsics (T, 4, 4)."""
    one, two = (x.astype(np.float64) for x in (poses, truth))
    off = (one[1:] @ invert(one[:-1])) @ invert(two[1:] @ invert(two[:-1]))
    sine = np.linalg.norm(off[:, :3, :3] - np.eye(3), axis=(1, 2)) / 8**0.5  # of half the angle; exact for small ones
    return np.degrees(2 * np.arcsin(np.minimum(sine, 1))), np.linalg.norm(off[:, :3, 3], axis=-1)
