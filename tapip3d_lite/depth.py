"""Depth from elsewhere: from a stereo pair, from sparse measurements, from a camera beside; and what is no surface removed.

    z = f b / d                                    d: how far a point moves between two views at a distance b
    flying:  few of the neighbours q' of q = 1 / z have |q' - q| < slack q  or  |q'' - 2 q' + q| < slack q / 3

On a plane 1 / z is affine over the pixels, however steep it is, so that a neighbour and the next one behind it go on in
line; a pixel that a sensor mixed of front and back stands on neither.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from tapip3d_lite.geometry import pixel_grid, project, resize_intrinsics, transform, unproject
from tapip3d_lite.validate import floats, video_frames

_SUPPORT = 3  # neighbours of eight that a pixel on a surface has at least, also at a corner
_ROWS = 1.0  # pixels by which points of a rectified pair may differ in height


def stereo_depth(
    left: np.ndarray, right: np.ndarray, intrinsics: np.ndarray, baseline: float, fill: bool = True
) -> np.ndarray:
    """z-depth (T, H, W) float32 of the left images of rectified pairs, by semi-global matching (SGBM) to a 16th of a pixel.

    Matching from right to left must give the same within a pixel. What only the left camera sees takes the farther of the
    depths beside it in its row, since near things hide far ones.

    Args:
        left: (T, H, W, 3) uint8.
        right: the same from a camera `baseline` to the right, with the same intrinsics and parallel axes.
        intrinsics: (3, 3) or (T, 3, 3), pixels.
        baseline: distance of the cameras in scene units.
        fill: False leaves pixels without a match at 0.

    Raises:
        ValueError: images of other sizes or dtypes, a baseline that is not positive, pairs that are swapped or not
            rectified (points differ in height), or in which nothing matches.
    """
    left, right = video_frames(left, "left"), video_frames(right, "right")
    if left.shape != right.shape:
        raise ValueError(f"right: expected {left.shape} as left, got {right.shape}; rectify both to one size")
    if not 0 < baseline < math.inf:
        raise ValueError(f"baseline: expected a positive distance in scene units, got {baseline}")
    shape = (3, 3) if np.ndim(intrinsics) == 2 else (len(left), 3, 3)
    focal = np.broadcast_to(floats("intrinsics", intrinsics, shape, finite=True)[..., 0, 0], len(left))
    if not (focal > 0).all():
        raise ValueError(f"intrinsics: the focal length must be positive, got {focal.min():g} pixels")
    # A 16th of a pixel is too coarse for small images. The scale is odd: middles of blocks are the old pixels' centres.
    scale = 1 + 2 * max(0, math.ceil(192 / left.shape[2] - 0.5))
    gray = [[cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images] for images in (left, right)]
    most = _largest_disparity(*gray) * scale
    depths = np.zeros(left.shape[:3], np.float32)
    for t, pair in enumerate(zip(*gray, strict=True)):
        larger = (cv2.resize(x, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC) for x in pair)
        disparity = _matched(*larger, most)[scale // 2 :: scale, scale // 2 :: scale] / scale
        np.divide(focal[t] * baseline, disparity, out=depths[t], where=disparity > 0)
    if not depths.any():
        raise ValueError(
            "stereo_depth: nothing in the right images matches the left ones; are they of one time and place?"
        )
    return densify_depth(np.stack([_beside(depth) for depth in depths])) if fill else depths


def _largest_disparity(left: list[np.ndarray], right: list[np.ndarray]) -> int:
    """How far corners move at most, found by optical flow with some room; ValueError unless they move level, to the left."""
    moves = []
    for one, two in zip(left[:: max(1, len(left) // 8)], right[:: max(1, len(left) // 8)], strict=True):
        corners = cv2.goodFeaturesToTrack(one, 300, 0.01, 3)
        if corners is not None:
            there, found, _ = cv2.calcOpticalFlowPyrLK(one, two, corners, None)
            back, again, _ = cv2.calcOpticalFlowPyrLK(two, one, there, None)
            good = (found & again).ravel().astype(bool) & (np.abs(back - corners).max((1, 2)) < 0.3)
            moves.append((there - corners)[good, 0])
    moves = np.concatenate(moves) if moves else np.zeros((0, 2))
    if len(moves) < 8:
        return one.shape[1] // 4  # too blank to tell
    across, down = np.median(moves[:, 0]), np.median(np.abs(moves[:, 1]))
    if down > _ROWS or across > 0.5:
        wrong = f"differ in height by {down:.1f} px" if down > _ROWS else f"lie {across:.1f} px to the right in `right`"
        remedy = "rectify the pair (cv2.stereoRectify)" if down > _ROWS else "swap left and right"
        raise ValueError(f"right: points of the left images {wrong} (median); {remedy}")
    return math.ceil(1.25 * np.quantile(-moves[:, 0], 0.98)) + 4


def _matched(left: np.ndarray, right: np.ndarray, most: int) -> np.ndarray:
    """Disparities (H, W) of the left image up to `most` where both directions agree, else 0."""
    count = -(-most // 16) * 16
    matcher = cv2.StereoSGBM.create(0, count, 5, 8 * 25, 32 * 25, 1, 31, 5, 0, 0, cv2.STEREO_SGBM_MODE_HH)
    # A margin on the left, where the search would leave the image; mirrored images are matched from right to left.
    pair = [cv2.copyMakeBorder(x, 0, 0, count, count, cv2.BORDER_REPLICATE) for x in (left, right)]
    ours = matcher.compute(*pair)[:, count:-count] / np.float32(16)
    theirs = matcher.compute(*(np.ascontiguousarray(x[:, ::-1]) for x in pair[::-1]))[:, ::-1][:, count:-count] / 16
    v, u = np.indices(left.shape)
    source = np.rint(u - ours).astype(int)
    seen = theirs[v, np.clip(source, 0, left.shape[1] - 1)]
    return np.where((ours > 0) & (source >= 0) & (np.abs(seen - ours) <= 1), ours, np.float32(0))


def _beside(depth: np.ndarray) -> np.ndarray:
    """Holes of a depth map (H, W) filled by the farther of the nearest known depths to the left and right."""
    sides = []
    for image in (depth, depth[:, ::-1]):
        last = np.maximum.accumulate(np.where(image > 0, np.arange(image.shape[1]), 0), 1)
        sides.append(np.take_along_axis(image, last, 1))
    return np.where(depth > 0, depth, np.maximum(sides[0], sides[1][:, ::-1]))


def densify_depth(depths: np.ndarray) -> np.ndarray:
    """Sparse depth (T, H, W), 0 = unknown, made dense: each pixel takes the nearest known one's (as the paper does for LiDAR).

    A frame without any stays empty.
    """
    depths = _valid(depths)
    dense = depths.copy()
    for old, new in zip(depths, dense, strict=True):
        unknown = (old == 0).astype(np.uint8)
        if unknown.any() and not unknown.all():
            kind = cv2.DIST_LABEL_PIXEL
            _, label = cv2.distanceTransformWithLabels(unknown, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=kind)
            values = np.zeros(label.max() + 1, np.float32)
            values[label[unknown == 0]] = old[unknown == 0]
            new[:] = values[label]
    return dense


def filter_depth(depths: np.ndarray, edge: float = 0.03) -> np.ndarray:
    """Depth (T, H, W) without the pixels that lie on no surface: flying ones between front and back, and single errors.

    A pixel is removed (0) if fewer than three of its eight neighbours continue its surface: their depths differ by less
    than the share `edge` (more where depth is noisy), or go on as on a plane that is seen at a grazing angle.
    """
    depths = _valid(depths)
    if not 0 < edge < 1:
        raise ValueError(f"edge: expected a share in (0, 1), got {edge}")
    return np.stack([np.where(_surface(depth, edge), depth, np.float32(0)) for depth in depths])


def _surface(depth: np.ndarray, edge: float) -> np.ndarray:
    """Which pixels (H, W) lie on a surface."""
    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
    padded = np.pad(inverse, 2, "reflect", reflect_type="odd")  # planes go on beyond the image
    steps = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if y or x]
    # The neighbours in eight directions, and what lies behind them: (8, H, W) each.
    views = np.lib.stride_tricks.sliding_window_view(padded, depth.shape)  # (5, 5, H, W)
    one, two = (np.stack([views[2 + k * y, 2 + k * x] for y, x in steps]) for k in (1, 2))
    there, beyond = (one > 0) & (inverse > 0), (one > 0) & (two > 0) & (inverse > 0)
    bend = np.abs(two + inverse - 2 * one)
    # Noise shows in most pixels, edges in few.
    noise = np.median((bend / np.maximum(inverse, 1e-12))[beyond]) if beyond.any() else 0
    slack = max(edge, 2 * noise) * inverse
    goes_on = there & (np.abs(one - inverse) < slack) | beyond & (bend < slack / 3)
    return goes_on.sum(0) >= _SUPPORT


def register_depth(
    depth: np.ndarray,
    depth_intrinsics: np.ndarray,
    intrinsics: np.ndarray,
    color_from_depth: np.ndarray,
    size: tuple[int, int],
) -> np.ndarray:
    """Depth (h, w) of one camera as the colour camera beside it sees it: (H, W), 0 where nothing was measured.

    X_color = color_from_depth X_depth, rounded to pixels; of several points that meet in one, the nearest counts.
    Depth images whose pixels see more than the colour camera's are enlarged first, so that they leave no holes.
    """
    depth = floats("depth", depth, (None, None))
    floats("color_from_depth", color_from_depth, (4, 4), finite=True)
    for name, camera in (("depth_intrinsics", depth_intrinsics), ("intrinsics", intrinsics)):
        floats(name, camera, (3, 3), finite=True)
    scale = math.ceil(intrinsics[0, 0] / depth_intrinsics[0, 0] - 0.05) if depth.size else 1
    if scale > 1:
        larger = tuple(scale * n for n in depth.shape)
        depth_intrinsics = resize_intrinsics(depth_intrinsics, depth.shape, larger)
        depth = cv2.resize(depth, larger[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
    known = depth > 0
    uv = pixel_grid(*depth.shape, like=np.zeros(0))[known]
    points = unproject(uv, depth[known].astype(np.float64), depth_intrinsics)
    return splat(*project(transform(points, color_from_depth), intrinsics), size)


def splat(uv: np.ndarray, z: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Depth (H, W) of points at pixels (n, 2) and z (n,), elsewhere 0; of several points in one pixel the nearest counts."""
    uv, depth = np.rint(uv), np.zeros(size, np.float32)
    inside = (z > 0) & ((uv >= 0) & (uv < size[::-1])).all(-1)
    order = np.argsort(-z[inside])  # the nearest is written last
    u, v = uv[inside][order].astype(int).T
    depth[v, u] = z[inside][order]
    return depth


def _valid(depths: np.ndarray) -> np.ndarray:
    depths = floats("depths", depths, (None, None, None))
    return np.where(np.isfinite(depths) & (depths > 0), depths, np.float32(0))
