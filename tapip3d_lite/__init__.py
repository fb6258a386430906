"""tapip3d_lite: TAPIP3D ("Tracking Any Point in Persistent 3D Geometry") small enough to read, exact where it matters.

Names are loaded on first use, so that `import tapip3d_lite` is instant and a clip can be read without torch models,
MuJoCo or plotly being imported.
"""

from __future__ import annotations

from importlib import import_module
from inspect import isfunction

__version__ = "0.1.0"

_HOMES = {
    "clip": ["Clip", "Tracks", "check_queries"],
    "formats.arrays": ["load_tracks"],
    "formats": ["load_clip", "save_clip"],
    "queries": ["dense_queries", "grid_queries", "has_depth", "queries_from_pixels", "resolve_queries"],
    "depth": ["densify_depth", "filter_depth", "register_depth", "stereo_depth"],
    "check": ["check_clip"],
    "poses": ["carry", "estimate_poses", "steady_clip"],
    "simulate": ["SimulationConfig", "simulate_clip"],
    "evaluation.metrics": ["tapvid2d_metrics", "tapvid3d_metrics"],
    "evaluation.evaluate": ["evaluate"],
    "export": ["export_tracks", "serve_tracks"],
    "trackers": ["list_trackers", "load_tracker", "track_many"],
    "model.config": ["TrackerConfig"],
    "model.tracker": ["Tracker"],
    "model.weights": ["load_weights", "save_weights"],
    "official": ["from_official_state", "load_official"],
    "recorder": ["Recorder"],
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}
_MODULES = ("geometry", "figures")

__all__ = [*_HOME_OF, *_MODULES]


def __getattr__(name: str) -> object:
    if name in _MODULES:
        return import_module(f"{__name__}.{name}")
    if name in _HOME_OF:
        value = getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)
        if isfunction(value):  # what users call checks what they give; the library's own calls need not
            value = import_module(f"{__name__}.validate").checked(value)
            value.__module__ = __name__  # where a pickle finds it
        return globals().setdefault(name, value)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
