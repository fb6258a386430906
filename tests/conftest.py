"""Fixtures for all test modules; the sizes behind them are in `tiny`."""

import os
from unittest import mock

import pytest
import torch

from tapip3d_lite.simulate import SimulationConfig, simulate_dataset


@pytest.fixture(scope="session", autouse=True)
def one_core():
    """Clips are simulated in this process where nobody asks for workers: each would take seconds to start."""
    with mock.patch.object(os, "cpu_count", return_value=1):
        yield


@pytest.fixture(scope="session")
def clips(tmp_path_factory):
    """Three training clips: 8 frames of 32x32, 24 tracks."""
    config = SimulationConfig(frames=8, size=(32, 32), tracks=24)
    return simulate_dataset(tmp_path_factory.mktemp("clips"), 3, config, workers=1, progress=False)


@pytest.fixture
def one_thread():
    """Sums in the same order each time."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
