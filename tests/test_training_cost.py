"""Where a step's time goes, and what it keeps: flat with the memory-saving backward, growing without."""

import time

import pytest
import torch

from tests.bench.training_cost import SavedBytes, backward_memory, memory_table, split_table, step_split
from tests.tiny import SIZES, recipe


def test_saved_bytes_by_hand():
    x = torch.ones(10, requires_grad=True)
    with SavedBytes() as memory:
        y = x.exp()  # keeps its result
        assert memory.now == 40
        z = y.square()  # keeps its input
        assert memory.now == 80
        z.sum().backward()
    assert (memory.now, memory.most) == (0, 80) and torch.allclose(x.grad, 2 * (2 * x).exp().detach())


def test_memory_is_flat_with_the_saving_backward_and_grows_without():
    rows = backward_memory((1, 2, 4), (1, 3), tracks=8, **{k: v for k, v in SIZES.items() if k != "iterations"})
    assert [(r["iterations"], r["windows"]) for r in rows] == [(1, 1), (2, 1), (4, 1), (1, 3)]
    one, two, four, long = rows
    assert four["saving"] < 1.15 * one["saving"] and long["saving"] < 1.3 * one["saving"]
    assert four["plain"] > 1.5 * two["plain"] > 2.1 * one["plain"] and long["plain"] > 2 * one["plain"]
    assert f"| 4 | 1 | {four['saving'] / 1e6:.1f} | {four['plain'] / 1e6:.1f} |" in memory_table(rows)


@pytest.mark.parametrize("train_encoder", [False, True])
def test_parts_add_up_to_the_step(clips, train_encoder):
    config = recipe(train_encoder=train_encoder)
    backward = torch.Tensor.backward
    seconds = step_split(config, clips, steps=1, warm=1)
    assert torch.Tensor.backward is backward and ("encoder" in seconds) == train_encoder
    whole = seconds.pop("whole step")
    assert sum(seconds.values()) == pytest.approx(whole) and min(seconds.values()) > 0
    assert "100%" in split_table(seconds | {"whole step": whole})


def test_the_first_steps_of_the_recipe_are_measured(clips, monkeypatch):
    from tapip3d_lite.training.examples import Examples

    drawn, lengths = [], Examples.lengths
    monkeypatch.setattr(Examples, "lengths", lambda self, *place: drawn.append(lengths(self, *place)) or drawn[-1])
    step_split(recipe(short=0.1, steps=60), clips, steps=5, warm=1)
    assert set(drawn) == {(4, 2)}


def test_time_is_put_where_it_was_spent(clips, monkeypatch):
    from tapip3d_lite.training.trainer import Trainer

    example = Trainer.example
    monkeypatch.setattr(Trainer, "example", lambda self: time.sleep(0.5) or example(self))
    assert step_split(recipe(), clips, steps=1, warm=0)["data"] > 0.5
