"""The tracker computes the released model's numbers, at every recorded stage."""

import pytest
import torch

from tests import parity

needs_golden = pytest.mark.skipif(not parity.GOLDEN.is_dir(), reason="the recorded runs are not beside this checkout")


@pytest.fixture(autouse=True, params=["fast", "clear"])
def _form(request, monkeypatch):
    monkeypatch.setattr(parity, "FAST", request.param == "fast")


@needs_golden
@pytest.mark.parametrize(("name", "function"), list(parity.measurements()))
def test_every_recorded_stage(name, function):
    report = function(parity.GOLDEN / f"{name}.npz")
    assert len(report) >= 5
    assert not report.failures()


def test_the_small_set_of_this_checkout():
    report = parity.measure(parity.SMALL)
    assert len(report) >= 20
    assert not report.failures()


def test_the_comparison_can_fail():
    report = parity.Report()
    report.add("same", torch.ones(3), torch.ones(3), 0)
    assert not report.failures()
    report.add("worse", torch.ones(3), torch.tensor([1, 1, 1.5]), 0.1)
    report.add("nan", torch.tensor([float("nan")]), torch.ones(1), 0.1)
    report.same_sets("sets", torch.tensor([[1, 2]]), torch.tensor([[3, 1]]))
    assert set(report.failures()) == {"worse", "nan", "sets"}
