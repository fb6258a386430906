"""How well the parts of an RGB-D clip fit together, as numbers, from the data alone.

    depth     |z_s(X_t) / z_t->s - 1|: pixels lifted from frame t must meet the depth stored in frame s, if they rest
    colour    |I_s(X_t) - I_t| / |I_s(random) - I_t|: and have the colour there, better than any other pixel does
    edges     colour changes more at silhouettes of the depth than beside them
    curvature 1/z is affine over any plane, so its second differences vanish on floors and walls

The lower quartile of `depth` and `colour` counts, since parts of a good clip disagree too: what moves, is hidden, or
leaves the view. All work at about 128 pixels, so that their cost does not grow with the image.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import cv2
import numpy as np

from tapip3d_lite.clip import Clip
from tapip3d_lite.geometry import invert, project, unproject

USUAL_DEPTH, USUAL_COLOUR = 0.045, 0.15  # good clips stay below, with a poor depth sensor too
_CAP = 0.25  # relative depth errors above this count as this: the point is simply lost


@dataclass(frozen=True)
class Agreement:
    """How well a clip fits together: `depth` from 0 to 0.25, `colour` from 0 to about 1; 0 is perfect."""

    depth: float
    colour: float

    def usual(self, slack: float = 1.0) -> bool:
        """Whether good clips have such numbers."""
        return self.depth <= slack * USUAL_DEPTH and self.colour <= slack * USUAL_COLOUR

    def doubtful(self) -> bool:
        """Whether no good clip has such numbers; where depths agree to a thousandth, poses are right, and colours hardly count."""
        return not self.usual(1.5 if self.depth > 1e-3 else 3)

    def numbers(self) -> str:
        """Both, in words."""
        return (
            f"relative depth error of what rests {self.depth:.2g} where less than {USUAL_DEPTH} is usual, "
            f"colour error {self.colour:.2g} where less than {USUAL_COLOUR} is usual"
        )

    def badness(self) -> float:
        """The logarithm of both, by which fixes are compared; differences that are too small to matter hardly count."""
        return float(np.log(self.depth + 1e-3) + np.log(self.colour + 0.03))


def agreement(clip: Clip, starts: int = 4, count: int = 400, memory: dict | None = None) -> Agreement:
    """Points carried between pairs of frames through depths, poses and intrinsics: do they meet depth and colour there?

    Args:
        clip: T frames; one alone fits.
        starts: how many pairs of frames for each of four gaps of time.
        count: points carried between each pair, at random.
        memory: keeps smoothed images and depths from call to call.
    """
    rng, frames, memory = np.random.default_rng(0), len(clip), {} if memory is None else memory
    gaps = sorted({max(1, round(frames * share)) for share in (0.04, 0.1, 0.25, 0.5)})
    pairs = [(t, t + gap) for gap in gaps for t in np.linspace(0, max(frames - gap - 1, 0), starts).astype(int)]
    pairs = [pair for pair in dict.fromkeys(pairs) if pair[1] < frames]
    near = [(t, t + 1) for t in np.unique(np.linspace(0, frames - 2, 6 * starts).astype(int)) if frames > 1]
    # x lives on beside what is known of it: so does its id.
    known, image = (memory.setdefault(id(x), ({}, x))[0] for x in (clip.depths, clip.video))
    for t in {t for pair in pairs + near for t in pair} - (set(known) & set(image)):
        inverse = smooth_inverse(clip.depths[t])
        known[t] = inverse, *np.nonzero(np.isfinite(inverse))
        image[t] = cv2.GaussianBlur(clip.video[t], (0, 0), 1).astype(np.float32)
    if frames == 1 or sum(len(x[1]) for x in known.values()) < 0.05 * len(known) * clip.depths[0].size:
        return Agreement(0.0, 0.0)  # points without surfaces between them are no evidence
    rows = [_carry(clip, pair, known, image, rng, count) for pair in pairs]
    if not sum(map(len, rows)):
        return Agreement(_CAP, 1.0)
    depth, colour, other = np.concatenate(rows).T
    usual = np.quantile(other, 0.25)  # of two pixels that have nothing to do with each other
    steps = [row[:, 1] for pair in near if len(row := _carry(clip, pair, known, image, rng, count // 2)) > 20]
    worst = max((np.quantile(step, 0.25) for step in steps), default=0)  # where a single frame is wrong
    share = max(np.quantile(colour, 0.25), worst / 2) / usual if usual > 2 else 0.0
    return Agreement(float(np.quantile(depth, 0.25)), float(min(share, 1)))


@contextmanager
def flawed_on_purpose() -> Iterator[None]:
    """No such warnings as `warn_of_misfit` gives: these clips are known to be wrong."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "clip .* does not fit together")
        yield


def warn_of_misfit(clip: Clip) -> None:
    """Warn where a clip does not fit together at all, in some hundredths of a second: what `check_clip` would look into."""
    if len(clip) == 1 or min(clip.size) < 64:  # too little to tell
        return
    found = agreement(reduced(clip), starts=2, count=200)
    if found.doubtful():
        warnings.warn(
            f"clip {clip.name!r} does not fit together: {found.numbers()}; look for the cause with check_clip(clip)",
            stacklevel=4,
        )


def _carry(
    clip: Clip, pair: tuple[int, int], known: dict, image: dict, rng: np.random.Generator, count: int
) -> np.ndarray:
    """(n, 3): relative errors of depth, differences of colour, and those to the colours of other points."""
    (t, s), (height, width) = pair, clip.size
    inverse, v, u = known[t]
    pick = rng.integers(0, max(len(v), 1), count if len(v) else 0)
    v, u = v[pick], u[pick]
    (k, k_s), (e, e_s) = (x[[t, s]].astype(np.float64) for x in (clip.intrinsics, clip.extrinsics))
    points = unproject(np.stack([u, v], -1).astype(np.float64), 1 / inverse[v, u].astype(np.float64), k, e)
    uv, z = project(points, k_s, e_s)
    inside = (z > 0) & ((uv >= 0) & (uv <= (width - 1, height - 1))).all(-1)
    if inside.sum() < 2:
        return np.full((len(u), 3), (_CAP, 255.0, 255.0))
    seen, there = (_bilinear(x, np.where(inside[:, None], uv, 0)) for x in (known[s][0], image[s]))
    error = np.where(inside, np.minimum(np.abs(z * seen - 1), _CAP), _CAP)
    here, there = np.column_stack([image[t][v, u], np.full(len(u), 255.0)])[inside], there[inside]
    change = there - here[:, :3]
    for _ in range(2):  # exposure and white balance differ: an affine function of colours, by what fits best
        size = np.abs(change).sum(-1)
        fits = size <= (np.median(size) if len(size) >= 20 else np.inf)
        change = there - here @ np.linalg.lstsq(here[fits], there[fits], rcond=None)[0]
    other = np.resize(np.abs(there - np.roll(there, 1, 0)).mean(-1), len(u))
    colour = np.full(len(u), np.median(other))
    colour[inside] = np.abs(change).mean(-1)
    return np.stack([error, colour, other], -1)[~np.isnan(error)]  # a pixel without depth is no evidence


def smooth_inverse(depth: np.ndarray) -> np.ndarray:
    """1/z averaged over 3 x 3 pixels (exact on planes), (H, W) float32; NaN at silhouettes and where depth is missing."""
    valid = (depth > 0).astype(np.float32)
    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
    share, first, second = (cv2.blur(x, (3, 3)) for x in (valid, inverse, inverse**2))
    mean = first / np.maximum(share, 1e-6)
    spread = np.sqrt(np.maximum(second / np.maximum(share, 1e-6) / np.maximum(mean, 1e-6) ** 2 - 1, 0))
    known = share > 0.4
    limit = max(0.03, 2.5 * float(np.median(spread[known]))) if known.any() else 0  # noise is no silhouette
    return np.where(known & (spread < limit), mean, np.float32(np.nan))


def _bilinear(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Values of an image (H, W, ...) at sub-pixel positions (n, 2) inside it; NaN beside NaN."""
    (height, width), extra = image.shape[:2], (1,) * (image.ndim - 2)
    u0, v0 = np.minimum(uv.astype(int), (width - 2, height - 2)).T
    a, b = (uv[:, i].reshape(-1, *extra) - x.reshape(-1, *extra) for i, x in enumerate((u0, v0)))
    top = image[v0, u0] * (1 - a) + image[v0, u0 + 1] * a
    return top * (1 - b) + (image[v0 + 1, u0] * (1 - a) + image[v0 + 1, u0 + 1] * a) * b


def reduced(clip: Clip) -> Clip:
    """Every n-th pixel of a large clip, so that its shorter side has about 128; without queries and tracks."""
    step = max(1, round(min(clip.size) / 128))
    video = clip.video[:, ::step, ::step]
    if step > 1:
        video = np.stack([cv2.blur(frame, (step, step))[::step, ::step] for frame in clip.video])
    k = clip.intrinsics / np.array([[step], [step], [1]], np.float32)
    return replace(clip, video=video, depths=clip.depths[:, ::step, ::step], intrinsics=k, queries=None, tracks=None)


def triangulated(clip: Clip, span: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frames (n,), given depths and depths (n,) that corners followed over `span` frames have by poses and intrinsics alone."""
    gray, rows = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in clip.video], []
    for a in np.unique(np.linspace(0, len(clip) - 1, 48).astype(int)):
        step = span if a + span < len(clip) else -span
        if not 0 <= a + step < len(clip):
            continue
        known = cv2.erode((clip.depths[a] > 0).astype(np.uint8), np.ones((3, 3), np.uint8))
        first = cv2.goodFeaturesToTrack(gray[a], 200, 0.005, 4, mask=known, blockSize=5)
        if first is None:
            continue
        there, good = first, np.ones(len(first), bool)
        for t in range(a, a + step, np.sign(step)):
            there, out, _ = cv2.calcOpticalFlowPyrLK(gray[t], gray[t + np.sign(step)], there, None, winSize=(11, 11))
            good &= out[:, 0].astype(bool)
        (k, k_s), (e, e_s) = (x[[a, a + step]].astype(np.float64) for x in (clip.intrinsics, clip.extrinsics))
        motion = e_s @ invert(e)
        pixels = ((first, k), (there, k_s))
        here, seen = (np.column_stack([x[:, 0], np.ones(len(x))]) @ np.linalg.inv(y).T for x, y in pixels)
        m, n = np.cross(seen, here @ motion[:3, :3].T), np.cross(seen, motion[:3, 3])  # z m + n = 0
        square = np.maximum((m * m).sum(-1), 1e-20)
        z = -(m * n).sum(-1) / square
        meet = np.linalg.norm(z[:, None] * m + n, axis=-1) < 0.05 * np.linalg.norm(n, axis=-1)
        good &= (z > 0) & (square > (2 / k[0, 0]) ** 2) & meet
        u, v = first[good, 0].astype(int).T
        rows.append(np.stack([np.full(len(u), a), clip.depths[a, v, u], z[good]], -1))
    found = np.concatenate(rows) if rows else np.zeros((0, 3))
    return tuple((found if len(found) >= 40 else found[:0]).T)


def line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """The line y = a x + b through most of the points, by reweighted least squares of relative errors."""
    weight, a, b = 1 / y, 1.0, 0.0
    for _ in range(20 if len(x) else 0):
        rows = np.stack([x, np.ones_like(x)], -1) * weight[:, None]
        a, b = np.linalg.lstsq(rows, y * weight, rcond=None)[0]
        weight = 1 / y / np.sqrt(np.maximum(np.abs((a * x + b) / y - 1), 0.01))
    return float(a), float(b)


def curvature(clip: Clip) -> tuple[float, float]:
    """The median relative second difference of 1/z in four frames, and how much of it chance could be.

    Near 0 in scenes with planes, whatever the noise; ray lengths and disparities bulge.
    """
    step, values = max(1, min(clip.size) // 12), []
    for t in np.linspace(0, len(clip) - 1, 4).astype(int):
        inverse = smooth_inverse(clip.depths[t])
        second = ((x[2 * step :] + x[: -2 * step] - 2 * x[step:-step]) / x[step:-step] for x in (inverse, inverse.T))
        values += [x.ravel() for x in second]
    values = np.concatenate(values)
    values = values[np.isfinite(values)]
    if len(values) < 100:
        return 0.0, np.inf
    middle = float(np.median(values))
    return abs(middle), float(20 * np.median(np.abs(values - middle)) / len(values) ** 0.5)


def edges(clip: Clip, reach: int = 6) -> np.ndarray:
    """Changes of colour at silhouettes of the depth that are shifted to the right by -reach ... reach pixels: (2 reach + 1,).

    In units of the mean over the image, of four frames. Where both come from the same place the peak lies in the middle.
    """
    total, count, shifts = np.zeros(2 * reach + 1), 0, np.arange(2 * reach + 1)
    for t in np.linspace(0, len(clip) - 1, 4).astype(int):
        depth, image = clip.depths[t], cv2.GaussianBlur(clip.video[t], (0, 0), 1).astype(np.float32)
        depth = cv2.medianBlur(np.where(depth > 0, depth, cv2.dilate(depth, np.ones((5, 5), np.uint8))), 5)
        near = cv2.erode(np.where(depth > 0, depth, np.float32(1e30)), np.ones((3, 3), np.uint8))
        step = cv2.dilate(depth, np.ones((3, 3), np.uint8)) / near
        v, u = np.nonzero(step > np.exp(max(0.1, 4 * np.log(max(np.median(step), 1)))))
        change = np.linalg.norm(np.stack(np.gradient(image, axis=(0, 1))), axis=(0, 3))
        change = cv2.blur(np.minimum(change / max(change.mean(), 1e-6), 3), (1, 3))
        total += np.pad(change, ((0, 0), (reach, reach)), mode="reflect")[v, u + shifts[:, None]].sum(-1)
        count += len(v)
    return total / count if count >= 200 else np.ones_like(total)
