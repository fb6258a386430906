"""Exercise of notebook 06: backpropagation that holds one update at a time, tried on a chain that watches its use."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from lessons.checker import Exercise, Mistake


class EncoderFreedError(RuntimeError):
    """The encoder's graph was walked before, and nothing had asked to keep it."""


class NotDetachedError(RuntimeError):
    """An estimate still hangs on the update before, whose graph was walked already."""


class Chain:
    """A tracker in miniature: an "encoder", M updates that all read its features, and a loss after each.

    It watches how it is used: how many updates autograd holds in memory at once, and how often the encoder is passed.

    Attributes:
        x: the first estimate.
        updates: M.
        held: most updates held at once so far.
        passes: through the encoder, forward and backward together.
    """

    def __init__(self, rng: np.random.Generator, updates: int, width: int = 3) -> None:
        def normal(*shape: int) -> Tensor:
            return torch.from_numpy(rng.normal(size=shape))

        self.image, self.x, self.truth = normal(4, width), normal(4, width), normal(4, width)
        self.encoder, self.updater = (normal(width, width).requires_grad_() for _ in range(2))
        self.updates = updates
        self.held = self.passes = self._alive = 0
        self._walked = False  # whether the last update was backpropagated

    def encode(self) -> Tensor:
        """The features; costly, in a real tracker."""
        self.passes += 1
        return _Encoder.apply(self.image, self.encoder, self)

    def update(self, x: Tensor, features: Tensor) -> Tensor:
        """Correct the estimate x once."""
        if x.requires_grad and self._walked:
            raise NotDetachedError("x still hangs on the update before, whose graph was walked already")
        self._walked, token = False, _Alive(self)
        with torch.autograd.graph.saved_tensors_hooks(lambda kept: (kept.detach(), token), _unpack):
            return x + torch.tanh((x + features) @ self.updater)

    def loss(self, x: Tensor, m: int) -> Tensor:
        """The discounted loss of update m = 1 ... M."""
        return 0.8 ** (self.updates - m) * (x - self.truth).square().mean()

    def result(self) -> tuple[Tensor, Tensor, int]:
        """Gradients of encoder and updater, and most updates held at once."""
        gradients = (torch.zeros_like(p) if p.grad is None else p.grad.clone() for p in (self.encoder, self.updater))
        return *gradients, self.held

    def __repr__(self) -> str:
        return f"a chain of {self.updates} updates"

    def __deepcopy__(self, memo: dict) -> Chain:
        fresh = copy.copy(self)
        fresh.encoder, fresh.updater = (p.detach().clone().requires_grad_() for p in (self.encoder, self.updater))
        return fresh


class _Encoder(torch.autograd.Function):
    """tanh(image @ weights), counting the walks back."""

    @staticmethod
    def forward(ctx: object, image: Tensor, weights: Tensor, chain: Chain) -> Tensor:
        features = torch.tanh(image @ weights)
        ctx.save_for_backward(image, features)
        ctx.chain = chain
        return features

    @staticmethod
    def backward(ctx: object, gradient: Tensor) -> tuple[None, Tensor, None]:
        try:
            image, features = ctx.saved_tensors
        except RuntimeError:
            raise EncoderFreedError("the encoder's graph was walked before, and is freed") from None
        ctx.chain.passes += 1
        return None, image.T @ (gradient * (1 - features**2)), None


def _unpack(pair: tuple[Tensor, _Alive]) -> Tensor:
    pair[1].chain._walked = True
    return pair[0]


class _Alive:
    """Lives as long as autograd keeps anything of one update."""

    def __init__(self, chain: Chain) -> None:
        self.chain = chain
        chain._alive += 1
        chain.held = max(chain.held, chain._alive)

    def __del__(self) -> None:
        self.chain._alive -= 1


def saving(
    chain: Chain,
    leaf: bool = True,
    collects: bool = True,
    detached: bool = True,
    keep: bool = False,
    encode: bool = False,
    early: bool = False,
    last: bool = False,
    hand: bool = True,
) -> Sequence[object]:
    """One update's graph at a time; other values than the defaults make mistakes.

    Args:
        chain: a `Chain`, or what is used like one.
        leaf: updates read a leaf, else the features themselves.
        collects: the leaf requires a gradient.
        detached: cut the estimate off its history after each update.
        keep: retain the graph of every walk.
        encode: anew for every update.
        early: hand the leaf's gradient on after every update.
        last: only the last update has a loss.
        hand: the leaf's gradient on to the encoder, at the end.
    """
    features, x = chain.encode(), chain.x
    read = features.detach().requires_grad_(collects) if leaf else features
    for m in range(1, chain.updates + 1):
        x = chain.update(x, chain.encode() if encode else read)
        if m == chain.updates or not last:
            chain.loss(x, m).backward(retain_graph=keep)
        x = x.detach() if detached else x
        if early:
            features.backward(read.grad, retain_graph=True)
    if leaf and hand and not early and not encode:
        features.backward(read.grad)
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


def passes(answer: Callable[[Chain], object], arguments: tuple) -> int:
    """How often an answer passes through the chain's encoder, forward and backward together."""
    answer(*arguments)
    return arguments[0].passes


def _slipped(**slip: bool) -> Callable[[Chain], Sequence[object]]:
    return lambda chain: saving(chain, **slip)


BACKWARD = Exercise(
    "06.backward",
    reference=saving,
    cases=lambda rng, size: (Chain(rng, updates=1 + size),),
    tolerance=1e-9,
    cost=passes,
    cost_unit="passes through the encoder",
    mistakes=(
        Mistake(
            "walked at the end",
            plain,
            "the gradients are right, but all updates wait in memory: call backward inside the loop.",
        ),
        Mistake(
            "walked at the end, not detached",
            lambda chain: plain(chain, detached=False),
            "an update's loss must not reach back into the update before: `x = x.detach()` after each; and call backward "
            "inside the loop.",
        ),
        Mistake(
            "not detached",
            _slipped(detached=False),
            "x still hangs on the update before: `x = x.detach()` at the end of the loop. (`retain_graph` would only make "
            "the walk possible that should not happen.)",
        ),
        Mistake(
            "leaf without gradient",
            _slipped(collects=False),
            "leaf.grad is empty: the leaf must require a gradient, `features.detach().requires_grad_()`, and backward "
            "must have been called before you read it.",
        ),
        Mistake(
            "encoder walked by every update",
            _slipped(leaf=False),
            "the first backward frees the encoder's graph: let updates read `features.detach().requires_grad_()`.",
        ),
        Mistake(
            "encoder's graph retained",
            _slipped(leaf=False, keep=True),
            "`retain_graph` makes every update walk through the whole encoder again. Collect the features' gradient in "
            "a leaf, and walk once.",
        ),
        Mistake(
            "handed on too early",
            _slipped(early=True),
            "leaf.grad adds up over the updates; handed on after each one, early updates count several times. Hand it "
            "on once, after the loop.",
        ),
        Mistake(
            "encoder forgotten",
            _slipped(hand=False),
            "the leaf has collected its gradient, but the encoder has not got it: features.backward(leaf.grad).",
        ),
        Mistake(
            "encoded again",
            _slipped(encode=True),
            "encode once, before the loop; every update reads the same features.",
        ),
        Mistake(
            "last loss only",
            _slipped(last=True),
            "every update has a loss of its own, not only the last one.",
        ),
    ),
)
