"""Guards over the committed notebooks, and a run of each with its exercises solved."""

import ast
import json
import re
import sys
from itertools import chain
from urllib.request import Request, urlopen

import nbformat
import pytest
from jupyter_client import BlockingKernelClient

from lessons.restart import RULE, needs, with_lines
from lessons.teaching import solution_copy, solution_of, tags
from tests.notebook_tools import FOLDER, ROOT, clean, jupyter_lab, notebooks, on_the_learners_code, run

NOTEBOOKS = notebooks()
CHECK = re.compile(r"n\d\d\.check\(")
LIBRARIES = {"matplotlib", "numpy", "plotly", "tapip3d_lite", "torch"} | sys.stdlib_module_names
each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)


def read(path):
    return nbformat.read(path, as_version=4)


def code_cells(nb):
    return [c for c in nb.cells if c.cell_type == "code"]


def outputs(nb):
    return [(c, o) for c in code_cells(nb) for o in c.outputs]


def test_there_are_notebooks():
    assert [p.stem[:2] for p in NOTEBOOKS] == [f"{i:02d}" for i in range(11)]


@each_notebook
def test_opening(path):
    nb = read(path)
    nbformat.validate(nb)
    opening = "".join(c.source for c in nb.cells[:3])
    assert "By the end you will have shown that" in opening
    assert re.search(r"\d+ min", opening)
    assert sum("parameters" in tags(c) for c in nb.cells) == 1


@each_notebook
def test_outputs_are_fresh_and_clean(path):
    nb = read(path)
    cells = code_cells(nb)
    assert [c.execution_count for c in cells] == list(range(1, len(cells) + 1)), "run `python3 run.py notebooks`"
    for cell, output in outputs(nb):
        assert output.output_type != "error", cell.source
        assert not (output.output_type == "stream" and output.name == "stderr"), cell.source
    text = json.dumps([o for _, o in outputs(nb)])
    assert not re.search(r"(?<![\w.])(/home/|/root/|/tmp/|/Users/|[A-Z]:\\\\)", text)
    assert str(ROOT) not in text
    assert "widgets" not in nb.metadata and "widget-view" not in text
    assert path.stat().st_size < 2e6


@each_notebook
def test_nothing_asks_the_network(path):
    lessons = (ROOT / "notebooks" / "lessons").rglob("*.py")
    for source in [*(c.source for c in code_cells(read(path))), *(x.read_text(encoding="utf-8") for x in lessons)]:
        assert not re.search(
            r"^\s*(?:import|from) (?:urllib|requests|http|socket|ftplib)\b|\b(?:wget|curl|pip) ", source, re.M
        )


@each_notebook
def test_links_lead_somewhere(path):
    for cell in read(path).cells:
        for target in re.findall(r"\]\(([\w./-]+)[)#]", cell.source) if cell.cell_type == "markdown" else ():
            assert (path.parent / target).exists(), target


@each_notebook
def test_checked_cells_have_outputs(path):
    for cell in code_cells(read(path)):
        if "nbval-check-output" in tags(cell):
            assert cell.outputs, cell.source
            assert all(o.output_type == "stream" or "text/plain" in o.data for o in cell.outputs)


@each_notebook
def test_every_figure_has_a_static_form(path):
    scenes = [c for c in code_cells(read(path)) if "show_3d(" in c.source]
    for cell in scenes:
        shown = [o.data for o in cell.outputs if "data" in o]
        assert any("<img" in data.get("text/html", "") for data in shown), cell.source
        assert not any("application/vnd.plotly.v1+json" in data for data in shown), cell.source
    assert len(scenes) <= 6  # a browser keeps few WebGL contexts alive


@each_notebook
def test_source_has_one_path_for_all(path):
    source = "\n".join(c.source for c in code_cells(read(path)))
    assert not re.search(r"TESTING|FigureWidget|kaleido|%cd|os\.chdir|sys\.path", source)


@each_notebook
def test_imports_stand_together_and_name_no_lesson_but_its_own(path):
    cells = [list(ast.walk(ast.parse(c.source))) for c in code_cells(read(path))]
    imports = [[node for node in cell if isinstance(node, ast.Import | ast.ImportFrom)] for cell in cells]
    assert sum(map(bool, imports)) <= 3
    lessons = set()
    for node in chain.from_iterable(imports):
        names = [alias.name for alias in node.names]
        modules = names if isinstance(node, ast.Import) else [f"{node.module}.{name}" for name in names]
        lessons |= {module for module in modules if module.startswith("lessons")}
        others = {module for module in modules if not module.startswith("lessons.")}
        assert {module.split(".")[0] for module in others} <= LIBRARIES
        assert not any(part.startswith("_") for module in modules for part in module.split("."))
    assert lessons == {f"lessons.n{path.stem[:2]}"}


def test_lessons_are_small_and_use_public_names():
    for path in sorted((FOLDER / "lessons").glob("*.py")):
        text = path.read_text(encoding="utf-8")
        assert len(text.splitlines()) <= 300, path.name
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ImportFrom):
                assert node.module.split(".")[0] != "tests", path.name
                names = [*node.module.split("."), *(alias.name for alias in node.names)]
                assert not [name for name in names if name.startswith("_") and not name.startswith("__")], path.name


def test_a_kernel_finds_the_lessons_wherever_lab_is_started(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT))
    import run as command

    called = []
    monkeypatch.setattr(command, "_call", lambda *arguments: called.extend(arguments) or 0)
    command.run_lab()
    monkeypatch.delenv("PYTHONPATH", raising=False)  # the notebook's folder alone must do
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    with jupyter_lab(tmp_path, called, cwd=elsewhere) as server:
        asked = {"path": NOTEBOOKS[0].name, "name": "", "type": "notebook", "kernel": {"name": "python3"}}
        head = {"Authorization": f"token {server['token']}"}
        session = json.load(urlopen(Request(f"{server['url']}api/sessions", json.dumps(asked).encode(), head)))
        client = BlockingKernelClient(
            connection_file=str(tmp_path / "runtime" / f"kernel-{session['kernel']['id']}.json")
        )
        client.load_connection_file()
        client.hb_channel.time_to_dead = 60.0  # a busy machine misses beats, which would count as death
        client.start_channels()
        try:
            client.wait_for_ready(60)
            wanted = {"file": "checker.__file__"}
            reply = client.execute("from lessons import checker", user_expressions=wanted, reply=True, timeout=60)
        finally:
            client.stop_channels()
    assert reply["content"]["user_expressions"]["file"]["data"]["text/plain"] == repr(
        str(FOLDER / "lessons/checker.py")
    )


@each_notebook
def test_each_section_says_what_it_needs(path):
    nb = read(path)
    assert with_lines(read(path)) == nb, "run `python3 run.py notebooks`"


def test_needs_of_a_small_notebook():
    cells = [
        "# 1",
        "import math",
        "## 1. A",
        "a = 1\ndef f(x): return [a + y for y in x]",
        "text\n\n## B",
        "b = f([a])",
    ]
    cells += ["## 2. C", "for a in [2]: a += math.pi", "## 3. D", "d = [b for b in [1]], a", "## 4. E", "e = b, a"]
    nb = {"cells": [{"cell_type": "code" if i % 2 else "markdown", "source": s} for i, s in enumerate(cells)]}
    assert needs(nb) == [set(), set(), {1}, {0}, {0, 3}, {0, 1, 2, 3}]
    texts = [cell["source"] for cell in with_lines(with_lines(nb))["cells"][::2]]
    assert texts == [
        f"# 1\n\n{RULE}",
        "## 1. A",
        "text\n\n## B\n\n*Needs section 1.*",
        "## 2. C",
        "## 3. D\n\n*Needs section 2.*",
        "## 4. E\n\n*Needs “B” and sections 1 and 2.*",
    ]


@each_notebook
def test_exercises_are_whole(path):
    nb = read(path)
    stubs = [i for i, c in enumerate(nb.cells) if "exercise" in tags(c)]
    assert len(stubs) >= 3
    for i in stubs:
        assert CHECK.match(nb.cells[i + 1].source), nb.cells[i].source
        assert len(solution_of(nb, i)) > 20
        after = "".join(c.source for c in nb.cells[i + 1 : i + 5] if c.cell_type == "markdown")
        assert after.count("<summary>Hint") >= 2, nb.cells[i].source
        before = nb.cells[i - 1].source
        assert re.search(r"\d+ min", before) and re.search(r"★|Difficulty", before), before


@each_notebook
def test_solutions_pass(path):
    nb = run(on_the_learners_code(solution_copy(read(path))))
    warned = [o.text for _, o in outputs(nb) if o.get("name") == "stderr" and "Warning" in o.text]
    assert not warned, warned[0]  # `clean` would hide it from the stored notebook
    checkers = [c for c in code_cells(nb) if CHECK.match(c.source)]
    assert len(checkers) == sum("exercise" in tags(c) for c in nb.cells)
    for cell in checkers:
        shown = "".join(o.get("data", {}).get("text/plain", "") for o in cell.outputs)
        assert "passed" in shown, f"{cell.source}\n{shown}"


@each_notebook
def test_stubs_are_not_attempted_in_the_committed_outputs(path):
    for cell, output in outputs(read(path)):
        if CHECK.match(cell.source):
            assert "not attempted" in output["data"]["text/plain"], cell.source


@pytest.fixture
def small():
    """A notebook with one exercise and everything that must not be stored."""
    fold = (
        "<details><summary>Hint 1</summary>\n\n```python\nno\n```\n\n</details>\n\n<details><summary>Solution</summary>"
    )
    cells = [
        nbformat.v4.new_code_cell(
            "def f():\n    ...", metadata={"tags": ["exercise"], "execution": {"started": "now"}}
        ),
        nbformat.v4.new_code_cell(
            "import sys; print(f(), flush=True); print('/home/me/x/notebooks/a.png'); print('w', file=sys.stderr)"
        ),
        nbformat.v4.new_markdown_cell(f"{fold}\n\n```python\ndef f():\n    return 41 + 1\n```\n\n</details>"),
    ]
    return nbformat.v4.new_notebook(cells=cells, metadata={"widgets": {"state": {}}})


def test_a_solution_copy_runs_the_folded_code_and_leaves_the_stub_alone(small):
    done = clean(run(solution_copy(small)))
    nbformat.validate(done)
    assert [o.text for o in done.cells[1].outputs] == ["42\nnotebooks/a.png\n"]  # no stderr, no home
    assert "widgets" not in done.metadata and done.cells[0].metadata == {"tags": ["exercise"]}
    assert small.cells[0].source.endswith("...")
    del small.cells[2]
    with pytest.raises(ValueError, match="no folded solution"):
        solution_copy(small)


def test_only_what_rests_on_an_exercise_is_run_again():
    sources = ["import math", "a = 1", "def f(x): return x + a", 'n01.check("01.f", f)', "b = a + 1", "c = f(math.pi)"]
    sources += ["d = [b]", "e = c", 'g = n01.in_use("01.f")', "h = b", "print(h, g(0))"]
    cells = [nbformat.v4.new_code_cell(source) for source in sources]
    cells[2].metadata["tags"] = ["exercise"]
    kept = [cell.source for cell in on_the_learners_code(nbformat.v4.new_notebook(cells=cells)).cells]
    assert kept == [source for source in sources if source != "d = [b]"]


def test_a_stored_scene_and_explorer_leave_their_text(small):
    scene = {"application/vnd.plotly.v1+json": {}, "text/plain": "3D scene"}
    view = {"application/vnd.jupyter.widget-view+json": {}, "text/plain": "VBox(...)"}
    small.cells[1].outputs = [nbformat.v4.new_output("display_data", d) for d in (scene, view)]
    stored = [o.data for o in clean(small).cells[1].outputs]
    assert stored == [{"text/plain": "3D scene"}, {"text/plain": "(run the notebook to use this explorer)"}]
