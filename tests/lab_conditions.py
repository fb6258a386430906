"""Conditions and a part for the studies of test_lab, which worker processes import."""

import os
import signal
from dataclasses import replace

import torch
from torch import nn

from tapip3d_lite.model.n2n import N2N, Context


def darker(clip, seed):
    return replace(clip, video=clip.video // (2 + seed))


def die(clip, seed):
    """What the system does to a process that takes too much memory."""
    os.kill(os.getpid(), signal.SIGKILL)


def broken(clip, seed):
    raise RuntimeError("no such clip\nwith details")


class Mine(N2N):
    """A user's own by name alone: the library's modules inside a part that the fast path does not know."""


class Mean(Context):
    """A part of a user's own: the query's feature beside the mean of its surroundings'."""

    def __init__(self, config):
        super().__init__()
        self.width = config.token_dim
        self.layer = nn.Linear(2 * config.feature_dim, config.token_dim)

    def describe(self, index, support):
        return support.features[..., 0, :]

    def forward(self, index, kept, near):
        found = near.features.mean(-2)
        return self.layer(torch.cat([kept[:, None].expand_as(found), found], -1))
