"""Checked exercises: the learner's function against a reference on random cases, from small to large.

A wrong answer is shown the smallest case on which it fails, where it differs, and a hint. The hint is chosen by what
the answer computes: if it agrees with a known mistake on that case, it gets the hint for that mistake. The exercises of
notebook 03 are in `n03.EXERCISES`, and so on.
"""

from __future__ import annotations

import copy
import html
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import numpy as np

Answer = Callable[..., object]
_ICONS = {"passed": ("✓", "#1a7f37"), "wrong": ("✗", "#b42318"), "not attempted": ("○", "#57606a")}


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


@dataclass(frozen=True)
class Exercise:
    """One exercise.

    Attributes:
        name: `"<notebook>.<function>"`, e.g. `"01.unproject"`.
        reference: the right answer.
        cases: (random generator, size) to a tuple of arguments; size runs from 1 to 4.
        mistakes: typical wrong answers with their hints.
        tolerance: largest absolute or relative difference that still is right.
    """

    name: str
    reference: Answer
    cases: Callable[[np.random.Generator, int], tuple]
    mistakes: tuple[Mistake, ...]
    tolerance: float = 1e-4


@dataclass(frozen=True)
class Verdict:
    """What a checker says; shows itself as the last line of a notebook cell.

    Attributes:
        status: `"passed"`, `"wrong"` or `"not attempted"`.
        message: in words.
        hint: for a recognised mistake, else empty.
    """

    status: str
    message: str
    hint: str = ""

    def __str__(self) -> str:
        lines = [f"{_ICONS[self.status][0]} {self.status}: {self.message}"]
        return "\n".join([*lines, f"Hint: {self.hint}"] if self.hint else lines)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        _, color = _ICONS[self.status]
        style = f"border-left:4px solid {color};padding:2px 10px;white-space:pre-wrap;font-family:monospace"
        return f'<div style="{style}">{html.escape(str(self))}</div>'


def check(name: str, answer: Answer) -> Verdict:
    """Judge a learner's function.

    Args:
        name: the exercise, e.g. `"01.unproject"`.
        answer: the function.

    Raises:
        ValueError: there is no such exercise.
    """
    known = {exercise.name: exercise for exercise in exercises_of(name[:2])}
    if name not in known:
        raise ValueError(f"check: no exercise {name!r}; there are {', '.join(known or all_exercises())}")
    return judge(known[name], answer)


def exercises_of(notebook: str) -> tuple[Exercise, ...]:
    """The exercises of the notebook with a number, e.g. `"03"`; none where no lesson has it."""
    if not Path(__file__).with_name(f"n{notebook}.py").is_file():
        return ()
    return import_module(f"{__package__}.n{notebook}").EXERCISES


def all_exercises() -> dict[str, Exercise]:
    """All exercises by name, in the order of the notebooks."""
    numbers = (path.stem[1:] for path in sorted(Path(__file__).parent.glob("n[0-9][0-9].py")))
    return {exercise.name: exercise for number in numbers for exercise in exercises_of(number)}


def judge(exercise: Exercise, answer: Answer) -> Verdict:
    """Run an answer on random cases of growing size and say how it did."""
    for size in (1, 2, 3, 4):
        for seed in range(3):
            arguments = exercise.cases(np.random.default_rng([size, seed]), size)
            expected = exercise.reference(*_copied(arguments))
            try:
                got = answer(*_copied(arguments))
            except NotImplementedError:
                return _not_attempted()
            except Exception as error:
                message = f"{_crash(error)}\nThe input was {describe(arguments)}"
                return Verdict("wrong", message, _hint(exercise, arguments, error))
            if got is None or got is Ellipsis:
                return _not_attempted()
            difference = compare(got, expected, exercise.tolerance)
            if difference:
                message = f"{difference}\nThe input was {describe(arguments)}"
                return Verdict("wrong", message, _hint(exercise, arguments, got))
    return Verdict("passed", "agrees with the reference on 12 random cases.")


def compare(got: object, expected: object, tolerance: float) -> str:
    """Where and how two results differ, in words; empty if they agree."""
    if isinstance(expected, tuple):
        if not isinstance(got, tuple | list) or len(got) != len(expected):
            return f"expected {len(expected)} results, got {describe((got,))}"
        parts = (compare(g, e, tolerance) for g, e in zip(got, expected, strict=True))
        return next((f"result {i}: {p}" for i, p in enumerate(parts) if p), "")
    try:
        a, b = np.asarray(got), np.asarray(expected)
        if a.dtype.kind not in "biuf":
            return f"expected numbers, got {type(got).__name__}"
    except (TypeError, ValueError, RuntimeError):
        return f"expected an array, got {type(got).__name__}"
    if a.shape != b.shape:
        return f"expected shape {b.shape}, got {a.shape}"
    if b.ndim and a.dtype.kind == "f" and b.dtype.kind in "bi":
        return f"expected whole numbers ({b.dtype}), got {a.dtype}"
    same = np.isclose(a.astype(float), b.astype(float), rtol=tolerance, atol=tolerance, equal_nan=True)
    if same.all():
        return ""
    lost = ", among them NaN" if np.isnan(a[~same].astype(float)).any() else ""
    where = tuple(int(i) for i in np.argwhere(~same)[0])
    place = f"at index {where}: " if where else ""
    share = f"{(~same).sum()} of {same.size} values differ{lost}"
    return f"{place}expected {_number(b[where])}, got {_number(a[where])} ({share})"


def describe(arguments: tuple) -> str:
    """Arguments of a call on a few lines: small arrays whole, larger ones by their shape."""
    return ", ".join(_described(a) for a in arguments)


def score_guess(guess: float | str | None, truth: float | str, unit: str = "") -> Verdict:
    """Compare a committed prediction with what was measured; a guess that is None spoils nothing.

    Args:
        guess: the reader's number or word.
        truth: the measured number or word.
        unit: printed behind the numbers.
    """
    if guess is None:
        return Verdict("not attempted", f"no guess committed; measured: {_number(truth)} {unit}".rstrip())
    if isinstance(truth, str) or isinstance(guess, str):
        right = str(guess).strip().lower() == str(truth).lower()
        return Verdict("passed" if right else "wrong", f"you said {guess}; measured: {_number(truth)} {unit}".rstrip())
    close = abs(float(guess) - truth) <= 0.25 * abs(truth)
    factor = f", {float(guess) / truth:.2g} times as much" if truth else ""
    return Verdict(
        "passed" if close else "wrong", f"measured: {_number(truth)} {unit}; you said {_number(guess)}{factor}"
    )


def _not_attempted() -> Verdict:
    return Verdict("not attempted", "the function still returns nothing; fill in the stub and run both cells again.")


def _hint(exercise: Exercise, arguments: tuple, got: object) -> str:
    for mistake in exercise.mistakes:
        try:
            known: object = mistake.answer(*_copied(arguments))
        except Exception as error:
            known = error
        if isinstance(known, Exception) or isinstance(got, Exception):
            if type(known) is type(got):
                return mistake.hint
        elif not compare(got, _tupled(known), exercise.tolerance):
            return mistake.hint
    return ""


def _tupled(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


def _crash(error: Exception) -> str:
    frames = traceback.extract_tb(error.__traceback__)[1:]
    own = [f for f in frames if f.filename == frames[0].filename]  # the learner's cell, not the library it calls
    where = f" (line {own[-1].lineno}: {own[-1].line})" if own else ""
    return f"{type(error).__name__}: {error}{where}"


def _copied(arguments: tuple) -> tuple:
    return copy.deepcopy(arguments)  # an answer may change its arguments; arrays and tensors alike


def _described(value: object) -> str:
    value = value.detach().cpu().numpy() if hasattr(value, "detach") else value
    if isinstance(value, np.ndarray):
        small = value.size <= 12
        return (
            np.array2string(value, precision=3, suppress_small=True) if small else f"array {value.shape} {value.dtype}"
        )
    return f"{value:.4g}" if isinstance(value, float) else repr(value)


def _number(value: object) -> str:
    return str(value) if isinstance(value, str | bool | np.bool_) else f"{float(value):.4g}"
