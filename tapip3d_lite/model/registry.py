"""Which part stands behind each name of the four switches, and which of its forms: the clear one or the fast one.

Parts are named as strings and imported when they are asked for, so that `model/` depends neither on `variants/` nor on
`speed/`. A fast part is a subclass of the clear one with the same parameters and the same numbers; this is the one
place that chooses between them.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import torch
from torch import nn

from tapip3d_lite.model.config import TrackerConfig

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


class Function(nn.Module):
    """A plain function as a module, so that hooks see it like any other part."""

    def __init__(self, function: Any) -> None:
        super().__init__()
        self.function = function

    def forward(self, *args: Any) -> Any:
        """Call it."""
        return self.function(*args)


def make_space(choice: Any) -> Any:
    """The space behind a name, or a custom space as it is."""
    found = _look_up("space", choice, fast=False)
    return found() if isinstance(found, type) else found


def make_module(switch: str, config: TrackerConfig, *sizes: int, fast: bool = True) -> nn.Module:
    """The neighbourhood, context or updater that a config asks for.

    Args:
        switch: name of the config's field.
        config: names of built-in parts are looked up, classes are called with (config, *sizes), modules are used as
            they are, functions are wrapped.
        sizes: what the part's constructor needs beside the config.
        fast: the fast form of a built-in part, where there is one.

    Raises:
        ValueError: an unknown name.
    """
    found = _look_up(switch, getattr(config, switch), fast)
    if isinstance(found, type):
        return found(config, *sizes)
    return found if isinstance(found, nn.Module) else Function(found)


def fast_step(device: str) -> Any:
    """What runs a training step faster on a device: on a GPU a CUDA graph, else None."""
    return load_part(CUDA_STEP) if torch.device(device).type == "cuda" else None


def load_part(path: str) -> Any:
    """What `"module:name"` names; the module is imported."""
    module, _, name = path.partition(":")
    return getattr(import_module(module), name)


def _look_up(switch: str, choice: Any, fast: bool) -> Any:
    if not isinstance(choice, str):
        return choice
    if choice not in PARTS[switch]:
        raise ValueError(f"{switch}: expected one of {', '.join(PARTS[switch])} or a custom part, got {choice!r}")
    return load_part(FAST.get((switch, choice), PARTS[switch][choice]) if fast else PARTS[switch][choice])
