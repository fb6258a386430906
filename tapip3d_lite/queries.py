"""Query points (t, x, y, z): lifted from pixels, or as a grid on a frame."""

from __future__ import annotations

import numpy as np

from tapip3d_lite.clip import Clip, check_queries, query_frames
from tapip3d_lite.geometry import unproject
from tapip3d_lite.validate import floats


def queries_from_pixels(clip: Clip, pixels: np.ndarray) -> np.ndarray:
    """Lift pixel queries, rows (t, u, v), to world-space queries, float32 rows (t, x, y, z).

    The depth is that of the nearest pixel; (0, 0) is the top-left pixel's centre.

    Raises:
        ValueError: wrong shape, frame or pixel outside the clip, or invalid depth there.
    """
    pixels = floats("pixels", pixels, (None, 3), finite=True)
    t = query_frames(clip, pixels)
    nearest = np.rint(pixels[:, 1:]).astype(int)
    height, width = clip.size
    outside = ((nearest < 0) | (nearest >= (width, height))).any(-1)
    if outside.any():
        first = pixels[outside][0].tolist()
        raise ValueError(
            f"pixels: {first} is outside the {width}x{height} image; u must be in [0, {width - 1}], v in [0, {height - 1}]"
        )
    depth = clip.depths[t, nearest[:, 1], nearest[:, 0]]
    if not depth.all():
        first = pixels[depth == 0][0].tolist()
        raise ValueError(
            f"pixels: {int((depth == 0).sum())} queries fall on invalid depth, first {first}; move them or fill the depth"
        )
    world = unproject(pixels[:, None, 1:], depth[:, None], clip.intrinsics[t], clip.extrinsics[t])
    return np.concatenate([pixels[:, :1], world[:, 0]], -1)


def grid_queries(clip: Clip, side: int = 16, frame: int = 0, margin: float = 1 / 64) -> np.ndarray:
    """A side x side grid of queries on one frame, without the nodes that fall on invalid depth.

    The outermost nodes keep `margin` times the image width from every border, as in the released code's support grid;
    in images less than twice as high they lie along the middle.
    Rows (t, x, y, z) are float32, in row-major order.
    """
    if side < 1 or not 0 <= frame < len(clip):
        raise ValueError(f"grid_queries: expected side >= 1, a frame in [0, {len(clip) - 1}], got {side=}, {frame=}")
    height, width = clip.size
    inset = [min(width * margin, (length - 1) / 2) for length in (width, height)]
    u, v = (np.linspace(x, length - x, side) for x, length in zip(inset, (width, height), strict=True))
    u, v = np.meshgrid(u, v)
    pixels = np.stack([np.full(u.size, frame), u.ravel(), v.ravel()], -1)
    pixels[:, 1:] = np.minimum(pixels[:, 1:], (width - 1, height - 1))
    nearest = np.rint(pixels[:, 1:]).astype(int)
    return queries_from_pixels(clip, pixels[clip.depths[frame, nearest[:, 1], nearest[:, 0]] > 0])


def resolve_queries(clip: Clip, queries: np.ndarray | None, grid: int = 16) -> np.ndarray:
    """The queries a tracker should follow: those given, else the clip's own, else a grid on the first frame."""
    if queries is not None:
        return check_queries(clip, queries)
    return grid_queries(clip, grid) if clip.queries is None else clip.queries
