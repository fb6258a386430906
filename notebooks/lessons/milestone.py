"""Milestones: the learner's own functions at their places in the tracker, and the tracks that they give.

Each lesson's `parts(use)` names places in the library, as `"module:attribute"`, and what stands there while the
functions are plugged in: `use("01.unproject")` gives the learner's function, or the reference while there is none.
Where lessons meet, one may name places in `KEPT` that another one must leave to the library, as its own functions
would not be called any more.
Tracks are computed in double precision: the method amplifies differences of the last digit, and in single precision
two right orders of summation could give different tracks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import cache
from importlib import import_module
from itertools import product
from pathlib import Path
from unittest import mock

import numpy as np
import torch

import tapip3d_lite as t3d
from lessons import progress
from lessons.verdict import Verdict
from tapip3d_lite.model.frames import Frames, frames_from_clip
from tapip3d_lite.model.registry import make_module

Use = Callable[[str], Callable[..., object]]
Pass = Callable[[np.ndarray], np.ndarray]  # queries (N, 4) to tracks (T, N, 3)
CLIP = Path(__file__).parents[2] / "data_samples" / "handheld.npz"
_FRAMES, _POINTS = 16, 16  # three windows
_METRES = 1e-3


def milestone(
    *lessons: str, spaces: tuple[str | None, ...] = (None,), neighborhoods: tuple[str | None, ...] = (None,)
) -> Verdict:
    """Track a clip with the learner's functions of some lessons, e.g. `milestone("03")`, and compare with the library.

    `spaces` are those to track in and `neighborhoods` the kinds to track with, None for the tracker's own. Where a
    lesson has `BOTH_WAYS`, points are asked for in all frames and tracked both ways in time.
    Passed: each function is the learner's, the tracker called each, and no point is off by a millimetre.
    """
    calls: dict[str, int] = {}
    late = any(getattr(import_module(f"lessons.n{lesson}"), "BOTH_WAYS", False) for lesson in lessons)
    with plugged(lessons, calls):
        mine = {form: _tracks(*form) for form in product(spaces, [late], neighborhoods)}
    apart = max(float(np.abs(xyz - _library(*form)).max()) for form, xyz in mine.items())
    where = f", in the spaces {', '.join(map(str, spaces))}" if spaces != (None,) else ""
    where += f", with the neighbourhoods {', '.join(map(str, neighborhoods))}" if neighborhoods != (None,) else ""
    opening = f"{len(calls)} functions in the tracker; tracks of {_POINTS} points over {_FRAMES} frames{where}"
    return report(calls, apart < _METRES, opening, f"largest distance from the library's tracks: {1000 * apart:.4f} mm")


def report(calls: Mapping[str, int], agrees: bool, opening: str, closing: str) -> Verdict:
    """What a milestone says: whose each function is and how often it was called, between an opening and a closing line.

    Passed: all are the learner's, the library called each, and the result agrees with the library's.
    """
    rows = [f"  {name}: {progress.whose(name)}, called {count} times" for name, count in calls.items()]
    message = "\n".join([opening, *rows, closing])
    if not agrees or 0 in calls.values():
        return Verdict("wrong", message)
    return Verdict("passed" if all(map(progress.is_yours, calls)) else "not attempted", message)


class plugged:
    """A context in which the functions of some lessons stand in the library.

    Args:
        lessons: numbers, e.g. `("01", "03")`.
        calls: is filled with the number of calls of each exercise's function.
    """

    def __init__(self, lessons: tuple[str, ...], calls: dict[str, int]) -> None:
        self.calls = calls
        self.places: dict[str, object] = {}
        modules = [import_module(f"lessons.n{lesson}") for lesson in lessons]
        for module in modules:
            self.places |= module.parts(self._use)
        for place in (place for module in modules for place in getattr(module, "KEPT", ())):
            self.places.pop(place, None)
        self._stack = ExitStack()

    def _use(self, name: str) -> Callable[..., object]:
        function = progress.in_use(name, quiet=True)
        self.calls[name] = 0

        def counted(*arguments: object, **named: object) -> object:
            self.calls[name] += 1
            return function(*arguments, **named)

        return counted

    def __enter__(self) -> plugged:
        for place, part in self.places.items():
            module, _, attribute = place.partition(":")
            owner = import_module(module)
            *path, last = attribute.split(".")
            for name in path:
                owner = getattr(owner, name)
            self._stack.enter_context(mock.patch.object(owner, last, part))
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()


def frames_and_queries(late: bool = False) -> tuple[Frames, torch.Tensor]:
    """The first frames of a clip and queries (1, N, 4) in half of them, or in all, in double precision."""
    clip = t3d.load_clip(CLIP)
    rows = clip.tracks.queries[clip.tracks.queries[:, 0] < (_FRAMES if late else _FRAMES // 2)]
    queries = torch.from_numpy(rows[:: len(rows) // _POINTS][:_POINTS]).double()[None]
    frames = frames_from_clip(clip).cut(0, _FRAMES)
    rgb, depths, intrinsics, poses = (
        x.double() for x in (frames.rgb, frames.depths, frames.intrinsics, frames.extrinsics)
    )
    # A rotation of seven digits has a transpose that is not quite its inverse, and right answers may use either.
    left, _, right = torch.linalg.svd(poses[..., :3, :3])
    poses[..., :3, :3] = left @ right
    return Frames(rgb, depths, intrinsics, poses), queries


def both_ways(forward: Pass, backward: Pass, queries: np.ndarray) -> np.ndarray:
    """Tracks (T, N, 3) joined from two passes as `model.track.track` joins them, which knows single precision only."""
    there, turned = forward(queries), queries.copy()
    turned[:, 0] = len(there) - 1 - turned[:, 0]
    before = np.arange(len(there))[:, None] < queries[:, 0]
    return np.where(before[..., None], backward(turned)[::-1], there)


def _tracks(space: str | None = None, late: bool = False, neighborhood: str | None = None) -> np.ndarray:
    tracker, (frames, queries) = t3d.load_tracker("lite", fast=False).double(), frames_and_queries(late)
    tracker.config = replace(tracker.config, image_size=frames.size)  # no image is resized: less to wait for
    if neighborhood:
        config = replace(tracker.config, neighborhood=neighborhood)
        tracker.neighborhood = make_module("neighborhood", config, fast=False)

    def way(frames: Frames) -> Pass:
        return lambda rows: tracker(frames, torch.from_numpy(rows)[None], space=space)[0][0].numpy()

    rows = queries[0].numpy()
    with torch.no_grad():
        return both_ways(way(frames), way(frames.flip()), rows) if late else way(frames)(rows)


_library = cache(_tracks)
