"""Exercise of notebook 06: backpropagation that holds one update at a time, tried on a chain that watches its use."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from lessons.checker import Exercise, Mistake


class Chain:
    """A tracker in miniature: an "encoder", M updates that all read its features, and a loss after each.

    It watches how it is used: how often it encodes, and how many updates autograd holds in memory at once.
    """

    def __init__(self, rng: np.random.Generator, updates: int, width: int = 3) -> None:
        def normal(*shape: int) -> Tensor:
            return torch.from_numpy(rng.normal(size=shape))

        self.image, self.x, self.truth = normal(4, width), normal(4, width), normal(4, width)
        self.encoder, self.updater = (normal(width, width).requires_grad_() for _ in range(2))
        self.updates = updates
        self._encoded, self._alive, self._most = 0, 0, 0

    def encode(self) -> Tensor:
        """The features; costly, in a real tracker."""
        self._encoded += 1
        return torch.tanh(self.image @ self.encoder)

    def update(self, x: Tensor, features: Tensor) -> Tensor:
        """Correct the estimate x once."""
        token = _Alive(self)
        with torch.autograd.graph.saved_tensors_hooks(lambda kept: (kept, token), lambda pair: pair[0]):
            return x + torch.tanh((x + features) @ self.updater)

    def loss(self, x: Tensor, m: int) -> Tensor:
        """The discounted loss of update m = 1 ... M."""
        return 0.8 ** (self.updates - m) * (x - self.truth).square().mean()

    def result(self) -> tuple[Tensor, Tensor, int, int]:
        """Gradients of encoder and updater, most updates held at once, and how often the image was encoded."""
        gradients = (torch.zeros_like(p) if p.grad is None else p.grad.clone() for p in (self.encoder, self.updater))
        return *gradients, self._most, self._encoded

    def __repr__(self) -> str:
        return f"a chain of {self.updates} updates"

    def __deepcopy__(self, memo: dict) -> Chain:
        fresh = copy.copy(self)
        fresh.encoder, fresh.updater = (p.detach().clone().requires_grad_() for p in (self.encoder, self.updater))
        return fresh


class _Alive:
    """Lives as long as autograd keeps anything of one update."""

    def __init__(self, chain: Chain) -> None:
        self.chain = chain
        chain._alive += 1
        chain._most = max(chain._most, chain._alive)

    def __del__(self) -> None:
        self.chain._alive -= 1


def saving(chain: Chain, **slip: bool) -> Sequence[object]:
    """One update's graph at a time; `slip` makes one mistake."""
    features = chain.encode()
    leaf, x = features.detach().requires_grad_(), chain.x
    for m in range(1, chain.updates + 1):
        x = chain.update(x, chain.encode() if slip.get("encodes_again") else leaf)
        if m == chain.updates or not slip.get("last_only"):
            chain.loss(x, m).backward()
        x = x.detach()
    if leaf.grad is not None and not slip.get("encoder_forgotten"):
        features.backward(leaf.grad)
    return chain.result()


def plain(chain: Chain, detached: bool = True) -> Sequence[object]:
    """The same gradients by one walk over the sum of all losses; not the same unless `detached`."""
    features, x, total = chain.encode(), chain.x, torch.zeros(())
    for m in range(1, chain.updates + 1):
        x = chain.update(x, features)
        total = total + chain.loss(x, m)
        x = x.detach() if detached else x
    total.backward()
    return chain.result()


def _no_leaf(chain: Chain) -> Sequence[object]:
    features, x = chain.encode(), chain.x
    for m in range(1, chain.updates + 1):
        x = chain.update(x, features)
        chain.loss(x, m).backward()
        x = x.detach()
    return chain.result()


BACKWARD = Exercise(
    "06.backward",
    reference=saving,
    cases=lambda rng, size: (Chain(rng, updates=1 + size),),
    tolerance=1e-9,
    mistakes=(
        Mistake(
            "walked at the end",
            plain,
            "the gradients are right, but all updates wait in memory: call backward inside the loop.",
        ),
        Mistake(
            "not detached",
            lambda chain: plain(chain, detached=False),
            "an update's loss must not reach back into the update before: x.detach() after each.",
        ),
        Mistake(
            "encoder walked by every update",
            _no_leaf,
            "the first backward frees the encoder's graph: let updates read `features.detach().requires_grad_()`.",
        ),
        Mistake(
            "encoder forgotten",
            lambda chain: saving(chain, encoder_forgotten=True),
            "the leaf has collected its gradient, but the encoder has not got it: features.backward(leaf.grad).",
        ),
        Mistake(
            "encoded again",
            lambda chain: saving(chain, encodes_again=True),
            "encode once, before the loop; every update reads the same features.",
        ),
        Mistake(
            "last loss only",
            lambda chain: saving(chain, last_only=True),
            "every update has a loss of its own, not only the last one.",
        ),
    ),
)
