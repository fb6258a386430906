"""Exercises of notebook 05: the token, windows and what they hand over, virtual tracks, and time run backward."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lessons.checker import Exercise, Mistake
from lessons.n04_exercises import fourier_features, softmax

Array = np.ndarray


def token(coords: Array, logits: Array, evidence: Array, uv: Array, size: tuple[int, int], **slip: object) -> Array:
    """Coordinates (S, N, 3), logits (S, N), evidence (S, N, E), pixels (S, N, 2): (S, N, 1 + E + 264), no time yet."""
    after = np.concatenate([coords[1:], coords[:1] if slip.get("wrap") else coords[-1:]])
    before = np.concatenate([coords[-1:] if slip.get("wrap") else coords[:1], coords[:-1]])
    sign = -1 if slip.get("velocity") else 1
    motion = np.concatenate([coords - after, coords - before] if sign == 1 else [after - coords, coords - before], -1)
    motion = np.concatenate([motion[..., 3:], motion[..., :3]], -1) if slip.get("past first") else motion
    motion = np.concatenate([coords, coords], -1) if slip.get("absolute") else motion
    sides = np.array(size if slip.get("rows first") else size[::-1]) - (0 if slip.get("whole sides") else 1)
    return np.concatenate([logits[..., None], evidence, fourier_features(motion), fourier_features(uv / sides)], -1)


def _token_case(rng: np.random.Generator, size: int) -> tuple:
    shape = size + 2, size
    return (
        rng.normal(size=(*shape, 3)),
        rng.normal(size=shape),
        rng.normal(size=(*shape, 2 * size)),
        rng.uniform(0, 16, size=(*shape, 2)),
        (16 + size, 30 + size),
    )


def _token(**slip: object) -> Callable[..., Array]:
    return lambda *arguments: token(*arguments, **slip)


TOKEN = Exercise(
    "05.token",
    reference=token,
    cases=_token_case,
    mistakes=(
        Mistake("wrapped round", _token(wrap=True), "the window has no frame before its first or after its last: 0."),
        Mistake(
            "velocity to the next frame",
            _token(velocity=True),
            "the estimate minus that of the next frame, and the estimate minus that of the one before: self comes first.",
        ),
        Mistake("previous frame first", _token(**{"past first": True}), "motion to the next frame comes first."),
        Mistake("position in place of motion", _token(absolute=True), "the token has differences, not positions."),
        Mistake(
            "height for width", _token(**{"rows first": True}), "u belongs to the width: divide by (W - 1, H - 1)."
        ),
        Mistake(
            "pixel-centre slip",
            _token(**{"whole sides": True}),
            "the centre of the last pixel is at W - 1 and should become 1.",
        ),
    ),
)


def window_starts(frames: int, window: int) -> Array:
    """First frames of the windows of a clip that is padded to whole half windows: 0, S / 2, S, ..."""
    half = window // 2
    padded = -(-frames // half) * half
    return np.arange(0, padded - window + 1, half)


WINDOWS = Exercise(
    "05.windows",
    reference=window_starts,
    cases=lambda rng, size: (4 * (size + 1) + int(rng.integers(1, size + 1)), 2 * size + 2),
    mistakes=(
        Mistake("no overlap", lambda t, s: np.arange(0, t, s), "windows overlap by half: each starts S / 2 later."),
        Mistake(
            "not padded",
            lambda t, s: np.arange(0, t - s + 1, s // 2),
            "the last frames are in no window; pad the clip to a multiple of S / 2 first.",
        ),
        Mistake(
            "windows over the end",
            lambda t, s: np.arange(0, t, s // 2),
            "a window must end within the padded clip: start + S <= padded length.",
        ),
        Mistake(
            "ends in place of starts",
            lambda t, s: window_starts(t, s) + s,
            "these are the ends; subtract S.",
        ),
    ),
)


def hand_over(previous: Array, queries: Array, start: int) -> Array:
    """What the window at `start` begins with: previous (S, N, 3), queries (N, 4); the result is (S, N, 3)."""
    half = len(previous) // 2
    first = np.concatenate([previous[half:], np.repeat(previous[-1:], half, 0)])
    return np.where((queries[:, 0] < start + half)[:, None], first, queries[:, 1:])


def _hand_over_case(rng: np.random.Generator, size: int) -> tuple:
    start, half = size + 1, size + 1
    times = np.r_[rng.integers(0, start, size), start + half, start + half + rng.integers(0, half)]
    queries = np.concatenate([times[:, None], rng.normal(size=(len(times), 3))], -1)
    return rng.normal(size=(2 * half, len(times), 3)), queries, start


def _known(previous: Array, queries: Array, start: int, first: Array) -> Array:
    return np.where((queries[:, 0] < start + len(previous) // 2)[:, None], first, queries[:, 1:])


HAND_OVER = Exercise(
    "05.hand_over",
    reference=hand_over,
    cases=_hand_over_case,
    mistakes=(
        Mistake("whole window copied", lambda p, q, s: _known(p, q, s, p), "both windows share S / 2 frames only."),
        Mistake(
            "first half handed over",
            lambda p, q, s: _known(p, q, s, np.concatenate([p[: len(p) // 2], np.repeat(p[:1], len(p) // 2, 0)])),
            "the shared frames are the second half of the window before.",
        ),
        Mistake(
            "query in the new frames",
            lambda p, q, s: np.concatenate([p[len(p) // 2 :], np.repeat(q[None, :, 1:], len(p) // 2, 0)]),
            "the best guess for new frames is the last known position.",
        ),
        Mistake(
            "late queries forgotten",
            lambda p, q, s: np.concatenate([p[len(p) // 2 :], np.repeat(p[-1:], len(p) // 2, 0)]),
            "a track queried in the new half has no history: it starts at its query in all frames.",
        ),
        Mistake(
            "off by one in time",
            lambda p, q, s: np.where(
                (q[:, 0] <= s + len(p) // 2)[:, None],
                np.concatenate([p[len(p) // 2 :], np.repeat(p[-1:], len(p) // 2, 0)]),
                q[:, 1:],
            ),
            "frame start + S / 2 is the first new one; a query there is late already.",
        ),
    ),
)


def through_virtual(points: Array, virtual: Array, **slip: object) -> tuple[Array, Array]:
    """Points (N, D) and virtual tracks (V, D) after gather, mix and scatter, all matrices the identity."""

    def look(x: Array, y: Array) -> Array:
        scores = x @ y.T / (1 if slip.get("unscaled") else np.sqrt(x.shape[-1]))
        return (0 if slip.get("alone") else x) + softmax(scores, slip.get("axis", -1)) @ y

    gathered = look(virtual, points)
    mixed = gathered if slip.get("unmixed") else look(gathered, gathered)
    return look(points, virtual if slip.get("old") else mixed), mixed


def _virtual(**slip: object) -> Callable[..., tuple[Array, Array]]:
    return lambda points, virtual: through_virtual(points, virtual, **slip)


VIRTUAL = Exercise(
    "05.virtual",
    reference=through_virtual,
    cases=lambda rng, size: (rng.normal(size=(size + 3, size + 1)), rng.normal(size=(size + 1, size + 1))),
    mistakes=(
        Mistake("not mixed", _virtual(unmixed=True), "between reading and writing, virtual tracks look at each other."),
        Mistake("old virtual tracks", _virtual(old=True), "points look at what the virtual tracks have learnt by now."),
        Mistake("missing residual", _virtual(alone=True), "what is seen is added: x + ..."),
        Mistake("missing scale", _virtual(unscaled=True), "divide the scores by sqrt(D) before the softmax."),
        Mistake("softmax over the wrong axis", _virtual(axis=0), "each ROW of the weights sums to one."),
    ),
)


def both_directions(forward: Array, flipped: Array, times: Array) -> tuple[Array, Array]:
    """Query frames in the reversed clip (N,), and tracks (T, N, 3) joined from passes in both directions."""
    frames = len(forward)
    before = np.arange(frames)[:, None] < times
    return frames - 1 - times, np.where(before[..., None], flipped[::-1], forward)


def _joined(forward: Array, flipped: Array, before: Array) -> Array:
    return np.where(before[..., None], flipped, forward)


def _frames(x: Array) -> Array:
    return np.arange(len(x))[:, None]


BACKWARD = Exercise(
    "05.backward",
    reference=both_directions,
    cases=lambda rng, size: (
        *rng.normal(size=(2, size + 3, size + 1, 3)),
        rng.integers(1, size + 2, size + 1),
    ),
    mistakes=(
        Mistake(
            "off by one in time",
            lambda f, b, t: (len(f) - t, both_directions(f, b, t)[1]),
            "the last frame, T - 1, becomes frame 0.",
        ),
        Mistake(
            "not flipped back",
            lambda f, b, t: (len(f) - 1 - t, _joined(f, b, _frames(f) < t)),
            "row 0 of the second pass is the clip's last frame; reverse it.",
        ),
        Mistake(
            "query frame from the wrong pass",
            lambda f, b, t: (len(f) - 1 - t, _joined(f, b[::-1], _frames(f) <= t)),
            "only frames BEFORE the query come from the pass backward.",
        ),
        Mistake(
            "sides exchanged",
            lambda f, b, t: (len(f) - 1 - t, _joined(f, b[::-1], _frames(f) > t)),
            "from the query on the forward pass counts.",
        ),
    ),
)

EXERCISES = (TOKEN, WINDOWS, HAND_OVER, VIRTUAL, BACKWARD)
