"""The teacher's pack: every notebook once for students and once solved, and a timing plan, from the notebooks alone.

`python3 run.py teach --out PACK` writes it. A stub is a code cell tagged `exercise`. Its solution is folded into a later text cell, its title, difficulty and minutes
stand in the cell before it. Notebooks are plain dictionaries as in their JSON; `nbformat`'s do as well.
"""

from __future__ import annotations

import copy
import json
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lessons.guesses import SHOW
from lessons.tool import ToolParser
from tapip3d_lite.files import atomic_path

Notebook = dict[str, Any]

_CODE = re.compile(r"<details>\s*<summary>Solution</summary>\s*```python\n(.*?)```", re.DOTALL)
_FOLD = re.compile(r"\s*<details>\s*<summary>Solution</summary>.*?</details>", re.DOTALL)
_TITLE = re.compile(r"^#+ Exercise\s*([\d.]*)\s*[:·]\s*(.+)$", re.MULTILINE)
_MINUTES = re.compile(r"(\d+)\s*min")
_NO_GUESS = re.compile(r"^(\w+\s*=\s*)None", re.MULTILINE)
_QUESTION = re.compile(r"^#+ [^\n]*In your own words[^\n]*\n(.*?)(?=^#|\Z)", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\[([^\]]*)\]\(\.\./tapip3d_lite[^)]*\)")


@dataclass(frozen=True)
class Task:
    """An exercise as it stands in the plan: number (may be empty), title, stars, minutes."""

    number: str
    title: str
    stars: str
    minutes: int


def read_notebook(path: str | Path) -> Notebook:
    """A notebook as a dictionary, each cell's source one string.

    Raises:
        ValueError: no such file, or not a notebook.
    """
    try:
        nb = json.loads(Path(path).read_text(encoding="utf-8"))
        for cell in nb["cells"]:
            cell["source"] = "".join(cell["source"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not a readable notebook ({error})") from None
    return nb


def tags(cell: dict[str, Any]) -> list[str]:
    """A cell's tags."""
    return cell["metadata"].get("tags", [])


def stubs(nb: Notebook) -> list[int]:
    """Indices of the cells that a student fills in."""
    return [i for i, cell in enumerate(nb["cells"]) if "exercise" in tags(cell)]


def solution_of(nb: Notebook, index: int) -> str:
    """The code of the first folded solution after the stub at `index`, before the next stub; ValueError without one."""
    for cell in nb["cells"][index + 1 :]:
        if "exercise" in tags(cell):
            break
        found = _CODE.search(cell["source"]) if cell["cell_type"] == "markdown" else None
        if found:
            return found.group(1).rstrip()
    raise ValueError(f"no folded solution after the stub:\n{nb['cells'][index]['source']}")


def solution_copy(nb: Notebook) -> Notebook:
    """A copy in which every stub is replaced by the folded solution that follows it, and every seal is open."""
    filled = copy.deepcopy(nb)
    for i in stubs(nb):
        filled["cells"][i]["source"] = solution_of(nb, i)
    for cell in filled["cells"]:
        if "guess" in tags(cell):
            cell["source"] = _NO_GUESS.sub(rf'\1"{SHOW}"', cell["source"])
    return filled


def handout(nb: Notebook) -> Notebook:
    """A copy without outputs and without folded solutions; hints stay."""
    bare = copy.deepcopy(nb)
    for cell in bare["cells"]:
        if cell["cell_type"] == "code":
            cell["outputs"], cell["execution_count"] = [], None
        elif cell["cell_type"] == "markdown":
            cell["source"] = _FOLD.sub("", cell["source"])
    bare["cells"] = [cell for cell in bare["cells"] if cell["source"].strip()]
    return bare


def tasks(nb: Notebook) -> list[Task]:
    """The exercises of a notebook with their minutes; ValueError where the cell before a stub does not say them."""
    found = []
    for i in stubs(nb):
        before = nb["cells"][i - 1]["source"] if i else ""
        titles, facts = list(_TITLE.finditer(before)), re.search(r"(★+)\D*(\d+) min", before)
        if not titles or not facts:
            raise ValueError(
                f"expected 'Exercise … · title' and 'Difficulty ★ · 5 min' before the stub, got:\n{before[-300:]}"
            )
        found.append(Task(titles[-1][1], titles[-1][2].strip(), facts[1], int(facts[2])))
    return found


def minutes(nb: Notebook) -> int:
    """Minutes for reading and solving a notebook, from the line of its opening that says them; ValueError without."""
    opening = "\n".join(cell["source"] for cell in nb["cells"][:3] if cell["cell_type"] == "markdown")
    found = [
        (not re.search("read", line, re.IGNORECASE), m[1])
        for line in opening.splitlines()
        if (m := _MINUTES.search(line))
    ]
    if not found:
        raise ValueError(
            f"expected the opening to say its minutes, e.g. 'Reading and exercises: 40 minutes', got:\n{opening[:300]}"
        )
    return int(min(found, key=lambda pair: pair[0])[1])  # else the first one


def timing_plan(notebooks: dict[str, Notebook], lesson: int = 45) -> str:
    """One page in Markdown: minutes of every notebook and exercise.

    Args:
        notebooks: name to notebook, in the order of the course.
        lesson: minutes of one lesson.

    Raises:
        ValueError: a lesson of no minute, or exercises that take longer than their notebook.
    """
    if lesson < 1:
        raise ValueError(f"lesson: expected at least 1 minute, got {lesson}")
    lines = [
        "# Timing plan",
        "",
        f"Minutes as the notebooks give them; a lesson has {lesson}. Together: what is shown and talked through in class.",
        "",
        "| notebook | minutes | lessons | together | exercises: title, difficulty, minutes |",
        "|---|---|---|---|---|",
    ]
    total = together = 0
    for name, nb in notebooks.items():
        whole, todo = minutes(nb), tasks(nb)
        rest = whole - sum(task.minutes for task in todo)
        if rest < 0:
            raise ValueError(f"{name}: its exercises take {whole - rest} minutes, more than the {whole} of the opening")
        shown = " · ".join(f"{' '.join(filter(None, (t.number, t.title)))} {t.stars} {t.minutes}" for t in todo)
        lines.append(f"| {name} | {whole} | {-(-whole // lesson)} | {rest} | {shown} |")
        total, together = total + whole, together + rest
    lines.append(f"| all | {total} | {-(-total // lesson)} | {together} | {total - together} minutes |")
    return "\n".join(lines) + "\n"


def question_of(nb: Notebook) -> str:
    """The question that is to be answered in one's own words; ValueError where the notebook asks none."""
    for cell in nb["cells"]:
        found = _QUESTION.search(cell["source"]) if cell["cell_type"] == "markdown" else None
        if found:
            return found[1].strip()
    raise ValueError("expected a text cell with a heading '… In your own words'")


def model_answers(notebooks: Path) -> str:
    """One page in Markdown: the questions to be answered in one's own words, and an answer to each."""
    lines = ["# In your own words: the questions, and an answer to each", ""]
    for path in sorted(notebooks.glob("[0-9][0-9]_*.ipynb")):
        text = (notebooks / "lessons" / "answers" / f"{path.stem[:2]}.md").read_text(encoding="utf-8")
        lines += [f"## {path.stem}", "", question_of(read_notebook(path)), "", text.strip(), ""]
    return "\n".join(lines)


def write_pack(notebooks: Path, out: Path, lesson: int = 45) -> list[Path]:
    """Write the pack: `student/` and `solution/` notebooks, `TIMING.md`, and what they load: clips and lessons.

    Args:
        notebooks: folder of the numbered notebooks and of `lessons`; `data_samples` lies beside it.
        out: the pack's folder.
        lesson: minutes of one lesson.

    Returns:
        The notebooks and the plan that were written.

    Raises:
        ValueError: no notebooks there, or one whose exercises are not whole.
    """
    course = {path.stem: read_notebook(path) for path in sorted(notebooks.glob("[0-9][0-9]_*.ipynb"))}
    if not course:
        raise ValueError(f"{notebooks}: no notebooks named 00_….ipynb there; name their folder with --notebooks")
    files = {out / "TIMING.md": timing_plan(course, lesson)}
    for name, nb in course.items():
        for folder, version in (("student", nb), ("solution", solution_copy(nb))):
            files[out / folder / f"{name}.ipynb"] = json.dumps(handout(version), indent=1, ensure_ascii=False) + "\n"
    files[out / "ANSWERS.md"] = model_answers(notebooks)
    for page in sorted(notebooks.glob("*.md")):
        text = _LINK.sub(r"\1", page.read_text(encoding="utf-8"))  # the code does not lie beside the pack
        files |= {out / folder / page.name: text for folder in ("student", "solution")}
    for path, text in files.items():
        with atomic_path(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
    loaded = {"data_samples": notebooks.parent / "data_samples"}
    loaded |= {f"{folder}/lessons": notebooks / "lessons" for folder in ("student", "solution")}
    for name, source in loaded.items():
        if source.is_dir():
            shutil.copytree(
                source, out / name, ignore=shutil.ignore_patterns("__pycache__", "answers"), dirs_exist_ok=True
            )
    return list(files)


def main(argv: Sequence[str] | None = None) -> None:
    """Write the pack."""
    parser = ToolParser("teach", "Write student and solution versions of all notebooks, and a timing plan.")
    parser.add_argument("--out", type=Path, required=True, help="the pack's folder")
    parser.add_argument("--notebooks", type=Path, default=Path(__file__).parents[1], help="folder of the notebooks")
    parser.add_argument("--lesson", type=int, default=45, help="minutes of one lesson")
    options = parser.parse_args(argv)
    with parser.complaints():
        written = write_pack(options.notebooks, options.out, options.lesson)
    print(f"wrote {len(written)} files to {options.out}; begin with {options.out / 'TIMING.md'}")


if __name__ == "__main__":
    main()
