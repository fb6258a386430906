"""What every part owes, whatever it computes: each check yields (kind, one sentence) where a part fails it.

A part is deep-copied before each call, so that one call cannot help or harm the next.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from tapip3d_lite.lab.probes import Holder, Probe, Tensors, frames_of, random_frames
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.training.backward import add_gradients
from tapip3d_lite.training.loss import LossConfig, Truth

Faults = Iterator[tuple[str, str]]
_HIDDEN = (
    "the memory-saving backward misses gradients; expected tensors with gradient in Level.features, in Level.extra "
    "(lists, tuples, dicts), or in what describe returns (a tensor, or an object with map)"
)


def examine(probe: Probe, switch: str, config: TrackerConfig, faults: dict[str, str], notes: list[str]) -> None:
    """Add the faults of a part, the first of each kind, and notes; outputs of wrong shapes are not looked at further."""

    def add(found: Faults) -> None:
        for kind, text in found:
            faults.setdefault(kind, text)

    with torch.no_grad():
        out = _run(probe, probe.inputs)
        add(_formal(probe, out))
        if "shape" in faults or "type" in faults:
            return
        for check in (_finite, _repeated, _apart, _values):
            add(check(probe, out))
        if switch != "space":  # spaces compute in float32 always
            add(_precision(probe))
        add(_device(probe, switch, notes))
    add(_gradients(probe, switch))
    if not faults:
        add(_whole(probe, switch, config))


def said(error: BaseException) -> str:
    """An exception in one line."""
    text = " ".join(str(error).split())
    return text if isinstance(error, ValueError) else f"{type(error).__name__}: {text}"


def _run(probe: Probe, inputs: Tensors, seed: int = 0, owner: nn.Module | None = None) -> Tensors:
    torch.manual_seed(seed)
    given = {name: x.clone() for name, x in inputs.items()}
    out = probe.call(copy.deepcopy(probe.owner) if owner is None else owner, given)
    changed = [name for name, x in inputs.items() if not torch.equal(x.nan_to_num(), given[name].nan_to_num())]
    if changed:
        raise ValueError(f"it writes into its input {changed[0]!r}, which others use too")
    return out


def _formal(probe: Probe, out: Tensors) -> Faults:
    for name, value in out.items():
        if not isinstance(value, Tensor):
            yield "type", f"{name} is {type(value).__name__}, expected a tensor"
            return
    for name, (shape, dtype) in probe.expected(out).items():
        if tuple(out[name].shape) != shape:
            yield "shape", f"{name} has shape {tuple(out[name].shape)}, expected {shape}"
        elif out[name].dtype != dtype:
            yield "dtype", f"{name} has dtype {out[name].dtype}, expected {dtype}, that of the inputs"


def _finite(probe: Probe, out: Tensors) -> Faults:
    for where, inputs in {"for ordinary inputs": probe.inputs, **probe.variants}.items():
        for name, value in (out if inputs is probe.inputs else _run(probe, inputs)).items():
            if not value.isfinite().all():
                yield "finite", f"{name} has NaN or infinite values {where}, expected finite ones"


def _repeated(probe: Probe, out: Tensors) -> Faults:
    if not _same(_run(probe, probe.inputs, seed=1), out):
        yield "random", "two calls in evaluation mode give different results, expected the same"
        return
    owner = copy.deepcopy(probe.owner)
    for inputs in (*probe.variants.values(), probe.inputs):
        again = _run(probe, inputs, owner=owner)
    if not _same(again, out):
        yield "memory", "the result depends on calls before, expected nothing kept between calls"


def _apart(probe: Probe, _: Tensors) -> Faults:
    other = {name: torch.cat([x[:1], _another(x[1:])]) for name, x in probe.inputs.items()}
    for mode in (False, True):  # in training too, where batch normalisation mixes clips
        owner = copy.deepcopy(probe.owner).train(mode)
        results = [_first_clip(probe, inputs, copy.deepcopy(owner)) for inputs in (probe.inputs, other)]
        if not _same(*results):
            yield "batch", "the result of one clip changes with the other clips of the batch, expected no influence"
            break
    if probe.tracks:
        inputs = dict(probe.inputs)
        for name, axis in probe.tracks.items():
            first, rest = inputs[name].split([1, inputs[name].shape[axis] - 1], axis)
            inputs[name] = torch.cat([first, _another(rest)], axis)
        mine = [{name: x[:, :, 0] for name, x in _run(probe, given).items()} for given in (probe.inputs, inputs)]
        if not _same(*mine):
            yield "tracks", "the result of one track changes with the other tracks, expected no influence"
    if probe.unused is not None:
        inputs, text = probe.unused(probe.inputs)
        kept = [  # of inactive tracks, the last ones, outputs may be anything
            {name: x[:, :, :-1] if x.ndim > 2 else x for name, x in _run(probe, given).items()}
            for given in (probe.inputs, inputs)
        ]
        if not _same(*kept):
            yield "unused", f"the result depends on values {text}; expected none"


def _first_clip(probe: Probe, inputs: Tensors, owner: nn.Module) -> Tensors:
    """Outputs of clip 0; where outputs are of all clips together (a loss), their gradients for it."""
    if not isinstance(probe.owner, Holder):
        return {name: x[0] for name, x in _run(probe, inputs, owner=owner).items()}
    with torch.enable_grad():
        given = {k: x.clone().requires_grad_(k in probe.learnt) for k, x in inputs.items()}
        torch.manual_seed(0)
        total, learnt = sum(probe.call(owner, given).values()), [given[k] for k in probe.learnt]
        found = torch.autograd.grad(total, learnt, allow_unused=True) if total.requires_grad else ()
    return {str(i): x[0] for i, x in enumerate(found) if x is not None}


def _another(x: Tensor) -> Tensor:
    """Other values of the same kind."""
    return 1.1 * x + 0.01 * x.abs() if x.is_floating_point() else x.flip(-1)


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(_same(one[name], other[name]) for name in one)
    close = {"rtol": 1e-3, "atol": 1e-4, "equal_nan": True}
    return one.shape == other.shape and torch.allclose(one.double(), other.double(), **close)


def _values(probe: Probe, out: Tensors) -> Faults:
    for text, value, wanted in probe.facts(copy.deepcopy(probe.owner), probe.inputs, out):
        if not _same(value, wanted):
            yield "values", text


def _precision(probe: Probe) -> Faults:
    try:
        with torch.autocast("cpu", torch.bfloat16):
            _run(probe, probe.inputs)
    except Exception as error:
        text = f"it fails where torch.autocast gives bfloat16: {said(error)}"
        yield "dtype", f"{text}; expected to take what the layers give"


class MixedDevicesError(RuntimeError):
    """An operation on tensors of two devices."""


class _OneDevice(TorchDispatchMode):
    """Raises where an operation takes tensors (not single numbers) from two devices, as a GPU would."""

    def __torch_dispatch__(self, func: Callable, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        name = func.name().removeprefix("aten::").partition(".")[0]
        tensors = [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor) and x.ndim]
        if len({x.device.type for x in tensors}) > 1 and name not in ("_to_copy", "copy_", "index", "index_put_"):
            raise MixedDevicesError(name)
        return func(*args, **(kwargs or {}))


def _device(probe: Probe, switch: str, notes: list[str]) -> Faults:
    """Whether everything is made where the inputs are, seen on the device "meta", which has no values."""
    owner = copy.deepcopy(probe.owner).to("meta")
    inputs = {name: x.to("meta") for name, x in probe.inputs.items()}
    text = "tensors are made on the CPU, expected the inputs' device: give device=x.device, or register a buffer"
    try:
        with _OneDevice():
            out = probe.call(owner, inputs)
    except MixedDevicesError as error:
        yield "device", f"in the operation {error} {text}"
        return
    except Exception as error:
        reason = said(error)
        if "same device" in reason:
            yield "device", f"{text} ({reason})"
        elif "numpy" in reason or "can't convert" in reason:
            yield (
                "device",
                f"values are taken to the CPU ({reason}), expected operations of torch on the inputs' device",
            )
        elif "unsupported scalarType" not in reason:  # torch.autocast does not know the device "meta"
            notes.append(
                f"it looks at values ({reason[:100]} …), so a GPU is waited for, and no CUDA graph can hold it"
            )
            if getattr(getattr(owner, switch), "sync_free", False):
                yield "device", f"{notes[-1]}; expected sync_free = False"
        return
    if wrong := [name for name, x in out.items() if x.device.type != "meta"]:
        yield "device", f"{wrong[0]} is on the CPU: {text}"


def _gradients(probe: Probe, switch: str) -> Faults:
    owner = copy.deepcopy(probe.owner)
    part = getattr(owner, switch)
    named = dict(part.named_parameters()) if isinstance(part, nn.Module) else {}
    named = {name: p for name, p in named.items() if p.requires_grad}
    with torch.no_grad():
        for parameter in named.values():  # what begins as zero would hide what lies before it
            parameter += 0.1 * torch.randn(parameter.shape)
    for where, inputs in {"": probe.inputs, **probe.variants}.items():
        given = {name: x.clone().requires_grad_(name in probe.learnt) for name, x in inputs.items()}
        out = [x.flatten() for x in probe.call(owner, given).values() if x.requires_grad]
        if not out:
            yield "gradient", "the outputs carry no gradient at all; expected no detach, no_grad, or rounding"
            return
        total = sum((x * torch.linspace(0.5, 1.5, len(x))).sum() for x in out)
        wanted = [given[name] for name in probe.learnt] + list(named.values())
        found = torch.autograd.grad(total, wanted, allow_unused=True)
        if any(x is not None and not x.isfinite().all() for x in found):
            yield "finite", f"gradients are NaN or infinite {where or 'for ordinary inputs'}, expected finite ones"
        if where:
            continue
        stopped = [x is None or not x.any() for x in found]
        dead = [name for name, stop in zip(named, stopped[len(probe.learnt) :], strict=True) if stop]
        if dead:
            text = f"no gradient reaches the parameter {', '.join(dead[:3])}"
            yield "gradient", f"{text}; expected one for each, or a buffer"
        for name in (name for name, stop in zip(probe.learnt, stopped, strict=False) if stop):
            moved = inputs | {name: inputs[name] + 0.1 * torch.randn(inputs[name].shape)}
            if isinstance(owner, Holder) or not _same(*(_run(probe, x, owner=owner) for x in (moved, inputs))):
                text = f"the outputs depend on {name}, but no gradient reaches it"
                yield "gradient", f"{text}; expected no detach or no_grad"


def _whole(probe: Probe, switch: str, config: TrackerConfig) -> Faults:
    """The part at work in a training step: the backward pass in pieces gives the gradients of the whole one."""
    g, count = torch.Generator().manual_seed(0), 3 * config.window // 2
    tracker = Tracker(config, fast=False).eval() if switch == "loss" else copy.deepcopy(probe.owner)
    loss = probe.owner.loss if switch == "loss" else LossConfig(form="paper", scale=1.0)
    frames = frames_of(random_frames(config, g, count))
    xyz = torch.tensor([0.0, 0.0, 2.5]) + 0.3 * torch.randn(2, count, 3, 3, generator=g)
    times = torch.tensor([[0, 1, 0], [1, 0, config.window - 1]])
    own = xyz.gather(1, times[:, None, :, None].expand(-1, 1, -1, 3))[:, 0]
    queries = torch.cat([times[..., None].float(), own], -1)
    truth = Truth(xyz, torch.rand(xyz.shape[:3], generator=g) > 0.3, times)
    shape, results = (2, count, config.feature_dim, *config.grid_sizes[0]), []
    for pieces in (True, False):
        features = torch.randn(shape, generator=torch.Generator().manual_seed(1)).requires_grad_()
        tracker.zero_grad()
        try:
            if pieces:
                add_gradients(tracker, frames, queries, truth, loss, features, iterations=2)
            else:
                steps = tracker.steps(frames, queries, features=features, iterations=2)
                sum(sum(loss(step, truth, 2)) for step in steps).backward()
        except Exception as error:
            yield "training", _HIDDEN if "second time" in str(error) else f"a training step fails: {said(error)}"
            return
        results.append([features.grad, *(p.grad for p in tracker.parameters())])
    if not all(map(_alike, *results)):
        yield "training", _HIDDEN


def _alike(one: Tensor | None, other: Tensor | None) -> bool:
    return one is other or (one is not None and other is not None and torch.allclose(one, other, rtol=1e-2, atol=1e-6))
