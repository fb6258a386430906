"""The tracker's parts compiled by torch: slow to start, then faster on a GPU."""

from __future__ import annotations

from tapip3d_lite.model.blocks import Block
from tapip3d_lite.model.tracker import Tracker


def compile_parts(tracker: Tracker) -> None:
    """Compile a tracker's encoder, neighbourhood, context and updating blocks in place, at their first call."""
    from torch._dynamo import config as dynamo
    from torch._functorch import config as functorch

    dynamo.recompile_limit = 64  # levels differ in size
    functorch.donated_buffer = False  # the queries' neighbourhoods are backpropagated once for each window
    parts = [tracker.encoder, tracker.neighborhood, tracker.context]
    parts += [part for part in tracker.updater.modules() if isinstance(part, Block)]  # alike, so compiled once for all
    for part in parts:
        part.compile(dynamic=False)
