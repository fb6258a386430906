"""Weights on disk: one safetensors file with the parameters and, in its header, the config.

    file = {parameter name: tensor},  header = {"format": "tapip3d_lite", "config": TrackerConfig as JSON}

Such a file holds no code, and classes that its config names are imported only where the caller allows it. The authors'
checkpoints are read by `official.load_official`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import safetensors.torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from tapip3d_lite.files import atomic_path, regular
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.outline import NoValues
from tapip3d_lite.validate import check_device, check_state

_FORMAT = "tapip3d_lite"


def save_weights(tracker: Tracker, path: str | Path, half: bool = False) -> None:
    """Write parameters and config as one safetensors file, atomically; missing folders are made.

    With `half` floats are stored in 16 bits, which halves the file; they are read back as 32-bit ones.

    Raises:
        ValueError: a custom part that is no class, which no file can name, or parameters that are not finite.
    """
    config = json.dumps(tracker.config.to_dict())
    state = {name: (x.half() if half else x).contiguous() for name, x in tracker.state_dict().items()}
    check_state(state, state)
    data = safetensors.torch.save(state, metadata={"format": _FORMAT, "config": config})
    end = 8 + int.from_bytes(data[:8], "little")
    # Sorted, since safetensors orders at random: same weights, same bytes.
    header = json.dumps(json.loads(data[8:end]), sort_keys=True).encode()
    header = header.ljust(-(-len(header) // 8) * 8)
    with atomic_path(path) as temporary:
        temporary.write_bytes(len(header).to_bytes(8, "little") + header + data[end:])


def load_weights(
    path: str | Path, device: Any = "cpu", fast: bool = True, parts: Sequence[Any] | type | str = ()
) -> Tracker:
    """Read a tracker that `save_weights` wrote, in evaluation mode, to a device; `fast` as for `Tracker`.

    Custom parts that the file names must be among `parts`: classes, matched by name, or names of modules to import.

    Raises:
        ValueError: missing, truncated or foreign file, a part that is not allowed, parameters that do not fit or are NaN.
    """
    check_device(device)
    state, config = read_weights(path)
    try:
        made = TrackerConfig.from_dict(config, parts)
        check_state(state, outline(made).state_dict())
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from error
    tracker = Tracker(made, fast)
    tracker.load_state_dict(state)
    return tracker.to(device).eval()


def read_weights(path: str | Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Parameters and config as they stand in a file of `save_weights`, else ValueError; nothing is imported."""
    regular(path)
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dictionary)
    except (SafetensorError, MemoryError) as error:
        raise ValueError(
            f"{path}: not a readable safetensors file ({error}); the authors' .pth goes through load_official"
        ) from error
    if metadata.get("format") != _FORMAT:
        raise ValueError(f"{path}: safetensors without a {_FORMAT} config; it belongs to another program")
    try:
        return state, dict(json.loads(metadata["config"]))
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{path}: no readable config ({error}); the file is damaged") from error


def outline(config: TrackerConfig) -> Tracker:
    """A tracker whose parameters have shapes but take no memory (unless parts are custom), to compare a file with."""
    with nullcontext() if config.custom else NoValues():
        return Tracker(config, fast=False)
