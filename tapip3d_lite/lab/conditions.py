"""Conditions under which a row of a study is tested: what is done to each held-out clip, alike for all rows and seeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any

import cv2
import numpy as np

from tapip3d_lite.clip import Clip
from tapip3d_lite.depth import densify_depth, stereo_depth
from tapip3d_lite.geometry import project
from tapip3d_lite.parts import import_part
from tapip3d_lite.simulate.degrade import SensorConfig, degrade, wrong_poses
from tapip3d_lite.validate import check_names

_EDGE = 0.1  # of 1 / z: how far it may bend within a surface
_SENSOR = {field.name for field in fields(SensorConfig)}


def grey(clip: Clip, _value: bool, _seed: int) -> Clip:
    """Every pixel has one grey: nothing to see, all depths to feel."""
    return replace(clip, video=np.full_like(clip.video, 127))


def frozen(clip: Clip, what: str, _seed: int) -> Clip:
    """A part of the clip, e.g. `"depths"`, stands still at its first frame."""
    return replace(clip, **{what: np.repeat(getattr(clip, what)[:1], len(clip), 0)})


def poses(clip: Clip, degrees: float, seed: int) -> Clip:
    """Each camera is turned about a random axis by an angle N(0, degrees), as in the paper."""
    return wrong_poses(clip, degrees, seed, drift=0.0)


def silhouettes(clip: Clip, share: float, _seed: int) -> Clip:
    """Only the share of the points that frame 0 shows nearest to a silhouette is asked for, and judged."""
    depth = np.maximum(clip.depths[0], 1e-3)
    bent = np.abs(cv2.Laplacian(1 / depth, cv2.CV_32F)) * depth > _EDGE  # 1 / z is straight on planes
    away = cv2.distanceTransform((~bent).astype(np.uint8), cv2.DIST_L2, 3)
    uv, _ = project(clip.queries[:, 1:], clip.intrinsics[0], clip.extrinsics[0])
    column, row = np.rint(uv).clip(0, np.array(depth.shape[::-1]) - 1).astype(int).T
    near = np.argsort(away[row, column], kind="stable")[: max(1, round(share * len(uv)))]
    tracks = clip.tracks.select(near)
    return replace(clip, queries=tracks.queries, tracks=tracks)


def stereo(clip: Clip, _value: bool, _seed: int) -> Clip:
    """Depth from the images of two cameras, of a clip that was simulated with a `stereo_baseline`."""
    if "video_right" not in clip.extras:
        raise ValueError(f"degrade: {clip.name} has no right images; simulate it with a stereo_baseline")
    baseline = float(clip.extras["stereo_baseline"])
    return replace(clip, depths=stereo_depth(clip.video, clip.extras["video_right"], clip.intrinsics, baseline))


def sparse(clip: Clip, share: float, seed: int) -> Clip:
    """Only this share of the pixels knows its depth; the others take the nearest one's, as in the paper."""
    known = np.random.default_rng(seed).random(clip.depths.shape) < share
    return replace(clip, depths=densify_depth(np.where(known, clip.depths, np.float32(0))))


CONDITIONS: dict[str, Callable[[Clip, Any, int], Clip]] = {
    "grey": grey, "frozen": frozen, "poses": poses, "silhouettes": silhouettes, "stereo": stereo, "sparse": sparse
}  # fmt: skip
"""Beside them the fields of `SensorConfig`, e.g. `{"blur": 1.5}` or `{"grain": 0.003, "shadow": 2.0}`."""


def check_condition(condition: Any) -> Any:
    """The condition in plain values: names of conditions with their values, or `"module:function"` of (clip, seed).

    Raises:
        ValueError: an unknown name or value, or a function that has no place in a module.
    """
    if callable(condition):
        condition = f"{condition.__module__}:{condition.__qualname__}"
    if isinstance(condition, str):
        import_part(condition, "degrade")
    if condition is None or isinstance(condition, str):
        return condition
    if not isinstance(condition, Mapping):
        raise ValueError(f"degrade: expected a function of (clip, seed), or values by name, got {condition!r}")
    check_names("degrade", condition, {*CONDITIONS, *_SENSOR})
    SensorConfig(**{name: value for name, value in condition.items() if name in _SENSOR})
    if condition.get("frozen", "video") not in ("video", "depths", "intrinsics", "extrinsics"):
        raise ValueError(f"degrade: frozen must be a part of the clip, e.g. 'depths', got {condition['frozen']!r}")
    return dict(condition)


def under(clip: Clip, condition: Any, index: int) -> Clip:
    """The held-out clip with this index under a condition, which draws the same numbers for all rows and seeds."""
    if isinstance(condition, str):
        return import_part(condition, "degrade")(clip, index)
    for name, value in (condition or {}).items():
        if name in CONDITIONS:
            clip = CONDITIONS[name](clip, value, index)
    flaws = {name: value for name, value in (condition or {}).items() if name in _SENSOR}
    return degrade(clip, SensorConfig(**flaws), index) if flaws else clip
