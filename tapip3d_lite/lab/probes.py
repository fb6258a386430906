"""Tiny random inputs for each switch, and how a part is called with them: what `contract` tries a part with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

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

CALLS = {
    "space": "lift, from_world, to_world and to_pixels as in `model.spaces.Space`",
    "neighborhood": "forward(level, coords, cells) as in `model.neighbors.KNearest`",
    "context": "prepare, describe and forward(index, kept, near) as in `model.n2n.Context`",
    "updater": "forward(tokens, active) as in `model.updater.Transformer`",
    "loss": "(step, truth, iterations) -> (position, visibility) as in `training.loss.LossConfig`",
}
_BATCH, _TRACKS = 2, 3


class Holder(nn.Module):
    """A loss as part of a module, so that it moves like a tracker's parts."""

    def __init__(self, loss: Any) -> None:
        super().__init__()
        self.loss = loss


class _WorldStep(Step):
    """A step in the world, which needs no autocast, since the device "meta" has none."""

    xyz = property(lambda self: self.coords)


@dataclass
class Probe:
    """One part with inputs.

    Attributes:
        owner: the tracker (or `Holder`) that has the part.
        call: from an owner and inputs to outputs, by name.
        inputs: tensors that lead with B.
        expected: from outputs to the shape and dtype that each should have.
        variants: other inputs for which outputs must be finite too, by what is special about them.
        learnt: inputs whose gradients must not stop.
        tracks: axis of the tracks in those inputs that belong to tracks, where no track may depend on others.
        unused: from inputs to the same with other values where a part may not look, and why.
        facts: from inputs and outputs to (what, value, wanted value) that must be equal.
    """

    owner: nn.Module
    call: Callable[[Any, Tensors], Tensors]
    inputs: Tensors
    expected: Callable[[Tensors], dict[str, tuple[tuple[int, ...], torch.dtype]]]
    variants: dict[str, Tensors]
    learnt: tuple[str, ...]
    tracks: dict[str, int] = field(default_factory=dict)
    unused: Callable[[Tensors], tuple[Tensors, str]] | None = None
    facts: Callable[[Any, Tensors, Tensors], list[tuple[str, Tensor, Tensor]]] = lambda *_: []


def random_frames(config: TrackerConfig, g: torch.Generator, count: int) -> Tensors:
    """Depths with holes, cameras that turn a little, colours: what `Frames` takes, of two clips."""
    height, width = config.image_size
    depths = 2 + torch.rand(_BATCH, count, height, width, generator=g)
    depths[torch.rand(depths.shape, generator=g) < 0.1] = 0
    intrinsics = torch.tensor([[40.0, 0, width / 2], [0, 50.0, height / 2], [0, 0, 1]]).repeat(_BATCH, count, 1, 1)
    extrinsics = torch.eye(4).repeat(_BATCH, count, 1, 1)
    angle = 0.2 * torch.rand(_BATCH, count, generator=g)
    extrinsics[..., 0, 0] = extrinsics[..., 2, 2] = angle.cos()
    extrinsics[..., 0, 2], extrinsics[..., 2, 0] = angle.sin(), -angle.sin()
    extrinsics[..., :3, 3] = 0.1 * torch.randn(_BATCH, count, 3, generator=g)
    rgb = torch.rand(_BATCH, count, 3, height, width, generator=g)
    return {"rgb": rgb, "depths": depths, "intrinsics": intrinsics, "extrinsics": extrinsics}


def make_probe(switch: str, owner: nn.Module, config: TrackerConfig, g: torch.Generator) -> Probe:
    """The probe of a switch, or of the loss, with inputs drawn from a generator."""
    return {"space": _space, "neighborhood": _neighborhood, "context": _context, "updater": _updater, "loss": _loss}[
        switch
    ](owner, config, g)


def frames_of(x: Tensors) -> Frames:
    """The frames among inputs."""
    return Frames(x["rgb"], x["depths"], x["intrinsics"], x["extrinsics"])


def _cloud(owner: Tracker, config: TrackerConfig, g: torch.Generator) -> Tensors:
    """One level of S frames and estimates near its cells, normalised coordinates."""
    height, width = config.grid_sizes[-1]
    shape = _BATCH, config.window, height, width
    points = torch.randn(*shape, 3, generator=g)
    valid = torch.rand(shape, generator=g) > 0.1
    points[~valid] = -3.0
    size = torch.tensor([width - 1.0, height - 1.0])
    cells = torch.rand(_BATCH, config.window, _TRACKS, 2, generator=g) * size
    return {
        "features": torch.randn(*shape, config.feature_dim, generator=g),
        "points": points,
        "valid": valid,
        "coords": torch.randn(_BATCH, config.window, _TRACKS, 3, generator=g),
        "cells": cells,
    }


def _poor(x: Tensors) -> dict[str, Tensors]:
    """What happens in real clips: frames without depth, points outside the image."""
    valid, points = x["valid"].clone(), x["points"].clone()
    valid[:, 0], points[:, 0] = False, 0.0
    return {
        "where no cell of a frame is valid": x | {"valid": valid, "points": points},
        "where a point projects far outside the image": x | {"cells": x["cells"] * 0 - 1e6, "coords": x["coords"] * 50},
    }


def _neighborhood(owner: Tracker, config: TrackerConfig, g: torch.Generator) -> Probe:
    def call(owner: Tracker, x: Tensors) -> Tensors:
        near = owner.neighborhood(Level(x["features"], x["points"], x["valid"]), x["coords"], x["cells"])
        found = {name: getattr(near, name) for name in ("features", "points", "center", "indices")}
        return {name: value for name, value in found.items() if value is not None}

    def expected(out: Tensors) -> dict:
        lead, kind = x["coords"].shape[:3], torch.float32
        count = out["points"].shape[3] if out["points"].ndim == 5 else config.neighbors
        wanted = {"features": (*lead, count, config.feature_dim), "points": (*lead, count, 3), "center": (*lead, 3)}
        wanted = {name: (shape, kind) for name, shape in wanted.items()}
        return wanted | ({"indices": ((*lead, count), torch.int64)} if "indices" in out else {})

    def facts(_: Any, x: Tensors, out: Tensors) -> list:
        cells = x["points"].shape[2] * x["points"].shape[3]
        inside = out["indices"].clamp(0, cells - 1) if "indices" in out else x["coords"]
        return [
            ("center is not the coords that were asked for", out["center"], x["coords"]),
            ("indices lie outside the h * w cells of a frame", out.get("indices", x["coords"]), inside),
        ]

    x = _cloud(owner, config, g)
    return Probe(owner, call, x, expected, _poor(x), ("features",), {"coords": 2, "cells": 2}, facts=facts)


def _context(owner: Tracker, config: TrackerConfig, g: torch.Generator) -> Probe:
    indices = sorted({0, config.levels - 1})

    def call(owner: Tracker, x: Tensors, rows: slice = slice(None)) -> Tensors:
        support, out = Neighbors(x["support"], x["support points"], x["center"]), {}
        for i in indices:
            level = owner.context.prepare(i, Level(x["features"], x["points"], x["valid"]))
            near = owner.neighborhood(level, x["coords"][:, :, rows], x["cells"][:, :, rows])
            kept = owner.context.describe(i, support)
            out[f"level {i}"] = owner.context(i, kept if rows == slice(None) else kept[:, rows], near)
        return out

    def expected(out: Tensors) -> dict:
        return dict.fromkeys(out, ((*x["coords"].shape[:3], owner.context.width), torch.float32))

    def facts(owner: Tracker, x: Tensors, out: Tensors) -> list:
        some = call(owner, x, slice(1, 3))
        text = "tracks 1 and 2 alone, with kept[:, 1:3], give something else"
        return [(text, some[name], out[name][:, :, 1:3]) for name in out]

    x = _cloud(owner, config, g)
    near = owner.neighborhood(Level(x["features"], x["points"], x["valid"]), x["coords"], x["cells"])
    x["center"] = x["coords"][:, 0].clone()
    own = x["center"].unsqueeze(2), torch.randn(_BATCH, _TRACKS, 1, config.feature_dim, generator=g)
    x["support points"] = torch.cat([own[0], near.points[:, 0]], 2)  # (B, N, 1 + K, 3)
    x["support"] = torch.cat([own[1], near.features[:, 0]], 2)
    tracks = {"coords": 2, "cells": 2, "center": 1, "support": 1, "support points": 1}
    return Probe(owner, call, x, expected, _poor(x), ("features", "support"), tracks, facts=facts)


def _updater(owner: Tracker, config: TrackerConfig, g: torch.Generator) -> Probe:
    def call(owner: Tracker, x: Tensors) -> Tensors:
        return {"corrections": owner.updater(x["tokens"], x["active"])}

    def expected(out: Tensors) -> dict:
        shape = out["corrections"].shape
        channels = shape[-1] if len(shape) == 4 and shape[-1] >= 4 else 4
        return {"corrections": ((*x["tokens"].shape[:3], channels), torch.float32)}

    def unused(x: Tensors) -> tuple[Tensors, str]:
        other = x["tokens"].clone()
        other[:, :, -1] += 1.0
        return x | {"tokens": other}, "of a track that is not active, which nobody may see"

    def facts(owner: Tracker, x: Tensors, out: Tensors) -> list:
        all_of_them = owner.updater(x["tokens"], torch.ones_like(x["active"]))
        return [("active=None is not the same as all active", owner.updater(x["tokens"], None), all_of_them)]

    tokens = torch.randn(_BATCH, config.window, _TRACKS, owner.time.shape[1], generator=g)
    x = {"tokens": tokens, "active": torch.tensor([[True, True, False]] * _BATCH)}
    empty = x | {"active": torch.zeros_like(x["active"])}
    return Probe(owner, call, x, expected, {"without an active track": empty}, ("tokens",), unused=unused, facts=facts)


def _space(owner: Tracker, config: TrackerConfig, g: torch.Generator) -> Probe:
    def call(owner: Tracker, x: Tensors) -> Tensors:
        space, cameras = fitted(owner.space, frames_of(x)), (x["intrinsics"], x["extrinsics"])
        coords, cloud = space.from_world(x["xyz"], *cameras), space.lift(x["depths"], *cameras)
        rows = x["xyz"][:, 0, :, None]  # queries (B, N, 1, 3), each seen by a camera of its own
        own = [camera[:, :1].expand(-1, _TRACKS, -1, -1) for camera in cameras]
        return {
            "lift": cloud,
            "from_world": coords,
            "from_world of queries": space.from_world(rows, *own),
            "to_world": space.to_world(coords, *cameras, x["depths"]),
            "to_pixels": space.to_pixels(coords, *cameras),
        }

    def expected(out: Tensors) -> dict:
        points, grid = x["xyz"].shape, x["depths"].shape
        queries = (_BATCH, _TRACKS, 1, 3)
        shapes = (*grid, 3), points, queries, points, (*points[:3], 2)
        return {name: (tuple(shape), torch.float32) for name, shape in zip(out, shapes, strict=True)}

    def facts(owner: Tracker, x: Tensors, out: Tensors) -> list:
        space, cameras = fitted(owner.space, frames_of(x)), (x["intrinsics"], x["extrinsics"])
        flat, seen = getattr(space, "free_axes", (1.0, 1.0, 1.0))[2] == 0, project(x["xyz"], *cameras)[0]
        pixels = space.to_pixels(out["lift"].float().flatten(2, 3), *cameras).unflatten(2, x["depths"].shape[2:])
        known, grid = x["depths"] > 0, pixel_grid(*x["depths"].shape[2:], x["depths"]).expand(pixels.shape)
        return [
            ("to_world is not the inverse of from_world", x["xyz"] if flat else out["to_world"], x["xyz"]),
            ("to_pixels of from_world is not where the camera sees the point", out["to_pixels"], seen),
            ("to_pixels of lift is not the pixel that was lifted", pixels[known], grid[known]),
        ]

    x = random_frames(config, g, config.window)
    spread = torch.tensor([0.3, 0.3, 0.3])
    x["xyz"] = torch.tensor([0.0, 0.0, 2.5]) + spread * torch.randn(_BATCH, config.window, _TRACKS, 3, generator=g)
    holes = x["depths"].clone()
    holes[:, 1] = 0
    variants = {"where a frame has no depth": x | {"depths": holes}}
    return Probe(owner, call, x, expected, variants, ("xyz",), facts=facts)


def _loss(owner: Holder, config: TrackerConfig, g: torch.Generator) -> Probe:
    def call(owner: Holder, x: Tensors) -> Tensors:
        frames, space = frames_of(x), World()
        cloud = space.lift(frames.depths, frames.intrinsics, frames.extrinsics)
        scene = Scene(frames, cloud, frames.depths > 0, [], space)
        columns = torch.arange(_TRACKS, device=x["coords"].device)
        step = _WorldStep(0, 0, x["coords"], x["logits"], columns, x["active"], scene)
        parts = owner.loss(step, Truth(x["true xyz"], x["visible"], x["times"]), 2)
        if not isinstance(parts, tuple | list) or len(parts) != 2:
            raise TypeError(f"it returned {type(parts).__name__}, not a tuple (position, visibility)")
        return dict(zip(("position", "visibility"), parts, strict=True))

    def expected(out: Tensors) -> dict:
        return dict.fromkeys(out, ((), torch.float32))

    def unused(x: Tensors) -> tuple[Tensors, str]:
        coords, logits = x["coords"].clone(), x["logits"].clone()
        for values in (coords, logits):
            values[:, -1] += 0.3  # after the clip's end
            values[:, :, -1] += 0.3  # no active track
            values[:, 0, 1] += 0.3  # before the query
        return x | {"coords": coords, "logits": logits}, "after the clip's end, before the query, or of no active track"

    x = random_frames(config, g, config.window)
    real = config.window - 1  # the last frame is padded
    truth = torch.tensor([0.0, 0.0, 2.5]) + 0.3 * torch.randn(_BATCH, config.window, _TRACKS, 3, generator=g)
    x["coords"] = truth + 0.1 * torch.randn(truth.shape, generator=g)
    x["logits"] = torch.randn(truth.shape[:3], generator=g)
    x["visible"] = torch.rand(_BATCH, real, _TRACKS, generator=g) > 0.3
    x["visible"][:, 1] = True
    x["true xyz"] = truth[:, :real].clone()
    x["true xyz"][:, 2, 0], x["visible"][:, 2, 0] = torch.nan, False
    x["times"] = torch.tensor([[0, 1, 0]] * _BATCH)
    x["active"] = torch.tensor([[True, True, False]] * _BATCH)
    variants = {
        "where no point is visible": x | {"visible": torch.zeros_like(x["visible"])},
        "without an active track": x | {"active": torch.zeros_like(x["active"])},
        "where an estimate is exact": x | {"coords": truth.clone()},
    }
    return Probe(owner, call, x, expected, variants, ("coords", "logits"), unused=unused)
