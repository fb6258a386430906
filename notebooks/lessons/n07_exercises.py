"""Exercises of notebook 07: the scores of one count, pixels of the 2D raster, intervals by resampling, the worst tracks."""

from __future__ import annotations

import numpy as np

from lessons.checker import Exercise, slips

Array = np.ndarray


def scores(inside: Array, visible: Array, said: Array, scored: Array, slip: str = "") -> tuple:
    """OA, APD and AJ from hits (5, T, N) of the five thresholds and flags (T, N): visible in truth, said to be, scored."""
    everywhere = np.ones_like(scored)
    agrees = (visible == said)[{"unmasked word": everywhere, "visible only": scored & visible}.get(slip, scored)]
    if slip == "unmasked":
        scored = everywhere
    true, claims = visible & scored, said & scored
    found = inside & (scored if slip == "hidden hits" else true)
    axes = (1, 2)
    false = {"hidden only": claims & ~true, "missed only": claims & ~inside}.get(slip, claims & ~found)
    above = found if slip == "word above" else found & claims
    below = true.sum() + np.broadcast_to(false, inside.shape).sum(axes)
    if slip == "no misses":
        below = true.sum()
    near = (found & claims if slip == "word in APD" else found).sum(axes) / true.sum()
    jaccard = above.sum(axes) / below
    oa, apd, aj = agrees.mean(), near.mean(), jaccard.mean()
    if slip == "pooled":
        aj = above.sum() / below.sum()
    if slip == "widest":
        apd, aj = near[-1], jaccard[-1]
    return (oa, aj, apd) if slip == "order" else (oa, apd, aj)


def _counted(rng: np.random.Generator, size: int) -> tuple:
    """Nested hits, as those of growing thresholds are; every kind of moment is there, also outside of what is scored."""
    shape = size + 2, 6 * size + 2
    error = rng.lognormal(1.2, 1.2, shape)
    visible, said, scored = rng.random(shape) < 0.65, rng.random(shape) < 0.6, rng.random(shape) < 0.8
    kinds = np.array([(v, s, h) for v in (0, 1) for s in (0, 1) for h in (0, 1)])
    visible[0, :8], said[0, :8], error[0, :8] = kinds[:, 0], kinds[:, 1], np.where(kinds[:, 2], 0.5, 20)
    scored[0, :8] = True
    visible[1, :4], said[1, :4], scored[1, :4] = [1, 0, 1, 0], [1, 1, 0, 1], False
    return np.stack([error < k for k in (1, 2, 4, 8, 16)]), visible, said, scored


_SCORES_HINTS = {
    "unmasked word": "OA, too, asks only in moments that are scored.",
    "visible only": "OA asks in every scored moment, also where the point is hidden in truth.",
    "unmasked": "moments that are not scored count nowhere: neither as visible nor as claims.",
    "hidden hits": "a point that is hidden in truth is never found, however near: inside & visible & scored.",
    "hidden only": "a visible point that is called visible and missed stands below the bar twice: as not found, and as a false claim; see claims & ~found.",
    "missed only": "a claim about a hidden point is false even if the place is right: claims & ~found.",
    "word above": "above the bar of J stand only points that are also said to be visible.",
    "no misses": "below the bar stand the false claims, too.",
    "word in APD": "APD does not ask for the word, only whether a visible point is hit.",
    "pooled": "divide for every threshold first, then average the five; J's lower count differs from threshold to threshold.",
    "widest": "average over the five thresholds.",
    "order": "return OA, then APD, then AJ.",
}  # fmt: skip

SCORES = Exercise(
    "07.scores",
    reference=scores,
    cases=_counted,
    mistakes=slips(scores, _SCORES_HINTS),
)


def to_raster(points: Array, intrinsics: Array, size: tuple[int, int], slip: str = "") -> Array:
    """Pixels (T, N, 2) on a raster of 256 x 256 of camera points (T, N, 3), filmed by (T, 3, 3) in images of size (H, W)."""
    height, width = size
    focal, centre = intrinsics[:, None, [0, 1], [0, 1]], intrinsics[:, None, [0, 1], [2, 2]]
    if slip == "first lens":
        focal, centre = focal[:1], centre[:1]
    depth = points[..., 2:] if slip == "behind" else np.maximum(points[..., 2:], 1e-6)
    if slip == "ray":
        depth = np.linalg.norm(points, axis=-1, keepdims=True)
    uv = focal * points[..., :2] / depth + (0 if slip == "no centre" else centre)
    raster = {
        "pixels": np.ones(2),
        "one factor": np.full(2, 256 / min(size)),
        "rows first": 256 / np.array([height, width]),
        "gaps": 255 / np.array([width - 1, height - 1]),
        "inverse": np.array([width, height]) / 256,
    }.get(slip, 256 / np.array([width, height]))
    return (uv * raster)[..., ::-1] if slip == "v first" else uv * raster


def _filmed(rng: np.random.Generator, size: int) -> tuple:
    """Oblong images, lenses that differ from frame to frame, and a point behind the camera."""
    frames, (height, width) = size + 1, (int(x) for x in rng.permutation([40 + 8 * size, 72 + 12 * size]))
    points = rng.normal(size=(frames, 2 * size, 3)) * [0.8, 0.8, 0.5] + [0, 0, 3]
    points[:, 0, 2] = -1.5
    intrinsics = np.zeros((frames, 3, 3))
    intrinsics[:, 0, 0], intrinsics[:, 1, 1] = rng.uniform(60, 120, (2, frames))
    intrinsics[:, 0, 2], intrinsics[:, 1, 2], intrinsics[:, 2, 2] = width / 2 - 1, height / 2 + 2, 1
    return points, intrinsics, (height, width)


_RASTER_HINTS = {
    "first lens": "each frame has its own lens: intrinsics[t] for frame t.",
    "behind": "divide by at least 1e-6, so that a point behind the camera lands far outside and is no mirror image.",
    "ray": "divide by the depth z, not by the length of the ray.",
    "no centre": "pixels count from the top left: add cx and cy.",
    "pixels": "those are the image's own pixels; stretch them to the raster of 256 x 256.",
    "one factor": "that is the rule of the 3D metrics; TAP-Vid stretches each axis to 256, whatever the image's shape.",
    "rows first": "u belongs to the width, v to the height: size is (H, W).",
    "gaps": "the raster stretches pixels by 256 / W and 256 / H, not the gaps between centres.",
    "inverse": "256 divided by the side, not the side by 256.",
    "v first": "return (u, v): column, then row.",
}  # fmt: skip

RASTER = Exercise(
    "07.raster",
    reference=to_raster,
    cases=_filmed,
    mistakes=slips(to_raster, _RASTER_HINTS),
    tolerance=1e-6,
)


def interval(ours: Array, theirs: Array, picks: Array, others: Array, slip: str = "") -> tuple:
    """Mean of ours - theirs over clips (C,), and where 95 % of the resampled means lie; rows of picks, others are resamples."""
    if slip == "always paired":
        others = picks
    if slip == "crossed":
        picks, others = others, picks
    middle = np.median if slip == "median" else np.mean
    resampled = middle(ours[picks], axis=1) - middle(theirs[others], axis=1)
    if slip == "clips for means":
        resampled = (ours[picks] - theirs[others]).ravel()
    if slip == "along the wrong axis":
        resampled = ours[picks].mean(0) - theirs[others].mean(0)
    mean = resampled.mean() if slip == "mean of resamples" else ours.mean() - theirs.mean()
    if slip == "standard error":
        spread = (ours - theirs).std(ddof=1) / len(ours) ** 0.5
        return mean, mean - 1.96 * spread, mean + 1.96 * spread
    if slip == "one deviation":
        return mean, mean - resampled.std(), mean + resampled.std()
    ends = {"90 %": (0.05, 0.95), "extremes": (0, 1)}.get(slip, (0.025, 0.975))
    low, high = np.quantile(resampled, ends)
    return (mean, high, low) if slip == "high first" else (mean, low, high)


def _resampled(rng: np.random.Generator, size: int) -> tuple:
    """Clips that differ much more from one another than the two trackers do."""
    count, rounds = 3 + 2 * size, 80 * size
    level = rng.uniform(0.2, 0.9, count)
    ours, theirs = (level + rng.normal(shift, 0.06, count) for shift in (0.05, 0.0))
    return ours, theirs, *(rng.integers(count, size=(rounds, count)) for _ in range(2))


_INTERVAL_HINTS = {
    "always paired": "theirs is resampled by `others`; only where both are the same are the clips paired.",
    "crossed": "ours goes with `picks`, theirs with `others`.",
    "median": "the score of a resample is its mean over clips.",
    "clips for means": "first the mean of each resample, then the quantiles of these means: single clips scatter more than their mean.",
    "along the wrong axis": "one row is one resample: average along axis 1.",
    "mean of resamples": "the estimate is the mean of the clips themselves; the resamples only say how sure it is.",
    "standard error": "that is the interval of the normal distribution; take the quantiles of the resampled means.",
    "one deviation": "one standard deviation holds only 68 %; take the quantiles 0.025 and 0.975 of the resampled means.",
    "90 %": "2.5 % are cut off at either end: quantiles 0.025 and 0.975.",
    "extremes": "the smallest and largest resample move with their number; take quantiles 0.025 and 0.975.",
    "high first": "return the mean, the low end, the high end.",
}  # fmt: skip

INTERVAL = Exercise(
    "07.interval",
    reference=interval,
    cases=_resampled,
    mistakes=slips(interval, _INTERVAL_HINTS),
    tolerance=1e-6,
)


def worst(p: Array, q: Array, visible: Array, focal: Array, count: int, slip: str = "") -> Array:
    """The `count` tracks with the largest mean error in pixels over moments (T, N) that are visible in truth, worst first."""
    depth = q[..., 2] if slip == "predicted depth" else p[..., 2]
    error = np.linalg.norm(q - p, axis=-1) * focal[:, None] / depth
    if slip == "metres":
        error = np.linalg.norm(q - p, axis=-1)
    if slip == "sideways":
        error = np.linalg.norm((q - p)[..., :2], axis=-1) * focal[:, None] / depth
    if slip == "hidden too":
        visible = np.ones_like(visible)
    total = np.where(visible, error, 0).sum(0)
    mean = total / np.maximum(visible.sum(0), 1)
    value = {"sum": total, "largest": np.where(visible, error, 0).max(0), "end": error[-1]}.get(slip, mean)
    if slip == "never seen":
        value = np.where(visible.any(0), value, np.inf)
    order = np.argsort(value if slip == "best" else -value)[:count]
    if slip == "sorted":
        return np.sort(order)
    return order[::-1] if slip == "worst last" else order


def _tracked(rng: np.random.Generator, size: int) -> tuple:
    """Tracks whose errors differ in size, in length of visibility and with depth; one is seen once, one never."""
    frames, tracks = size + 4, 5 * size + 4
    p = rng.normal(size=(frames, tracks, 3)) * 0.3 + np.stack([*np.zeros((2, tracks)), rng.uniform(1.5, 9, tracks)], -1)
    p[..., 2] = np.maximum(p[..., 2], 0.8)
    spread = rng.lognormal(-2, 1, (frames, tracks, 1)) * rng.lognormal(0, 0.8, tracks)[:, None]
    q = p + rng.normal(size=p.shape) * spread
    q[..., 2] = np.maximum(q[..., 2], 0.2)
    visible = rng.random((frames, tracks)) < rng.uniform(0.3, 1, tracks)
    visible[0] = True
    visible[:, tracks // 2] = False
    q[:, tracks // 2] += 4
    focal = rng.uniform(80, 240, frames)
    visible[1:, 0] = False  # seen once, and far off; the next one nearly as far, all the time
    for n, pixels in ((0, 900), (1, 700)):
        q[:, n] = p[:, n] + [[pixels, 0, 0]] * (p[:, n, 2] / focal)[:, None]
    return p, q, visible, focal, min(3 + size, tracks - 1)


_WORST_HINTS = {
    "predicted depth": "a pixel's length is that at the true depth; a prediction far away would excuse itself.",
    "metres": "errors in pixels: metres times focal over the true depth, as the thresholds see them.",
    "sideways": "an error along the ray counts as well: use all three coordinates.",
    "hidden too": "only moments in which the point is visible in truth are scored.",
    "sum": "the mean, not the sum: a track that is seen for long is not worse for that.",
    "largest": "the mean over the moments, not the worst moment.",
    "end": "over all visible moments, not the last frame alone.",
    "never seen": "a track that is never visible has no error; it must not lead the list.",
    "best": "largest error first; argsort sorts upward.",
    "sorted": "keep the order by error, do not sort the indices.",
    "worst last": "worst first.",
}

WORST = Exercise(
    "07.worst",
    reference=worst,
    cases=_tracked,
    mistakes=slips(worst, _WORST_HINTS),
)

EXERCISES = (SCORES, RASTER, INTERVAL, WORST)
