"""Every exercise with typical wrong answers and what its checker says: `PYTHONPATH=notebooks python -m tests.exercise_matrix`, in Markdown."""

import sys

from lessons.checker import all_exercises, check


def rows(exercises):
    """(exercise, answer, verdict, hint), the reference first, as the checkers judge them now."""
    for name, exercise in exercises.items():
        yield name, "the reference", check(name, exercise.reference).status, ""
        for mistake in exercise.mistakes:
            verdict = check(name, mistake.answer)
            hint = verdict.hint if verdict.hint == mistake.hint else f"NOT ITS OWN: {verdict.hint}"
            yield name, mistake.name, verdict.status, hint


def table(exercises):
    """The matrix as lines of Markdown."""
    cells = [("exercise", "answer", "verdict", "hint"), ("---",) * 4, *rows(exercises)]
    return [f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |" for row in cells]


if __name__ == "__main__":
    sys.stdout.write("\n".join(table(all_exercises())) + "\n")
