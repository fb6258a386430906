"""Tiny random inputs, and how a part of each switch is called with them: what `contract` tries a part with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from tapip3d_lite.geometry import pixel_grid, project
from tapip3d_lite.model.cloud import Level
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.frames import Frames
from tapip3d_lite.model.neighbors import Neighbors
from tapip3d_lite.model.spaces import World, fitted
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.model.windows import Scene, Step
from tapip3d_lite.training.loss import Truth

Tensors = dict[str, Tensor]
Outputs = dict[str, tuple[Tensor, tuple[int, ...]]]
_BATCH, _TRACKS = 2, 3
_CAMERAS, _LEVEL = ("depths", "intrinsics", "extrinsics"), ("features", "points", "valid", "coords", "cells")


class _WorldStep(Step):
    """A step in the world, which needs no autocast, since the device "meta" has none."""

    xyz = property(lambda self: self.coords)


@dataclass(frozen=True)
class Probe:
    """How the parts of one switch are tried.

    Attributes:
        contract: how they are called, in words.
        made: how a class is called.
        inputs: names of those of `random_inputs` that they are given.
        call: from a tracker that has the part, and inputs, to outputs by name, each with the shape that it should have.
        learnt: inputs whose gradients must not stop.
        tracks: axis of the tracks in those inputs that belong to tracks, where no track may depend on others.
        facts: from tracker, inputs and outputs to (what, value, wanted value) that must be equal.
    """

    contract: str
    made: str
    inputs: tuple[str, ...]
    call: Callable[[Tracker, Tensors], Outputs]
    learnt: tuple[str, ...]
    tracks: dict[str, int] = field(default_factory=dict)
    facts: Callable[[Tracker, Tensors, Tensors], list[tuple[str, Tensor, Tensor]]] = lambda *_: []


def random_inputs(config: TrackerConfig, g: torch.Generator, channels: int) -> Tensors:
    """Two clips of S frames with all that a part may be given; of three tracks the last one is not active.

    Depths have holes, cameras turn a little; `points` and `coords` are normalised, `xyz` is true and `estimate` near it.
    `channels` are those of tokens.
    """
    (height, width), (h, w), lead = config.image_size, config.grid_sizes[-1], (_BATCH, config.window)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*lead, *shape, generator=g)

    def randn(*shape: int) -> Tensor:
        return torch.randn(*lead, *shape, generator=g)

    extrinsics, angle, valid = torch.eye(4).repeat(*lead, 1, 1), 0.2 * rand(), rand(h, w) > 0.1
    extrinsics[..., 0, 0] = extrinsics[..., 2, 2] = angle.cos()
    extrinsics[..., 0, 2], extrinsics[..., 2, 0] = angle.sin(), -angle.sin()
    extrinsics[..., :3, 3] = 0.1 * randn(3)
    xyz, visible = torch.tensor([0.0, 0.0, 2.5]) + 0.3 * randn(_TRACKS, 3), rand(_TRACKS) > 0.3
    visible[:, 1], visible[:, 2, 0] = True, False
    return {
        "rgb": rand(3, height, width),
        "depths": torch.where(rand(height, width) > 0.1, 2 + rand(height, width), 0.0),
        "intrinsics": torch.tensor([[40.0, 0, width / 2], [0, 50.0, height / 2], [0, 0, 1]]).repeat(*lead, 1, 1),
        "extrinsics": extrinsics,
        "features": randn(h, w, config.feature_dim),
        "points": torch.where(valid[..., None], randn(h, w, 3), -3.0),
        "valid": valid,
        "coords": randn(_TRACKS, 3),
        "cells": rand(_TRACKS, 2) * torch.tensor([w - 1.0, h - 1.0]),
        "own": randn(_TRACKS, 1, config.feature_dim)[:, 0],
        "tokens": randn(_TRACKS, channels),
        "active": torch.tensor([[True, True, False]] * _BATCH),
        "xyz": xyz,
        "estimate": xyz + 0.1 * randn(_TRACKS, 3),
        "logits": randn(_TRACKS),
        "visible": visible,
        "times": torch.tensor([[0, 1, 0]] * _BATCH),
    }


def poor_inputs(x: Tensors) -> dict[str, Tensors]:
    """What happens in real clips, for which outputs must be finite too: the inputs that change, by what is special."""
    later = torch.arange(x["valid"].shape[1]) > 0
    empty = {name: x[name] * later[:, None, None] for name in ("valid", "depths")}
    return {
        "where a frame has no depth": {**empty, "points": x["points"] * empty["valid"][..., None]},
        "where a point projects far outside the image": {"cells": x["cells"] * 0 - 1e6, "coords": x["coords"] * 50},
        "where no point is visible": {"visible": torch.zeros_like(x["visible"])},
        "without an active track": {"active": torch.zeros_like(x["active"])},
        "where an estimate is exact": {"estimate": x["xyz"].clone()},
    }


def _space(owner: Tracker, x: Tensors) -> Outputs:
    space, cameras = fitted(owner.space, _frames(x)), (x["intrinsics"], x["extrinsics"])
    coords, own = space.from_world(x["xyz"], *cameras), [c[:, :1].expand(-1, _TRACKS, -1, -1) for c in cameras]
    points, queries = x["xyz"].shape, x["xyz"][:, 0, :, None]  # each seen by a camera of its own
    return {
        "lift": (space.lift(x["depths"], *cameras), (*x["depths"].shape, 3)),
        "from_world": (coords, points),
        "from_world of queries": (space.from_world(queries, *own), queries.shape),
        "to_world": (space.to_world(coords, *cameras, x["depths"]), points),
        "to_pixels": (space.to_pixels(coords, *cameras), (*points[:3], 2)),
    }


def _space_facts(owner: Tracker, x: Tensors, out: Tensors) -> list:
    space, cameras = fitted(owner.space, _frames(x)), (x["intrinsics"], x["extrinsics"])
    flat, seen = getattr(space, "free_axes", (1.0, 1.0, 1.0))[2] == 0, project(x["xyz"], *cameras)[0]
    pixels = space.to_pixels(out["lift"].flatten(2, 3), *cameras).unflatten(2, x["depths"].shape[2:])
    known, grid = x["depths"] > 0, pixel_grid(*x["depths"].shape[2:], x["depths"]).expand(pixels.shape)
    return [
        ("to_world is not the inverse of from_world", x["xyz"] if flat else out["to_world"], x["xyz"]),
        ("to_pixels of from_world is not where the camera sees the point", out["to_pixels"], seen),
        ("to_pixels of lift is not the pixel that was lifted", pixels[known], grid[known]),
    ]


def _neighborhood(owner: Tracker, x: Tensors) -> Outputs:
    near, lead = owner.neighborhood(_level(x), x["coords"], x["cells"]), x["coords"].shape[:3]
    count = near.points.shape[3] if near.points.ndim == 5 else owner.config.neighbors
    out = {"features": (near.features, (*lead, count, x["features"].shape[-1]))}
    out |= {"points": (near.points, (*lead, count, 3)), "center": (near.center, (*lead, 3))}
    return out if near.indices is None else {**out, "indices": (near.indices, (*lead, count))}


def _neighborhood_facts(owner: Tracker, x: Tensors, out: Tensors) -> list:
    index, cells = out.get("indices", torch.zeros(1)), x["points"].shape[2] * x["points"].shape[3]
    return [
        ("center is not the coords that were asked for", out["center"], x["coords"]),
        ("indices lie outside the h * w cells of a frame", index, index.clamp(0, cells - 1)),
    ]


def _context(owner: Tracker, x: Tensors) -> Outputs:
    level, center, out = _level(x), x["coords"][:, 0], {}
    near = owner.neighborhood(level, x["coords"], x["cells"])
    both = [torch.cat(x, 2) for x in ((x["own"], near.features[:, 0]), (center[:, :, None], near.points[:, 0]))]
    for i in sorted({0, owner.config.levels - 1}):
        near = owner.neighborhood(owner.context.prepare(i, level), x["coords"], x["cells"])
        kept = owner.context.describe(i, Neighbors(*both, center))
        out[f"level {i}"] = owner.context(i, kept, near), (*x["coords"].shape[:3], owner.context.width)
    return out


def _updater(owner: Tracker, x: Tensors) -> Outputs:
    out = owner.updater(x["tokens"], x["active"])
    return {"corrections": (out, (*x["tokens"].shape[:3], max(4, out.shape[-1])))}


def _loss(owner: Tracker, x: Tensors) -> Outputs:
    frames, space, truth = _frames(x), World(), x["xyz"][:, :-1].clone()  # the last frame is padded
    truth[:, 2, 0] = torch.nan
    cloud = space.lift(frames.depths, frames.intrinsics, frames.extrinsics)
    scene, columns = Scene(frames, cloud, frames.depths > 0, [], space), torch.arange(_TRACKS, device=truth.device)
    step = _WorldStep(0, 0, x["estimate"], x["logits"], columns, x["active"], scene)
    terms = owner.loss(step, Truth(truth, x["visible"][:, :-1], x["times"]), 2)
    if not isinstance(terms, tuple | list) or len(terms) != 2:
        raise TypeError(f"it returned {type(terms).__name__}, not a tuple (position, visibility)")
    return {"position": (terms[0], ()), "visibility": (terms[1], ())}


def _frames(x: Tensors) -> Frames:
    return Frames(x["rgb"], x["depths"], x["intrinsics"], x["extrinsics"])


def _level(x: Tensors) -> Level:
    return Level(x["features"], x["points"], x["valid"])


PROBES = {
    "space": Probe(
        "lift, from_world, to_world and to_pixels as in `model.spaces.Space`", "()",
        ("rgb", *_CAMERAS, "xyz"), _space, ("xyz",), facts=_space_facts,
    ),
    "neighborhood": Probe(
        "forward(level, coords, cells) as in `model.neighbors.KNearest`", "(config)",
        _LEVEL, _neighborhood, ("features",), {"coords": 2, "cells": 2}, facts=_neighborhood_facts,
    ),
    "context": Probe(
        "prepare, describe and forward(index, kept, near) as in `model.n2n.Context`", "(config)",
        (*_LEVEL, "own"), _context, ("features", "own"), {"coords": 2, "cells": 2, "own": 1},
    ),
    "updater": Probe(
        "forward(tokens, active) as in `model.updater.Transformer`", "(config, inputs)",
        ("tokens", "active"), _updater, ("tokens",),
    ),
    "loss": Probe(
        "(step, truth, iterations) -> (position, visibility) as in `training.loss.LossConfig`", "()",
        ("rgb", *_CAMERAS, "xyz", "estimate", "logits", "visible", "times", "active"), _loss,
        ("estimate", "logits"),
    ),
}  # fmt: skip
"""The probe of each switch, and of the loss."""
