"""The teacher's pack: the student's notebook is the solved one minus blanks, and the plan gives the notebooks' minutes."""

import json
import re
from pathlib import Path

import nbformat
import pytest

from lessons.guesses import SHOW
from lessons.teaching import (
    handout,
    main,
    minutes,
    read_notebook,
    solution_copy,
    solution_of,
    stubs,
    tags,
    tasks,
    timing_plan,
    write_pack,
)

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("[0-9][0-9]_*.ipynb"))
each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)


def contents(folder):
    return {p.relative_to(folder): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def pack(tmp_path_factory):
    out = tmp_path_factory.mktemp("pack")
    write_pack(ROOT / "notebooks", out)
    return out


@each_notebook
def test_the_students_version_is_the_solution_minus_blanks(path, pack):
    committed = read_notebook(path)
    student, solved = (json.loads((pack / way / path.name).read_text("utf-8")) for way in ("student", "solution"))
    for nb in (student, solved):
        nbformat.validate(nbformat.from_dict(nb))
        assert not any(cell.get("outputs") for cell in nb["cells"])
        assert "<summary>Solution" not in json.dumps(nb) and "<summary>Hint" in json.dumps(nb)
    assert len(student["cells"]) == len(solved["cells"])
    assert {key: student[key] for key in student if key != "cells"} == {k: solved[k] for k in solved if k != "cells"}
    blanks = 0
    for mine, full in zip(student["cells"], solved["cells"], strict=True):
        if "guess" in tags(mine):
            sealed = re.sub(rf'^(\w+\s*=\s*)"{SHOW}"', r"\1None", full["source"], flags=re.MULTILINE)
            assert sealed == mine["source"] != full["source"]
            continue
        if "exercise" not in tags(mine):
            assert mine == full
            continue
        where = next(i for i in stubs(committed) if committed["cells"][i]["id"] == mine["id"])
        assert mine["source"] == committed["cells"][where]["source"]
        assert full["source"] == solution_of(committed, where) != mine["source"]
        assert {k: mine[k] for k in mine if k != "source"} == {k: full[k] for k in full if k != "source"}
        blanks += 1
    assert blanks == len(stubs(committed)) == len(tasks(committed)) >= 3


@each_notebook
def test_a_handout_keeps_everything_but_solutions_and_outputs(path):
    nb = read_notebook(path)
    kept = {cell["id"]: cell["source"] for cell in handout(nb)["cells"]}
    for cell in nb["cells"]:
        folds = cell["source"].count("<summary>Solution</summary>")
        assert folds or kept[cell["id"]] == cell["source"]
        assert not folds or kept[cell["id"]].count("</details>") == cell["source"].count("</details>") - folds


def test_writing_again_changes_nothing(pack, tmp_path):
    write_pack(ROOT / "notebooks", tmp_path)
    first = contents(pack)
    assert contents(tmp_path) == first
    write_pack(ROOT / "notebooks", tmp_path)
    assert contents(tmp_path) == first


def test_the_pack_has_what_its_notebooks_load_and_link(pack):
    for path in sorted(pack.rglob("*.ipynb")):
        text = "".join(cell["source"] for cell in json.loads(path.read_text("utf-8"))["cells"])
        for name in re.findall(r"\.\./data_samples/[\w.]+", text):
            assert (path.parent / name).exists(), name
        for name in re.findall(r"\]\((\w+\.md)\)", text):
            assert (path.parent / name).is_file(), name
    for folder in ("student", "solution"):
        lessons = {p.name: p.read_bytes() for p in (ROOT / "notebooks" / "lessons").iterdir() if p.is_file()}
        assert {p.name: p.read_bytes() for p in (pack / folder / "lessons").iterdir()} == lessons  # no answers
    assert "## 03_neighborhoods" in (pack / "ANSWERS.md").read_text("utf-8")
    assert "](../tapip3d_lite" not in (pack / "student" / "FORMULAS.md").read_text("utf-8")


def test_the_plan_has_every_exercise_and_adds_up(pack):
    lines = (pack / "TIMING.md").read_text("utf-8").splitlines()
    rows = {line.split(" | ")[0].strip("| "): line.strip("|").split(" | ") for line in lines if line.startswith("| ")}
    for path in NOTEBOOKS:
        nb, row = read_notebook(path), rows[path.stem]
        assert int(row[1]) == minutes(nb) == int(row[3]) + sum(task.minutes for task in tasks(nb))
        assert all(f"{task.title} {task.stars} {task.minutes}" in row[4] for task in tasks(nb))
    assert int(rows["all"][1]) == sum(int(rows[path.stem][1]) for path in NOTEBOOKS)
    assert len(lines) < 60  # one page


def test_the_readme_gives_the_same_minutes():
    readme = (ROOT / "README.md").read_text("utf-8")
    shown = dict(re.findall(r"\(notebooks/(\w+)\.ipynb\) \|.*\| (\d+)\D* \|", readme))
    assert shown
    assert {name: int(value) for name, value in shown.items()} == {
        path.stem: minutes(read_notebook(path)) for path in NOTEBOOKS if path.stem in shown
    }


def cell(kind, source, *labels):
    code = {"outputs": [], "execution_count": None} if kind == "code" else {}
    return {"cell_type": kind, "source": source, "metadata": {"tags": list(labels)}, "id": f"{len(source)}"} | code


@pytest.fixture
def course():
    fold = "<details><summary>Solution</summary>\n\n```python\ndef f(): return 1\n```\n\n</details>"
    cells = [
        cell("markdown", "# x\n\ntrained in 5 minutes\n\nReading: 30 min"),
        cell("code", "SEED = 0", "parameters"),
        cell("code", "import numpy"),
        cell("markdown", "### Exercise 1.1 · One\n\nDifficulty ★★ · 10 min"),
        cell("code", "def f(): ...", "exercise"),
        cell("markdown", fold),
    ]
    return {"cells": cells, "metadata": {}, "nbformat": 4, "nbformat_minor": 5}


def test_small_course(course):
    assert "| c | 30 | 2 | 20 | 1.1 One ★★ 10 |" in timing_plan({"c": course}, lesson=20)
    solved = handout(solution_copy(course))
    assert [c["source"] for c in solved["cells"]][-1] == "def f(): return 1"  # the fold was all of its cell
    assert course["cells"][4]["source"] == "def f(): ..."


def test_what_is_missing_is_named(course, tmp_path):
    with pytest.raises(ValueError, match="no notebooks named"):
        write_pack(tmp_path, tmp_path / "out")
    (tmp_path / "00_x.ipynb").write_text("{}")
    with pytest.raises(ValueError, match="not a readable notebook"):
        write_pack(tmp_path, tmp_path / "out")
    course["cells"][0]["source"] = "# x\n\n5 min"
    with pytest.raises(ValueError, match="c: its exercises take 10 minutes"):
        timing_plan({"c": course})
    course["cells"][0]["source"] = "# x"
    with pytest.raises(ValueError, match="say its minutes"):
        timing_plan({"c": course})
    course["cells"][3]["source"] = "### Exercise 1.1 · One"
    with pytest.raises(ValueError, match="before the stub"):
        tasks(course)
    del course["cells"][5]
    with pytest.raises(ValueError, match="no folded solution"):
        solution_copy(course)


def test_the_command_writes_the_pack_and_refuses_in_one_line(tmp_path, capsys):
    main(["--out", str(tmp_path / "pack"), "--lesson", "30"])
    assert "a lesson has 30" in (tmp_path / "pack" / "TIMING.md").read_text("utf-8")
    capsys.readouterr()
    wrong = [[], ["--out", str(tmp_path / "pack" / "TIMING.md")]]
    wrong += [["--out", str(tmp_path), option, value] for option, value in (("--lesson", "0"), ("--notebooks", "none"))]
    for arguments in wrong:
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        shown = capsys.readouterr().err
        assert stop.value.code == 2 and shown.startswith("run.py teach: ") and len(shown.splitlines()) == 1
