"""What processes that help another one have in common."""

from __future__ import annotations

import signal


def leave_interrupts(worker: int = 0) -> None:
    """Let Ctrl-C be for the parent, which ends its workers; to be called by a worker (of that number) as it begins."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
