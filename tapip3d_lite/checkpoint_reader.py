"""The authors' checkpoint {"cfg": OmegaConf, "weight": state_dict, …} as plain dictionaries and tensors."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch

from tapip3d_lite.pickled import Name, Record
from tapip3d_lite.saved import read_saved

_VALUES, _DEPTH, _LETTERS = 20_000, 20, 100  # of a configuration: values, levels, letters of a key


def read_checkpoint(path: str | Path) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """The configuration, as plain dictionaries, and the parameters of a checkpoint {"cfg", "weight", …}.

    Raises:
        ValueError: not such a file, or a refused name in its pickle.
    """
    content = read_saved(path)
    content = content if type(content) is dict else {type(content).__name__: content}
    missing = " and ".join(key for key in ("cfg", "weight") if key not in content)
    if missing:
        found = ", ".join(map(str, itertools.islice(content, 20)))
        raise ValueError(f'{path}: expected a checkpoint {{"cfg", "weight"}}, {missing} missing in {found}')
    weight = content["weight"]
    if not isinstance(weight, dict) or not all(isinstance(x, torch.Tensor) for x in weight.values()):
        raise ValueError(f'{path}: expected named tensors in "weight", got {type(weight).__name__} of other things')
    try:
        cfg = plain(content["cfg"])
        return _resolved(cfg, cfg, itertools.count()), {str(name): value for name, value in weight.items()}
    except ValueError as error:
        raise ValueError(f"{path}: {error}; the file is damaged") from None


def plain(value: Any, depth: int = 0, steps: Iterator[int] | None = None) -> Any:
    """Configuration records as plain dictionaries, lists and values; ValueError if too large, as what holds itself is."""
    steps = _count(depth, steps or itertools.count())
    if isinstance(value, Record):
        for key in ("_content", "_val"):
            if key in value.state:
                return plain(value.state[key], depth + 1, steps)
        value = dict(value) or value.state or {"arguments": value.arguments}
    if isinstance(value, Mapping):
        if any(len(str(key)) > _LETTERS for key in value):
            raise ValueError(f"cfg: keys of over {_LETTERS} letters")
        return {key: plain(item, depth + 1, steps) for key, item in value.items()}
    if isinstance(value, Name):
        return ".".join(value)
    if isinstance(value, list | tuple):
        return [plain(item, depth + 1, steps) for item in value]
    if not isinstance(value, str | int | float | None):
        raise ValueError(f"cfg: expected numbers and text, got {type(value).__name__}")
    return value


def _resolved(value: Any, root: Any, steps: Iterator[int], depth: int = 0) -> Any:
    """OmegaConf's references `${a.b.c}` replaced by what they name."""
    _count(depth, steps)
    if isinstance(value, dict):
        return {key: _resolved(item, root, steps, depth + 1) for key, item in value.items()}
    if isinstance(value, list):
        return [_resolved(item, root, steps, depth + 1) for item in value]
    named = re.fullmatch(r"\$\{([\w.]+)\}", value) if isinstance(value, str) else None
    if not named:
        return value
    target = root
    for part in named.group(1).split("."):
        if not isinstance(target, dict) or part not in target:
            return value  # a reference into a part we do not need; the strict mapping complains if we do
        target = target[part]
    return _resolved(target, root, steps, depth + 1)


def _count(depth: int, steps: Iterator[int]) -> Iterator[int]:
    if depth > _DEPTH or next(steps) > _VALUES:
        raise ValueError(f"cfg refers to itself, or has over {_VALUES} values or {_DEPTH} levels")
    return steps
