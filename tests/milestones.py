"""What every lesson's milestone must notice."""

from lessons import progress
from lessons.checker import check


def notices(lesson, number, slips, **options):
    """Not attempted, passed by the references, and wrong as soon as one function has a slip; one name for each exercise."""
    progress.reset(number)
    assert lesson.milestone(number, **options).status == "not attempted"
    for exercise in lesson.EXERCISES:
        assert check(exercise.name, lambda *case, right=exercise.reference: right(*case)).status == "passed"
    said = lesson.milestone(number, **options)
    assert said.status == "passed" and "yours" in said.message
    for exercise, slip in zip(lesson.EXERCISES, slips, strict=True):
        mistake = next(m for m in exercise.mistakes if m.name == slip)
        progress.record(exercise.name, mistake.answer, "passed")
        assert lesson.milestone(number, **options).status == "wrong", exercise.name
        progress.record(exercise.name, lambda *case, right=exercise.reference: right(*case), "passed")
    progress.reset(number)
