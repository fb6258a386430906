"""A step that reads no number from the device: the same gradients, and nothing that a CUDA graph cannot hold."""

from dataclasses import replace

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from tapip3d_lite.model.blocks import DEGREES
from tapip3d_lite.model.neighbors import KNearest
from tapip3d_lite.speed.cuda_graph import CudaGraphStep, sync_free
from tapip3d_lite.training.data import SamplingConfig
from tapip3d_lite.training.trainer import Trainer
from tests.tiny import SIZES, SYSTEMS, recipe

READS = ("_local_scalar_dense", "nonzero", "lift_fresh", "unique", "masked_select", "is_nonzero")


class Reads(TorchDispatchMode):
    """Collects operations that make a CPU wait for a GPU, or copy constants to it."""

    def __enter__(self):
        self.names = []
        return super().__enter__()

    def __torch_dispatch__(self, function, types, arguments=(), options=None):
        name = str(function)
        self.names += [name for read in READS if read in name]
        if name.startswith("aten.index"):
            tensors = [x for part in arguments if isinstance(part, list | tuple) for x in part]
            self.names += [name for x in tensors if isinstance(x, torch.Tensor) and x.dtype == torch.bool]
        return function(*arguments, **(options or {}))


def make_trainer(folder, clips, **switches):
    # Some tracks have their query so late that they do not belong to the first window.
    late = {"sampling": SamplingConfig(tracks=6, anywhere=1.0, seen=0.0), "frames": (8, 8), "batch": 2}
    config = recipe(matching_steps=0, train_encoder=True, tracker={**SIZES, **switches}, **late)
    trainer = Trainer(folder, config, clips)
    if trainer.tracker.config.neighborhood == "knn":
        trainer.tracker.neighborhood = KNearest(trainer.tracker.config)  # boxes are for a CPU
    return trainer


@pytest.fixture
def trainer(tmp_path, clips, monkeypatch):
    # The order of sums differs with masked tracks, and 2^13 x would magnify the last bit.
    monkeypatch.setattr("tapip3d_lite.model.blocks._SCALES", tuple(2.0 ** min(degree, 2) for degree in DEGREES))
    return make_trainer(tmp_path, clips)


def gradients(trainer, batch):
    trainer.optimizer.zero_grad()
    line = trainer._track(batch)
    return line, [p.grad.clone() for p in trainer.parameters if p.grad is not None]


def alike(some, others):
    """The biases before an instance norm have no gradient but rounding, of 1e-9."""
    return all(float((a - b).norm()) < 1e-4 * float(a.norm()) + 2e-8 for a, b in zip(some, others, strict=True))


def test_a_sync_free_step_has_the_same_gradients(trainer):
    batch = trainer.example()
    assert int(batch.truth.times.max()) >= 4  # so that some tracks join later
    line, plain = gradients(trainer, batch)
    with sync_free(trainer.tracker):
        free_line, free = gradients(trainer, batch)
    assert free_line == pytest.approx(line, rel=1e-5) and not trainer.tracker.sync_free
    assert alike(plain, free)


def test_an_ordinary_step_reads_numbers(trainer):
    batch = trainer.example().to("cpu")
    with Reads() as reads:
        trainer._add_gradients(batch, 2)
    assert {"aten._local_scalar_dense.default", "aten.nonzero.default"} <= set(reads.names)


@pytest.mark.parametrize("name", ["paper's", *SYSTEMS])
def test_a_sync_free_step_reads_no_number_from_the_device(tmp_path, clips, name, monkeypatch):
    monkeypatch.setattr("tapip3d_lite.variants.image_spaces.may_wait", lambda x: False)
    trainer = make_trainer(tmp_path, clips, **SYSTEMS.get(name, {}))
    batch = trainer.example().to("cpu")
    with sync_free(trainer.tracker):
        trainer._add_gradients(batch, 2)  # constants are made
        with Reads() as reads:
            trainer._add_gradients(batch, 2)
    assert not reads.names


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_recorded_steps_are_the_steps_themselves(tmp_path, clips):
    logs = []
    for recorded in (False, True):
        config = recipe(matching_steps=0, train_encoder=True, iterations=(1, 2), frames=(6, 8))
        trainer = Trainer(tmp_path / f"{recorded}", config, clips, device="cuda")
        if not recorded:
            trainer._replay = None
        logs.append([line["loss"] for line in trainer.steps()])
    assert logs[1] == pytest.approx(logs[0], rel=1e-2)


def test_a_recording_is_made_for_each_length_and_gets_each_batch(trainer, monkeypatch):
    """With graphs that run the step again in place of a GPU's: inputs, results and gradients go the right ways."""
    made = []

    def record(self, batch, iterations):
        inputs = batch.map(torch.clone)
        results = self._run(inputs, iterations)
        gradients = [p.grad for p in self._parameters]
        made.append((len(batch.frames), iterations))

        class Graph:
            def replay(_):
                for p in trainer.parameters:
                    p.grad = None
                for old, new in zip(results, self._run(inputs, iterations), strict=True):
                    old.copy_(new)
                for old, p in zip(gradients, trainer.parameters, strict=True):
                    if old is not None:
                        old.copy_(p.grad)

        return Graph(), inputs, results, gradients

    batches = [trainer.examples.batch(step, step) for step in range(3)]
    expected = [gradients(trainer, batch) for batch in batches]
    monkeypatch.setattr(CudaGraphStep, "_record", record)
    trainer._replay = CudaGraphStep(trainer._add_gradients, trainer.tracker, trainer.parameters)
    for batch, (line, plain) in zip(batches, expected, strict=True):
        again, replayed = gradients(trainer, batch)
        assert again == pytest.approx(line, rel=1e-5)
        assert alike(plain, replayed)
    assert len(made) == len(set(made)) == 1
    longer = replace(batches[0], iterations=made[0][1] + 1)
    gradients(trainer, longer)
    assert len(made) == len(set(made)) == 2
