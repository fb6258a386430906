"""Checked exercises: the learner's function against a reference on random cases, from small to large.

An answer is judged by its values, where the exercise says so also by its gradients and by what it cost. A wrong one is
shown the smallest case on which it fails, the first place that differs, and a hint if it is a known mistake: one that
computes the same as the answer on *every* case, since on a single small one quite different mistakes agree. The
exercises of notebook 03 are in `n03.EXERCISES`, and so on.
"""

from __future__ import annotations

import copy
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path

import numpy as np

from lessons import progress
from lessons.compare import compare, describe, short
from lessons.verdict import Verdict

Answer = Callable[..., object]


@dataclass(frozen=True)
class Mistake:
    """A typical wrong answer and what helps the one who gave it.

    Attributes:
        name: for the test matrix, e.g. `"transposed matrix"`.
        answer: computes what the mistaken learner computes.
        hint: what to say.
    """

    name: str
    answer: Answer
    hint: str


def slips(answer: Answer, hints: Mapping[str, str]) -> tuple[Mistake, ...]:
    """The mistakes that an answer makes itself when asked to, by the name of its `slip`, each with its hint."""
    return tuple(Mistake(slip, partial(answer, slip=slip), hint) for slip, hint in hints.items())


@dataclass(frozen=True)
class Exercise:
    """One exercise.

    Attributes:
        name: `"<notebook>.<function>"`, e.g. `"01.unproject"`.
        reference: the right answer.
        cases: (random generator, size) to a tuple of arguments; size runs from 1 to 4, three cases each.
        mistakes: typical wrong answers with their hints.
        tolerance: largest absolute or relative difference that still is right.
        gradients: places among the arguments of float tensors whose gradient must be right, too.
        cost: (answer, arguments) to a number that must not exceed the reference's by more than `slack`, e.g. the cells
            that the answer visited; it calls the answer itself.
        cost_unit: what the number counts, e.g. `"cells visited"`.
        slack: how many times the reference's cost is still accepted.
    """

    name: str
    reference: Answer
    cases: Callable[[np.random.Generator, int], tuple]
    mistakes: tuple[Mistake, ...]
    tolerance: float = 1e-4
    gradients: tuple[int, ...] = ()
    cost: Callable[[Answer, tuple], float] | None = None
    cost_unit: str = ""
    slack: float = 1.0


@dataclass(frozen=True)
class Outcome:
    """What a function made of one case: a value, or the error that it raised; its gradients; its cost."""

    value: object = None
    error: Exception | None = None
    gradients: tuple = ()
    cost: float | None = None

    @property
    def empty(self) -> bool:
        """Whether the function is still a stub."""
        return isinstance(self.error, NotImplementedError) or (
            self.error is None and (self.value is None or self.value is Ellipsis)
        )


def check(name: str, answer: Answer) -> Verdict:
    """Judge a learner's function, and keep it for `progress.in_use` if it is right.

    Args:
        name: the exercise, e.g. `"01.unproject"`.
        answer: the function.

    Raises:
        ValueError: there is no such exercise.
    """
    verdict = judge(find(name), answer)
    progress.record(name, answer, verdict.status)
    return verdict


def find(name: str) -> Exercise:
    """The exercise of a name; ValueError if there is none."""
    known = {exercise.name: exercise for exercise in exercises_of(name[:2])}
    if name not in known:
        raise ValueError(f"check: no exercise {name!r}; there are {', '.join(known or all_exercises())}")
    return known[name]


def exercises_of(notebook: str) -> tuple[Exercise, ...]:
    """The exercises of the notebook with a number, e.g. `"03"`; none where no lesson has it."""
    if not Path(__file__).with_name(f"n{notebook}.py").is_file():
        return ()
    return import_module(f"{__package__}.n{notebook}").EXERCISES


def all_exercises() -> dict[str, Exercise]:
    """All exercises by name, in the order of the notebooks."""
    numbers = (path.stem[1:] for path in sorted(Path(__file__).parent.glob("n[0-9][0-9].py")))
    return {exercise.name: exercise for number in numbers for exercise in exercises_of(number)}


def cases_of(exercise: Exercise) -> list[tuple]:
    """The twelve cases of an exercise, from small to large; always the same."""
    return [exercise.cases(np.random.default_rng([size, seed]), size) for size in (1, 2, 3, 4) for seed in range(3)]


def judge(exercise: Exercise, answer: Answer) -> Verdict:
    """Run an answer on random cases of growing size and say how it did."""
    cases, outcomes, fault = cases_of(exercise), [], ""
    for arguments in cases:
        got = run(exercise, answer, arguments)
        if got.empty and not fault:
            return Verdict("not attempted", "the function still returns nothing; fill in the stub and run both cells.")
        outcomes.append(got)
        if not fault:
            fault = difference(exercise, got, run(exercise, exercise.reference, arguments), by_cost=True)
            if fault:
                fault = f"{fault}\nThe input was {describe(arguments)}"
    if fault:
        return Verdict("wrong", fault, recognised(exercise, cases, outcomes))
    counted = ["values"] + ["gradients"] * bool(exercise.gradients) + [exercise.cost_unit] * (exercise.cost is not None)
    return Verdict("passed", f"agrees with the reference on {len(cases)} random cases ({', '.join(counted)}).")


def run(exercise: Exercise, answer: Answer, arguments: tuple) -> Outcome:
    """What an answer makes of a case; the case stays as it is, whatever the answer does to its arguments."""
    mine = copy.deepcopy(arguments)
    leaves = [mine[place].requires_grad_() for place in exercise.gradients]
    try:
        value = answer(*mine)
        value = tuple(value) if isinstance(value, list) else value
        outcome = Outcome(value, gradients=_gradients(value, leaves) if leaves else ())
        if outcome.empty or exercise.cost is None:
            return outcome
        return Outcome(value, None, outcome.gradients, exercise.cost(answer, copy.deepcopy(arguments)))
    except Exception as error:
        return Outcome(error=error)


def difference(exercise: Exercise, got: Outcome, expected: Outcome, by_cost: bool = False) -> str:
    """Where and how two outcomes differ, in words; empty if they agree.

    Args:
        exercise: says what is compared, and how closely.
        got: the answer's.
        expected: the reference's.
        by_cost: only too high a cost counts, and only by the exercise's slack; else any other cost does.
    """
    if got.error is not None or expected.error is not None:
        return "" if type(got.error) is type(expected.error) else _crash(got.error)
    fault = compare(got.value, expected.value, exercise.tolerance)
    if fault:
        return fault
    for place, mine, right in zip(exercise.gradients, got.gradients, expected.gradients, strict=True):
        fault = compare(mine, right, exercise.tolerance)
        if fault:
            return f"the values are right, the gradient with respect to argument {place + 1} is not: {fault}"
    if got.cost is None or expected.cost is None:
        return ""
    limit = expected.cost * exercise.slack
    if got.cost > limit if by_cost else got.cost != expected.cost:
        return f"the values are right, but too dear: {got.cost:g} {exercise.cost_unit}, where {limit:g} are enough"
    return ""


def recognised(exercise: Exercise, cases: list[tuple], outcomes: list[Outcome]) -> str:
    """The hint of the mistake that computes what the answer computes on every case; empty if there is none."""
    for mistake in exercise.mistakes:
        pairs = zip(cases, outcomes, strict=True)
        if not any(difference(exercise, got, run(exercise, mistake.answer, case)) for case, got in pairs):
            return mistake.hint
    return ""


def _gradients(value: object, leaves: list) -> tuple:
    """Gradients of a weighted sum of all results; zeros where none flows."""
    import torch

    parts = list(_tensors(value))
    total = sum((x * torch.cos(torch.arange(x.numel()) + 1.0).view_as(x)).sum() for x in parts if x.requires_grad)
    if not isinstance(total, torch.Tensor):
        return tuple(torch.zeros_like(leaf) for leaf in leaves)
    found = torch.autograd.grad(total, leaves, allow_unused=True, materialize_grads=True)
    return tuple(gradient.detach() for gradient in found)


def _tensors(value: object) -> Iterator:
    """All tensors of a result, also of tuples in lists."""
    import torch

    if isinstance(value, torch.Tensor):
        yield value
    for part in value if isinstance(value, list | tuple) else ():
        yield from _tensors(part)


def _crash(error: Exception | None) -> str:
    if error is None:
        return "expected an error, got a value"
    frames = traceback.extract_tb(error.__traceback__)[1:]
    own = [f for f in frames if f.filename == frames[0].filename]  # the learner's cell, not the library it calls
    where = f" (line {own[-1].lineno}: {own[-1].line})" if own else ""
    return f"{type(error).__name__}: {short(str(error))}{where}"
