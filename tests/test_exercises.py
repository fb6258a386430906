"""Every checker is itself checked: right answers pass, each typical mistake gets its own hint, stubs stop nothing."""

import numpy as np
import pytest
import torch

from lessons.checker import Exercise, Mistake, all_exercises, check, compare, judge, score_guess
from tests.exercise_matrix import table

EXERCISES = all_exercises()
MISTAKES = [(name, mistake.name) for name, exercise in EXERCISES.items() for mistake in exercise.mistakes]


@pytest.mark.parametrize("name", EXERCISES)
def test_the_reference_passes(name):
    assert check(name, EXERCISES[name].reference).status == "passed"


@pytest.mark.parametrize(("name", "mistake"), MISTAKES, ids=lambda part: part.replace(" ", "-"))
def test_each_mistake_gets_its_hint(name, mistake):
    wrong = next(m for m in EXERCISES[name].mistakes if m.name == mistake)
    verdict = check(name, wrong.answer)
    assert verdict.status == "wrong"
    assert verdict.hint == wrong.hint


@pytest.mark.parametrize("name", EXERCISES)
def test_at_least_three_mistakes_with_different_hints(name):
    hints = {m.hint for m in EXERCISES[name].mistakes}
    assert len(hints) == len(EXERCISES[name].mistakes) >= 3


@pytest.mark.parametrize("name", EXERCISES)
def test_a_stub_is_not_an_error(name):
    def raising(*_):
        raise NotImplementedError

    for stub in (lambda *_: None, lambda *_: ..., raising):
        assert check(name, stub).status == "not attempted"


def test_the_matrix_shows_every_answer_with_its_hint():
    lines = table()[2:]
    assert len(lines) == len(EXERCISES) + len(MISTAKES)
    assert sum("| the reference | passed |" in line for line in lines) == len(EXERCISES)
    assert sum("| wrong |" in line and "NOT ITS OWN" not in line for line in lines) == len(MISTAKES)


@pytest.fixture
def double():
    halved = Mistake("halved", lambda x: x / 2, "multiply, do not divide.")
    crash = Mistake("text", lambda x: x + "1", "x is an array of numbers.")
    return Exercise("test.double", lambda x: 2 * x, lambda rng, size: (rng.normal(size=size),), (halved, crash))


def test_a_wrong_answer_is_located_on_the_smallest_case(double):
    verdict = judge(double, lambda x: np.where(np.arange(len(x)) == 2, 0, 2 * x))
    assert verdict.status == "wrong" and verdict.hint == ""
    assert "index (2,)" in verdict.message and "got 0" in verdict.message
    assert "1 of 3 values" in verdict.message


def test_shape_type_and_crash_are_said_in_words(double):
    assert "expected shape (1,), got (1, 1)" in judge(double, lambda x: 2 * x[None]).message
    assert "expected numbers" in judge(double, lambda x: "text").message
    crash = judge(double, lambda x: x + "1")
    assert "UFuncTypeError" in crash.message or "UFuncNoLoopError" in crash.message
    assert crash.hint == "x is an array of numbers."
    assert judge(double, lambda x: x / 2).hint == "multiply, do not divide."


def test_nan_and_dtype_are_said_in_words(double):
    assert "got nan (1 of 1 values differ, among them NaN)" in judge(double, lambda x: x * np.nan).message
    assert "expected whole numbers (int64), got float64" in compare(np.ones(2), np.ones(2, np.int64), 1e-6)
    assert compare(1.0, 1, 1e-6) == ""


def test_a_crash_shows_the_learners_line_not_the_librarys(double):
    crash = judge(double, lambda x: np.linalg.inv(x))
    assert "LinAlgError" in crash.message and "np.linalg.inv(x))" in crash.message
    assert "The input was [" in crash.message
    assert "TypeError" in judge(double, ord).message  # no Python frame at all


def test_tensors_are_cases_too():
    def half(x):
        x /= 2
        return x

    tensors = Exercise("test.half", lambda x: x / 2, lambda rng, size: (torch.ones(size, 2),), ())
    assert judge(tensors, half).status == "passed"
    assert "input was [[1. 1.]]" in judge(tensors, lambda x: x).message


def test_an_answer_cannot_change_the_case(double):
    def spoils(x):
        x *= 2
        return x

    assert judge(double, spoils).status == "passed"


def test_compare():
    assert compare((1, np.ones(2)), (1, np.ones(2)), 1e-6) == ""
    assert compare((1, np.zeros(2)), (1, np.ones(2)), 1e-6).startswith("result 1: at index (0,)")
    assert "expected 2 results" in compare(3, (1, 2), 1e-6)
    assert compare(np.array([np.nan]), np.array([np.nan]), 1e-6) == ""


def test_guesses():
    score = score_guess
    assert score(None, 3.0, "px").status == "not attempted"
    assert "3 px" in str(score(None, 3.0, "px"))
    assert (score(2.9, 3.0).status, score(6, 3.0).status) == ("passed", "wrong")
    assert "2 times" in str(score(6, 3.0))
    assert (score("a lot", 3.0).status, score("world", "world").status) == ("wrong", "passed")
    assert (score("World", "world").status, score("uvd", "world").status) == ("passed", "wrong")


def test_verdicts_show_themselves():
    verdict = check("01.unproject", lambda *_: None)
    assert "not attempted" in repr(verdict) and "<div" in verdict._repr_html_()


def test_exercises_are_found_by_their_notebooks_number():
    assert [name for name in EXERCISES if name.startswith("03.")] == ["03.knn", "03.window", "03.walls", "03.proof"]
    assert [name[:2] for name in EXERCISES] == sorted(name[:2] for name in EXERCISES)
    with pytest.raises(ValueError, match=r"no exercise '03.nothing'; there are 03.knn, 03.window, 03.walls, 03.proof$"):
        check("03.nothing", len)
    for name in ("99.nothing", "", "../03.knn"):
        with pytest.raises(ValueError, match=r"no exercise .* there are 00.lift, .*06.backward$"):
            check(name, len)
