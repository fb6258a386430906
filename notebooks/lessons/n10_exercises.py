"""Exercises of notebook 10: units of depth images, time stamps that match, points carried to another frame, stereo, a path's error."""

from __future__ import annotations

import numpy as np

from lessons.checker import Exercise, slips

Array = np.ndarray


def units(stored: Array, scale: float, no_depth: int, slip: str = "") -> Array:
    """Depths (H, W) in metres of whole numbers (H, W): divided by `scale`, 0 where they are 0 or `no_depth`."""
    metres = {"multiplied": stored * float(scale), "thousand": stored / 1000, "whole": stored // scale}.get(
        slip, stored / scale
    )
    unknown = {"mark kept": stored < 0, "all above": stored >= no_depth}.get(slip, stored == no_depth)
    return np.where(unknown, np.nan if slip == "nan" else 0, metres)


def _stored(rng: np.random.Generator, size: int) -> tuple:
    """Images of 16 bits in which the mark stands, numbers above it, and 0."""
    scale, mark = (1000, 5000, 256, 2000)[size - 1], int(rng.choice([65535, 30000, 9000]))
    stored = rng.integers(400, 65000, (size + 2, size + 3)).astype(np.uint16)
    stored.flat[:3] = 0, mark, min(mark + 1, 65535)
    return stored, float(scale), mark


_UNITS_HINTS = {
    "multiplied": "`scale` says how many of the whole numbers make a metre: divide by it.",
    "thousand": "1000 a metre is usual, not sure: TUM's images have 5000; divide by `scale`.",
    "whole": "a // b throws away what comes after the point: 3.7 m become 3 m; use /.",
    "mark kept": "the number `no_depth` is no depth but a mark: it becomes 0, or a wall stands where nothing was measured.",
    "all above": "only the very number `no_depth` means unknown; larger ones may be depths.",
    "nan": "unknown is 0 here, not NaN.",
}

UNITS = Exercise("10.units", reference=units, cases=_stored, mistakes=slips(units, _UNITS_HINTS))


def partners(colour: Array, depth: Array, most: float, slip: str = "") -> Array:
    """Pairs (p, 2) of indices: each colour frame's time (n,) with the nearest time (m,) of depth, if less than `most` s apart."""
    if slip == "single precision":
        colour, depth = colour.astype(np.float32), depth.astype(np.float32)
    apart = np.abs(colour[:, None] - depth)
    nearest, gap = apart.argmin(1), apart.min(1)
    if slip == "in order":
        nearest = np.minimum(np.arange(len(colour)), len(depth) - 1)
        gap = np.abs(colour - depth[nearest])
    if slip == "the one before":
        nearest = np.maximum(np.searchsorted(depth, colour, side="right") - 1, 0)
        gap = np.abs(colour - depth[nearest])
    if slip == "signed":
        nearest = (colour[:, None] - depth).argmin(1)
        gap = np.abs(colour - depth[nearest])
    if slip == "for each depth":
        back = apart.argmin(0)
        kept = np.flatnonzero(apart.min(0) < most)
        return np.stack([back[kept], kept], -1)
    kept = np.arange(len(colour)) if slip == "no limit" else np.flatnonzero(gap < most)
    pairs = np.stack([kept, nearest[kept]], -1)
    return pairs[:, ::-1] if slip == "turned" else pairs


def _times(rng: np.random.Generator, size: int) -> tuple:
    """Two clocks of one start, in seconds since 1970: depth comes late, some of it is missing, some twice as often."""
    count = 5 + 2 * size
    colour = 1305031102.0 + np.arange(count) / 30 + rng.uniform(0, 0.002, count)
    depth = colour + rng.uniform(-0.012, 0.012, count)
    depth = np.delete(depth, rng.integers(1, count - 1, 1 + size // 2))
    depth = np.sort(np.concatenate([depth, depth[:2] + 0.009, colour[-1:] + 0.2, [1305031200 + 1 / 64]]))
    return np.append(colour, 1305031200.0), depth, 1 / 64  # the last two are not less than that apart


_PARTNERS_HINTS = {
    "in order": "the n-th depth image does not belong to the n-th colour image: after one that is missing all are late. Compare times.",
    "single precision": "seconds since 1970 need 64 bits: in 32 the next number is two minutes later.",
    "the one before": "the nearest may come after the colour frame, too.",
    "signed": "nearest means the smallest size of the difference: np.abs.",
    "for each depth": "ask from the colour frames: each takes its nearest depth image, and some depth images remain.",
    "no limit": "a colour frame without depth within `most` seconds gets no partner and is left out.",
    "turned": "colour's index first, then depth's.",
}

PARTNERS = Exercise("10.partners", reference=partners, cases=_times, mistakes=slips(partners, _PARTNERS_HINTS))


def carried(depth: Array, other: Array, lens: Array, pose: Array, other_pose: Array, slip: str = "") -> Array:
    """Relative errors (H, W) of a frame's depth (H, W) against another's, NaN where there is nothing to compare.

    Each pixel is lifted, expressed in the other camera, and projected; its z there is compared with the depth of the
    nearest pixel. `lens` (3, 3) is both cameras', the poses (4, 4) are world to camera.
    """
    height, width = depth.shape
    half = 0.5 if slip == "half a pixel" else 0
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack([u + half, v + half, np.ones_like(u)], -1) @ np.linalg.inv(lens).T
    if slip == "ray":
        rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    points = rays * depth[..., None]
    motion = other_pose @ np.linalg.inv(pose)
    if slip == "turned":
        motion = np.linalg.inv(motion)
    if slip == "camera to world":
        motion = np.linalg.inv(other_pose) @ pose
    x = points @ motion[:3, :3].T + motion[:3, 3]
    z = x[..., 2]
    with np.errstate(all="ignore"):
        there = x @ lens.T / z[..., None]
        to_pixel = np.floor if slip == "floor" else np.rint
        column, row = (to_pixel(np.nan_to_num(there[..., i], nan=-9, posinf=-9, neginf=-9)).astype(int) for i in (0, 1))
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        stored = other[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
        error = {"upside down": stored / z - 1, "metres": z - stored}.get(slip, z / stored - 1)
    usable = (depth > 0) & (stored > 0 if slip != "holes" else True)
    usable &= inside if slip != "clipped" else True
    usable &= z > 0 if slip != "behind" else True
    return np.where(usable, error if slip == "signed" else np.abs(error), np.nan)


def _frames(rng: np.random.Generator, size: int) -> tuple:
    """Uneven depth with holes; the other camera stands near the first, in the midst of the points, or behind the first."""
    shape = 5 + size, 7 + 2 * size
    depth, other = (np.where(rng.random(shape) < 0.15, 0, rng.uniform(0.5, 4, shape)) for _ in range(2))
    lens = np.array([[6.0 + size, 0, shape[1] / 2 - 0.7], [0, 6.5 + size, shape[0] / 2 - 0.4], [0, 0, 1]])
    poses, ahead = [], rng.choice([0, -2.2, 1.5])
    for i in range(2):
        axis = rng.normal(size=3)
        x, y, z = 0.2 * axis / np.linalg.norm(axis)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        pose = np.eye(4)
        pose[:3, :3] += np.sin(0.2) / 0.2 * cross + (1 - np.cos(0.2)) / 0.04 * cross @ cross
        pose[:3, 3] = rng.uniform(-0.3, 0.3, 3) + (0, 0, i * ahead)
        poses.append(pose)
    return depth, other, lens, *poses


_CARRIED_HINTS = {
    "turned": "world to camera both: undo the first pose, then apply the other one: other_pose @ inv(pose).",
    "camera to world": "the poses map world to camera: it is the first one that has to be inverted.",
    "ray": "depth is z, not the length of the ray: the ray K^-1 (u, v, 1) has z = 1, leave it so.",
    "half a pixel": "pixel centres are whole numbers: (u, v) as they are, without 0.5.",
    "floor": "the nearest pixel is np.rint, not the one before.",
    "upside down": "the carried z over the stored depth, minus 1.",
    "metres": "relative to the stored depth: z / stored - 1.",
    "signed": "the size of the error: np.abs.",
    "holes": "where the other frame has no depth there is nothing to compare: NaN.",
    "clipped": "a point that leaves the image meets nothing: NaN, not the pixel at the border.",
    "behind": "a point behind the other camera (z <= 0) is not seen by it: NaN.",
}

CARRIED = Exercise("10.carried", reference=carried, cases=_frames, mistakes=slips(carried, _CARRIED_HINTS))


def stereo(left: Array, right: Array, focal: float, baseline: float, slip: str = "") -> Array:
    """Depths (H, W) of the left image of a rectified pair from disparities (H, W) of both, 0 where they contradict.

    Pixel u of the left image lies at u - left[v, u] in the right one, and must be sent back within one pixel.
    """
    width = left.shape[1]
    v, u = np.indices(left.shape)
    step = -left if slip != "other way" else left
    source = (np.floor if slip == "floor" else np.rint)(u + step).astype(int)
    if slip == "same pixel":
        source = u
    back = right[v, np.clip(source, 0, width - 1)]
    limit = 0.5 if slip == "half a pixel" else 1
    agree = np.abs(back - left) <= limit
    if slip != "clipped":
        agree &= (source >= 0) & (source < width)
    if slip == "no check":
        agree = np.ones_like(agree)
    if slip != "zero":
        agree &= left > 0
    with np.errstate(all="ignore"):
        depth = {"upside down": left / (focal * baseline), "no baseline": focal / left}.get(
            slip, focal * baseline / left
        )
    return np.where(agree, depth, np.nan if slip == "nan" else 0)


def _disparities(rng: np.random.Generator, size: int) -> tuple:
    """Disparities that mostly agree, by less than a pixel; some contradict, some are unknown, some leave the image."""
    height, width = 2 + size, 9 + 3 * size
    left = rng.uniform(0.6, 3.4, (height, width))
    right = rng.uniform(0.6, 3.4, (height, width))
    for v in range(height):
        for u in range(width):
            there = round(u - left[v, u])
            if there >= 0 and rng.random() < 0.7:
                right[v, there] = left[v, u] + rng.uniform(-0.8, 0.8)
    left[rng.random(left.shape) < 0.1], right[rng.random(right.shape) < 0.05] = 0, 0
    left[0, 5], right[0, 5] = 0, 0  # unknown on both sides
    left[1, 6], right[1, 4] = 2, 3  # one pixel apart, no more
    return left, right, float(rng.uniform(50, 300)), float(rng.uniform(0.05, 0.4))


_STEREO_HINTS = {
    "no check": "matching from right to left must send the pixel back: elsewhere there is no depth.",
    "other way": "things lie further to the left in the right image: column u - left[v, u].",
    "same pixel": "look up the right image's disparity where the left pixel lies in it, at column u - left[v, u].",
    "floor": "the nearest column is np.rint, not the one before.",
    "clipped": "a pixel whose partner lies outside the image has none: 0.",
    "half a pixel": "they may differ by one pixel.",
    "zero": "a disparity of 0 means nothing was found, and would be infinitely far: 0.",
    "upside down": "near things have large disparities: z = f b / d.",
    "no baseline": "z = f b / d; without the baseline the depth has no unit.",
    "nan": "unknown is 0 here, not NaN.",
}

STEREO = Exercise("10.stereo", reference=stereo, cases=_disparities, mistakes=slips(stereo, _STEREO_HINTS))


def path(places: Array, true: Array, slip: str = "") -> float:
    """Root mean square distance of places (T, 3) to the true ones, after the rotation and translation that make it least."""
    a, b = places - places.mean(0), true - true.mean(0)
    if slip in ("not aligned", "only turned"):
        a, b = places, true
    left, stretch, right = np.linalg.svd(b.T @ a)
    flip = np.diag([1, 1, 1 if slip == "mirror" else np.sign(np.linalg.det(left @ right))])
    turn = left @ flip @ right
    if slip in ("not aligned", "only shifted"):
        turn = np.eye(3)
    scale = (stretch * np.diag(flip)).sum() / (a**2).sum() if slip == "scaled" else 1
    moved = scale * a @ (turn if slip == "other way" else turn.T)
    away = np.linalg.norm(moved - b, axis=-1)
    return {"mean": away.mean(), "median": np.median(away), "squares": (away**2).mean()}.get(
        slip, np.sqrt((away**2).mean())
    )


def _paths(rng: np.random.Generator, size: int) -> tuple:
    """A path, and the same one turned, shifted, a little too long and unsteady; one of three is mirrored."""
    true = rng.normal(size=(3 + 2 * size, 3)).cumsum(0)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn[0] *= np.sign(np.linalg.det(turn)) * (-1 if rng.random() < 1 / 3 else 1)
    return 1.2 * true @ turn.T + 3 * rng.normal(size=3) + 0.1 * rng.normal(size=true.shape), true


_PATH_HINTS = {
    "not aligned": "the estimate lives in a world of its own: first the best rotation and translation.",
    "only shifted": "the estimate's world may be turned, too: find the rotation by an SVD of the 3x3 matrix of products.",
    "only turned": "subtract each path's mean before you look for the rotation.",
    "mirror": "a rotation does not mirror: where the determinant is -1 turn the sign of the last direction.",
    "scaled": "depth has metres, so the path has, too: no scale is fitted.",
    "other way": "the rotation is applied backwards: rows times its transpose.",
    "mean": "the root of the mean square, which large errors dominate, not the mean.",
    "median": "the root of the mean square: all frames count.",
    "squares": "take the root, so that it is metres.",
}

PATH = Exercise("10.path", reference=path, cases=_paths, mistakes=slips(path, _PATH_HINTS), tolerance=1e-6)

EXERCISES = (UNITS, PARTNERS, CARRIED, STEREO, PATH)
