"""Mutants of the notebooks' solutions: does each checker notice a changed operator, number, axis or argument?

`PYTHONPATH=notebooks python -m tests.mutants [01 …]` prints those that pass their checker. A survivor is either
equivalent to the solution, and stands with its reason in `tests/data/equivalent_mutants/01.json`, or shows a blind checker.
"""

import ast
import copy
import json
import signal
import sys
import warnings
from pathlib import Path

import numpy as np

from lessons.checker import exercises_of, judge
from lessons.progress import function_name, imports_and_parameters
from lessons.teaching import read_notebook, solution_of, stubs

ROOT = Path(__file__).resolve().parents[1]
KNOWN = ROOT / "tests" / "data" / "equivalent_mutants"  # one file for each lesson
_SWAPS = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Div}
_SWAPS |= {ast.Pow: ast.Mult, ast.MatMult: ast.Mult, ast.Mod: ast.FloorDiv}
_SWAPS |= {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq}
_SWAPS |= {ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.And: ast.Or, ast.Or: ast.And}
_NAMES = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "floor": "ceil", "ceil": "floor"}
_NAMES |= {"rint": "floor", "round": "floor", "mean": "sum", "sum": "mean", "sin": "cos", "cos": "sin", "any": "all"}
_NAMES |= {"all": "any", "argmin": "argmax", "argmax": "argmin", "log": "exp", "exp": "log", "sqrt": "square"}


def mutants(source):
    """Changed forms of a piece of code, each with where and what was changed."""
    tree = ast.parse(source)
    for place, node in enumerate(ast.walk(tree)):
        for what, change in _changes(node):
            changed = copy.deepcopy(tree)
            target = next(n for i, n in enumerate(ast.walk(changed)) if i == place)
            change(target)
            text = ast.unparse(ast.fix_missing_locations(changed))
            if text != ast.unparse(tree):
                yield f"{getattr(node, 'lineno', 0)}:{getattr(node, 'col_offset', 0)} {what}", text


def _changes(node):
    """(description, function that changes a node in place)."""
    if isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in _SWAPS:
        new = _SWAPS[type(node.op)]
        yield f"{type(node.op).__name__} -> {new.__name__}", lambda n: setattr(n, "op", new())
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult | ast.Sub | ast.Div):
            yield "operands swapped", _swap_operands
    if isinstance(node, ast.Compare) and type(node.ops[0]) in _SWAPS:
        new = _SWAPS[type(node.ops[0])]
        yield f"{type(node.ops[0]).__name__} -> {new.__name__}", lambda n: n.ops.__setitem__(0, new())
    if isinstance(node, ast.BoolOp):
        yield "and <-> or", lambda n: setattr(n, "op", _SWAPS[type(n.op)]())
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not | ast.Invert):
        yield "sign dropped", lambda n: setattr(n, "op", ast.UAdd())
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        yield f"{node.value} -> {node.value + 1}", lambda n: setattr(n, "value", n.value + 1)
        if node.value:
            yield f"{node.value} -> {node.value - 1}", lambda n: setattr(n, "value", n.value - 1)
    if isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield f"{node.value} -> {not node.value}", lambda n: setattr(n, "value", not n.value)
    if isinstance(node, ast.Attribute) and node.attr in _NAMES:
        yield f"{node.attr} -> {_NAMES[node.attr]}", lambda n: setattr(n, "attr", _NAMES[n.attr])
    if isinstance(node, ast.Name) and node.id in _NAMES:
        yield f"{node.id} -> {_NAMES[node.id]}", lambda n: setattr(n, "id", _NAMES[n.id])
    if isinstance(node, ast.Call):
        if len(node.args) >= 2:
            yield "first arguments swapped", lambda n: n.args.__setitem__(slice(0, 2), n.args[1::-1])
        for i, keyword in enumerate(node.keywords):
            yield f"{keyword.arg} left out", lambda n, i=i: n.keywords.pop(i)
    if hasattr(node, "body") and isinstance(node.body, list) and len(node.body) > 1:
        for i, statement in enumerate(node.body):
            if isinstance(statement, ast.AugAssign | ast.Expr | ast.Assign):
                yield f"statement {i} left out", lambda n, i=i: n.body.__setitem__(i, ast.Pass(lineno=1, col_offset=0))


def _swap_operands(node):
    node.left, node.right = node.right, node.left


def survivors(number, seconds=10):
    """(exercise, change, code) of each mutant of a lesson's solutions that its checker lets pass; and how many there were."""
    path = next((ROOT / "notebooks").glob(f"{number}_*.ipynb"))
    notebook, found, count = read_notebook(path), [], 0
    names = {function_name(notebook, exercise.name): exercise for exercise in exercises_of(number)}
    space = _imports(notebook)
    for i in stubs(notebook):
        solution = solution_of(notebook, i)
        exec(solution, space)
        for node in ast.parse(solution).body:
            if isinstance(node, ast.FunctionDef) and node.name in names:
                exercise = names[node.name]
                for what, text in mutants(solution):
                    count += 1
                    if _passes(exercise, text, node.name, space, seconds):
                        found.append((exercise.name, what, text))
    return found, count


def _imports(notebook):
    """What the solutions may use: the notebook's own imports and parameters."""
    space = {}
    exec("\n".join(imports_and_parameters(notebook)), space)
    return space


def _passes(exercise, text, name, space, seconds):
    def late(*_):
        raise TimeoutError

    own = dict(space)
    signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            exec(text, own)
            return judge(exercise, own[name]).status == "passed"
    except Exception:
        return False
    finally:
        signal.alarm(0)


def known():
    """Exercise to {change: reason} of mutants that compute the same as the solution."""
    pages = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(KNOWN.glob("[0-9]*.json"))]
    return {exercise: changes for page in pages for exercise, changes in page.items()}


if __name__ == "__main__":
    numbers = sys.argv[1:] or [p.name[:2] for p in sorted((ROOT / "notebooks").glob("[0-9][0-9]_*.ipynb"))]
    for number in numbers:
        alive, count = survivors(number)
        print(f"lesson {number}: {count} mutants, {len(alive)} pass")
        for exercise, what, _ in alive:
            print(f"  {exercise}, {what}: {known().get(exercise, {}).get(what, 'NOT EXPLAINED')}")
