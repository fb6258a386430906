"""Which module stands behind each name of the four switches; the one place where a built-in part is registered."""

from __future__ import annotations

from typing import Any

from torch import nn

from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.contexts import N2N, P2N
from tapip3d_lite.model.correlations import Correlation, PlaneCorrelation
from tapip3d_lite.model.grids import Planes, Window
from tapip3d_lite.model.neighbors import KNearest
from tapip3d_lite.model.spaces import UV, UVD, Camera, First, UVLogD, World
from tapip3d_lite.model.updater import Temporal, Transformer

PARTS: dict[str, dict[str, type]] = {
    "space": {"uv": UV, "uvd": UVD, "uvlogd": UVLogD, "camera": Camera, "world": World, "first": First},
    "neighborhood": {"knn": KNearest, "window": Window, "planes": Planes},
    "context": {"n2n": N2N, "p2n": P2N, "correlation": Correlation, "planes": PlaneCorrelation},
    "updater": {"transformer": Transformer, "temporal": Temporal},
}


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
    found = _look_up("space", choice)
    return found() if isinstance(found, type) else found


def make_module(switch: str, config: TrackerConfig, *sizes: int) -> nn.Module:
    """The neighbourhood, context or updater that a config asks for.

    Args:
        switch: name of the config's field.
        config: names of built-in parts are looked up, classes are called with (config, *sizes), modules are used as
            they are, functions are wrapped.
        sizes: what the part's constructor needs beside the config.
    """
    found = _look_up(switch, getattr(config, switch))
    if isinstance(found, type):
        return found(config, *sizes)
    return found if isinstance(found, nn.Module) else Function(found)


def _look_up(switch: str, choice: Any) -> Any:
    if not isinstance(choice, str):
        return choice
    if choice not in PARTS[switch]:
        raise ValueError(f"{switch}: expected one of {', '.join(PARTS[switch])} or a custom part, got {choice!r}")
    return PARTS[switch][choice]
