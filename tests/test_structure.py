"""The house rules that a machine can check: style, sizes, names, and imports that point down only."""

import ast
import re
import statistics
import subprocess
import sys
from collections import Counter
from itertools import chain
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "tapip3d_lite"
FILES = sorted(PACKAGE.rglob("*.py"))

# A module may import from its own floor and from floors below, never above. Rooms on one floor are apart, unless the
# later one of a floor's list uses the earlier ones.
FLOORS = [
    ["geometry", "archive", "pickled", "files", "validate", "outline", "parts"],
    ["clip", "depth", "queries", "bundle", "poses", "measures", "mistakes", "check"],
    ["formats"],
    ["simulate", "model"],
    ["variants", "speed"],
    ["saved", "official", "recorder"],
    ["training", "evaluation"],
    ["figures"],
    ["export"],
    ["trackers"],
    ["lab"],
    ["refusals", "__main__", ""],
]
APART = [("training", "evaluation"), ("variants", "speed"), ("simulate", "model")]
CORE = ["geometry", "clip", "model", "training.loss", "training.backward", "training.trainer"]
CORE += ["evaluation.metrics", "evaluation.evaluate"]


def module_name(path):
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in FILES}
TREES = {name: ast.parse(path.read_text()) for name, path in MODULES.items()}


def imported(name):
    """(module, line) of every import of our own, the ones inside functions and the registry's strings included."""
    for node in ast.walk(TREES[name]):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("tapip3d_lite"):
            base = node.module.removeprefix("tapip3d_lite").lstrip(".")
            targets = [f"{base}.{a.name}".lstrip(".") for a in node.names]
        elif isinstance(node, ast.Import):
            ours = [a.name for a in node.names if a.name.startswith("tapip3d_lite")]
            targets = [x.removeprefix("tapip3d_lite").lstrip(".") for x in ours]
        else:
            continue
        for target in targets:
            while target and target not in MODULES:
                target = target.rpartition(".")[0]
            yield target, node.lineno


def room(module):
    return module.partition(".")[0]


def floor(module):
    found = [level for level, rooms in enumerate(FLOORS) if room(module) in rooms]
    assert found, f"{module}: which floor? add it to FLOORS"
    return found[0]


@pytest.mark.parametrize("name", MODULES)
def test_imports_point_down(name):
    # The package's own __init__ loads names on first use; `import tapip3d_lite as t3d` is for the top floor.
    up = [f"line {line}: {target}" for target, line in imported(name) if floor(target) > floor(name)]
    assert not up, f"{name} imports from above: {up}"


def test_what_stands_apart_does_not_meet():
    graph = rooms()
    for one, other in APART:
        assert other not in graph.get(one, ()) and one not in graph.get(other, ()), (one, other)
    text = "\n".join(MODULES[name].read_text() for name in MODULES if room(name) == "model")
    assert not re.search(r"(import|from) tapip3d_lite\.(speed|variants)", text)
    assert not re.search(r"self\.fast|\.fast\b", text)  # the registry alone decides


def rooms():
    """Folders and top-level modules, each with those that it imports."""
    graph = {}
    for name in MODULES:
        graph.setdefault(room(name), set()).update(room(target) for target, _ in imported(name))
    return {name: targets - {name} for name, targets in graph.items()}


@pytest.mark.parametrize("graph", ["files", "folders"])
def test_no_circles(graph):
    files = {name: {target for target, _ in imported(name)} - {name} for name in MODULES}
    graph, done, stack = files if graph == "files" else rooms(), set(), []

    def visit(node):
        assert node not in stack, f"circle: {' -> '.join([*stack[stack.index(node) :], node])}"
        if node not in done:
            stack.append(node)
            for other in sorted(graph[node]):
                visit(other)
            stack.pop()
            done.add(node)

    for name in graph:
        visit(name)


def lines(path):
    return len(path.read_text().splitlines())


def functions():
    for name, tree in TREES.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                body = [n for n in node.body if not (isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant))]
                length = body[-1].end_lineno - body[0].lineno + 1 if body else 0  # the docstring does not count
                yield length, f"{name}:{node.lineno} {node.name}"


def test_sizes():
    assert not {name: lines(path) for name, path in MODULES.items() if lines(path) > 300}
    lengths = list(functions())
    assert not [f for n, f in lengths if n > 60]
    assert statistics.median(n for n, _ in lengths) <= 15
    assert sum(map(lines, FILES)) <= 16_260  # 10,000 before formats, parts, untrusted files and the laboratory came in
    core = [path for name, path in MODULES.items() if any(f"{name}.".startswith(f"{part}.") for part in CORE)]
    assert sum(map(lines, core)) <= 3_500


def test_shipped_files_are_small():
    weights = [path.stat().st_size for path in (PACKAGE / "lab/paper").rglob("*.safetensors")]
    assert max(weights) < 2e6 and sum(weights) < 30e6
    assert all(path.stat().st_size < 8e6 for path in PACKAGE.rglob("*.safetensors"))
    assert all(path.stat().st_size < 2e6 for path in (ROOT / "data_samples").rglob("*"))


def test_one_name_one_thing():
    modules = Counter(name.rpartition(".")[2] for name, path in MODULES.items() if name and path.stem != "__init__")
    assert not [name for name, count in modules.items() if count > 1]
    classes = Counter(
        node.name
        for node in chain.from_iterable(tree.body for tree in TREES.values())
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    assert not [name for name, count in classes.items() if count > 1]


def docstrings():
    for name, tree in TREES.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                yield f"{name}:{getattr(node, 'lineno', 1)}", ast.get_docstring(node) or ""


def test_docstrings_say_something():
    assert not [place for place, text in docstrings() if re.fullmatch(r"(See|As) `[\w.]+`\.", text)]


def test_only_sections_and_equations_of_the_paper_are_cited():
    """Its Method has sections 3.1 and 3.2, and four equations."""
    texts = [*FILES, *(ROOT / "notebooks").rglob("*.py"), ROOT / "notebooks" / "FORMULAS.md", ROOT / "README.md"]
    texts += (ROOT / "notebooks").glob("*.ipynb")
    for path in texts:
        wrong = re.findall(r"section 3\.[03-9]|[Ee]quations? (?:[5-9]|\d to [5-9])", path.read_text(encoding="utf-8"))
        assert not wrong, (path.name, wrong)


def test_each_file_of_the_model_opens_with_its_equation():
    silent = {"__init__", "config", "registry"}  # sizes and names
    for name, tree in TREES.items():
        if room(name) == "model" and name.rpartition(".")[2] not in silent | {"model"}:
            assert re.search(r"^    \S.*[=:<>→]", ast.get_docstring(tree), re.M), name


def test_a_tracked_clip_touches_few_files():
    code = (
        "import sys, threading, tapip3d_lite as t3d\n"
        "clip = t3d.simulate_clip(seed=0, frames=12, size=(32, 32), tracks=8)\n"
        "tracker = t3d.Tracker(t3d.TrackerConfig.preset('lite', image_size=(32, 32), levels=2))\n"
        "files = set()\n"
        "see = lambda frame, event, _: files.add(frame.f_code.co_filename)\n"
        "threading.setprofile(see), sys.setprofile(see)\n"
        "tracker.track(clip, support_grid=2)\n"
        "sys.setprofile(None)\n"
        "print(*sorted(f for f in files if 'tapip3d_lite' in f), sep='\\n')\n"
    )
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    touched = [line for line in result.stdout.splitlines() if line.startswith(str(PACKAGE))]
    assert 10 < len(touched) <= 18, touched


@pytest.mark.parametrize("command", [["check"], ["format", "--check"]], ids=" ".join)
def test_ruff_is_clean(command):
    result = subprocess.run([sys.executable, "-m", "ruff", *command, "."], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr


def test_import_is_light():
    code = (
        "import sys, tapip3d_lite; print(sorted({'torch', 'mujoco', 'plotly', 'cv2', 'matplotlib'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_every_public_name_resolves():
    import tapip3d_lite as t3d

    for name in t3d.__all__:
        assert getattr(t3d, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        t3d.nonsense  # noqa: B018


def test_an_installed_package_has_all_of_its_files():
    (line,) = re.findall(r"^tapip3d_lite = (\[.*\])$", (ROOT / "pyproject.toml").read_text(), re.M)
    packed = {path for pattern in ast.literal_eval(line) for path in PACKAGE.glob(pattern)}
    ignored = {".pyc", ".py"}
    assert {path for path in PACKAGE.rglob("*.*") if path.is_file() and path.suffix not in ignored} == packed


def test_no_test_module_imports_another():
    for path in (ROOT / "tests").rglob("*.py"):
        assert not re.search(r"^(from|import) tests\.test_", path.read_text(), re.M), path.name
