"""Weights to start a training from, also those of a tracker with a coarser pyramid."""

from __future__ import annotations

import re

import torch
from torch import Tensor

from tapip3d_lite.files import shipped_weights
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.model.weights import load_weights


def begin_with(tracker: Tracker, name: str) -> None:
    """Give a tracker the weights of another one.

    If the other has fewer levels, its levels become the coarser ones: halve the stride, add a level, and the tracker
    goes on from where it was, with a finer look besides. What a new level says counts for nothing at first.

    Args:
        tracker: gets the weights.
        name: `"lite"` or a weights file.

    Raises:
        ValueError: the sizes do not fit; which, and what was tried.
    """
    source = load_weights(shipped_weights().get(name, name))
    state, extra = source.state_dict(), tracker.config.levels - source.config.levels
    if extra > 0:
        state = _finer(state, extra, source, tracker)
    try:
        tracker.load_state_dict(state)
    except RuntimeError as error:
        raise ValueError(
            f"TrainConfig.init: {name!r} belongs to a tracker of other sizes: {str(error).splitlines()[-1].strip()}"
        ) from error


def _finer(state: dict[str, Tensor], extra: int, source: Tracker, tracker: Tracker) -> dict[str, Tensor]:
    """The weights with `extra` levels before the finest, each a copy of it whose result is not listened to yet."""
    moved, levels = {}, source.config.levels
    for key, value in state.items():
        found = None if source.config.share_levels else re.fullmatch(r"(context\.(?:\w+\.)*?)(\d+)(\..+)", key)
        if found is None:
            moved[key] = value
            continue
        head, level, tail = found[1], int(found[2]), found[3]
        moved[f"{head}{level + extra}{tail}"] = value
        if level == 0:
            moved |= {f"{head}{new}{tail}": value.clone() for new in range(extra)}
    old = state["updater.input.weight"]  # its columns: visibility, then the context of each level, then motion
    if 1 + source.context.width * levels > old.shape[1] or tracker.context.width != source.context.width:
        raise ValueError(f"TrainConfig.init: a tracker with context {source.config.context!r} cannot be given levels")
    silent = old.new_zeros(len(old), extra * source.context.width)
    new = torch.cat([old[:, :1], silent, old[:, 1:]], 1)
    # Time is added to the token as a sinusoid over all of its columns, which lie elsewhere now: the smallest change
    # of the weights that leaves what they make of time as it was.
    changed = old @ source.time.T - new @ tracker.time.T  # (U, S)
    moved["updater.input.weight"] = new + (torch.linalg.pinv(tracker.time.double()) @ changed.T.double()).T.to(new)
    return moved
