"""Exercises of notebook 05, first part: the token of equation (2), and one group of the updater's blocks."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from lessons.checker import Exercise, slips
from lessons.n05_windows import BACKWARD, HAND_OVER, WINDOWS
from tapip3d_lite.model.blocks import fourier

Look = Callable[..., Tensor]


def token(
    coords: Tensor, logits: Tensor, evidence: Tensor, uv: Tensor, size: tuple[int, int], time: Tensor, slip: str = ""
) -> Tensor:
    """Coordinates (S, N, 3), logits (S, N), evidence (S, N, L D), pixels (S, N, 2), time (S, G): tokens (S, N, G)."""
    last, first = (coords[:1], coords[-1:]) if slip == "wrapped" else (coords[-1:], coords[:1])
    to_next, to_last = coords - torch.cat([coords[1:], last]), coords - torch.cat([first, coords[:-1]])
    to_next, to_last = {
        "paper": (-to_next, to_last),
        "signs": (-to_next, -to_last),
        "past": (to_last, to_next),
        "place": (coords, coords),
    }.get(slip, (to_next, to_last))
    waves = fourier(torch.cat([to_next, to_last], -1))
    waves = torch.cat([fourier(to_next), fourier(to_last)], -1) if slip == "apart" else waves
    evidence = evidence.detach() if slip == "detached" else evidence
    logits = logits.sigmoid() if slip == "sigmoid" else logits
    parts = [logits[..., None], evidence, waves, fourier(_pixels(uv, size, slip))]
    whole = torch.cat(parts if slip != "late logit" else [*parts[1:], parts[0]], -1)
    if slip == "appended":
        return torch.cat([whole, time[:, None].expand_as(whole)], -1)
    return whole if slip == "timeless" else whole + time[:, None]


def _pixels(uv: Tensor, size: tuple[int, int], slip: str) -> Tensor:
    sides = torch.tensor(size if slip == "rows" else size[::-1], dtype=uv.dtype)
    limit = {"unlimited": 1e9 * sides, "once": sides, "short": 2 * (sides - 1)}.get(slip, 2 * sides)
    inside = torch.minimum(torch.maximum(uv, 0 * limit if slip == "positive" else -limit), limit)
    return inside if slip == "raw" else inside / (sides if slip == "whole sides" else sides - 1)


def _token_case(rng: np.random.Generator, size: int) -> tuple:
    sides = tuple(int(x) for x in rng.permutation([8 + 4 * size, 13 + 6 * size]) + 1)
    frames, tracks, width = size + 2, size, 2 * size
    shapes = (frames, tracks, 3), (frames, tracks), (frames, tracks, width)
    uv = rng.uniform(-0.2, 1.2, size=(frames, tracks, 2)) * sides[::-1]
    far = rng.choice([-2.6, -1.9, 2.4, 1.2], size=uv.shape) * sides[::-1]  # left behind by the camera
    uv = np.where(rng.random(uv.shape) < 0.4, far, uv)
    uv[0, 0], uv[1, 0] = (2.6 * sides[1], -1.2 * sides[0]), (-2.6 * sides[1], 2.6 * sides[0])
    time = rng.normal(size=(frames, 1 + width + 264))
    coords, logits, evidence, uv, time = map(torch.from_numpy, (*map(rng.normal, *_normal(shapes)), uv, time))
    return coords, logits, evidence, uv, sides, time


def _normal(shapes: tuple) -> tuple:
    return (0.0,) * len(shapes), (1.0,) * len(shapes), shapes


_TOKEN_HINTS = {
    "wrapped": "the window has no frame before its first or after its last: that difference is 0.",
    "paper": "that is how the paper writes motion, the next minus this; the released code and this exercise take this "
    "minus the next.",
    "signs": "both signs are turned: this estimate minus its neighbours in time, not the neighbours minus this one.",
    "past": "the motion to the next frame comes first, then that to the one before.",
    "place": "the token has differences, not positions.",
    "apart": "join both motions to six numbers, then take the features once: all numbers, all sines, all cosines.",
    "detached": "the evidence must keep its history: through it the loss reaches N2N and the encoder.",
    "sigmoid": "the token holds the logit itself, not its sigmoid.",
    "late logit": "visibility comes first.",
    "rows": "u belongs to the width: size is (H, W), pixels are (u, v).",
    "whole sides": "the centre of the last pixel lies at W - 1 and should become 1.",
    "raw": "divide pixels by (W - 1, H - 1): a place in the image, whatever its size.",
    "unlimited": "a point far outside the image counts as one at 2 W or 2 H at most, on either side.",
    "once": "the limit is twice the image's side, not once.",
    "short": "the limit is 2 W and 2 H; the 1 is subtracted only from what you divide by.",
    "positive": "the limit to the left and above is -2 W and -2 H, not 0.",
    "appended": "the paper sets the time beside the rest; the released code and this exercise add it.",
    "timeless": "the embedding of time is missing: (S, G), the same for all tracks of a frame.",
}  # fmt: skip

TOKEN = Exercise(
    "05.token",
    reference=token,
    cases=_token_case,
    mistakes=slips(token, _TOKEN_HINTS),
    tolerance=2e-3,  # in single precision the fastest waves are off by 1e-3
    gradients=(2,),
)


class Attention:
    """Attention with random weights, without norms or MLP, as a case of an exercise: `x + attention(x, seen)`."""

    def __init__(self, width: int, seed: int, name: str) -> None:
        self.weights = torch.randn(3, width, width, generator=torch.Generator().manual_seed(seed)).double() / 2
        self.name = name

    def __call__(self, x: Tensor, seen: Tensor | None = None) -> Tensor:
        """(..., X, U) that looks at seen (..., Y, U), or at itself."""
        seen = x if seen is None else seen
        query, key, value = self.weights.to(x.dtype)
        scores = x @ query @ (seen @ key).transpose(-1, -2) / x.shape[-1] ** 0.5
        return x + scores.softmax(-1) @ (seen @ value)

    def __repr__(self) -> str:
        return f"<{self.name}>"


def update_group(x: Tensor, count: int, over_time: Look, read: Look, talk: Look, write: Look, slip: str = "") -> Tensor:
    """Tokens (S, N + V, U), points first, after a look over time and the way through virtual tracks; same shape."""
    if slip == "points in time":
        x = torch.cat([_over_frames(over_time, x[:, :count]), x[:, count:]], 1)
    elif slip != "timeless":
        x = over_time(x) if slip == "tracks as time" else _over_frames(over_time, x)
    points, virtual = x[:, :count], x[:, count:]
    if slip == "all look at all":
        return over_time(x)
    if slip == "write first":
        points = write(points, virtual)
    old, virtual = virtual, read(virtual, points.detach() if slip == "detached" else points)
    if slip == "talk first":
        virtual = read(talk(old), points)
    elif slip != "no talk":
        virtual = talk(virtual)
    if slip != "write first":
        points = write(points, old if slip == "old virtual" else virtual)
    if slip == "swapped":
        return torch.cat([virtual, points], 1)
    return torch.cat([points, old if slip == "forgotten" else virtual], 1)


def _over_frames(over_time: Look, x: Tensor) -> Tensor:
    return over_time(x.transpose(0, 1)).transpose(0, 1)


def _group_case(rng: np.random.Generator, size: int) -> tuple:
    width, count = size + 3, size + 2
    x = torch.from_numpy(rng.normal(size=(size + 1, count + size, width)))
    names = "attention over time", "virtual read points", "virtual talk", "points read virtual"
    return x, count, *(Attention(width, int(rng.integers(1 << 30)), name) for name in names)


_GROUP_HINTS = {
    "tracks as time": "a block looks along the last axis but one: bring the frames there, and back afterwards.",
    "points in time": "virtual tracks are tracks: they look over time, too.",
    "timeless": "the group begins with the look over time.",
    "no talk": "between reading and writing the virtual tracks look at each other.",
    "talk first": "virtual tracks read first, and then talk about what they have read.",
    "write first": "points read last: they hear what the virtual tracks have just learnt.",
    "old virtual": "points must read the virtual tracks as they are after talking, not as they were.",
    "forgotten": "the next group goes on with the virtual tracks as they are now: return those.",
    "swapped": "points stand first, virtual tracks behind them.",
    "detached": "what points tell the virtual tracks must keep its history.",
    "all look at all": "points never look at points; they go through read, talk and write.",
}

GROUP = Exercise(
    "05.group",
    reference=update_group,
    cases=_group_case,
    mistakes=slips(update_group, _GROUP_HINTS),
    tolerance=1e-3,
    gradients=(0,),
)

EXERCISES = (TOKEN, GROUP, WINDOWS, HAND_OVER, BACKWARD)
