"""Every checker is itself checked: right answers pass, each typical mistake gets its own hint, stubs stop nothing."""

import numpy as np
import pytest
import torch

from lessons import progress
from lessons.checker import Exercise, Mistake, all_exercises, check, judge
from lessons.compare import compare, describe
from lessons.guesses import reveal
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
    """Of one lesson; the two tests above judge the same of all."""
    some = {name: exercise for name, exercise in EXERCISES.items() if name.startswith("02.")}
    mistakes = sum(len(exercise.mistakes) for exercise in some.values())
    lines = table(some)[2:]
    assert len(lines) == len(some) + mistakes > len(some) >= 3
    assert sum("| the reference | passed |" in line for line in lines) == len(some)
    assert sum("| wrong |" in line and "NOT ITS OWN" not in line for line in lines) == mistakes


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


def scored(guess, truth, **options):
    return reveal(guess, truth, **options).verdict


def test_a_guess_is_sealed_until_it_is_made():
    shown = []
    sealed = reveal(None, 3.0, unit="px", then=lambda: shown.append(1))
    assert sealed.verdict.status == "sealed" and "3" not in str(sealed.verdict)
    sealed._ipython_display_()
    assert not shown
    opened = reveal("show me", 3.0, unit="px", then=lambda: shown.append(1))
    assert opened.verdict.status == "shown" and "3 px" in str(opened.verdict)
    opened._ipython_display_()
    assert shown
    assert (
        scored("three", 3.0).status == scored(float("nan"), 3.0).status == "sealed"
    )  # no number: nothing is given away


@pytest.mark.parametrize(
    ("guess", "truth", "options", "status", "why"),
    [
        (1.0, 1.17, {"null": 1}, "wrong", "there is an effect"),
        (1.1, 1.17, {"null": 1}, "passed", "sign and size"),
        (1.3, 1.17, {"null": 1}, "passed", "sign and size"),
        (2.0, 1.17, {"null": 1}, "wrong", "too large"),
        (0.9, 1.17, {"null": 1}, "wrong", "sign"),
        (0.75, 1.0, {"null": 1}, "wrong", "there is no effect"),
        (1.0, 1.0, {"null": 1}, "passed", "no effect"),
        (-1.0, 1.17, {"null": 1}, "wrong", "positive"),
        (0.0, -0.09, {"null": 0}, "wrong", "there is an effect"),
        (0.1, -0.09, {"null": 0}, "wrong", "sign"),
        (-0.15, -0.09, {"null": 0}, "passed", "sign and size"),
        (6, 3.0, {}, "passed", "size"),
        (7, 3.0, {}, "wrong", "2.3 times too large"),
        (1, 3.0, {}, "wrong", "3 times too small"),
        ("World", "world", {}, "passed", "world"),
        ("uvd", "world", {"choices": ("world", "uvd")}, "wrong", "world"),
        ("a lot", "world", {"choices": ("world", "uvd")}, "sealed", "expected one of world, uvd"),
    ],
)
def test_guesses_are_scored_by_sign_and_size(guess, truth, options, status, why):
    verdict = scored(guess, truth, **options)
    assert verdict.status == status and why in verdict.message


def test_verdicts_show_themselves():
    verdict = check("01.unproject", lambda *_: None)
    assert "not attempted" in repr(verdict) and "<div" in verdict._repr_html_()


def test_exercises_are_found_by_their_notebooks_number():
    assert [name for name in EXERCISES if name.startswith("03.")] == ["03.knn", "03.window", "03.walls", "03.proof"]
    assert [name[:2] for name in EXERCISES] == sorted(name[:2] for name in EXERCISES)
    with pytest.raises(ValueError, match=r"no exercise '03.nothing'; there are 03.knn, 03.window, 03.walls, 03.proof$"):
        check("03.nothing", len)
    for name in ("99.nothing", "", "../03.knn"):
        with pytest.raises(ValueError, match=r"no exercise .* there are 00\.movers, .*10.path$"):
            check(name, len)


def test_a_hint_needs_agreement_on_every_case():
    same_for_one = Mistake(
        "doubled", lambda x: x + x[0], "you added the first value."
    )  # right and wrong meet at size 1
    double = Exercise("test.double", lambda x: 3 * x, lambda rng, size: (rng.normal(size=size),), (same_for_one,))
    assert judge(double, lambda x: 2 * x).hint == ""
    assert judge(double, lambda x: x + x[0]).hint == "you added the first value."


def test_gradients_and_cost_are_judged():
    square = Exercise("test.square", lambda x: x**2, lambda rng, n: (torch.ones(n),), (), gradients=(0,))
    assert judge(square, lambda x: x * x).status == "passed"
    cut = judge(square, lambda x: x.detach() * x)
    assert cut.status == "wrong" and "gradient with respect to argument 1" in cut.message
    assert "gradient" in judge(square, lambda x: x.detach() ** 2).message

    def visits(answer, arguments):
        seen = []
        answer(Visited(arguments[0], seen))
        return len(seen)

    class Visited(list):
        def __init__(self, values, seen):
            super().__init__(values)
            self.seen = seen

        def __getitem__(self, i):
            self.seen.append(i)
            return super().__getitem__(i)

    def all_of_it(x):
        values = [x[i] for i in range(len(x))]
        return values[0]

    first = Exercise(
        "test.first", lambda x: x[0], lambda rng, n: (list(range(n + 1)),), (Mistake("all", all_of_it, "stop early."),),
        cost=visits, cost_unit="values read",
    )  # fmt: skip
    assert "values read" in judge(first, lambda x: x[0]).message
    dear = judge(first, all_of_it)
    assert dear.status == "wrong" and "too dear: 2 values read, where 1 are enough" in dear.message
    assert dear.hint == "stop early."


def test_single_precision_is_accepted():
    third = Exercise("test.third", lambda x: x / 3, lambda rng, n: (rng.normal(size=n) * 1e4,), (), tolerance=1e-9)
    assert judge(third, lambda x: (x / 3).astype(np.float32)).status == "passed"
    assert judge(third, lambda x: x / 3 + 1).status == "wrong"


def test_failures_are_compact(double):
    def long(x):
        raise ValueError("no " * 1000)

    assert len(str(judge(double, long))) < 600
    assert len(describe((np.ones((50, 50)), [1] * 100, "x" * 1000))) <= 300


def test_progress_keeps_what_passed_and_forgets_on_demand(capsys):
    progress.reset()
    reference = EXERCISES["01.unproject"].reference
    assert progress.in_use("01.unproject") is reference and "until yours passes" in capsys.readouterr().out

    def mine(*arguments):
        return reference(*arguments)

    check("01.unproject", mine)
    assert progress.in_use("01.unproject") is mine and "yours" in capsys.readouterr().out
    assert "✓ 01.unproject: passed, 1 try" in str(progress.progress("01"))
    check("01.unproject", lambda *a: mine(*a) + 1)
    assert progress.in_use("01.unproject") is reference
    assert "· 01.unproject: wrong, 2 tries" in str(progress.progress("01"))
    assert "01.unproject" in str(progress.reset("01")) and "nothing" in str(progress.reset("01"))
