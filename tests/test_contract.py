"""`lab.check_part` lets every built-in part pass, and names what is wrong with each of many broken ones."""

import time
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import nn

import tapip3d_lite as t3d
from tapip3d_lite import lab
from tapip3d_lite.model.neighbors import KNearest, Neighbors
from tapip3d_lite.model.registry import PARTS
from tapip3d_lite.model.spaces import Camera, World
from tapip3d_lite.training.loss import FORMS, LossConfig
from tests import lab_conditions
from tests.tiny import SIZES

BUILT_IN = [(switch, name) for switch, names in (PARTS | {"loss": FORMS}).items() for name in names]


@pytest.mark.parametrize(("switch", "name"), BUILT_IN)
def test_every_built_in_part_passes(switch, name):
    report = lab.check_part(name, switch)
    assert report.ok and str(report).startswith(f"{name} ({switch}): keeps the contract"), report


# --- one good part of each switch, and ways to break it: a class that inherits from it and breaks one thing ----------


class Mean(lab_conditions.Mean):
    """The query's feature beside the mean of the neighbourhood's."""

    def forward(self, index, kept, near):
        return self.change(super().forward(index, kept, near), near)

    def change(self, x, near):
        return x


class Nearest(nn.Module):
    """Nearest cells, their features scaled (which are the encoder's of queries, and the context's of estimates)."""

    def __init__(self, config):
        super().__init__()
        self.search, self.scale = KNearest(config), nn.Parameter(torch.ones(()))

    def forward(self, level, coords, cells):
        near = self.search(level, coords, cells)
        return self.change(replace(near, features=self.scale * near.features), level, coords)

    def change(self, near, level, coords):
        return near


class Layer(nn.Module):
    """One layer, each token alone."""

    def __init__(self, config, inputs):
        super().__init__()
        self.layer = nn.Linear(inputs, 4)

    def forward(self, tokens, active=None):
        return self.change(self.layer(tokens), active)

    def change(self, x, active):
        return x


class Distance:
    """Mean distance, and cross-entropy."""

    def __call__(self, step, truth, iterations):
        index = torch.arange(step.start, step.start + step.coords.shape[1], device=step.coords.device)
        real = index.clamp(max=truth.xyz.shape[1] - 1)
        target, visible = truth.xyz[:, real][:, :, step.columns], truth.visible[:, real][:, :, step.columns]
        counted = (
            (index[None, :, None] >= truth.times[:, None, step.columns])
            & step.active[:, None]
            & (index == real)[None, :, None]
        )
        error = (step.xyz - torch.where(target.isfinite(), target, step.xyz.detach())).abs().sum(-1)
        entropy = F.binary_cross_entropy_with_logits(step.logits, visible.to(step.logits), reduction="none")
        return self.total(error, counted), self.total(entropy, counted)

    def total(self, x, counted):
        return ((x * counted).flatten(1).sum(1) / counted.flatten(1).sum(1).clamp(min=1)).mean()


class Normed(Layer):
    def __init__(self, config, inputs):
        super().__init__(config, inputs)
        self.norm = nn.BatchNorm1d(4)

    def change(self, x, active):
        return self.norm(x.flatten(0, 2)).view(x.shape)


class Blind(Mean):
    def prepare(self, index, level):
        share = level.valid.float().mean((2, 3))[..., None, None, None]
        return replace(level, features=level.features / share)


class NoWidth(Mean):
    def __init__(self, config):
        super().__init__(config)
        del self.width


class Alone(Mean):
    def __init__(self):
        super().__init__(t3d.TrackerConfig(**SIZES))


class Turned(World):
    def from_world(self, xyz, intrinsics, extrinsics):
        return 2 * xyz


class Wide(Layer):
    def __init__(self, config):
        super().__init__(config, 7)


def context(function):
    return type("Broken", (Mean,), {"change": function})


def neighborhood(function):
    return type("Broken", (Nearest,), {"change": function})


def updater(function):
    return type("Broken", (Layer,), {"change": function})


def loss(function):
    return type("Broken", (Distance,), {"total": function})


def space(base=World, **methods):
    return type("Broken", (base,), methods)


def lift(function):
    return space(lift=lambda self, *cameras: function(World.lift(self, *cameras)))


def world(function):
    return space(from_world=lambda self, xyz, intrinsics, extrinsics: function(xyz), to_world=lambda self, x, *_: x)


MEAN = Distance.total
BROKEN = [
    # what comes out
    ("context", "shape", context(lambda self, x, near: x[..., :-1]), "level 0 has shape"),
    ("neighborhood", "shape", neighborhood(lambda self, near, *_: replace(near, points=near.points[..., :2])), "points"),
    ("updater", "shape", updater(lambda self, x, _: x[..., :3]), "corrections has shape (2, 4, 3, 3), expected (2, 4, 3, 4)"),
    ("updater", "shape", updater(lambda self, x, _: x.transpose(1, 2)), "expected (2, 4, 3, 4)"),
    ("space", "shape", lift(lambda x: x[..., :2]), "lift has shape"),
    ("loss", "shape", loss(lambda self, x, counted: (x * counted).mean((1, 2))), "position has shape (2,), expected ()"),
    ("context", "type", context(lambda self, x, near: [x]), "is list, expected a tensor"),
    ("context", "dtype", context(lambda self, x, near: x.double()), "torch.float64, expected torch.float32"),
    ("neighborhood", "dtype", neighborhood(lambda self, near, *_: replace(near, indices=near.indices.int())), "int32"),
    ("updater", "dtype", updater(lambda self, x, _: x.half()), "torch.float16"),
    ("space", "dtype", lift(lambda x: x.double()), "torch.float64"),
    ("loss", "dtype", loss(lambda self, x, counted: MEAN(self, x, counted).double()), "torch.float64"),
    # devices
    ("context", "device", context(lambda self, x, near: x + torch.zeros(self.width)), "made on the CPU"),
    ("neighborhood", "device", neighborhood(lambda self, near, *_: replace(near, points=near.points + torch.zeros(3))), "add"),
    ("updater", "device", updater(lambda self, x, _: x * torch.ones(4)), "mul"),
    ("updater", "device", updater(lambda self, x, _: x @ torch.eye(4)), "two devices"),
    ("updater", "device", updater(lambda self, x, _: torch.zeros(x.shape) + 1e-9 * float(x.shape[0])), "on the CPU"),
    ("space", "device", lift(lambda x: x + torch.zeros(3)), "made on the CPU"),
    ("loss", "device", loss(lambda self, x, counted: MEAN(self, x * torch.ones(x.shape[1:]), counted)), "made on the CPU"),
    ("updater", "device", updater(lambda self, x, _: x + float(np.mean(x.detach().numpy())) * 0), "values are taken to the CPU"),
    # numbers
    ("context", "finite", context(lambda self, x, near: x.log()), "for ordinary inputs"),
    ("context", "finite", Blind, "where a frame has no depth"),
    ("neighborhood", "finite", neighborhood(lambda self, near, *_: replace(near, features=near.features / near.points.std((-1, -2), keepdim=True))), "no depth"),
    ("updater", "finite", updater(lambda self, x, active: x / active.float().mean()), "without an active track"),
    ("space", "finite", lift(lambda x: x / (x[..., 2:] - x[..., 2:].amin((-2, -3), keepdim=True)).clamp(max=1.0)), "lift"),
    ("loss", "finite", loss(lambda self, x, counted: (x * counted).sum() / counted.sum()), "without an active track"),
    ("loss", "finite", loss(lambda self, x, counted: MEAN(self, x.square().sqrt() + 0 * x.sqrt(), counted)), "gradients are NaN or infinite"),
    # what belongs together and what does not
    ("context", "batch", context(lambda self, x, near: x - x.mean(0)), "other clips"),
    ("neighborhood", "batch", neighborhood(lambda self, near, *_: replace(near, features=near.features / near.features.std())), "clips"),
    ("updater", "batch", updater(lambda self, x, _: x - x.mean((0, 1, 2))), "other clips"),
    ("updater", "batch", Normed, "other clips"),
    ("space", "batch", space(Camera, lift=lambda self, *x: Camera.lift(self, *x) * (1 + x[0].mean())), "other clips"),
    ("loss", "batch", loss(lambda self, x, counted: (x * counted).sum((1, 2)).square().sum().sqrt()), "other clips"),
    ("context", "tracks", context(lambda self, x, near: x - x.mean(2, keepdim=True)), "other tracks"),
    ("neighborhood", "tracks", neighborhood(lambda self, near, *_: replace(near, features=near.features + near.features.mean(2, keepdim=True))), "other tracks"),
    # gradients
    ("context", "gradient", context(lambda self, x, near: x.detach()), "no gradient at all"),
    ("context", "gradient", context(lambda self, x, near: x - near.features.mean((-1, -2)).unsqueeze(-1).detach()), None),
    ("context", "gradient", type("Broken", (Mean,), {"describe": lambda self, index, support: support.features[..., 0, :].detach()}), "depend on own"),
    ("context", "gradient", type("Broken", (Mean,), {"prepare": lambda self, index, level: replace(level, features=level.features.detach())}), "depend on features"),
    ("neighborhood", "gradient", neighborhood(lambda self, near, *_: replace(near, features=near.features.detach())), "no gradient at all"),
    ("updater", "gradient", updater(lambda self, x, _: x.round()), "gradient"),
    ("space", "gradient", world(lambda x: x.detach()), "no gradient at all"),
    ("loss", "gradient", loss(lambda self, x, counted: MEAN(self, x.detach(), counted)), "no gradient at all"),
    # the same each time
    ("context", "random", context(lambda self, x, near: F.dropout(x, 0.5)), "two calls"),
    ("neighborhood", "random", neighborhood(lambda self, near, *_: replace(near, features=near.features + torch.rand(()))), "two calls"),
    ("updater", "random", updater(lambda self, x, _: x + np.random.default_rng().random()), "two calls"),
    ("space", "random", lift(lambda x: x + torch.randn_like(x)), "two calls"),
    ("loss", "random", loss(lambda self, x, counted: MEAN(self, x, counted) * torch.rand(())), "two calls"),
    # values that are defined
    ("neighborhood", "values", neighborhood(lambda self, near, *_: replace(near, center=near.center + 1)), "center"),
    ("neighborhood", "values", neighborhood(lambda self, near, *_: replace(near, indices=near.indices + 10**6)), "indices lie outside"),
    ("space", "values", Turned, "not the inverse"),
    ("space", "values", lift(lambda x: x.flip(-3)), "not the pixel that was lifted"),
    # how it is made and called
    ("context", "constructor", Alone, "Alone() must be made by Alone(config)"),
    ("context", "constructor", NoWidth, "sets self.width"),
    ("updater", "constructor", Wide, "must be made by Wide(config, inputs)"),
    ("neighborhood", "constructor", type("Broken", (Nearest,), {"__init__": lambda self, config, more: None}), "must be made by Broken(config)"),
    ("loss", "constructor", type("Broken", (Distance,), {"__init__": lambda self, config: None}), "must be made by Broken()"),
    ("space", "constructor", type("Broken", (World,), {"__init__": lambda self, config: None}), "must be made by Broken()"),
    ("context", "call", type("Broken", (Mean,), {"forward": lambda self, index, near: near.features.mean(-2)}), "forward(index, kept, near)"),
    ("neighborhood", "call", type("Broken", (Nearest,), {"forward": lambda self, level, coords: coords}), "forward(level, coords, cells)"),
    ("updater", "call", type("Broken", (Layer,), {"forward": lambda self, tokens: self.layer(tokens)}), "forward(tokens, active)"),
    ("loss", "call", lambda step, truth, iterations: step.logits.mean(), "not a tuple (position, visibility)"),
    ("space", "call", type("Broken", (), {name: lambda self: None for name in ("lift", "from_world", "to_world", "to_pixels")}), "lift, from_world"),
]  # fmt: skip


@pytest.mark.parametrize(("switch", "part"), [("context", Mean), ("neighborhood", Nearest), ("updater", Layer), ("loss", Distance), ("space", Camera)])  # fmt: skip
def test_the_parts_that_are_broken_below_pass_as_they_are(switch, part):
    started = time.process_time()
    report = lab.check_part(part)
    assert report.ok and report.switch == switch, report
    assert time.process_time() - started < 4


@pytest.mark.parametrize(("switch", "kind", "part", "text"), BROKEN)
def test_what_is_broken_is_named(switch, kind, part, text):
    report = lab.check_part(part, switch)
    if text is None:
        assert report.ok, report
        return
    assert kind in report.faults and text in report.faults[kind], report
    assert kind in str(report) and f"({switch}): {len(report.faults)} fault" in repr(report)
    assert all("\n" not in sentence for sentence in report.faults.values())


@pytest.mark.parametrize(
    "part", [3, "moon", "no_such_module:Part", "tapip3d_lite.clip:Nothing", nn.Linear, print, "planes"]
)
def test_it_raises_nothing(part):
    assert not lab.check_part(part).ok


def test_switches_are_guessed_and_functions_tried():
    def near(level, coords, cells):
        index = torch.zeros(*coords.shape[:3], 2, dtype=torch.long, device=coords.device)
        features, points = (x.flatten(2, 3)[:, :, :2].unsqueeze(2).expand(-1, -1, coords.shape[2], -1, -1) for x in (level.features, level.points))  # fmt: skip
        return Neighbors(features, points, coords, index)

    def still(tokens, active=None):
        return tokens[..., :4]

    def looks(index, kept, near):
        return (kept[:, None, :, :1] * near.features).sum(-1)[..., :3]

    looks.width = 3
    reports = [lab.check_part(x) for x in (near, still, looks)]
    assert [(x.switch, x.ok) for x in reports] == [("neighborhood", True), ("updater", True), ("context", True)]
    assert (
        lab.check_part(LossConfig(soften=2.0)).ok and lab.check_part("tapip3d_lite.model.n2n:N2N").switch == "context"
    )
    assert "say switch=" in lab.check_part(lambda x: x).faults["switch"]
    config = t3d.TrackerConfig(**SIZES)
    assert lab.check_part(Mean(config), config=config).ok  # an instance has sizes of its own


def test_the_callers_random_numbers_stay():
    torch.manual_seed(3)
    before = torch.get_rng_state()
    lab.check_part(Mean)
    assert torch.equal(before, torch.get_rng_state())
