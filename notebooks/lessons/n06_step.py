"""Lesson 06's milestone: a training step of a real tracker that runs on the learner's own four functions.

What counts, the loss of an update, the discount and the backward pass are theirs; encoder, cloud, neighbourhoods,
N2N and updater are the library's. `TrackerChain` lets a real tracker be used as the chain of exercise 6.4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lessons.milestone import Use, plugged, report
from lessons.verdict import Verdict
from tapip3d_lite.clip import Clip
from tapip3d_lite.model.frames import Frames
from tapip3d_lite.model.spaces import fitted
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.model.windows import State, Step, Window, window_ends
from tapip3d_lite.training import trainer as place
from tapip3d_lite.training.data import Batch, SamplingConfig, make_batch, sample_tracks
from tapip3d_lite.training.loss import LossConfig, Truth

_UPDATES = 3
_AGREE = 1e-6  # of a parameter's largest gradient


def parts(use: Use) -> dict[str, object]:
    """What stands in the library's trainer: a backward pass that is made of the four functions."""
    functions = [use(f"06.{name}") for name in ("counted", "loss", "discount", "backward")]

    def add_gradients(
        tracker: Tracker, frames: Frames, queries: Tensor, truth: Truth, config: LossConfig, **options: Any
    ) -> Tensor:
        chain = TrackerChain(tracker, frames, queries, truth, config, functions[:3], **options)
        functions[3](chain)
        return torch.stack([chain.total, torch.zeros_like(chain.total)])  # the sum; not told apart

    return {"tapip3d_lite.training.trainer:add_gradients": add_gradients}


class TrackerChain:
    """A real tracker, used like `n06_chain.Chain`: the updates of all windows, one after another.

    An estimate is one tensor (B, S, n, 4): normalised coordinates and the logit of visibility.

    Attributes:
        x: the first estimate.
        updates: of all windows together.
        total: the loss so far, without gradient.
    """

    def __init__(
        self,
        tracker: Tracker,
        frames: Frames,
        queries: Tensor,
        truth: Truth,
        config: LossConfig,
        functions: list[Callable[..., Tensor]],
        features: Tensor | None = None,
        watch: Callable[[Step], None] | None = None,
        iterations: int | None = None,
        depth_roi: tuple | None = None,
    ) -> None:
        """As `training.backward.add_gradients`; `functions` are `counted`, the loss and the discount.

        Raises:
            ValueError: a loss of another form than the exercise's.
        """
        if config.form != "paper" or config.visibility != 3 or config.soften or config.within:
            raise ValueError("TrackerChain: exercise 6.2 is the paper's form of the loss with alpha = 3")
        self.tracker, self.frames, self.queries, self.truth, self.config = tracker, frames, queries, truth, config
        self.counted, self.update_loss, self.discounted = functions
        self.features, self.watch, self.roi = features, watch, depth_roi
        self.iterations = iterations or tracker.config.iterations
        size = tracker.config.window
        self.space = fitted(tracker.space, frames)
        self.state = State.start(queries, frames, self.space, size // 2)
        self.ends = list(window_ends(self.state.coords.shape[1], size))
        self.updates, self.total, self._done = len(self.ends) * self.iterations, queries.new_zeros(()), 0
        self.x = self._first_estimate(0, self._window(0, self.encode().detach()))

    def encode(self) -> Tensor:
        """The image features (B, T, C, h, w)."""
        return self.tracker.encoder(self.frames.rgb) if self.features is None else self.features

    def update(self, x: Tensor, features: Tensor) -> Tensor:
        """Correct the estimate once; at the beginning of a window that is the window's own first estimate."""
        index, self._iteration = divmod(self._done, self.iterations)
        if self._iteration == 0 and index > 0:
            self._write(x)
        self.window = self._window(index, features)
        if self._iteration == 0 and index > 0:
            x = self._first_estimate(index, self.window)
        self._done += 1
        coords, logits = self.tracker.update(self.window, x[..., :3], x[..., 3])
        return torch.cat([coords, logits[..., None]], -1)

    def loss(self, x: Tensor, m: int) -> Tensor:
        """The loss of the present update, discounted; the mean over clips."""
        window, (columns, mask) = self.window, self._members
        coords = window.norm.restore(x[..., :3])
        step = Step(window.scene.start, self._iteration, coords, x[..., 3], columns, mask, window.scene)
        if self.watch is not None:
            self.watch(step)
        one = torch.zeros(1, self.iterations, dtype=x.dtype, device=x.device)
        one[0, self._iteration] = 1
        weight = self.config.scale * self.discounted(one, self.config.discount)
        loss = weight * torch.stack([self._of_clip(step, b) for b in range(len(x))]).mean()
        self.total = self.total + loss.detach()
        return loss

    def result(self) -> dict[str, Tensor]:
        """The gradients by name."""
        return {name: p.grad for name, p in self.tracker.named_parameters() if p.grad is not None}

    def _of_clip(self, step: Step, b: int) -> Tensor:
        """The loss of one clip of the batch, as the learner computes it."""
        length = self.truth.xyz.shape[1]
        frames = torch.arange(step.start, step.start + step.coords.shape[1], device=step.coords.device)
        real = frames.clamp(max=length - 1)
        counts = self.counted(frames, self.truth.times[b, step.columns], length) & step.active[b]
        if not counts.any():
            return step.coords.sum() * 0
        xyz, visible = (x[b, real][:, step.columns] for x in (self.truth.xyz, self.truth.visible))
        return self.update_loss(step.xyz[b], xyz, step.logits[b], visible, step.scene.frames.extrinsics[b], counts)

    def _window(self, index: int, features: Tensor) -> Window:
        """A window, made anew from the features, so that all that updates share hangs on them alone."""
        stop = self.ends[index]
        scene = self.tracker.scene(self.frames, features, self.space, self.roi)
        support = self.tracker.support(scene, self.queries, self.state.queries)
        self._members = columns, mask = self.state.members(stop, None)
        cut = scene.cut(stop - self.tracker.config.window, stop)
        return self.tracker.window(cut, [near.pick(columns) for near in support], mask, columns)

    def _first_estimate(self, index: int, window: Window) -> Tensor:
        stop = self.ends[index]
        coords, logits = self.state.initial(stop - self.tracker.config.window, stop, self._members[0])
        return torch.cat([window.norm.normalize(coords), logits[..., None]], -1)

    def _write(self, x: Tensor) -> None:
        start, x = self.window.scene.start, x.detach()
        stop = start + self.tracker.config.window
        self.state.write(start, stop, *self._members, self.window.norm.restore(x[..., :3]), x[..., 3])


def example(clip: Clip, frames: int, tracks: int = 24, seed: int = 0) -> Batch:
    """The first frames of a clip, and some of its tracks, as a batch of one."""
    drawn = sample_tracks(clip.cut(0, frames), np.random.default_rng(seed), SamplingConfig(tracks=tracks))
    return make_batch([drawn]).to("cpu")


def double(batch: Batch) -> Batch:
    """A batch in double precision, in which two orders of summation agree."""
    return batch.map(lambda x: x.double() if x.is_floating_point() else x)


def gradients(backward: Callable, tracker: Tracker, batch: Batch, **options: Any) -> dict[str, Tensor]:
    """Gradients by the parameters' names, of the paper's form of the loss unless `config` says otherwise."""
    tracker.zero_grad()
    config = options.pop("config", LossConfig(form="paper"))
    backward(tracker, batch.frames, batch.queries, batch.truth, config, **options)
    return {name: p.grad.clone() for name, p in tracker.named_parameters() if p.grad is not None}


def apart(mine: dict[str, Tensor], theirs: dict[str, Tensor]) -> float:
    """Largest difference of two gradients, as a share of the parameter's largest; infinite if one lacks a parameter."""
    if mine.keys() != theirs.keys():
        return float("inf")
    return max(float((mine[n] - theirs[n]).abs().max() / theirs[n].abs().max().clamp(min=1e-12)) for n in theirs)


def training_step(tracker: Tracker, clip: Clip) -> Verdict:
    """Compare the gradients of one training step on the learner's functions with the library's, in double precision.

    Passed: each function is the learner's, the step called each, and no gradient differs. The clip is cut to one and a
    half windows, so that there are two windows, of which the second continues the first one's estimates.

    Args:
        tracker: any; a copy is trained.
        clip: with true tracks.
    """
    tracker, calls = replace_precision(tracker), {}
    batch = double(example(clip, frames=tracker.config.window * 3 // 2 - 1))  # its last frame is repeated
    theirs = gradients(place.add_gradients, tracker, batch, iterations=_UPDATES)
    with plugged(("06",), calls):
        mine = gradients(place.add_gradients, tracker, batch, iterations=_UPDATES)
    difference = apart(mine, theirs)
    opening = f"one training step, two windows of {_UPDATES} updates, on {len(calls)} functions"
    closing = f"gradients of {len(theirs)} parameter tensors, encoder included: largest difference {difference:.1e}"
    return report(calls, difference < _AGREE, opening, closing)


def replace_precision(tracker: Tracker) -> Tracker:
    """A copy in double precision on the CPU, by the clear forms of all parts."""
    copy = Tracker(replace(tracker.config), fast=False)
    copy.load_state_dict({name: x.detach().cpu() for name, x in tracker.state_dict().items()})
    return copy.double()
