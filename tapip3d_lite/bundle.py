"""Poses and depth scales that explain where corners are found over the frames: matching, and Gauss-Newton.

    min over E_t, s_t of  sum rho(|project(E_b E_a^-1 s_a X_a) - uv_b|^2 / sigma^2 + log(z / (s_b z_b))^2 / tau^2)

Corners of each frame a are lifted to X_a and followed by Lucas-Kanade, there and back, to frames b before and after it,
at gaps of 1, 2, 4 ... frames. Where nothing moves, the motion between the two cameras explains where corners are found
and how deep. The robust rho, narrowed step by step, ends the influence of what moves. All frames are solved for at once,
which leaves little drift: a bundle adjustment whose points are fixed by their depths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from tapip3d_lite.clip import Clip
from tapip3d_lite.geometry import invert, project, transform, unproject
from tapip3d_lite.measures import smooth_inverse

SCALE, POSES, BOTH = slice(6, 7), slice(6), slice(7)  # what may change of a frame's (translation, rotation, log scale)
_SPREADS = ((4, 0.2), (4, 0.2), (2, 0.1), (1, 0.05), (0.6, 0.03), (0.4, 0.02), (0.3, 0.015), (0.3, 0.015))
_MEASURED = 4  # further steps, with the spread of what rests as it is
_FINEST, _COARSE = np.array([0.05, 0.05, 0.0005]), np.array([0.5, 0.5, 0.02])  # of two pixels (of 128), and log depth
_PRIOR = 100.0  # 1 / variance of changes (median depths, radians, log scale): weak, it decides what no match does


@dataclass(frozen=True)
class Pair:
    """Corners of frame `a`, lifted to `x` (n, 3) in its camera, that frame `b` shows at `uv` (n, 2), at depth `z` (n,)."""

    a: int
    b: int
    x: np.ndarray
    uv: np.ndarray
    z: np.ndarray


class Views:
    """What matching needs of a clip: grey images, smooth inverse depths, corners and their places.

    Lengths are in units of the clip's median depth (`unit`), `uv` and `k` (T, 3, 3) of pairs in `pixel`s, of which the
    image's shorter side has 128.
    """

    def __init__(self, clip: Clip, count: int = 150) -> None:
        self.pixel, self.unit = min(clip.size) / 128, float(np.median(clip.depths[clip.depths > 0]))
        self.k = clip.intrinsics / np.array([[self.pixel], [self.pixel], [1.0]])
        self.gray = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in clip.video]
        self.inverse = [smooth_inverse(depth / np.float32(self.unit)) for depth in clip.depths]
        self.corners, self.x = [], []
        for gray, inverse, k in zip(self.gray, self.inverse, self.k, strict=True):
            mask = np.isfinite(inverse).astype(np.uint8)
            found = cv2.goodFeaturesToTrack(gray, count, 0.005, 4 * self.pixel, mask=mask, blockSize=5)
            uv = np.zeros((0, 2), np.float32) if found is None else found[:, 0]
            u, v = uv.astype(int).T
            self.corners.append(uv)
            self.x.append(unproject(uv / self.pixel, 1 / inverse[v, u].astype(np.float64), k))

    def pairs(self, poses: np.ndarray, gaps: int = 7) -> list[Pair]:
        """Matches of every frame with those at `gaps` gaps of 1, 2, 4 ... frames; poses say where to begin the search."""
        frames, steps = len(poses), [sign * 2**n for n in range(gaps) for sign in (-1, 1)]
        wanted = [(a, a + step) for a in range(frames) for step in steps if 0 <= a + step < frames]
        found = (self.match(a, b, poses[b] @ invert(poses[a])) for a, b in wanted)
        return [pair for pair in found if len(pair.z)]

    def match(self, a: int, b: int, motion: np.ndarray) -> Pair:
        """Corners of frame a found in frame b; the search begins where a motion (4, 4) from camera a to b puts them."""
        size, side = self.gray[0].shape[::-1], 2 * round(5 * self.pixel) + 1
        guess, z = project(transform(self.x[a], motion), self.k[b])
        guess = (guess * self.pixel).astype(np.float32)
        seen = (z > 0) & (np.abs(guess * 2 - size) < size).all(-1)
        here, x, guess = self.corners[a][seen], self.x[a][seen], guess[seen]
        if not len(here):
            return Pair(a, b, x, np.zeros((0, 2)), np.zeros(0))
        options = {"maxLevel": 3, "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 0.003)}
        images = self.gray[a], self.gray[b]
        there, returned = there_and_back(*images, here, guess, 0.5 * self.pixel, winSize=(side, side), **options)
        inverse = cv2.remap(self.inverse[b], there[:, None], None, cv2.INTER_LINEAR, borderValue=np.nan)[:, 0]
        kept = returned & np.isfinite(inverse)
        return Pair(a, b, x[kept], there[kept] / self.pixel, 1 / inverse[kept].astype(np.float64))


def there_and_back(
    one: np.ndarray, two: np.ndarray, here: np.ndarray, guess: np.ndarray, tolerance: float, **options: object
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) of a grey image found in another near a guess by Lucas-Kanade, and whether (n,) the way back returns."""
    options["flags"] = cv2.OPTFLOW_USE_INITIAL_FLOW
    there, out, _ = cv2.calcOpticalFlowPyrLK(one, two, here, guess.copy(), **options)
    # The way back begins as far from its target as the way there did, else it would return trivially.
    back, home, _ = cv2.calcOpticalFlowPyrLK(two, one, there, here + (there - guess), **options)
    return there, (out & home)[:, 0].astype(bool) & (np.linalg.norm(back - here, axis=-1) <= tolerance)


@dataclass(frozen=True)
class Fit:
    """Poses (T, 4, 4) and logarithms `scale` (T,) by which depths are multiplied, with what they leave of the matches.

    `left` (n, 3) are errors of two pixels and of the logarithm of depth, `sigma` (3,) their spread where nothing moves.
    """

    poses: np.ndarray
    scale: np.ndarray
    left: np.ndarray
    sigma: np.ndarray

    def rests(self) -> np.ndarray:
        """Whether matches (n,) belong to one world at rest, by a measure that better data does not make stricter."""
        return _weights(self.left, np.maximum(self.sigma, _COARSE)) > 0.25

    def error(self, left: np.ndarray) -> float:
        """The median, over the matches that this fit explains best, of what is `left` of them, in squares of the spread."""
        clear = _weights(self.left, self.sigma) > 0.25
        return float(np.median(((left[clear] / self.sigma) ** 2).sum(1))) if clear.any() else np.inf


def fit(pairs: Sequence[Pair], k: np.ndarray, start: np.ndarray, free: slice) -> Fit:
    """Gauss-Newton from poses `start` (T, 4, 4) and equal scales, of which `free` may change."""
    poses, scale, frames = start.copy(), np.zeros(len(start)), len(start)
    for spread in (*_SPREADS, *[None] * _MEASURED):
        parts = [_errors(pair, k, poses, scale) for pair in pairs]
        left = np.concatenate([r for r, _ in parts])
        if spread:
            sigma = np.array([spread[0], *spread])
        elif (rests := left[_weights(left, _COARSE) > 0.25]).size:
            pixels, depth = (1.48 * np.median(np.abs(x)) for x in (rests[:, :2], rests[:, 2]))
            sigma = np.clip([pixels, pixels, depth], _FINEST, sigma)
        h, g = _normal(pairs, parts, np.sqrt(_weights(left, sigma))[:, None] / sigma, frames)
        for t, (pose, first) in enumerate(zip(poses, start, strict=True)):
            h[t, t] += _PRIOR * np.eye(7)
            g[t] += _PRIOR * np.append(small(pose @ invert(first)), scale[t])
        h, g, step = h[:, :, free, free].transpose(0, 2, 1, 3), g[:, free], np.zeros((frames, 7))
        step[:, free] = -np.linalg.solve(h.reshape(g.size, g.size), g.ravel()).reshape(g.shape)
        poses = np.stack([motion(x) @ pose for x, pose in zip(step, poses, strict=True)])
        scale = scale + step[:, 6]
    return Fit(poses, scale, errors(pairs, k, poses, scale), sigma)


def errors(pairs: Sequence[Pair], k: np.ndarray, poses: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """What poses and log scales leave of all pairs' matches (n, 3), as in `Fit`."""
    return np.concatenate([_errors(pair, k, poses, scale)[0] for pair in pairs])


def _errors(pair: Pair, k: np.ndarray, poses: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What is left of a pair (n, 3), and its derivatives (n, 3, 14) by small motions and scales of its two frames."""
    turn, count = poses[pair.b] @ invert(poses[pair.a]), len(pair.z)
    here = pair.x * np.exp(scale[pair.a])
    there = transform(here, turn)
    z = np.maximum(there[:, 2], 1e-3)
    uv = (there @ k[pair.b].T)[:, :2] / z[:, None]
    left = np.concatenate([uv - pair.uv, (np.log(z) - np.log(pair.z) - scale[pair.b])[:, None]], 1)
    by = np.zeros((count, 3, 3))  # by the place in camera b
    by[:, :2] = (k[pair.b, :2] - uv[:, :, None] * (0, 0, 1)) / z[:, None, None]
    by[:, 2, 2] = 1 / z
    back, own = by @ turn[:3, :3], np.broadcast_to([[0.0], [0.0], [-1.0]], (count, 3, 1))
    of_a = -back, back @ _cross(here), back @ here[:, :, None]
    return left, np.concatenate([*of_a, by, -by @ _cross(there), own], 2)


def _normal(pairs: Sequence[Pair], parts: Sequence[tuple], weights: np.ndarray, frames: int) -> tuple:
    """Normal equations in blocks, (T, T, 7, 7) and (T, 7), from errors, derivatives and the roots of weights (n, 3)."""
    h, g, done = np.zeros((frames, frames, 7, 7)), np.zeros((frames, 7)), 0
    for pair, (left, by) in zip(pairs, parts, strict=True):
        w, done, both = weights[done : done + len(left)], done + len(left), [pair.a, pair.b]
        by, left = (by * w[..., None]).reshape(-1, 14), (left * w).ravel()
        h[np.ix_(both, both)] += (by.T @ by).reshape(2, 7, 2, 7).transpose(0, 2, 1, 3)
        g[both] += (by.T @ left).reshape(2, 7)
    return h, g


def _weights(left: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    return 1 / (1 + ((left / sigma) ** 2).sum(1) / 4) ** 2  # of Geman and McClure


def _cross(x: np.ndarray) -> np.ndarray:
    """Matrices (n, 3, 3) that multiply by the cross product with x (n, 3)."""
    return np.cross(x[:, None], np.eye(3)).swapaxes(1, 2)


def motion(vector: np.ndarray) -> np.ndarray:
    """The rigid motion (4, 4) of a translation and a rotation vector, (x, y, z, rx, ry, rz, ...)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = cv2.Rodrigues(vector[3:6])[0], vector[:3]
    return matrix


def small(matrix: np.ndarray) -> np.ndarray:
    """The inverse of `motion`: (6,)."""
    return np.append(matrix[:3, 3], cv2.Rodrigues(matrix[:3, :3])[0])
