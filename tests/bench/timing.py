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
from time import perf_counter, process_time
from typing import Any

import torch
from torch import nn


def own_clock() -> Callable[[], float]:
    """The processor's time with one torch thread, which other work on the machine does not lengthen; else the wall's."""
    return process_time if torch.get_num_threads() == 1 else perf_counter


def side_by_side(
    runs: dict[str, Callable[[], Any]], rounds: int = 3, warm: bool = True, clock: Callable[[], float] = perf_counter
) -> dict[str, list[float]]:
    """Seconds of functions that take turns.

    Args:
        runs: functions by name.
        rounds: how often each is measured.
        warm: run each once before, unmeasured.
        clock: tells seconds.
    """
    for run in runs.values() if warm else ():
        run()
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(rounds):
        for name, run in runs.items():
            start = clock()
            run()
            seconds[name].append(clock() - start)
    return seconds


def ratios(slow: list[float], fast: list[float]) -> tuple[float, float, float]:
    """(minimum, median, maximum) of how many times longer `slow` took than `fast`, round by round."""
    values = [a / b for a, b in zip(slow, fast, strict=True)]
    return min(values), median(values), max(values)


@contextmanager
def stages(parts: dict[str, nn.Module], clock: Callable[[], float] = perf_counter) -> Iterator[dict[str, float]]:
    """Collect the seconds spent in modules' forward passes, by name, while the context lasts."""
    spent, started, handles = dict.fromkeys(parts, 0.0), {}, []

    def begin(name: str) -> None:
        started[name] = clock()

    def end(name: str) -> None:
        spent[name] += clock() - started[name]

    for name, part in parts.items():
        handles.append(part.register_forward_pre_hook(lambda *_, name=name: begin(name)))
        handles.append(part.register_forward_hook(lambda *_, name=name: end(name)))
    try:
        yield spent
    finally:
        for handle in handles:
            handle.remove()


def extra_memory(prepare: Callable[..., Callable[[], Any]], *arguments: Any) -> tuple[float, float] | None:
    """MiB by which the memory of a fresh process grows at most while a function runs, and the seconds that it takes.

    Args:
        prepare: at the top level of a module, since a new process looks it up by name; returns the function.
        arguments: of `prepare`.

    Returns:
        (growth, seconds), or None where the system does not tell the peak (outside Linux).

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
    before, clock = _memory("VmRSS"), own_clock()
    start = clock()
    run()
    sender.send((_memory("VmHWM") - before, clock() - start))


def _memory(field: str) -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{field}:")) / 1024
