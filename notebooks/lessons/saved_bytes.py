"""`SavedBytes`: how much memory autograd keeps for the backward pass, in bytes of distinct storages."""

from __future__ import annotations

from collections import Counter

import torch
from torch import Tensor


class SavedBytes:
    """Counts, while it is entered, the bytes that autograd keeps for the backward pass.

    Tensors that share a storage (views, and one tensor that several operations keep) count once.

    Attributes:
        now: bytes kept at this moment.
        most: the greatest number so far.
    """

    def __init__(self) -> None:
        self.now = self.most = 0
        self._keepers: Counter[int] = Counter()  # by the address of a storage: how many kept tensors use it

    def __enter__(self) -> SavedBytes:
        self._hooks = torch.autograd.graph.saved_tensors_hooks(lambda x: _Kept(x, self), lambda kept: kept.tensor)
        self._hooks.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._hooks.__exit__(*error)


class _Kept:
    """A tensor that autograd keeps; this object lives exactly as long as autograd needs it."""

    def __init__(self, tensor: Tensor, counter: SavedBytes) -> None:
        self.tensor, self.counter = tensor.detach(), counter
        storage = tensor.untyped_storage()
        self.address, self.bytes = storage.data_ptr(), storage.nbytes()
        if not counter._keepers[self.address]:
            counter.now += self.bytes
            counter.most = max(counter.most, counter.now)
        counter._keepers[self.address] += 1

    def __del__(self) -> None:
        self.counter._keepers[self.address] -= 1
        if not self.counter._keepers[self.address]:
            self.counter.now -= self.bytes
