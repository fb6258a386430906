"""`check_clip`: find the usual mistakes in RGB-D clips from the data alone, with the evidence as a number.

Two properties of a correct clip are measured, and every finding states them before and after its fix:

- *Consistency.* Most of a scene stands still: pixels lifted from frame t and projected into frame t' must meet the
  depth stored there. Wrong pose conventions, axes, units and intrinsics break that as soon as the camera moves.
- *Flatness.* The inverse of z-depth is affine over any plane (1/z = (a u + b v + c) in pixels), so its second
  differences vanish on floors and walls. Those of the inverse ray length do not. This needs no camera motion.

A camera that never moves provides no evidence about poses, and about units only that sensors store millimetres as
whole numbers. Colour order (BGR for RGB) cannot be determined from the data and is not checked.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from tapip3d_lite.clip import Clip
from tapip3d_lite.geometry import invert, point_map, project, unproject

_GAIN = 0.4  # a fix must leave at most this share of the error, once for each change that it makes
NOISE = 0.001  # exact clips stay well below; a mistake that changes less than this does no harm either
_CAP = 0.25  # relative depth errors above this count as this: the point is simply lost


@dataclass(frozen=True)
class Finding:
    """One suspected mistake.

    Attributes:
        name: short key, e.g. `"camera_to_world"`.
        message: what seems wrong.
        remedy: what to do, in words.
        fix: maps the clip to the corrected clip.
        measure: what the two numbers measure.
        before: the measure of the clip as given.
        after: the measure once the fix is applied.
    """

    name: str
    message: str
    remedy: str
    fix: Callable[[Clip], Clip]
    measure: str
    before: float
    after: float

    def __str__(self) -> str:
        numbers = f"{self.measure}: {self.before:.4g} as given, {self.after:.4g} after the fix"
        return f"{self.name}: {self.message} ({numbers}). {self.remedy}"


def check_clip(clip: Clip) -> list[Finding]:
    """Findings for a clip, whose true tracks are not used, most basic first; none where nothing is suspicious.

    There is one for each mistake in the simplest set of fixes that makes the clip consistent. Applying them in their
    order repairs the clip.
    """
    findings, repaired = [], clip
    for test in (_wrong_intrinsics, _ray_length):
        for finding in test(repaired):
            findings.append(finding)
            repaired = finding.fix(repaired)
    moves = np.ptp(clip.extrinsics, axis=0).max() > 1e-6
    return findings + (_wrong_motion(repaired) if moves else _whole_numbers(repaired))


def _wrong_intrinsics(clip: Clip) -> list[Finding]:
    """The principal point reveals the size that the intrinsics were made for: it lies near the middle of most images."""
    height, width = clip.size
    centre = np.array([width - 1, height - 1]) / 2
    point = np.median(clip.intrinsics[:, :2, 2], axis=0).astype(np.float64)
    focal = float(np.median(clip.intrinsics[:, 0, 0]))
    offset = float(np.abs(point / centre - 1).max())
    if focal < width / 20 and (np.abs(point) < 2).all():
        name, fix = "normalised_intrinsics", partial(_rescaled, scale=(width, height), shift=-0.5)
        message = f"intrinsics look normalised: fx = {focal:.3g} for an image {width} pixels wide"
        remedy = "Multiply row 0 by W and row 1 by H, then subtract 0.5 from cx and cy."
    elif offset > 0.1 and (point > 0).all():
        ratio = centre / point
        name, fix = "intrinsics_of_another_size", partial(_rescaled, scale=ratio, shift=0.0)
        # A crop shifts the point as well. Motion decides; without motion only a point outside the image proves it.
        if not _motion_prefers(clip, fix(clip), otherwise=bool((point > (width, height)).any())):
            return []
        size = np.rint(2 * point + 1).astype(int)
        message = f"intrinsics look made for a {size[0]}x{size[1]} image, the video is {width}x{height}"
        remedy = f"Multiply row 0 by {ratio[0]:.4g}, row 1 by {ratio[1]:.4g}, or exactly: geometry.resize_intrinsics."
    else:
        return []
    after = float(np.abs(np.median(fix(clip).intrinsics[:, :2, 2], axis=0) / centre - 1).max())
    measure = "principal point's distance from the centre, in half images"
    return [Finding(name, message, remedy, fix, measure, offset, after)]


def _motion_prefers(clip: Clip, fixed: Clip, otherwise: bool) -> bool:
    """Whether static-scene consistency supports the fix; `otherwise` where it supports neither."""
    before, after = consistency(clip), consistency(fixed)
    if max(before, after) < 0.1 * NOISE or min(before, after) > _GAIN * max(before, after):
        return otherwise
    return after < before


def _rescaled(clip: Clip, scale: ArrayLike, shift: float) -> Clip:
    matrix = clip.intrinsics.copy()
    matrix[:, :2] *= np.asarray(scale, np.float32)[:, None]
    matrix[:, :2, 2] += shift
    return _rebuilt(clip, intrinsics=matrix)


def _ray_length(clip: Clip) -> list[Finding]:
    before, after = flatness(clip), flatness(_ray_to_z(clip))
    if before < 2e-4 or after > 0.3 * before:
        return []
    remedy = "Divide the depth by |K^-1 (u, v, 1)| of each pixel."
    message = "depths look like ray lengths, not z: planes bulge"
    return [Finding("ray_length", message, remedy, _ray_to_z, "curvature of planes in 1/depth", before, after)]


def _ray_to_z(clip: Clip) -> Clip:
    rays = point_map(np.ones_like(clip.depths), clip.intrinsics)
    return _rebuilt(clip, depths=clip.depths / np.linalg.norm(rays, axis=-1))


_FLIP = np.diag([1, -1, -1, 1]).astype(np.float32)
_SHORTER = np.array([[1, 1, 1, 1e-3]] * 3 + [[1, 1, 1, 1]], np.float32)
# Name: what seems wrong, what to do, and the same as a function.
_MIX_UPS = {
    "camera_to_world": (
        "extrinsics look camera-to-world",
        "Invert every matrix (geometry.invert).",
        lambda clip: _rebuilt(clip, extrinsics=invert(clip.extrinsics)),
    ),
    "opengl_axes": (
        "cameras look along -z with y up (OpenGL, Blender)",
        "Multiply extrinsics from the left by diag(1, -1, -1, 1).",
        lambda clip: _rebuilt(clip, extrinsics=_FLIP @ clip.extrinsics),
    ),
    "depth_in_millimetres": (
        "depths are 1000 times too large for the poses",
        "Multiply depths by 0.001.",
        lambda clip: _rebuilt(clip, depths=clip.depths * np.float32(1e-3)),
    ),
    "poses_in_millimetres": (
        "translations are 1000 times too large for the depths",
        "Multiply translations by 0.001.",
        lambda clip: _rebuilt(clip, extrinsics=_SHORTER * clip.extrinsics),
    ),
}
# One of each may be needed together.
_POSES = [], ["camera_to_world"], ["opengl_axes"], ["camera_to_world", "opengl_axes"]
_UNITS = [], ["depth_in_millimetres"], ["poses_in_millimetres"]


def _wrong_motion(clip: Clip) -> list[Finding]:
    """The simplest set of pose and unit fixes that makes an inconsistent static scene consistent."""
    before = consistency(clip)
    if before < NOISE:
        return []
    scored = []
    for pose, unit in product(_POSES, _UNITS):
        turned = _fixed(clip, pose)
        if not unit or _plausible_unit(turned, unit[0]):
            error = consistency(_fixed(turned, unit))
            scored.append((error / _GAIN ** len(pose + unit), error, pose + unit))
    _, after, names = min(scored, key=lambda row: row[0])
    measure = "relative depth error of the static scene"
    return [Finding(name, *_MIX_UPS[name], measure, before, after) for name in names]


def _fixed(clip: Clip, names: list[str]) -> Clip:
    for name in names:
        clip = _MIX_UPS[name][2](clip)
    return clip


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
    after = float(((depths * 1e-3) == np.rint(depths * 1e-3)).mean())
    name, message = "depth_in_millimetres", "depths look like millimetres"
    return [Finding(name, message, *_MIX_UPS[name][1:], "share of whole numbers", share, after)]


def _rebuilt(clip: Clip, **changes: np.ndarray) -> Clip:
    # World-space queries and tracks belong to the old cameras: a repaired clip starts without them.
    return replace(clip, queries=None, tracks=None, **changes)


def consistency(clip: Clip) -> float:
    """How well static points carried between a dozen pairs of frames meet the depth there: a low quantile of relative errors.

    Low, since parts of a correct clip disagree too: moving objects, and pixels that become hidden or leave the view.
    0 for a perfect static scene; at most 0.25, the value of a point that is lost altogether.
    """
    rng, frames = np.random.default_rng(0), len(clip)
    gaps = sorted({max(1, round(frames * share)) for share in (0.1, 0.25, 0.5)})
    pairs = [(t, t + gap) for gap in gaps for t in np.linspace(0, max(frames - gap - 1, 0), 4).astype(int)]
    errors = [_carry(clip, t, s, rng) for t, s in dict.fromkeys(pairs) if s < frames]
    pooled = np.concatenate(errors) if errors else np.zeros(1)
    return float(np.quantile(pooled, 0.25)) if pooled.size else _CAP


def flatness(clip: Clip) -> float:
    """Lower quartile of the relative second differences of inverse depth in four frames: near 0 in scenes with planes."""
    step = max(1, min(clip.size) // 12)
    chosen = np.linspace(0, len(clip) - 1, 4).astype(int)
    values = np.concatenate([_second_differences(clip.depths[t], step) for t in chosen])
    return float(np.quantile(values, 0.25)) if values.size else 0.0


def _carry(clip: Clip, t: int, s: int, rng: np.random.Generator) -> np.ndarray:
    """Capped relative depth errors of 1,500 random pixels of frame t seen from frame s."""
    v, u = np.nonzero(clip.depths[t])
    if not len(v):
        return np.zeros(0)
    pick = rng.integers(0, len(v), 1500)
    uv = np.stack([u[pick], v[pick]], -1).astype(np.float64)
    cameras = [clip.intrinsics[[t, s]].astype(np.float64), clip.extrinsics[[t, s]].astype(np.float64)]
    points = unproject(uv, clip.depths[t, v[pick], u[pick]].astype(np.float64), cameras[0][0], cameras[1][0])
    target, z = project(points, cameras[0][1], cameras[1][1])
    seen = _bilinear_inverse(clip.depths[s], target)
    inside = np.isfinite(seen) & (z > 0)
    error = np.full(len(pick), _CAP)
    error[inside] = np.minimum(np.abs(z[inside] * seen[inside] - 1), _CAP)
    return error[~np.isnan(seen)]  # a pixel without depth is no evidence


def _bilinear_inverse(depth: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """1/z at sub-pixel positions (exact on planes): NaN on invalid depth, infinite outside the image."""
    (height, width), inverse = depth.shape, _inverse_depth(depth)
    inside = ((uv >= 0) & (uv <= (width - 1, height - 1))).all(-1)
    safe = np.where(inside[:, None], uv, 0)
    u0, v0 = np.minimum(safe.astype(int), (width - 2, height - 2)).T
    a, b = safe[:, 0] - u0, safe[:, 1] - v0
    top = inverse[v0, u0] * (1 - a) + inverse[v0, u0 + 1] * a
    bottom = inverse[v0 + 1, u0] * (1 - a) + inverse[v0 + 1, u0 + 1] * a
    return np.where(inside, top * (1 - b) + bottom * b, np.inf)


def _inverse_depth(depth: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return np.where(depth > 0, 1 / depth.astype(np.float64), np.nan)


def _second_differences(depth: np.ndarray, step: int) -> np.ndarray:
    inverse = _inverse_depth(depth)
    relative = [(x[2 * step :] + x[: -2 * step] - 2 * x[step:-step]) / x[step:-step] for x in (inverse, inverse.T)]
    values = np.abs(np.concatenate([r.ravel() for r in relative]))
    return values[np.isfinite(values)]
