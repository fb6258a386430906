"""`check_part`: does a part of your own keep to the contract of its switch? Answered in about a second, without data.

A part is called with tiny random inputs (`probes`), and its outputs are compared with what every part owes: shapes,
types, devices, finite numbers, one clip apart from another, gradients, the same result each time.
"""

from __future__ import annotations

import inspect
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import nn

from tapip3d_lite.lab.faults import examine, said
from tapip3d_lite.lab.probes import CALLS, Holder, make_probe
from tapip3d_lite.model.config import SWITCHES, TrackerConfig
from tapip3d_lite.model.n2n import Context
from tapip3d_lite.model.registry import PARTS
from tapip3d_lite.model.spaces import Space
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.parts import find_part, make_part
from tapip3d_lite.training.loss import FORMS, LossConfig

_TINY = {
    "image_size": (24, 32), "window": 4, "feature_dim": 12, "stride": 2, "levels": 2, "neighbors": 5, "token_dim": 10,
    "context_head_dim": 6, "offset_layers": 2, "offset_dim": 8, "hidden": 14, "heads": 2, "head_dim": 7, "time_depth": 1,
    "space_depth": 1, "virtual_tracks": 3, "iterations": 2, "support_grid": 0,
}  # fmt: skip
_COMPANIONS = {  # built-in parts that need another one
    ("context", "correlation"): {"neighborhood": "window"},
    ("context", "planes"): {"neighborhood": "planes"},
    ("neighborhood", "planes"): {"context": "planes"},
}
_ARGUMENTS = {
    "neighborhood": {"level", "coords", "cells"},
    "context": {"index", "kept", "near"},
    "updater": {"tokens"},
    "loss": {"step", "truth", "iterations"},
}


@dataclass(frozen=True, repr=False)
class PartReport:
    """What `check_part` found; shown as text.

    Attributes:
        part: its name.
        switch: whose contract it was held to.
        faults: one sentence by kind, e.g. `"shape"` or `"batch"`; what comes after a fault may not have been tried.
        notes: what is allowed and good to know.
    """

    part: str
    switch: str | None
    faults: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether nothing was found."""
        return not self.faults

    def __str__(self) -> str:
        head = f"{self.part} ({self.switch or 'unknown switch'}): "
        head += "keeps the contract" if self.ok else f"{len(self.faults)} fault{'s' if len(self.faults) > 1 else ''}"
        lines = [f"{kind}: {text}" for kind, text in self.faults.items()] + [f"note: {text}" for text in self.notes]
        return "\n- ".join([head, *lines])

    __repr__ = __str__


def check_part(part: Any, switch: str | None = None, config: TrackerConfig | None = None, seed: int = 0) -> PartReport:
    """Try a part with tiny random inputs, before any training; it raises nothing, whatever the part does.

    Args:
        part: a class, a module, a function, `"module:Class"` or a built-in name.
        switch: `"space"`, `"neighborhood"`, `"context"`, `"updater"` or `"loss"`; None: guessed from the part's base
            class or the names of its arguments.
        config: sizes and the other switches; None: tiny ones, all different.
        seed: of the inputs.

    Example:
        >>> from tapip3d_lite import lab
        >>> lab.check_part("p2n")
        p2n (context): keeps the contract
    """
    report = PartReport(getattr(part, "__name__", part if isinstance(part, str) else type(part).__name__), switch)
    try:
        names = {name for known in PARTS.values() for name in known} | set(FORMS)
        part = find_part("part", part, sorted(names))
        report = replace(report, switch=switch or _guess(part))
        if report.switch not in (*SWITCHES, "loss"):
            wanted = ", ".join((*SWITCHES, "loss"))
            report.faults["switch"] = f"it is not clear what this is for; say switch= one of {wanted}, got {switch!r}"
            return report
        config = _config(report.switch, part, config)
        with torch.random.fork_rng(devices=[]), torch.inference_mode(False), torch.enable_grad():
            torch.manual_seed(seed)
            owner = _owner(report.switch, part, config)
            probe = make_probe(report.switch, owner, config, torch.Generator().manual_seed(seed))
            examine(probe, report.switch, config, report.faults, report.notes)
    except Exception as error:  # the part's own code may raise anything
        kind = "call" if "owner" in locals() else "constructor"
        report.faults.setdefault(kind, f"{said(error)}; expected {_wanted(report.switch, kind)}")
    return report


def _wanted(switch: str | None, kind: str) -> str:
    if kind == "call":
        return CALLS[switch]
    made = {"space": "()", "loss": "()", "updater": "(config, inputs)"}.get(switch, "(config)")
    return f"an instance, a function, or a class that is made by {made}"


def _guess(part: Any) -> str | None:
    if isinstance(part, str):
        found = [switch for switch in SWITCHES if part in PARTS[switch]] + (["loss"] if part in FORMS else [])
        return found[0] if len(found) == 1 else None
    kind = part if isinstance(part, type) else type(part)
    for base, switch in ((Context, "context"), (Space, "space"), (LossConfig, "loss")):
        if issubclass(kind, base):
            return switch
    if hasattr(part, "from_world"):
        return "space"
    if not inspect.isfunction(part):
        part = kind.forward if issubclass(kind, nn.Module) else kind.__call__
    given = set(inspect.signature(part).parameters)
    return next((switch for switch, names in _ARGUMENTS.items() if names <= given), None)


def _config(switch: str, part: Any, config: TrackerConfig | None) -> TrackerConfig:
    own = {} if switch == "loss" else {switch: part}
    if config is not None:
        return config.replace(**own)
    companions = _COMPANIONS.get((switch, part), {}) if isinstance(part, str) else {}
    return TrackerConfig(**(_TINY | companions | own))


def _owner(switch: str, part: Any, config: TrackerConfig) -> nn.Module:
    if switch != "loss":
        return Tracker(config, fast=False).eval()
    return Holder(LossConfig(form=part) if isinstance(part, str) else make_part("loss", part)).eval()
