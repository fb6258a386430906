"""Measuring functions that take turns, the stages of one call, and peak memory in a process of its own.

Absolute times say more about a machine and its load than about a program. So the ways to compare take turns, and the
result is the ratio of measurements that are neighbours in time: minimum, median and maximum.
"""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import wraps
from pathlib import Path
from statistics import median
from time import perf_counter, process_time
from typing import Any
from unittest import mock

import torch
from torch.utils.benchmark import Timer

Clock = Callable[[], float]


def own_clock() -> Clock:
    """The processor's time with one torch thread, which other programs do not lengthen; else the wall's."""
    return process_time if torch.get_num_threads() == 1 else perf_counter


def side_by_side(
    runs: dict[str, Callable[[], Any]], rounds: int = 3, clock: Clock | None = None
) -> dict[str, list[float]]:
    """Seconds of functions that take turns, in each round the median after a warm-up; the wall's by default."""
    options = {"num_threads": torch.get_num_threads()} | ({} if clock is None else {"timer": clock})
    timers = {name: Timer("run()", globals={"run": run}, **options) for name, run in runs.items()}
    measured = [
        {name: t.blocked_autorange(min_run_time=0.01).median for name, t in timers.items()} for _ in range(rounds)
    ]
    return {name: [seconds[name] for seconds in measured] for name in runs}


def ratios(slow: list[float], fast: list[float]) -> tuple[float, float, float]:
    """(minimum, median, maximum) of how many times longer `slow` took than `fast`, round by round."""
    values = [a / b for a, b in zip(slow, fast, strict=True)]
    return min(values), median(values), max(values)


@contextmanager
def stages(calls: dict[str, tuple[Any, str]], clock: Clock, rest: str, whole: str) -> Iterator[dict[str, float]]:
    """Collect the seconds spent in functions, given as owner and attribute, and add at the end the rest and the whole."""
    spent = dict.fromkeys([whole, *calls, rest], 0.0)

    def timed(name: str, function: Callable) -> Callable:
        @wraps(function)  # a schedule of the learning rate recognises its optimiser by a mark on `step`
        def run(*arguments: Any, **options: Any) -> Any:
            start = clock()
            try:
                return function(*arguments, **options)
            finally:
                spent[name] += clock() - start

        return run

    with ExitStack() as stack:
        for name, (owner, attribute) in calls.items():
            stack.enter_context(mock.patch.object(owner, attribute, timed(name, getattr(owner, attribute))))
        start = clock()
        yield spent
        total = clock() - start
    spent |= {whole: total, rest: total - sum(spent.values())}


def extra_memory(prepare: Callable[..., Callable[[], Any]], *arguments: Any) -> tuple[float, float] | None:
    """MiB by which the memory of a fresh process grows at most while a function runs, and the seconds that it takes.

    Args:
        prepare: returns the function; at the top level of a module, since the new process looks it up by name.
        arguments: of `prepare`.

    Returns:
        (growth, seconds), or None outside Linux, where the memory before the run is not known.
    """
    if not sys.platform.startswith("linux"):
        return None
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_grown, prepare, arguments).result()


def _grown(prepare: Callable[..., Callable[[], Any]], arguments: tuple) -> tuple[float, float]:
    run, clock = prepare(*arguments), own_clock()
    before, start = _memory("VmRSS"), clock()
    run()
    return _memory("VmHWM") - before, clock() - start


def _memory(field: str) -> float:
    """MiB of this process (`resource.getrusage` will not do: a new process inherits the peak of its parent)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{field}:")) / 1024
