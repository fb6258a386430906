"""`check_clip`: find the usual mix-ups of RGB-D clips from the data alone, with the evidence as a number.

Two facts of a correct clip are tested, and every finding says how far they fail before and after its fix:

- *Consistency.* Most of a scene stands still: pixels lifted from frame t and projected into frame t' must meet the
  depth stored there. Wrong pose conventions, axes, units and intrinsics break that as soon as the camera moves.
- *Flatness.* The inverse of z-depth is affine over any plane (1/z = (a u + b v + c) in pixels), so its second
  differences vanish on floors and walls. Those of the inverse ray length do not. This needs no camera motion.

A camera that never moves carries no evidence about poses, and about units only that sensors store millimetres as whole
numbers. Colour order (BGR for RGB) cannot be told from the data and is not checked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from tapip3d_lite.clip import Clip
from tapip3d_lite.consistency import consistency, flatness
from tapip3d_lite.geometry import invert, pixel_grid, unproject

# A fix must leave at most this share of the error, once for each change that it makes.
_GAIN = 0.4
_NOISE = 0.001  # exact clips stay well below; a mix-up that changes less than this does no harm either


@dataclass(frozen=True)
class Finding:
    """One suspected mix-up.

    Attributes:
        name: short key, e.g. `"camera_to_world"`.
        message: what seems wrong.
        measure: what the two numbers are.
        before: the measure as the clip stands.
        after: the measure once the fix is applied.
        remedy: what to do, in words.
        fix: maps the clip to the corrected clip.
    """

    name: str
    message: str
    measure: str
    before: float
    after: float
    remedy: str
    fix: Callable[[Clip], Clip]

    def __str__(self) -> str:
        numbers = f"{self.measure}: {self.before:.4g} as given, {self.after:.4g} after the fix"
        return f"{self.name}: {self.message} ({numbers}). {self.remedy}"


def check_clip(clip: Clip) -> list[Finding]:
    """Findings for a clip, most basic first; an empty list where nothing is suspicious.

    Args:
        clip: any clip; ground truth is not used.

    Returns:
        One `Finding` for each mix-up in the simplest set of fixes that makes the clip consistent. Applying them in
        the order given repairs the clip.
    """
    findings = [*_wrong_intrinsics(clip)]
    repaired = _apply(clip, findings)
    ray = _ray_length(repaired)
    if ray is not None:
        findings.append(ray)
        repaired = ray.fix(repaired)
    return findings + (_wrong_motion(repaired) if _moves(clip) else _whole_numbers(repaired))


def _moves(clip: Clip) -> bool:
    return bool(np.ptp(clip.extrinsics, axis=0).max() > 1e-6)


def _wrong_intrinsics(clip: Clip) -> Iterator[Finding]:
    """The principal point says which image the intrinsics were made for: it lies near the middle of nearly all."""
    height, width = clip.size
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    point = np.median(clip.intrinsics[:, :2, 2], axis=0).astype(np.float64)
    focal = float(np.median(clip.intrinsics[:, 0, 0]))
    offset = float(np.abs(point / centre - 1).max())
    if focal < width / 20 and (np.abs(point) < 2).all():
        scaled = _with_intrinsics(np.array([width, height]), -0.5)
        message = f"intrinsics look normalised: fx = {focal:.3g} for an image {width} pixels wide"
        remedy = "Multiply row 0 by W and row 1 by H, then subtract 0.5 from cx and cy."
        name = "normalised_intrinsics"
    elif offset > 0.1 and (point > 0).all():
        ratio = centre / point
        scaled = _with_intrinsics(ratio, 0.0)
        # A crop shifts the point as well. Motion decides; without it only a point outside the image is proof.
        likely = bool((point > (width, height)).any())
        if not _motion_prefers(clip, scaled(clip), likely):
            return
        size = np.rint(2 * point + 1).astype(int)
        message = f"intrinsics look made for a {size[0]}x{size[1]} image, the video is {width}x{height}"
        remedy = f"Multiply row 0 by {ratio[0]:.4g} and row 1 by {ratio[1]:.4g} (geometry.resize_intrinsics)."
        name = "intrinsics_of_another_size"
    else:
        return
    fixed = np.median(scaled(clip).intrinsics[:, :2, 2], axis=0)
    after = float(np.abs(fixed / centre - 1).max())
    measure = "principal point's distance from the centre, in half images"
    yield Finding(name, message, measure, offset, after, remedy, scaled)


def _motion_prefers(clip: Clip, fixed: Clip, otherwise: bool) -> bool:
    """Whether static-scene consistency speaks for the fix; `otherwise` where it says nothing either way."""
    before, after = consistency(clip), consistency(fixed)
    if max(before, after) < 0.1 * _NOISE or min(before, after) > _GAIN * max(before, after):
        return otherwise
    return after < before


def _with_intrinsics(scale: np.ndarray, shift: float) -> Callable[[Clip], Clip]:
    def fix(clip: Clip) -> Clip:
        matrix = clip.intrinsics.copy()
        matrix[:, :2] *= np.asarray(scale, np.float32)[:, None]
        matrix[:, :2, 2] += shift
        return _rebuilt(clip, intrinsics=matrix)

    return fix


def _ray_length(clip: Clip) -> Finding | None:
    fixed = _ray_to_z(clip)
    before, after = flatness(clip), flatness(fixed)
    if before < 2e-4 or after > 0.3 * before:
        return None
    remedy = "Divide the depth by |K^-1 (u, v, 1)| of each pixel."
    message = "depths look like ray lengths, not z: planes bulge"
    return Finding("ray_length", message, "curvature of planes in 1/depth", before, after, remedy, _ray_to_z)


def _ray_to_z(clip: Clip) -> Clip:
    height, width = clip.size
    uv = pixel_grid(height, width, clip.depths).reshape(-1, 2)
    rays = unproject(uv, np.ones(len(uv), np.float32), clip.intrinsics)
    return _rebuilt(clip, depths=clip.depths / np.linalg.norm(rays, axis=-1).reshape(clip.depths.shape))


def _flip(clip: Clip) -> Clip:
    return _rebuilt(clip, extrinsics=np.diag([1, -1, -1, 1]).astype(np.float32) @ clip.extrinsics)


def _inverse(clip: Clip) -> Clip:
    return _rebuilt(clip, extrinsics=invert(clip.extrinsics))


def _depth_scale(factor: float) -> Callable[[Clip], Clip]:
    return lambda clip: _rebuilt(clip, depths=clip.depths * np.float32(factor))


def _translation_scale(clip: Clip) -> Clip:
    extrinsics = clip.extrinsics.copy()
    extrinsics[:, :3, 3] *= 1e-3
    return _rebuilt(clip, extrinsics=extrinsics)


# (name, message, remedy, fix); a pose fix and a unit fix may be needed together.
_POSES = [
    ("camera_to_world", "extrinsics look camera-to-world", "Invert every matrix (geometry.invert).", _inverse),
    (
        "opengl_axes",
        "cameras look along -z with y up (OpenGL, Blender)",
        "Multiply extrinsics from the left by diag(1, -1, -1, 1).",
        _flip,
    ),
]
_UNITS = [
    (
        "depth_in_millimetres",
        "depths are 1000 times too large for the poses",
        "Multiply depths by 0.001.",
        _depth_scale(1e-3),
    ),
    (
        "poses_in_millimetres",
        "translations are 1000 times too large for the depths",
        "Multiply translations by 0.001.",
        _translation_scale,
    ),
]


def _wrong_motion(clip: Clip) -> list[Finding]:
    """The simplest set of pose and unit fixes that makes the static scene consistent, if it is not."""
    before = consistency(clip)
    if before < _NOISE:
        return []
    poses = [[], [_POSES[0]], [_POSES[1]], _POSES]
    units = [[], [_UNITS[0]], [_UNITS[1]]]
    scored = []
    for pose, unit in product(poses, units):
        turned = _apply(clip, pose)
        if unit and not _plausible_unit(turned, unit[0][0]):
            continue
        error = consistency(_apply(turned, unit))
        scored.append((error / _GAIN ** len(pose + unit), error, pose + unit))
    _, after, fixes = min(scored, key=lambda row: row[0])
    measure = "relative depth error of the static scene"
    return [Finding(n, m, measure, before, after, remedy, fix) for n, m, remedy, fix in fixes]


def _plausible_unit(clip: Clip, name: str) -> bool:
    """Whether the camera's travel, measured in depths, is as extreme as a factor of 1000 makes it."""
    travel = np.ptp(invert(clip.extrinsics)[:, :3, 3], axis=0).max() / np.median(clip.depths[clip.depths > 0])
    return travel > 1 if name == "poses_in_millimetres" else travel < 0.01


def _whole_numbers(clip: Clip) -> list[Finding]:
    """Without camera motion units leave one trace: sensors store millimetres as whole numbers."""
    depths = clip.depths[clip.depths > 0]
    share = float((depths == np.rint(depths)).mean())
    if share < 1 or np.median(depths) < 100:
        return []
    name, _, remedy, fix = _UNITS[0]
    after = float(((depths * 1e-3) == np.rint(depths * 1e-3)).mean())
    return [Finding(name, "depths look like millimetres", "share of whole numbers", share, after, remedy, fix)]


def _apply(clip: Clip, fixes: list) -> Clip:
    for fix in fixes:
        clip = (fix.fix if isinstance(fix, Finding) else fix[-1])(clip)
    return clip


def _rebuilt(clip: Clip, **changes: np.ndarray) -> Clip:
    # World-space queries and tracks belong to the old cameras: a repaired clip starts without them.
    return replace(clip, queries=None, tracks=None, **changes)
