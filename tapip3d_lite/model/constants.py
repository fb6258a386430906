"""Small constant tensors, made once for each device: a GPU would wait for every copy from the CPU."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor


def constant(values: tuple[float, ...], like: Tensor) -> Tensor:
    """A tensor of some numbers, not to be changed, with the type and on the device of another one."""
    if torch.compiler.is_compiling():  # there they are part of the program
        return torch.tensor(values, dtype=like.dtype, device=like.device)
    return _constant(values, like.dtype, like.device)


@lru_cache(maxsize=256)
def _constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):  # also those who train use it
        return torch.tensor(values, dtype=dtype, device=device)
