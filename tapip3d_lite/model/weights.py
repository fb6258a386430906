"""Weights on disk: one safetensors file with the parameters and, in its header, the config.

    file = {parameter name: tensor},  header = {"format": "tapip3d_lite", "config": TrackerConfig as JSON}

Such a file holds no code, and classes that its config names are imported only where the caller allows it. The authors'
checkpoints are read by `official.load_official`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import safetensors.torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from tapip3d_lite.files import atomic_path
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.tracker import Tracker

_FORMAT = "tapip3d_lite"


def save_weights(tracker: Tracker, path: str | Path, half: bool = False) -> None:
    """Write parameters and config as one safetensors file, atomically; missing folders are made.

    With `half` floats are stored in 16 bits, which halves the file; they are read back as 32-bit ones.

    Raises:
        ValueError: the tracker has a custom part that is no class, which no file can name.
    """
    config = json.dumps(tracker.config.to_dict())
    state = {name: (x.half() if half else x).contiguous() for name, x in tracker.state_dict().items()}
    with atomic_path(path) as temporary:
        safetensors.torch.save_file(state, temporary, metadata={"format": _FORMAT, "config": config})


def load_weights(path: str | Path, device: str = "cpu", fast: bool = True, parts: Sequence[Any] = ()) -> Tracker:
    """Read a tracker that `save_weights` wrote, in evaluation mode, to a device; `fast` as for `Tracker`.

    Custom parts that the file names must be among `parts`: classes, matched by name, or names of modules to import.

    Raises:
        ValueError: missing, truncated or foreign file, a part that is not allowed, or parameters that do not fit.
    """
    state, config = read_weights(path)
    tracker = Tracker(TrackerConfig.from_dict(config, parts), fast)
    try:
        tracker.load_state_dict(state)
    except RuntimeError as error:
        raise ValueError(f"{path}: parameters do not fit the config: {str(error).splitlines()[-1].strip()}") from error
    return tracker.to(device).eval()


def read_weights(path: str | Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Parameters and config as they stand in a file of `save_weights`, else ValueError; nothing is imported."""
    if not Path(path).is_file():
        raise ValueError(f"{path}: no such file; check the path")
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dictionary)
    except SafetensorError as error:
        raise ValueError(
            f"{path}: not a readable safetensors file ({error}); the authors' .pth goes through load_official"
        ) from error
    if metadata.get("format") != _FORMAT:
        raise ValueError(f"{path}: safetensors without a {_FORMAT} config; it belongs to another program")
    return state, json.loads(metadata["config"])
