"""Which part stands behind each name of the four switches, and which of its forms: the clear one or the fast one.

Parts are named as strings and imported when they are asked for, so that `model/` depends neither on `variants/` nor on
`speed/`. A fast part is a subclass of the clear one with the same parameters and the same numbers; this is the one
place that chooses between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import nn

from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.n2n import Context
from tapip3d_lite.parts import LOG, find_part, import_part, make_part

PARTS: dict[str, dict[str, str]] = {
    "space": {
        "world": "tapip3d_lite.model.spaces:World",
        "camera": "tapip3d_lite.model.spaces:Camera",
        "first": "tapip3d_lite.model.spaces:First",
        "uv": "tapip3d_lite.variants.image_spaces:UV",
        "uvd": "tapip3d_lite.variants.image_spaces:UVD",
        "uvlogd": "tapip3d_lite.variants.image_spaces:UVLogD",
    },
    "neighborhood": {
        "knn": "tapip3d_lite.model.neighbors:KNearest",
        "window": "tapip3d_lite.variants.window2d:WindowNeighborhood",
        "planes": "tapip3d_lite.variants.planes:PlaneNeighborhood",
    },
    "context": {
        "n2n": "tapip3d_lite.model.n2n:N2N",
        "p2n": "tapip3d_lite.variants.p2n:P2N",
        "correlation": "tapip3d_lite.variants.correlation:Correlation",
        "planes": "tapip3d_lite.variants.planes:PlaneCorrelation",
    },
    "updater": {
        "transformer": "tapip3d_lite.model.updater:Transformer",
        "temporal": "tapip3d_lite.variants.temporal:Temporal",
    },
}
FAST: dict[tuple[str, str], str] = {
    ("neighborhood", "knn"): "tapip3d_lite.speed.box_knn:BoxKNearest",
    ("context", "n2n"): "tapip3d_lite.speed.folded_n2n:FoldedN2N",
}
CUDA_STEP = "tapip3d_lite.speed.cuda_graph:CudaGraphStep"


class Function(Context):
    """A plain function as a module, so that hooks see it like any other part.

    As a context it says its `width` by an attribute, and its `kept` are the support's features.
    """

    def __init__(self, function: Any) -> None:
        super().__init__()
        self.function, self.width = function, getattr(function, "width", None)

    def forward(self, *args: Any) -> Any:
        """Call it."""
        return self.function(*args)


def make_space(choice: Any) -> Any:
    """The space behind a name, an instance of a class, or a custom space as it is."""
    return make_part("space", _look_up("space", choice, fast=False))


def make_module(switch: str, config: TrackerConfig, *sizes: int, fast: bool = True) -> nn.Module:
    """The neighbourhood, context or updater that a config asks for.

    Args:
        switch: name of the config's field.
        config: names of built-in parts are looked up, classes are called with (config, *sizes), modules are used as
            they are, functions are wrapped.
        sizes: what the part's constructor needs beside the config: of an updater its number of inputs.
        fast: the fast form of a built-in part, where there is one; a custom part runs as it is written.

    Raises:
        ValueError: an unknown name, a class with another constructor, or a context without a width.
    """
    found = _look_up(switch, getattr(config, switch), fast)
    part = make_part(switch, found, **dict(zip(("config", "inputs"), (config, *sizes), strict=False)))
    part = part if isinstance(part, nn.Module) else Function(part)
    if switch == "context" and not (hasattr(part, "describe") and isinstance(getattr(part, "width", None), int)):
        raise ValueError(
            f"context: expected a `model.n2n.Context` that sets self.width, or a function with an attribute width, the "
            f"channels of its output; got {found!r}"
        )
    return part


def fast_step(device: str, custom: Sequence[Any] = ()) -> Any:
    """What runs a training step faster on a device: on a GPU a CUDA graph, else None.

    A graph can hold no part that waits for the GPU: of `custom` parts only those that say `sync_free = True`.
    """
    if torch.device(device).type != "cuda":
        return None
    if waiting := [str(getattr(part, "__name__", part)) for part in custom if not getattr(part, "sync_free", False)]:
        LOG.warning("no CUDA graph, as %s may wait for the GPU; it says otherwise by sync_free = True", waiting[0])
        return None
    return import_part(CUDA_STEP)


def _look_up(switch: str, choice: Any, fast: bool) -> Any:
    found = find_part(switch, choice, PARTS[switch])
    if isinstance(found, str):
        return import_part(FAST.get((switch, found), PARTS[switch][found]) if fast else PARTS[switch][found])
    if fast:
        LOG.info("%s: %s has no fast form and runs as it is written", switch, getattr(found, "__name__", found))
    return found
