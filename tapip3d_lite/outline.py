"""`NoValues`: modules whose parameters have shapes but take no memory."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import torch
from torch.overrides import TorchFunctionMode


class NoValues(TorchFunctionMode):
    """Makes parameters without values; `torch.device("meta")` alone would compute shapes of products for seconds."""

    def __torch_function__(self, function: Callable, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        """Call a function of torch, unless it gives a parameter its first values."""
        name, kwargs = function.__name__, kwargs or {}
        if function in (torch.empty, torch.randn):
            return torch.empty(*args, **(kwargs | {"device": "meta"}))
        first = args[0] if args else next(iter(kwargs.values()), None)
        if (name == "mul" or re.fullmatch("[a-z].*_", name)) and isinstance(first, torch.Tensor) and first.is_meta:
            return first
        return function(*args, **kwargs)
