"""What the learner has solved in this kernel, and what the lesson therefore runs on: their function or the reference."""

from __future__ import annotations

import ast
import contextlib
import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lessons.teaching import Notebook, read_notebook, tags
from lessons.verdict import Verdict

Answer = Callable[..., object]


@dataclass
class _Entry:
    tries: int = 0
    status: str = "not attempted"
    answer: Answer | None = None
    origin: str = ""


_ENTRIES: dict[str, _Entry] = {}


def record(name: str, answer: Answer, status: str, origin: str = "") -> None:
    """Keep what `check` said of a function; the function itself only if it passed."""
    entry = _ENTRIES.setdefault(name, _Entry())
    entry.tries += status != "not attempted"
    entry.status, entry.origin = status, origin
    entry.answer = answer if status == "passed" else None


def in_use(name: str, quiet: bool = False) -> Answer:
    """The learner's function if it has passed its checker, else the reference; says which.

    Args:
        name: the exercise, e.g. `"01.unproject"`.
        quiet: say nothing.
    """
    from lessons.checker import find

    entry, exercise = _ENTRIES.get(name, _Entry()), find(name)
    if not quiet:
        print(f"{name}: {whose(name)}")
    return entry.answer or exercise.reference


def is_yours(name: str) -> bool:
    """Whether `in_use` gives the learner's function."""
    return name in _ENTRIES and _ENTRIES[name].answer is not None


def whose(name: str) -> str:
    """Whose function `in_use` gives, in words."""
    return "yours" if is_yours(name) else "the reference, until yours passes"


def progress(*lessons: str) -> Verdict:
    """What is solved of some lessons, e.g. `progress("03")`; of all without arguments."""
    from lessons.checker import all_exercises

    names = [name for name in all_exercises() if not lessons or name[:2] in lessons]
    lines = []
    for name in names:
        entry = _ENTRIES.get(name, _Entry())
        tries = f", {entry.tries} {'try' if entry.tries == 1 else 'tries'}" if entry.tries else ""
        from_where = f", from {entry.origin}" if entry.origin else ""
        lines.append(f"{'✓' if entry.answer else '·'} {name}: {entry.status}{tries}{from_where}")
    solved = sum(is_yours(name) for name in names)
    status = "passed" if solved == len(names) else "not attempted"
    return Verdict(status, "\n".join([f"{solved} of {len(names)} exercises solved", *lines]))


def reset(*names: str) -> Verdict:
    """Forget what was solved: of some exercises or lessons (`"03"`), or all of it. The cells keep their code."""
    gone = [name for name in _ENTRIES if not names or name in names or name[:2] in names]
    for name in gone:
        del _ENTRIES[name]
    return Verdict("not attempted", f"forgotten: {', '.join(gone) or 'nothing, since nothing was tried'}")


def collect(folder: str | Path = ".", lessons: tuple[str, ...] = ()) -> Verdict:
    """Take over what was solved in other notebooks: run their exercise cells, and keep each function that passes.

    Only cells tagged `exercise` or `parameters` and imports are run, so a function must not need other cells.
    Save those notebooks first.

    Args:
        folder: where the notebooks lie.
        lessons: their numbers, e.g. `("01", "03")`; all by default.

    Returns:
        The progress over these lessons.
    """
    from lessons.checker import exercises_of, judge

    found = []
    for path in sorted(Path(folder).glob("[0-9][0-9]_*.ipynb")):
        if lessons and path.stem[:2] not in lessons:
            continue
        found.append(path.stem[:2])
        notebook = read_notebook(path)
        space = _exercise_cells(notebook, path.name)
        for exercise in exercises_of(path.stem[:2]):
            answer = space.get(function_name(notebook, exercise.name))
            if callable(answer) and not is_yours(exercise.name):
                verdict = judge(exercise, answer)
                if verdict.status != "not attempted":
                    record(exercise.name, answer, verdict.status, path.name)
    return progress(*found)


def function_name(notebook: Notebook, exercise: str) -> str:
    """The name of the function that a notebook hands to the checker of an exercise; empty if it does not."""
    for cell in notebook["cells"]:
        source = cell["source"]
        if cell["cell_type"] == "code" and f'check("{exercise}"' in source:
            return source.split(f'check("{exercise}",')[1].split(")")[0].strip()
    return ""


def imports_and_parameters(notebook: Notebook) -> list[str]:
    """Pieces of code that a learner's function may need: every import of a notebook, and the cell of its parameters."""
    pieces = []
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code" and "parameters" in tags(cell):
            pieces.append(cell["source"])
        elif cell["cell_type"] == "code" and "exercise" not in tags(cell):
            with contextlib.suppress(SyntaxError):
                body = ast.parse(cell["source"]).body
                pieces += [ast.unparse(node) for node in body if isinstance(node, ast.Import | ast.ImportFrom)]
    return pieces


def _exercise_cells(notebook: Notebook, name: str) -> dict[str, object]:
    space: dict[str, object] = {}
    stubs = [cell["source"] for cell in notebook["cells"] if "exercise" in tags(cell)]
    for source in [*imports_and_parameters(notebook), *stubs]:  # one that fails does not keep the others away
        with contextlib.suppress(Exception), contextlib.redirect_stdout(io.StringIO()):
            exec(compile(source, name, "exec"), space)
    return space
