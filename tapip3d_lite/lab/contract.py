"""`check_part`: does a part of your own keep to the contract of its switch? Answered in about a second, without data.

A part is called with tiny random inputs (`probes`), and its outputs are compared with what every part owes: shapes,
types, devices, finite numbers, one clip apart from another, gradients, the same result each time.
"""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from tapip3d_lite.lab.probes import PROBES, Outputs, Probe, Tensors, poor_inputs, random_inputs
from tapip3d_lite.model.config import SWITCHES, TrackerConfig
from tapip3d_lite.model.n2n import Context
from tapip3d_lite.model.registry import PARTS
from tapip3d_lite.model.spaces import Space
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.parts import find_part, make_part
from tapip3d_lite.training.loss import FORMS, LossConfig

Faults = Iterator[tuple[str, str]]
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
    """

    part: str
    switch: str | None
    faults: dict[str, str] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """Whether nothing was found."""
        return not self.faults

    def __str__(self) -> str:
        count = f"{len(self.faults)} fault{'s' if len(self.faults) > 1 else ''}"
        head = f"{self.part} ({self.switch or 'unknown switch'}): {'keeps the contract' if self.ok else count}"
        return "\n- ".join([head, *(f"{kind}: {text}" for kind, text in self.faults.items())])

    __repr__ = __str__


def check_part(part: Any, switch: str | None = None, config: TrackerConfig | None = None) -> PartReport:
    """Try a part with tiny random inputs, before any training; it raises nothing, whatever the part does.

    Args:
        part: a class, a module, a function, `"module:Class"` or a built-in name.
        switch: `"space"`, `"neighborhood"`, `"context"`, `"updater"` or `"loss"`; None: guessed from the part's base
            class or the names of its arguments.
        config: sizes and the other switches; None: tiny ones, all different.

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
        if report.switch not in PROBES:
            wanted = f"say switch= one of {', '.join(PROBES)}, got {switch!r}"
            report.faults["switch"] = f"it is not clear what this is for; {wanted}"
            return report
        with torch.random.fork_rng(devices=[]), torch.inference_mode(False), torch.enable_grad():
            torch.manual_seed(0)
            owner = _owner(report.switch, part, config)
            given = random_inputs(owner.config, torch.Generator().manual_seed(0), owner.time.shape[1])
            _examine(PROBES[report.switch], report.switch, owner, given, report.faults)
    except Exception as error:  # the part's own code may raise anything
        made = "owner" in locals()
        probe = PROBES.get(report.switch)
        expected = "" if probe is None else probe.contract if made else f"a function, or a class made by {probe.made}"
        report.faults.setdefault("call" if made else "constructor", f"{_said(error)}; expected {expected}")
    return report


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


def _owner(switch: str, part: Any, config: TrackerConfig | None) -> Tracker:
    """A tracker in evaluation mode that has the part, also a loss, which then moves with it."""
    companions = _COMPANIONS.get((switch, part), {}) if isinstance(part, str) else {}
    own = {} if switch == "loss" else {switch: part}
    config = TrackerConfig(**(_TINY | companions | own)) if config is None else config.replace(**own)
    owner = Tracker(config, fast=False)
    if switch == "loss":
        owner.loss = LossConfig(form=part) if isinstance(part, str) else make_part("loss", part)
    return owner.eval()


def _examine(probe: Probe, switch: str, owner: Tracker, given: Tensors, faults: dict[str, str]) -> None:
    """Add the faults of a part, the first of each kind; outputs of wrong shapes are not looked at further."""
    x = {name: given[name] for name in probe.inputs}
    poor = {where: x | {k: v for k, v in some.items() if k in x} for where, some in poor_inputs(given).items()}
    poor = {where: some for where, some in poor.items() if any(some[name] is not x[name] for name in x)}

    def called(inputs: Tensors, training: bool = False, seed: int = 0) -> Outputs:
        torch.manual_seed(seed)  # and a copy, so that one call cannot help or harm the next
        return probe.call(copy.deepcopy(owner).train(training), {name: value.clone() for name, value in inputs.items()})

    def run(*options: Any) -> Tensors:
        return {name: value for name, (value, _) in called(*options).items()}

    inputs = {"for ordinary inputs": x, **poor}
    with torch.no_grad():
        out = run(x)
        for check in (_formal(called(x)), _finite(run, inputs), _apart(probe, run, x), _device(probe, owner, x)):
            for kind, text in check:
                faults.setdefault(kind, text)
            if "shape" in faults or "type" in faults:
                return
        if not _same(run(x, False, 1), out):
            faults["random"] = "two calls in evaluation mode give different results, expected the same"
        for text, value, wanted in probe.facts(copy.deepcopy(owner), x, out):
            if not _same(value, wanted):
                faults.setdefault("values", text)
    for kind, text in _gradients(probe, copy.deepcopy(owner), switch, inputs):
        faults.setdefault(kind, text)


def _said(error: BaseException) -> str:
    """An exception in one line."""
    text = " ".join(str(error).split())
    return text if isinstance(error, ValueError) else f"{type(error).__name__}: {text}"


def _formal(out: Outputs) -> Faults:
    for name, (value, shape) in out.items():
        dtype = torch.int64 if name == "indices" else torch.float32
        if not isinstance(value, Tensor):
            yield "type", f"{name} is {type(value).__name__}, expected a tensor"
        elif value.shape != shape:
            yield "shape", f"{name} has shape {tuple(value.shape)}, expected {tuple(shape)}"
        elif value.dtype != dtype:
            yield "dtype", f"{name} has dtype {value.dtype}, expected {dtype}"


def _finite(run: Callable[..., Tensors], inputs: dict[str, Tensors]) -> Faults:
    for where, x in inputs.items():
        for name, value in run(x).items():
            if not value.isfinite().all():
                yield "finite", f"{name} has NaN or infinite values {where}, expected finite ones"


def _apart(probe: Probe, run: Callable[..., Tensors], x: Tensors) -> Faults:
    other = {name: torch.cat([value[:1], _another(value[1:])]) for name, value in x.items()}
    for mode in (False, True):  # in training too, where batch normalisation mixes clips
        one, two = run(x, mode), run(other, mode)
        if all(value.ndim for value in one.values()):
            same = _same(*({name: value[0] for name, value in out.items()} for out in (one, two)))
        else:  # a loss
            alone = [run({name: value[i : i + 1] for name, value in x.items()}, mode) for i in (0, 1)]
            same = _same(one, {name: (alone[0][name] + alone[1][name]) / 2 for name in one})
        if not same:
            yield "batch", "the result of one clip changes with the other clips of the batch, expected no influence"
    if probe.tracks:
        other = dict(x)
        for name, axis in probe.tracks.items():
            first, rest = x[name].split([1, x[name].shape[axis] - 1], axis)
            other[name] = torch.cat([first, _another(rest)], axis)
        if not _same(*({name: value[:, :, 0] for name, value in run(some).items()} for some in (x, other))):
            yield "tracks", "the result of one track changes with the other tracks, expected no influence"


def _another(x: Tensor) -> Tensor:
    """Other values of the same kind."""
    return 1.1 * x + 0.01 * x.abs() if x.is_floating_point() else x.flip(-1)


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(_same(one[name], other[name]) for name in one)
    close = {"rtol": 1e-3, "atol": 1e-4, "equal_nan": True}
    return one.shape == other.shape and torch.allclose(one.double(), other.double(), **close)


class _OneDevice(TorchDispatchMode):
    """Raises where an operation takes tensors (not single numbers) from two devices, as a GPU would."""

    def __torch_dispatch__(self, func: Callable, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        name, tensors = func.name(), [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor) and x.ndim]
        copies = ("_to_copy", "copy_", "index.", "index_put_")
        if len({x.device.type for x in tensors}) > 1 and not name.removeprefix("aten::").startswith(copies):
            raise RuntimeError(f"two devices in {name}")
        return func(*args, **(kwargs or {}))


def _device(probe: Probe, owner: Tracker, x: Tensors) -> Faults:
    """Whether everything is made where the inputs are, seen on the device "meta", which has no values."""
    advice = "expected the inputs' device: give device=x.device, or register a buffer"
    try:
        with _OneDevice():
            out = probe.call(copy.deepcopy(owner).to("meta"), {name: value.to("meta") for name, value in x.items()})
    except Exception as error:  # also where it looks at values, as it may
        reason = _said(error)
        if "two devices in" in reason:
            yield "device", f"{reason.partition(': ')[2]}: tensors are made on the CPU, {advice}"
        elif "numpy" in reason or "can't convert" in reason:
            yield "device", f"values are taken to the CPU ({reason}), expected torch's operations on the inputs' device"
        return
    if wrong := [name for name, (value, _) in out.items() if value.device.type != "meta"]:
        yield "device", f"{wrong[0]} is on the CPU, {advice}"


def _gradients(probe: Probe, owner: Tracker, switch: str, inputs: dict[str, Tensors]) -> Faults:
    part = getattr(owner, switch)
    with torch.no_grad():
        for parameter in part.parameters() if isinstance(part, nn.Module) else ():
            parameter += 0.1 * torch.randn(parameter.shape)  # what begins as zero would hide what lies before it
    for where, x in inputs.items():
        given = {name: value.clone().requires_grad_(name in probe.learnt) for name, value in x.items()}
        out = [value.flatten() for value, _ in probe.call(owner, given).values() if value.requires_grad]
        if not out:
            yield "gradient", "the outputs carry no gradient at all; expected no detach, no_grad, or rounding"
            return
        total = sum((value * torch.linspace(0.5, 1.5, len(value))).sum() for value in out)
        found = torch.autograd.grad(total, [given[name] for name in probe.learnt], allow_unused=True)
        if any(one is not None and not one.isfinite().all() for one in found):
            yield "finite", f"gradients are NaN or infinite {where}, expected finite ones"
        if where != next(iter(inputs)):
            continue
        for name in (name for name, one in zip(probe.learnt, found, strict=True) if one is None or not one.any()):
            moved = x | {name: x[name] + 0.1 * torch.randn(x[name].shape)}
            with torch.no_grad():
                both = [torch.cat([value.flatten() for value, _ in probe.call(owner, y).values()]) for y in (moved, x)]
                if not _same(*both):
                    text = f"the outputs depend on {name}, but no gradient reaches it; expected no detach or no_grad"
                    yield "gradient", text
