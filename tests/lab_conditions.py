"""Conditions for the studies of test_lab, which worker processes import."""

import os
import signal
from dataclasses import replace


def darker(clip, seed):
    return replace(clip, video=clip.video // (2 + seed))


def die(clip, seed):
    """What the system does to a process that takes too much memory."""
    os.kill(os.getpid(), signal.SIGKILL)


def broken(clip, seed):
    raise RuntimeError("no such clip\nwith details")
