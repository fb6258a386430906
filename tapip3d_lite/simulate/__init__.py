"""Small Kubric-like clips with exact ground truth: MuJoCo's physics and ray casting."""

from __future__ import annotations

from tapip3d_lite.simulate.dataset import simulate_dataset
from tapip3d_lite.simulate.rollout import Rollout
from tapip3d_lite.simulate.settings import SimulationConfig
from tapip3d_lite.simulate.simulator import object_maps, render_clip, simulate_clip, simulate_rollout

__all__ = ["Rollout", "SimulationConfig"]
__all__ += ["object_maps", "render_clip", "simulate_clip", "simulate_dataset", "simulate_rollout"]
