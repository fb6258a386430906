"""What holds for every lesson: one alphabet, honest minutes, sealed guesses, figures with words, living code."""

import base64
import html
import io
import json
import re
import shutil
from importlib import import_module
from pathlib import Path

import pytest
from PIL import Image

from lessons import place
from lessons.formulas import formulas
from lessons.teaching import minutes, model_answers, question_of, read_notebook, solution_copy, tags, tasks
from tests.mutants import KNOWN, known, mutants, survivors
from tests.notebook_tools import FOLDER, notebooks

NOTEBOOKS = notebooks()
NUMBERS = [path.stem[:2] for path in NOTEBOOKS]
each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
_ROW = re.compile(r"^\|(.*)\|\s*$", re.MULTILINE)
_SYMBOL = re.compile(r"\\(?:mathbf|mathrm|mathcal|text|hat|bar)\{(\w+)\}|\\(\w+)|([A-Za-z])")


def code_cells(nb):
    return [cell for cell in nb["cells"] if cell["cell_type"] == "code"]


def words(nb):
    """Words that are read: text without folded parts."""
    text = "\n".join(cell["source"] for cell in nb["cells"] if cell["cell_type"] == "markdown")
    return len(re.findall(r"\w[\w'-]*", re.sub(r"<details>.*?</details>", "", text, flags=re.DOTALL)))


def code_lines(nb):
    cells = [cell["source"] for cell in code_cells(nb) if "exercise" not in tags(cell)]
    return sum(bool(line.strip()) for source in cells for line in source.splitlines())


@each_notebook
def test_minutes_are_honest(path):
    nb = read_notebook(path)
    needed = words(nb) / 150 + code_lines(nb) / 12 + sum(task.minutes for task in tasks(nb))
    assert abs(minutes(nb) - needed) <= 5, f"{needed:.0f} minutes: {words(nb)} words, {code_lines(nb)} lines"
    assert minutes(nb) <= 90, "split the lesson"


def table_rows(text):
    """Cells of each row of the tables whose first column is headed `symbol`."""
    inside = False
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")] if line.startswith("|") else []
        if not cells:
            inside = False
        elif cells[0] == "symbol":
            inside = True
        elif inside and set(line) - set("|-: "):
            yield cells


def atoms(cell):
    """The symbols of a table's first cell without indices and primes, e.g. `$F^l_t$` -> {"F"}."""
    formulas = " ".join(re.findall(r"\$([^$]*)\$", cell))
    formulas = re.sub(r"\\text\{[^}]*\}|[\^_](?:\{[^{}]*(?:\{[^{}]*\}[^{}]*)*\}|\\\w+|\w|\*)", "", formulas)
    found = {"".join(part) for part in _SYMBOL.findall(formulas)}
    return found - {"lVert", "rVert", "sqrt", "frac", "cdot", "to", "mathbf", "mathrm", "mathcal", "hat", "bar", "ge"}


SYMBOLS = {}
for _cells in table_rows((FOLDER / "SYMBOLS.md").read_text(encoding="utf-8")):
    for _atom in atoms(_cells[0]):
        SYMBOLS.setdefault(_atom, []).append(re.search(r"\*\*(\w+)\*\*", _cells[1])[1])


@each_notebook
def test_a_symbol_means_the_same_in_all_lessons(path):
    for cell in read_notebook(path)["cells"]:
        for cells in table_rows(cell["source"]) if cell["cell_type"] == "markdown" else ():
            for atom in atoms(cells[0]):
                assert atom in SYMBOLS, f"{cells[0]}: {atom} is not in SYMBOLS.md"
            if len(atoms(cells[0])) == 1:
                wanted = SYMBOLS[min(atoms(cells[0]))]
                meaning = cells[1].lower()
                assert any(word[:6].lower() in meaning for word in wanted), f"{cells[0]}: {meaning}; {wanted}"


_INDEX = re.compile(
    r"_(?:\{[^{}]*(?:\{[^{}]*\}[^{}]*)*\}|\\text\{[^}]*\}|\\\w+|\w)|\^(?!\*)(?:\{[^{}]*\}|\\\w+|\w)|\\bar|\\text\{[^}]*\}"
)
_LETTER = re.compile(r"\\(?:mathbf|mathrm|mathcal)\{\w+\}(?:\^\*)?|\\hat ?\w|[A-Za-z]\^\*|\\[A-Za-z]+|[A-Za-z]")
_NAMED = re.compile(r"([fc]_[xy]|t_q|W_\\text\{\w\}|\\mathrm\{hit\}_k)")  # with these indices letters of their own
_OPERATIONS = (
    r"\sin \cos \log \min \arg \sqrt \frac \tfrac \sum \partial \lfloor \rfloor \lVert \rVert \overline \left \right"
)
_OPERATIONS += r" \cup \in \times \wedge \ge \cdot \dots \leftarrow \mathrel \quad \top"


def letters(formula):
    """The letters of a formula, bold, script, hat and star included, without indices and operations."""
    named = set(_NAMED.findall(formula))
    rest = _INDEX.sub("", _NAMED.sub("", formula))
    return named | set(_LETTER.findall(rest)) - set(_OPERATIONS.split())


ALPHABET = [
    (letter, cells)
    for cells in table_rows((FOLDER / "SYMBOLS.md").read_text(encoding="utf-8"))
    for letter in letters(" ".join(re.findall(r"\$([^$]*)\$", cells[0])))
]


def test_no_letter_has_two_meanings():
    found = [letter for letter, _ in ALPHABET]
    assert len(found) > 60 and sorted(set(found)) == sorted(found)


def test_the_table_of_formulas_speaks_the_same_language():
    known_letters = {letter for letter, _ in ALPHABET}
    named = {}  # what the code calls a letter
    for letter, cells in ALPHABET:
        for name in re.findall(r"`(\w+)`", cells[3].split(";")[0]):
            named.setdefault(name, set()).add(letter)
    for formula in formulas():
        for written in (formula.latex, *(symbol.written for symbol in formula.symbols)):
            assert letters(written) <= known_letters, f"{formula.name}: {letters(written) - known_letters} in {written}"
        for symbol in formula.symbols:
            wanted = named.get(symbol.tensor.split(".")[-1])
            assert not wanted or wanted & letters(symbol.written), f"{formula.name}: {symbol} is called {wanted}"


@each_notebook
def test_guesses_are_sealed(path):
    nb = read_notebook(path)
    cells = code_cells(nb)
    sealed = [i for i, cell in enumerate(cells) if "reveal(" in cell["source"]]
    assert sealed and "score_guess" not in json.dumps(nb)
    for i in sealed:
        name = re.search(r"reveal\(\s*(\w+)", cells[i]["source"])[1]
        above = [c for c in cells[:i] if re.search(rf"^{name}\s*=\s*None", c["source"], re.MULTILINE)]
        assert len(above) == 1 and "guess" in tags(above[0]), f"{name}: its cell is tagged guess"
        text = json.dumps(cells[i]["outputs"], ensure_ascii=False)
        assert "sealed" in text and "measured" not in text and "<img" not in text, cells[i]["source"]
    opened = solution_copy(nb)
    assert not [c for c in code_cells(opened) if "guess" in tags(c) and re.search(r"=\s*None", c["source"])]


def figures(nb):
    """(cell, HTML) of every figure in the outputs."""
    for cell in code_cells(nb):
        for output in cell["outputs"]:
            page = "".join(output.get("data", {}).get("text/html", ""))
            if "<img" in page:
                yield cell, page


@each_notebook
def test_every_figure_has_words_and_is_sharp(path):
    nb = read_notebook(path)
    for cell in code_cells(nb):
        for output in cell["outputs"]:
            assert "image/png" not in output.get("data", {}), f"use show(figure, alt, caption):\n{cell['source']}"
    pages = list(figures(nb))
    assert len(pages) >= 3
    for cell, page in pages:
        alt = html.unescape(re.search(r'<img alt="([^"]*)"', page)[1])
        caption = re.search(r"<figcaption>(.*?)</figcaption>", page)[1]
        assert len(alt.split()) >= 6 and len(caption.split()) >= 6, cell["source"]
        width = int(re.search(r'width="(\d+)"', page)[1])
        data = base64.b64decode(re.search(r"base64,([^\"]+)", page)[1])
        assert Image.open(io.BytesIO(data)).width >= 1.4 * width, cell["source"]


@each_notebook
def test_a_lesson_opens_with_the_map_and_ends_with_a_milestone(path):
    nb, number = read_notebook(path), path.stem[:2]
    source = "\n".join(cell["source"] for cell in code_cells(nb))
    assert f'n{number}.pipeline("{number}")' in source
    assert f"n{number}.milestone(" in source and f"n{number}.progress(" in source
    lesson = import_module(f"lessons.n{number}")
    assert lesson.parts(lambda name: lambda *_: None)
    used = set(re.findall(r'in_use\(\s*"([\w.]+)"', source))
    alive = used | {name for name in (e.name for e in lesson.EXERCISES) if name in _plugged(lesson)}
    assert {exercise.name for exercise in lesson.EXERCISES} <= alive, "an exercise's function is used nowhere"


def _plugged(lesson):
    names = []
    lesson.parts(lambda name: names.append(name) or (lambda *_: None))
    return names


@each_notebook
def test_one_question_in_ones_own_words(path):
    assert question_of(read_notebook(path)).count("?") >= 1
    answer = (FOLDER / "lessons" / "answers" / f"{path.stem[:2]}.md").read_text(encoding="utf-8")
    assert 40 <= len(answer.split()) <= 250 and answer.strip() in model_answers(FOLDER)


@pytest.mark.parametrize("number", NUMBERS)
def test_checkers_notice_every_mutant_of_the_solution(number):
    alive, count = survivors(number)
    assert count >= 50
    explained = known()
    for exercise, what, text in alive:
        assert explained.get(exercise, {}).get(what), f"{exercise} accepts a mutant ({what}):\n{text}"


def test_no_mutant_is_explained_in_vain():
    for exercise, changes in known().items():
        nb = read_notebook(next(FOLDER.glob(f"{exercise[:2]}_*.ipynb")))
        code = [solution["source"] for solution in code_cells(solution_copy(nb)) if "exercise" in tags(solution)]
        exists = {what for source in code for what, _ in mutants(source)}
        assert set(changes) <= exists, f"{KNOWN.name}/{exercise[:2]}.json: {exercise}: {sorted(set(changes) - exists)}"


def test_a_lesson_trains_elsewhere_where_nothing_can_be_written(tmp_path, monkeypatch, capsys):
    (tmp_path / "notebooks").mkdir()
    monkeypatch.chdir(tmp_path / "notebooks")
    monkeypatch.setattr(place.tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    place.folder.cache_clear()
    assert place.folder("06") == Path("../runs/06") and Path("../runs/06").is_dir() and not capsys.readouterr().out
    place.folder.cache_clear()
    shutil.rmtree(tmp_path / "runs")
    (tmp_path / "runs").write_text("no folder")
    for _ in range(2):  # it says so once
        assert place.folder("06") == tmp_path / "temporary" / "tapip3d_lite" / "06"
    assert capsys.readouterr().out.count("kept elsewhere") == 1 and place.folder("06").is_dir()
    place.folder.cache_clear()
