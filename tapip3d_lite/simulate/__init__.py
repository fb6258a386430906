"""Small Kubric-like clips with exact truth: MuJoCo throws the bodies, ray casting gives colour, depth and visibility."""

from __future__ import annotations

from tapip3d_lite.simulate.config import SimulationConfig
from tapip3d_lite.simulate.dataset import simulate_dataset
from tapip3d_lite.simulate.recording import Recording
from tapip3d_lite.simulate.simulator import object_maps, record, render_clip, simulate_clip

__all__ = ["Recording", "SimulationConfig", "object_maps", "record", "render_clip", "simulate_clip", "simulate_dataset"]
