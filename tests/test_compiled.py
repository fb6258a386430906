"""A training whose parts torch compiles takes the same steps; the backend here is fast and needs no compiler."""

from collections import Counter
from functools import cache
from types import MethodType

import pytest
import torch
from torch import nn
from torch._dynamo import config as dynamo
from torch._dynamo.backends.debugging import aot_eager
from torch._dynamo.utils import counters
from torch._functorch import config as functorch

import tapip3d_lite as t3d
from tapip3d_lite.lab import make_trainer
from tapip3d_lite.model.blocks import DEGREES
from tapip3d_lite.model.neighbors import KNearest
from tapip3d_lite.speed.cuda_graph import support_at_once
from tapip3d_lite.training.data import SamplingConfig
from tests.tiny import SIZES, recipe


@pytest.fixture
def graphs(monkeypatch):
    """How many graphs were compiled for each kind of module."""
    made = Counter()

    @cache  # a graph is used again by modules of the same kind only if their backend is the same
    def backend(kind):
        def count(graph, inputs):
            made[kind] += 1
            return aot_eager(graph, inputs)

        return count

    def compile_module(self, **options):
        self._compiled_call_impl = torch.compile(self._call_impl, backend=backend(type(self).__name__), **options)

    monkeypatch.setattr(nn.Module, "compile", compile_module)
    torch._dynamo.reset()
    counters.clear()
    with dynamo.patch(recompile_limit=dynamo.recompile_limit), functorch.patch(donated_buffer=True):
        yield made
    torch._dynamo.reset()
    counters.clear()


# Dynamo looks at the gradient of every tensor that it is given.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf Tensor:UserWarning")
def test_compiled_parts_take_the_same_steps(tmp_path, clips, graphs, monkeypatch):
    # Compiled, images are resized with other rounding (1e-6), which 2^13 x would make 1e-2 by the second update.
    monkeypatch.setattr("tapip3d_lite.model.blocks._SCALES", tuple(2.0 ** min(degree, 2) for degree in DEGREES))
    monkeypatch.setattr("tapip3d_lite.model.tracker.query_support", support_at_once)  # as on a GPU
    sampling = SamplingConfig(tracks=6, seen=1.0, anywhere=0.0)  # all queries are in the first frame
    sizes = {"frames": 6, "sampling": sampling, "tracker": SIZES | {"time_depth": 2, "space_depth": 2}}  # two windows
    config = recipe(train_encoder=True, matching_steps=0, steps=2, evaluate_every=2, **sizes)
    logs = []
    for compiled in (False, True):
        held_out = [t3d.load_clip(clips[0])]
        trainer = make_trainer(tmp_path / f"{compiled}", config, clips, held_out, compiled=compiled)
        searches = trainer.tracker.neighborhood  # boxes are for a CPU, which does not compile
        searches.search = MethodType(KNearest.search, searches)
        assert not graphs
        logs.append(list(trainer.steps()))
    one, other = ([[line[name] for name in ("loss", "norm")] for line in log] for log in logs)
    torch.testing.assert_close(torch.tensor(other), torch.tensor(one), rtol=1e-5, atol=0)
    assert len(one) == 2 and "val_AJ3D_none" in logs[1][-1]
    assert not counters["graph_break"]
    # One for all updates, windows, steps and levels. Searches see two sizes of level, in a window and in the example;
    # blocks are one over time and three kinds over tracks.
    assert graphs == {"FoldedN2N": 1, "Encoder": 1, "BoxKNearest": 4, "Block": 4}
    assert counters["stats"]["unique_graphs"] == 10
