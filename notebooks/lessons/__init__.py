"""Exercises of the notebooks with their checkers: `check("01.unproject", my_function)`."""

from __future__ import annotations

from importlib import import_module

from lessons.checker import Answer, Exercise, Mistake, Verdict, judge, score_guess

_MODULES = ("start", "lifting", "world", "neighborhoods", "attention", "training", "updates")

EXERCISES: dict[str, Exercise] = {
    exercise.name: exercise for module in _MODULES for exercise in import_module(f"{__name__}.{module}").EXERCISES
}

__all__ = ["EXERCISES", "Exercise", "Mistake", "Verdict", "check", "score_guess"]


def check(name: str, answer: Answer) -> Verdict:
    """Judge a learner's function.

    Args:
        name: the exercise, e.g. `"01.unproject"`.
        answer: the function.

    Raises:
        ValueError: no such exercise.
    """
    if name not in EXERCISES:
        raise ValueError(f"check: no exercise {name!r}; there are {', '.join(EXERCISES)}")
    return judge(EXERCISES[name], answer)
