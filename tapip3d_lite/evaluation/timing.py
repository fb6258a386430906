"""Measuring: functions side by side, the parts of a model, and peak memory in a process of its own.

Absolute times say more about a machine and its other work than about a program. So what is compared takes turns in one
run, and what is told is the ratio of neighbours in time, with its minimum, median and maximum.
"""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

from torch import nn


def side_by_side(runs: dict[str, Callable[[], Any]], rounds: int = 3, warm: bool = True) -> dict[str, list[float]]:
    """Seconds of functions that take turns.

    Args:
        runs: functions by name.
        rounds: how often each is measured.
        warm: run each once before, unmeasured.
    """
    for run in runs.values() if warm else ():
        run()
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(rounds):
        for name, run in runs.items():
            start = perf_counter()
            run()
            seconds[name].append(perf_counter() - start)
    return seconds


def ratios(slow: list[float], fast: list[float]) -> tuple[float, float, float]:
    """(minimum, median, maximum) of how many times longer `slow` took than `fast`, round by round."""
    values = [a / b for a, b in zip(slow, fast, strict=True)]
    return min(values), median(values), max(values)


@contextmanager
def stages(parts: dict[str, nn.Module]) -> Iterator[dict[str, float]]:
    """Collect the seconds spent in modules' forward passes, by name, while the context lasts."""
    spent, started, handles = dict.fromkeys(parts, 0.0), {}, []

    def begin(name: str) -> None:
        started[name] = perf_counter()

    def end(name: str) -> None:
        spent[name] += perf_counter() - started[name]

    for name, part in parts.items():
        handles.append(part.register_forward_pre_hook(lambda *_, name=name: begin(name)))
        handles.append(part.register_forward_hook(lambda *_, name=name: end(name)))
    try:
        yield spent
    finally:
        for handle in handles:
            handle.remove()


def extra_memory(prepare: Callable[..., Callable[[], Any]], *arguments: Any) -> float | None:
    """MiB by which the memory of a fresh process grows at most while a function runs.

    Args:
        prepare: at the top level of a module, since a new process looks it up by name; returns the function.
        arguments: of `prepare`.

    Returns:
        The growth, or None where the system does not tell the peak (outside Linux).

    Raises:
        RuntimeError: the process failed.
    """
    if not sys.platform.startswith("linux"):
        return None
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_measure, args=(sender, prepare, arguments))
    process.start()
    sender.close()
    try:
        return receiver.recv()
    except EOFError:
        raise RuntimeError(f"{prepare.__name__}{arguments}: the measuring process failed; see its message") from None
    finally:
        process.join()


def _measure(sender: Any, prepare: Callable[..., Callable[[], Any]], arguments: tuple) -> None:
    run = prepare(*arguments)
    before = _memory("VmRSS")
    run()
    sender.send(_memory("VmHWM") - before)


def _memory(field: str) -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{field}:")) / 1024
