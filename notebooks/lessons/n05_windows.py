"""Exercises of notebook 05, second part: where windows start, what one hands to the next, and time run backward."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lessons.checker import Exercise, Mistake

Array = np.ndarray
Pass = Callable[[Array], Array]


def window_starts(frames: int, window: int) -> Array:
    """First frames of the windows of a clip that is padded to whole half windows: 0, S / 2, S, ..."""
    half = window // 2
    return np.arange(0, _padded(frames, half) - window + 1, half)


def _padded(frames: int, multiple: int) -> int:
    return -(-frames // multiple) * multiple


def _windows_case(rng: np.random.Generator, size: int) -> tuple:
    half = size
    short, longer = rng.integers(1, half + 1), rng.integers(half + 1, 6 * half + 1)
    return int(short if rng.random() < 0.3 else longer), 2 * half


WINDOWS = Exercise(
    "05.windows",
    reference=window_starts,
    cases=_windows_case,
    mistakes=(
        Mistake("no overlap", lambda t, s: np.arange(0, t, s), "windows overlap by half: each starts S / 2 later."),
        Mistake(
            "not padded",
            lambda t, s: np.arange(0, t - s + 1, s // 2),
            "the last frames are in no window; pad the clip to a multiple of S / 2 first.",
        ),
        Mistake(
            "padded to whole windows",
            lambda t, s: np.arange(0, _padded(t, s) - s + 1, s // 2),
            "pad to whole half windows: a multiple of S / 2, not of S.",
        ),
        Mistake(
            "never fewer than one",
            lambda t, s: np.arange(0, max(_padded(t, s // 2), s) - s + 1, s // 2),
            "a clip of at most S / 2 frames has no window at all: its points stay at their queries.",
        ),
        Mistake(
            "windows over the end",
            lambda t, s: np.arange(0, t, s // 2),
            "a window must end within the padded clip: start + S <= padded length.",
        ),
        Mistake(
            "last window lost",
            lambda t, s: np.arange(0, _padded(t, s // 2) - s, s // 2),
            "the window that ends with the padded clip counts, too.",
        ),
        Mistake("ends in place of starts", lambda t, s: window_starts(t, s) + s, "these are the ends; subtract S."),
    ),
)


def hand_over(coords: Array, vis: Array, queries: Array, start: int, slip: str = "") -> tuple[Array, Array]:
    """What the window at `start` begins with: coords (S, N, 3) and logits (S, N) from those of the window before."""
    half = len(coords) // 2
    known = {
        "one frame too long known": queries[:, 0] <= start + half,
        "late from start on": queries[:, 0] < start,
        "all known": queries[:, 0] < np.inf,
        "late one frame too early": queries[:, 0] < start + half - 1,
    }.get(slip, queries[:, 0] < start + half)
    rest = np.repeat(coords[-1:], half, 0), np.repeat(vis[-1:], half, 0)
    if slip == "query":
        rest = np.repeat(queries[None, :, 1:], half, 0), rest[1]
    if slip == "extrapolated":
        rest = rest[0] + (coords[-1] - coords[-2]) * np.arange(1, half + 1)[:, None, None], rest[1]
    if slip == "first repeated":
        rest = np.repeat(coords[half : half + 1], half, 0), np.repeat(vis[half : half + 1], half, 0)
    if slip == "unseen":
        rest = rest[0], 0 * rest[1]
    shared = (coords[:half], vis[:half]) if slip == "first half" else (coords[half:], vis[half:])
    whole = [np.concatenate(pair) for pair in zip(shared, rest, strict=True)]
    whole = [coords, vis] if slip == "whole window" else whole
    first = np.where(known[:, None], whole[0], queries[:, :3] if slip == "time as place" else queries[:, 1:])
    return first, whole[1] if slip == "vis kept" else np.where(known, whole[1], 0)


def _hand_over_case(rng: np.random.Generator, size: int) -> tuple:
    half = size + 1
    start = half * int(rng.integers(1, 4))
    times = np.r_[start, start + half - 1, start + half, start + 2 * half - 1, rng.integers(0, start + 2 * half, size)]
    times = rng.permutation(times)
    queries = np.concatenate([times[:, None], rng.normal(size=(len(times), 3))], -1)
    return rng.normal(size=(2 * half, len(times), 3)), rng.normal(size=(2 * half, len(times))), queries, start


_HAND_OVER_HINTS = {
    "whole window": "both windows share S / 2 frames only.",
    "first half": "the shared frames are the second half of the window before.",
    "query": "the best guess for new frames is the last known position.",
    "extrapolated": "the last position is repeated; nothing is extrapolated.",
    "first repeated": "it is the LAST frame of the window before that is repeated.",
    "unseen": "visibility is handed over like the place: the last logit is repeated.",
    "all known": "a track queried in the new half has no history: it starts at its query in all frames.",
    "vis kept": "a late track has no visibility yet, either: its logit starts as 0.",
    "one frame too long known": "frame start + S / 2 is the first new one; a query there is late already.",
    "late from start on": "a query in the first half is not late: the window before contained that frame and has solved the track.",
    "late one frame too early": "frame start + S / 2 - 1 still belongs to the shared half; a query there is not late.",
    "time as place": "queries are rows (t, x, y, z): the place is columns 1 to 3.",
}


def _hand_over(slip: str) -> Callable[..., tuple[Array, Array]]:
    return lambda *case: hand_over(*case, slip=slip)


HAND_OVER = Exercise(
    "05.hand_over",
    reference=hand_over,
    cases=_hand_over_case,
    mistakes=tuple(Mistake(slip, _hand_over(slip), hint) for slip, hint in _HAND_OVER_HINTS.items()),
)


class Flight:
    """A stand-in for a tracker, as a case of an exercise: queries (N, 4) to tracks (T, N, 3)."""

    def __init__(self, frames: int, speed: Array, miss: float, name: str) -> None:
        self.frames, self.speed, self.miss, self.name = frames, speed, miss, name

    def __call__(self, queries: Array) -> Array:
        """Straight flights close by the queries, each at its own speed."""
        turned = self.speed * (1 + np.arange(len(queries)))[:, None]  # a track has its own speed
        after = np.arange(self.frames)[:, None] - queries[:, 0]
        return queries[:, 1:] + after[..., None] * turned + self.miss

    def __repr__(self) -> str:
        return f"<{self.name} pass>"


def both_ways(forward: Pass, backward: Pass, queries: Array, slip: str = "") -> Array:
    """Tracks (T, N, 3) of queries (N, 4): before each query's frame from the pass backward, else from the one forward."""
    there = forward(queries)
    frames, times = len(there), queries[:, 0]
    turned = queries.copy()
    turned[:, 0] = {"length": frames - times, "unturned": times, "negative": -times}.get(slip, frames - 1 - times)
    back = backward(turned)
    back = back if slip == "not turned back" else back[::-1]
    t = np.arange(frames)[:, None]
    before = {
        "query frame from the wrong pass": t <= times,
        "sides exchanged": t > times,
        "queries overwritten": t < turned[:, 0],
    }.get(slip, t < times)
    if slip == "mean":
        return (there + back) / 2
    return there if slip == "forward" else np.where(before[..., None], back, there)


def _backward_case(rng: np.random.Generator, size: int) -> tuple:
    frames = size + 3
    times = rng.permutation(np.r_[0, frames - 1, rng.integers(0, frames, size)])
    queries = np.concatenate([times[:, None], rng.normal(size=(len(times), 3))], -1)
    return *(Flight(frames, rng.normal(size=3), rng.normal(), name) for name in ("forward", "backward")), queries


def _both_ways(slip: str) -> Callable[..., Array]:
    return lambda *case: both_ways(*case, slip=slip)


_BACKWARD_HINTS = {
    "length": "the last frame, T - 1, becomes frame 0: a query at t becomes one at T - 1 - t.",
    "unturned": "the reversed clip has other frame numbers: a query at t is one at T - 1 - t there.",
    "negative": "a query at t becomes one at T - 1 - t; a negative frame is in no clip.",
    "not turned back": "row 0 of the second pass is the clip's last frame; reverse it.",
    "query frame from the wrong pass": "only frames BEFORE the query come from the pass backward.",
    "sides exchanged": "from the query on the forward pass counts; the sides are exchanged.",
    "queries overwritten": "which frames lie before a query is asked in the clip's own time: keep the queries as they were (a copy).",
    "mean": "each frame comes from one pass; nothing is averaged.",
    "forward": "the frames before a query are to come from the pass backward.",
}

BACKWARD = Exercise(
    "05.backward",
    reference=both_ways,
    cases=_backward_case,
    mistakes=tuple(Mistake(slip, _both_ways(slip), hint) for slip, hint in _BACKWARD_HINTS.items()),
)
