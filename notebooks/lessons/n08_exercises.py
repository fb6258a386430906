"""Exercises of notebook 08: mean squares of seeds and clips, Holm's correction, a claim's verdict, what a study can see."""

from __future__ import annotations

import numpy as np

from lessons.checker import Exercise, slips

Array = np.ndarray


def mean_squares(d: Array, slip: str = "") -> tuple:
    """Mean squares A, B, E of seeds, clips and the rest of differences (S, C)."""
    seeds, clips = d.shape
    of_seeds, of_clips, mean = d.mean(1, keepdims=True), d.mean(0, keepdims=True), d.mean()
    if slip == "swapped":
        seeds, clips, of_seeds, of_clips = clips, seeds, of_clips, of_seeds
    less = 0 if slip == "divided by S" else 1
    a = ((of_seeds - mean) ** 2).sum() / (seeds - less) * (1 if slip == "no factors" else clips)
    b = ((of_clips - mean) ** 2).sum() / (clips - less) * (1 if slip == "no factors" else seeds)
    rest = {"seeds left in": d - of_clips, "clips left in": d - of_seeds, "mean twice": d - of_seeds - of_clips}
    rest = rest.get(slip, d - of_seeds - of_clips + mean)
    free = d.size if slip == "rest divided by SC" else (seeds - 1) * (clips - 1)
    e = (rest**2).sum() / free
    return tuple(map(float, np.sqrt([a, b, e]) if slip == "root" else (a, b, e)))


def _scored(rng: np.random.Generator, size: int) -> tuple:
    """Differences with a mean, effects of seeds and of clips, and a rest."""
    seeds, clips = size + 1, 2 * size + 3
    parts = rng.normal(0.3, 0.1), rng.normal(0, 0.2, (seeds, 1)), rng.normal(0, 0.4, clips)
    return (sum(parts) + rng.normal(0, 0.1, (seeds, clips)),)


_SQUARES_HINTS = {
    "swapped": "d[s, c]: the first axis counts seeds. A is the mean square of seeds, so of the means over clips.",
    "divided by S": "S means around their own mean have S - 1 degrees of freedom, C clips C - 1.",
    "no factors": "a seed's mean is over C clips: its square counts C times; that of a clip's mean S times.",
    "seeds left in": "the rest has neither: subtract the mean of the clip and that of the seed, then add the grand mean.",
    "clips left in": "the rest has neither: subtract the mean of the seed and that of the clip, then add the grand mean.",
    "mean twice": "the grand mean is in both means; once it must be added again.",
    "rest divided by SC": "the rest has (S - 1)(C - 1) degrees of freedom.",
    "root": "mean squares, not their roots.",
}

SQUARES = Exercise(
    "08.squares",
    reference=mean_squares,
    cases=_scored,
    mistakes=slips(mean_squares, _SQUARES_HINTS),
    tolerance=1e-8,
)


def holm(p: Array, slip: str = "") -> Array:
    """Holm's correction of p-values (m,), in their own order."""
    p = np.asarray(p, float)
    order, count = np.argsort(-p if slip == "from the largest" else p, kind="stable"), len(p)
    factors = {
        "all alike": np.full(count, count),
        "rising": np.arange(1, count + 1),
        "one less": count - 1 - np.arange(count),
    }
    raised = factors.get(slip, count - np.arange(count)) * p[order]
    if slip != "falls again":
        raised = np.maximum.accumulate(raised)
    if slip != "above 1":
        raised = np.minimum(raised, 1)
    if slip == "sorted":
        return raised
    back = np.empty(count)
    back[order] = raised
    return back


def _family(rng: np.random.Generator, size: int) -> tuple:
    """Some small p-values, two of them close together, and large ones; in no order."""
    p = np.concatenate([rng.uniform(0, 0.02, size + 1), rng.uniform(0.3, 1, size), [0.011, 0.0111]])
    return (rng.permutation(p),)


_HOLM_HINTS = {
    "from the largest": "begin with the smallest p-value: it must be small enough for all m comparisons.",
    "all alike": "that is Bonferroni. The second smallest has one comparison less beside it: m - 1, then m - 2, …",
    "rising": "the factors fall: m for the smallest p-value, 1 for the largest.",
    "one less": "the smallest gets m, not m - 1; the largest keeps its own value.",
    "falls again": "a larger p-value may not end up below a smaller one: take the running maximum.",
    "above 1": "no p-value is above 1.",
    "sorted": "put the values back into the order in which they came.",
}

HOLM = Exercise("08.holm", reference=holm, cases=_family, mistakes=slips(holm, _HOLM_HINTS), tolerance=1e-8)


def beside_paper(theirs: Array, ours: Array, p: Array, slip: str = "") -> Array:
    """+1 where a claim of the paper holds, -1 where it does not, 0 where that is undecided: (m,) differences and p-values."""
    decided = p < 0.05 if slip == "not at 5 %" else p <= 0.05
    if slip == "sign alone":
        decided = np.ones_like(decided)
    sign = np.sign(theirs) * np.sign(ours)
    if slip == "ours alone":
        sign = np.sign(ours) * (theirs != 0)
    if slip == "a tie agrees":
        sign = np.where(theirs == 0, 1, sign)
    if slip == "size":
        sign = np.where((sign > 0) & (np.abs(ours) < np.abs(theirs)), -1, sign)
    return np.where(decided, sign, -1 if slip == "undecided is no" else 0).astype(int)


def _claims(rng: np.random.Generator, size: int) -> tuple:
    """Every kind of claim: decided or not, on either side, smaller than the paper's or larger, a tie there."""
    kinds = np.array([(t, o, p) for t in (-1, 0, 1) for o in (-1, 1) for p in (0, 1)])
    kinds = rng.permutation(np.concatenate([kinds] * size))
    theirs, ours = kinds[:, 0] * rng.uniform(0.05, 0.1, len(kinds)), kinds[:, 1] * rng.uniform(0.001, 0.2, len(kinds))
    p = np.where(kinds[:, 2], rng.uniform(0.06, 1, len(kinds)), rng.uniform(0, 0.04, len(kinds)))
    p[np.argmax(kinds[:, 0] * kinds[:, 1] != 0)] = 0.05
    return theirs, ours, p


_BESIDE_HINTS = {
    "sign alone": "where our study does not know (p above 0.05), no sign is worth anything: undecided.",
    "undecided is no": "not to know is not to disagree.",
    "not at 5 %": "0.05 itself still counts as decided.",
    "a tie agrees": "where the paper has no difference, there is no sign to agree with: undecided.",
    "size": "the sign is the claim; sizes depend on data and budget, which are not the paper's.",
    "ours alone": "compare our sign with the paper's.",
}

BESIDE = Exercise("08.beside", reference=beside_paper, cases=_claims, mistakes=slips(beside_paper, _BESIDE_HINTS))


def smallest_seen(seed_sd: float, clip_sd: float, rest_sd: float, seeds: int, clips: int, slip: str = "") -> float:
    """The difference that S seeds and C clips see in four of five cases, if its three parts vary so much."""
    a, b, e = seed_sd**2, clip_sd**2, rest_sd**2
    variance = {
        "all over SC": (a + b + e) / (seeds * clips),
        "no seeds": b / clips + e / (seeds * clips),
        "seeds over C": a / clips + b / seeds + e / (seeds * clips),
        "deviations": seed_sd / seeds + clip_sd / clips + rest_sd / (seeds * clips),
    }.get(slip, a / seeds + b / clips + e / (seeds * clips))
    factor = {"interval alone": 1.96, "power alone": 0.84, "ninety": 1.96 + 1.28}.get(slip, 1.96 + 0.84)
    return float(factor * (variance if slip == "no root" else np.sqrt(variance)))


def _planned(rng: np.random.Generator, size: int) -> tuple:
    return *map(float, rng.uniform(0.01, 0.1, 3) * size), size + 1, 5 * size + int(rng.integers(1, 5))


_SEEN_HINTS = {
    "all over SC": "a seed's effect is the same on all its clips: more clips do not average it away, only more seeds do.",
    "no seeds": "seeds vary, too: seed_sd ** 2 / S.",
    "seeds over C": "the effect of seeds shrinks with their number S, that of clips with C.",
    "deviations": "variances add, deviations do not.",
    "no root": "the standard error is the root of the variance.",
    "interval alone": "at 1.96 standard errors half of all studies miss it; 0.84 more for four of five.",
    "power alone": "1.96 standard errors for the interval come first.",
    "ninety": "1.28 is for nine of ten; four of five is 0.84.",
}

SEEN = Exercise(
    "08.seen",
    reference=smallest_seen,
    cases=_planned,
    mistakes=slips(smallest_seen, _SEEN_HINTS),
    tolerance=1e-8,
)

EXERCISES = (SQUARES, HOLM, BESIDE, SEEN)
