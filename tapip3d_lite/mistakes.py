"""The catalogue of mistakes in clips: one row each, with what undoes it. Adding a mistake is adding a row to `CATALOGUE`.

A row's `undo` yields candidates: functions that map the clip to a corrected one, with a remark where they have found a
number. `check` applies each and measures whether the parts of the clip fit together better; a row has to decide nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial

import cv2
import numpy as np

from tapip3d_lite.clip import CLIP_KEYS, Clip
from tapip3d_lite.depth import splat
from tapip3d_lite.geometry import invert, point_map
from tapip3d_lite.measures import agreement, edges, line, triangulated
from tapip3d_lite.poses import estimate_poses

Fix = Callable[[Clip], Clip]
Candidates = Iterator[tuple[Fix, str]]
_SWAP = np.float32([[0, 1, 0], [1, 0, 0], [0, 0, 1]])
_FLIP = np.diag([1, -1, -1, 1]).astype(np.float32)
_FACTORS = {1000: "millimetres", 100: "centimetres", 10: "decimetres", 5000: "not divided by 5000, as in TUM RGB-D"}
_FACTORS |= {0.2: "divided by 5000 in place of 1000", 0.001: "poses are in millimetres"}


@dataclass(frozen=True)
class Case:
    """A clip, at about 128 pixels, with what several rows look for in it, once."""

    clip: Clip

    @cached_property
    def poses(self) -> np.ndarray | None:
        """Extrinsics (T, 4, 4) from colour and depth alone, or None where that fails or takes too long."""
        try:
            return estimate_poses(self.clip).extrinsics.astype(np.float64) if 1 < len(self.clip) <= 100 else None
        except ValueError:
            return None

    @cached_property
    def triangles(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Frames (n,), depths given and depths triangulated of corners."""
        return triangulated(self.clip)


@dataclass(frozen=True)
class Mistake:
    """One row: a short name, what seems wrong, what to do about it, candidates that undo it; fits of more numbers cost more."""

    name: str
    message: str
    remedy: str
    undo: Callable[[Case], Candidates]
    price: float = 1


def rebuilt(clip: Clip, **changes: np.ndarray) -> Clip:
    """A clip with some arrays changed, without queries and tracks, since those belong to the old cameras."""
    return replace(clip, queries=None, tracks=None, **changes)


def poses(change: Callable[[np.ndarray], np.ndarray]) -> Fix:
    """A fix that changes extrinsics (T, 4, 4)."""
    return lambda clip: rebuilt(clip, extrinsics=change(clip.extrinsics))


def depths(change: Callable[[np.ndarray], np.ndarray]) -> Fix:
    """A fix that changes depths (T, H, W), of which the unknown ones stay unknown."""

    def fix(clip: Clip) -> Clip:
        with np.errstate(all="ignore"):
            return rebuilt(clip, depths=np.where(clip.depths > 0, change(clip.depths.astype(np.float64)), 0))

    return fix


def rescaled(clip: Clip, scale: np.ndarray, shift: float = 0.0) -> Clip:
    """Rows 0 and 1 of the intrinsics multiplied by `scale` (2,), and the principal point shifted."""
    matrix = clip.intrinsics * np.array([*scale, 1], np.float32)[:, None]
    matrix[:, :2, 2] += shift
    return rebuilt(clip, intrinsics=matrix)


def ray_to_z(clip: Clip) -> Clip:
    """Depths that are lengths of rays made z."""
    rays = point_map(np.ones_like(clip.depths), clip.intrinsics)
    return rebuilt(clip, depths=clip.depths / np.linalg.norm(rays, axis=-1))


def _always(*fixes: Fix) -> Callable[[Case], Candidates]:
    return lambda _: ((fix, "") for fix in fixes)


def _inverted(change: Callable[[np.ndarray], np.ndarray]) -> tuple[Fix, Fix]:
    """A change of rotations made in world-to-camera matrices, or in the others before they were inverted."""
    return poses(change), poses(lambda x: invert(change(invert(x))))


def _transposed(pose: np.ndarray) -> np.ndarray:
    return np.concatenate([invert(pose)[..., :3], pose[..., 3:]], -1)


def _reordered(pose: np.ndarray, shift: int) -> np.ndarray:
    """Rotations of unit quaternions whose four numbers are read in another order: rolled by one."""
    pose = pose.copy()
    for matrix in pose:
        vector = cv2.Rodrigues(matrix[:3, :3].astype(np.float64))[0][:, 0]
        angle = float(np.linalg.norm(vector))
        w, *axis = np.roll([np.cos(angle / 2), *(np.sin(angle / 2) * vector / max(angle, 1e-12))], shift)
        sine = float(np.linalg.norm(axis))
        matrix[:3, :3] = cv2.Rodrigues(np.array(axis) / max(sine, 1e-12) * 2 * np.arctan2(sine, w))[0]
    return pose


def shifted(clip: Clip, by: int, key: str) -> Clip:
    """What frame t + `by` holds of an array goes to frame t; frames for which there is nothing are cut off."""
    moved, rest = (slice(by, None), slice(None, -by)) if by > 0 else (slice(None, by), slice(-by, None))
    extras = {name: x[rest] if name.endswith("_right") else x for name, x in clip.extras.items()}
    arrays = {name: getattr(clip, name)[rest] for name in CLIP_KEYS}
    return rebuilt(clip, **(arrays | {key: getattr(clip, key)[moved]}), extras=extras)


def _late(key: str) -> Callable[[Case], Candidates]:
    def undo(case: Case) -> Candidates:
        for by in (by for by in (1, -1, 2, -2, 3, -3, 4, -4, 5, -5) if abs(by) < len(case.clip) / 2):
            yield partial(shifted, by=by, key=key), f"{'late' if by > 0 else 'early'} by {abs(by)} frames"

    return undo


def _missing(case: Case) -> Candidates:
    """A pose was dropped, and all after it are one frame early: the frame is left out, and the last one."""
    for k in np.unique(np.linspace(1, max(len(case.clip) - 2, 1), 12).astype(int)):

        def fix(clip: Clip, k: int = k) -> Clip:
            frames = np.delete(np.arange(len(clip)), k)
            images = {key: getattr(clip, key)[frames] for key in ("video", "depths", "intrinsics")}
            return rebuilt(clip, **images, extrinsics=clip.extrinsics[:-1])

        yield fix, f"from frame {k} on poses belong to the frame after"


def _estimated(kind: str) -> Callable[[Case], Candidates]:
    """Compare the poses with those that colour and depth alone give: shuffled, lost in some frames, or drifting."""

    def undo(case: Case) -> Candidates:
        clip, found = case.clip, case.poses
        if found is None:
            return
        given, unit = clip.extrinsics.astype(np.float64), float(np.median(clip.depths[clip.depths > 0]))
        best = np.inf, given, np.zeros((1, 1))
        # One pose is right (shuffled, it belongs to the first frame), and the others follow from it.
        for pose in range(len(clip)):
            wanted = found @ invert(found[0 if kind == "shuffled" else pose]) @ given[pose]
            off = np.abs((wanted[:, None] - given[None])[..., :3, :] / (1, 1, 1, unit)).max((2, 3))  # (T, T)
            error = np.minimum(off.min(1) if kind == "shuffled" else np.diagonal(off), 0.1).sum()
            best = min(best, (error, wanted, off), key=lambda x: x[0])
        _, wanted, off = best
        order, apart = off.argmin(1), np.diagonal(off) > max(0.03, 3 * np.median(np.diagonal(off)))
        if kind == "shuffled" and (off.min(1) < 0.1).all() and len(set(order)) == len(order):
            yield poses(lambda x: x[order]), ""
        elif kind == "lost" and 0 < apart.sum() < len(clip) / 3:
            where = ", ".join(map(str, np.flatnonzero(apart)))
            yield poses(lambda x: np.where(apart[:, None, None], wanted, x)), f"frames {where}"
        elif kind == "drift":
            yield poses(lambda x: wanted), ""

    return undo


def _closest(case: Case, fix: Callable[..., Clip], best: float, *widths: float) -> float:
    """The factor for which `fix(clip, factor=...)` fits best, near one given: about, then closely."""
    memory = {}
    for width in widths:
        factors = best * np.exp(width * np.arange(-4, 5))
        best = float(min(factors, key=lambda x: agreement(fix(case.clip, factor=x), 2, 200, memory).badness()))
    return best


def _scaled(case: Case) -> Candidates:
    """One factor: a known one, or that of the median."""
    fix, (_, d, z) = lambda clip, factor: depths(lambda x: x / factor)(clip), case.triangles
    for factor, remark in _FACTORS.items():
        yield partial(fix, factor=factor), f"{factor:g} times too large ({remark})"
    if len(d):
        factor = _closest(case, fix, float(np.median(d / z)), 0.05, 0.015)
        yield partial(fix, factor=factor), f"{factor:.3g} times too large"


def _scaled_frames(case: Case) -> Candidates:
    """A factor for each frame; between those of its neighbours where a frame shows too little."""
    t, d, z = case.triangles
    frames = [frame for frame in np.unique(t) if (t == frame).sum() >= 8]
    if len(frames) > 2:
        logs = [np.log(np.median((z / d)[t == frame])) for frame in frames]
        factors = np.exp(np.interp(np.arange(len(case.clip)), frames, logs))[:, None, None]
        yield depths(lambda x: x * factors), f"by factors from {1 / factors.max():.3g} to {1 / factors.min():.3g}"


def _affine(case: Case) -> Candidates:
    a, b = line(*case.triangles[1:])
    known = case.clip.depths[case.clip.depths > 0]
    if abs(b) < 4 * a * np.median(known):  # else little is left of what was given
        yield depths(lambda x: np.maximum(a * x + b, 0)), f"z = {a:.4g} d + {b:.4g}"


def _inverse(case: Case) -> Candidates:
    _, d, z = case.triangles
    for a, b in ((float(np.median(1 / (z * d))) if len(d) else 1.0, 0.0), line(d, 1 / z)):
        if a > 0:  # the farther, the smaller
            yield (
                depths(lambda x, a=a, b=b: np.where(a * x + b > 0, 1 / (a * x + b), 0)),
                f"1 / z = {a:.4g} d + {b:.4g}",
            )


def _focal(case: Case) -> Candidates:
    """The focal length that fits best."""

    def scaled(clip: Clip, factor: float) -> Clip:
        return rebuilt(clip, intrinsics=clip.intrinsics * np.float32([[factor, 1, 1], [1, factor, 1], [1, 1, 1]]))

    factor = _closest(case, scaled, 1.0, 0.15, 0.04)
    yield partial(scaled, factor=factor), f"about {1 / factor:.2f} times the right one"


def _other_size(case: Case) -> Candidates:
    """Intrinsics of a larger or smaller image: the principal point, near the middle of most, tells its size."""
    clip = case.clip
    centre = (np.array(clip.size[::-1]) - 1) / 2
    point = np.median(clip.intrinsics[:, :2, 2], axis=0).astype(np.float64)
    if np.abs(point / centre - 1).max() > 0.1 and (point > 0).all():
        ratio = centre / point
        size = "x".join(map(str, np.rint(2 * point + 1).astype(int)))
        yield partial(rescaled, scale=ratio), f"{size} pixels, multiply its rows by {ratio[0]:.4g} and {ratio[1]:.4g}"


def swapped_axes(clip: Clip) -> Clip:
    """Intrinsics of the image turned by a right angle: fx and fy, cx and cy exchanged."""
    return rebuilt(clip, intrinsics=_SWAP @ clip.intrinsics @ _SWAP)


def _registered(clip: Clip, baseline: float) -> Clip:
    """Depth seen from a place `baseline` to the right, in the clip's units; what only that place sees is unknown."""
    out = []
    for depth, k in zip(clip.depths, clip.intrinsics, strict=True):
        v, u = np.nonzero(depth)
        z = depth[v, u]
        out.append(splat(np.stack([u - baseline * k[0, 0] / z, v], -1), z, clip.size))
    return rebuilt(clip, depths=np.stack(out))


def _beside(case: Case) -> Candidates:
    """The silhouettes' shift between depth and colour, where it is horizontal, as a distance of the two cameras."""
    clip, agree = case.clip, edges(case.clip)
    u = int(agree.argmax()) - len(agree) // 2
    if abs(u) >= 2:
        unit = float(np.median(clip.depths[clip.depths > 0]) / clip.intrinsics[0, 0, 0])
        yield partial(_registered, baseline=-u * unit), f"colour lies {u} pixels (of {clip.size[1]}) beside depth"


_SHORTER = np.array([[1, 1, 1, 1e-3]] * 3 + [[1, 1, 1, 1]], np.float32)
_SAME_SENSOR = "Take colour and depth of the same instant; or cut the surplus frames of one."
CATALOGUE = {
    row[0]: Mistake(*row)
    for row in (
        ("camera_to_world", "extrinsics look camera-to-world", "Invert every matrix (geometry.invert).", _always(poses(invert))),
        ("opengl_axes", "cameras look along -z with y up (OpenGL, Blender)", "Multiply extrinsics from the left by diag(1, -1, -1, 1).", _always(poses(lambda x: _FLIP @ x))),
        ("depth_in_millimetres", "depths are 1000 times too large for the poses", "Multiply depths by 0.001.", _always(depths(lambda x: x * 1e-3))),
        ("poses_in_millimetres", "translations are 1000 times too large for the depths", "Multiply translations by 0.001.", _always(poses(lambda x: _SHORTER * x))),
        ("depth_scale", "depths have another scale than the poses", "Divide depths by that factor.", _scaled, 1.2),
        ("disparity", "depths look like disparities (inverse depths)", "Take their inverse.", _inverse, 1.3),
        ("depth_scale_per_frame", "each frame's depth has its own scale", "Multiply each frame's depth by its own factor, or take depth that is consistent over time.", _scaled_frames, 1.9),
        ("affine_depth", "depths are relative: true ones are an affine function of them", "Apply that function, or take metric depth.", _affine, 1.35),
        ("ray_length", "depths look like ray lengths, not z: planes bulge", "Divide the depth by |K^-1 (u, v, 1)| of each pixel.", _always(ray_to_z)),
        ("principal_point_swapped", "cx and cy look swapped, as those of a landscape image for a portrait video", "Swap them (and fx and fy).", _always(swapped_axes)),
        ("intrinsics_of_another_size", "intrinsics look made for an image of another size", "Use geometry.resize_intrinsics.", _other_size),
        ("focal_length", "the focal length is wrong", "Correct fx and fy; compare with the camera's calibration.", _focal, 1.3),
        ("rotation_transposed", "rotations look transposed, translations not", "Transpose the rotations.", _always(*_inverted(_transposed))),
        ("quaternion_order", "rotations come from quaternions read in the wrong order (w x y z for x y z w, or the reverse)", "Reorder the quaternions.", _always(*_inverted(partial(_reordered, shift=1)), *_inverted(partial(_reordered, shift=-1)))),
        ("poses_shifted_in_time", "poses belong to other frames", "Shift them, or cut the surplus frames.", _late("extrinsics"), 1.1),
        ("pose_missing", "one pose is missing, and those after it are one frame early", "Leave out that frame's image and depth.", _missing, 1.2),
        ("poses_shuffled", "poses are in another order than the frames (sorted by name, 10 before 2?)", "Sort both by the frame's number.", _estimated("shuffled"), 2.1),
        ("poses_lost", "the camera's tracking was lost in some frames", "Leave these frames out, or use estimate_poses.", _estimated("lost"), 2.2),
        ("poses_drift", "poses drift or jitter against what the images show", "Use estimate_poses, or steady_clip for jitter.", _estimated("drift"), 2.8),
        ("colour_mirrored", "the video is mirrored, depth and poses are not", "Mirror the images back.", _always(lambda c: rebuilt(c, video=c.video[:, :, ::-1]), lambda c: rebuilt(c, video=c.video[:, ::-1]))),
        ("poses_at_rest", "the poses say that the camera rests, but what rests moves in the images", "Give the camera's poses, or use estimate_poses.", _estimated("drift"), 4),
        ("clip_mirrored", "video and depth are mirrored, the cameras are not", "Mirror both back.", _always(lambda c: rebuilt(c, video=c.video[:, :, ::-1], depths=c.depths[:, :, ::-1]))),
        ("colour_shifted_in_time", "colour and depth are of different instants", _SAME_SENSOR, _late("video"), 1.1),
        ("depth_shifted_in_time", "depth is of other instants than colour and poses", _SAME_SENSOR, _late("depths"), 1.1),
        ("unregistered", "colour and depth are seen from different places", "Register the depth to the colour camera.", _beside, 3),
    )
}  # fmt: skip
