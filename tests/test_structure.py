"""The house rules that a machine can check: style, sizes, and imports that point down only."""

import ast
import statistics
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "tapip3d_lite"
FILES = sorted(PACKAGE.rglob("*.py"))

# A module may import from its own floor's folder and from floors below, never above.
FLOORS = [
    {"files", "geometry", "processes", "validate", "evaluation.metrics"},
    {"clip", "queries"},
    {"check", "consistency", "simulate", "degrade", "formats", "model"},
    {"training", "evaluation"},
    {"trackers"},
    {"ui"},
    {"__main__", "commands", ""},
]


def module_name(path):
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(tree, own):
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("tapip3d_lite"):
            base = node.module.removeprefix("tapip3d_lite").lstrip(".")
            yield from ((f"{base}.{a.name}".lstrip("."), node.lineno) for a in node.names)
        elif isinstance(node, ast.Import):
            yield from (
                (a.name.removeprefix("tapip3d_lite").lstrip("."), node.lineno)
                for a in node.names
                if a.name.startswith("tapip3d_lite")
            )


def floor(module):
    best = [
        (len(name), level)
        for level, names in enumerate(FLOORS)
        for name in names
        if f"{module}.".startswith(f"{name}.") and name
    ]
    return max(best)[1] if best else len(FLOORS) - 1


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_point_down(path):
    own = module_name(path)
    up = [
        f"line {line}: {target}"
        for target, line in imported(ast.parse(path.read_text()), own)
        if floor(target) > floor(own)
    ]
    assert not up, f"{own} imports from above: {up}"


def test_no_circles():
    graph = {module_name(p): set() for p in FILES}
    for path in FILES:
        own = module_name(path)
        for target, _ in imported(ast.parse(path.read_text()), own):
            while target and target not in graph:
                target = target.rpartition(".")[0]
            if target and target != own:
                graph[own].add(target)
    done, stack = set(), []

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


def functions():
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                body = [n for n in node.body if not (isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant))]
                lines = body[-1].end_lineno - body[0].lineno + 1 if body else 0  # the docstring does not count
                yield lines, f"{path.relative_to(ROOT)}:{node.lineno} {node.name}"


def test_sizes():
    lines = {str(p.relative_to(ROOT)): len(p.read_text().splitlines()) for p in FILES}
    assert not {name: n for name, n in lines.items() if n > 300}
    lengths = list(functions())
    assert not [f for n, f in lengths if n > 60]
    assert statistics.median(n for n, _ in lengths) <= 15


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
