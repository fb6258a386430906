"""Mutants of the code that must be right: do its tests notice a changed operator, number, argument or statement?

`python -m tests.code_mutants geometry metrics` runs the tests that belong to these files against every mutant, all files
without a name (`--list` counts them, `--sample 20` takes as many of each file, with `--seed`). A mutant that passes is
printed: it is equivalent, and stands with its reason in `tests/data/equivalent_mutants/code.json`, or shows a hole in the
tests. Each mutant lives in a fork of this process that reads the changed text in place of the file; no file is changed.
"""

import argparse
import ast
import importlib
import io
import json
import os
import random
import signal
import sys
import time
from contextlib import redirect_stderr, redirect_stdout
from importlib.machinery import SourceFileLoader
from pathlib import Path

import pytest
import torch

from tests.mutants import mutants

ROOT = Path(__file__).resolve().parents[1]
LOADED = [
    "cv2",
    "IPython.display",
    "ipywidgets",
    "matplotlib.pyplot",
    "mujoco",
    "numpy",
    "plotly.graph_objects",
    "tyro",
]
KNOWN = ROOT / "tests" / "data" / "equivalent_mutants" / "code.json"
SECONDS = 300  # for the tests of one mutant: an endless loop is noticed, too
TESTS = {  # file of the library, and the tests that hold it
    "geometry": ("geometry.py", ["geometry", "clip", "properties"]),
    "neighbors": ("model/neighbors.py", ["neighborhoods", "knn"]),
    "n2n": ("model/n2n.py", ["model", "fast"]),
    "loss": ("training/loss.py", ["training", "matching_loss"]),
    "metrics": ("evaluation/metrics.py", ["metrics", "properties"]),
}


def real_mutants(source: str) -> list[tuple[str, str]]:
    """The mutants of a file that differ in more than words for readers and the order of arguments that have none."""
    return [(what, text) for what, text in mutants(source) if _bare(text) != _bare(source)]


def _bare(source: str) -> str:
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            node.values = []
        if isinstance(node, ast.FunctionDef):
            node.returns = None
            for argument in ast.walk(node.args):
                argument.annotation = None
        if isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] in (
            "max",
            "min",
            "maximum",
            "minimum",
        ):
            node.args.sort(key=ast.unparse)
        if isinstance(getattr(node, "body", None), list):
            body = [n for n in node.body if not (isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant))]
            node.body = [n for n in body if not isinstance(n, ast.Pass)] or [ast.Pass()]
    return ast.unparse(tree)


def _named(source: str, what: str) -> str:
    """A mutant by its line's text, which stays when lines move: "scale = a / b: Div -> Mult"."""
    place, _, change = what.partition(" ")
    line, column = map(int, place.split(":"))
    if change.startswith("statement"):  # by what it says, since its number moves, too
        for node in ast.walk(ast.parse(source)):
            here = getattr(node, "lineno", 0), getattr(node, "col_offset", 0)
            if here == (line, column) and isinstance(getattr(node, "body", None), list):
                return f"{ast.unparse(node.body[int(change.split()[1])])}: left out"
    return f"{source.splitlines()[line - 1].strip()}: {change}"


def passes(name: str, text: str) -> bool:
    """Whether a file's tests pass with this text in its place."""
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        code = 1
        try:
            code = _test(str(ROOT / "tapip3d_lite" / TESTS[name][0]), text, TESTS[name][1])
        finally:
            os._exit(int(code != 0))
    end = time.monotonic() + SECONDS
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return status == 0
        if time.monotonic() > end:
            os.kill(child, signal.SIGKILL)
        time.sleep(0.02)


def _test(place: str, text: str, names: list[str]) -> int:
    """In a fork: run the tests while one file reads as `text`."""
    read, stats = SourceFileLoader.get_data, SourceFileLoader.path_stats
    SourceFileLoader.get_data = lambda self, path: text.encode() if path == place else read(self, path)
    # The compiled form of the good file must not be used, nor the mutant's be kept.
    SourceFileLoader.path_stats = lambda self, path: {"mtime": -1, "size": 0} if path == place else stats(self, path)
    sys.dont_write_bytecode = True
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"  # nbval's imports take longer than these tests
    torch.set_num_threads(1)
    tests = [str(ROOT / "tests" / f"test_{name}.py") for name in names]
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        return pytest.main(["-q", "-x", "-p", "no:cacheprovider", *tests])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", choices=[*TESTS, []], default=[])
    parser.add_argument("--sample", type=int, help="mutants of each file; default: all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--list", action="store_true", help="only say how many there are")
    options = parser.parse_args()
    for module in LOADED:  # what tests need and no mutant changes, once and for all forks
        importlib.import_module(module)
    known, alive = json.loads(KNOWN.read_text(encoding="utf-8")) if KNOWN.exists() else {}, 0
    for name in options.names or TESTS:
        source = (ROOT / "tapip3d_lite" / TESTS[name][0]).read_text(encoding="utf-8")
        found = real_mutants(source)
        if options.list:
            print(f"{name}: {len(found)} mutants")
            continue
        if not passes(name, source):
            print(f"  the tests fail on the code as it is: {' '.join(TESTS[name][1])}")
            return 2
        chosen = random.Random(options.seed).sample(found, min(options.sample or len(found), len(found)))
        living = [_named(source, what) for what, text in chosen if passes(name, text)]
        unknown = [what for what in living if what not in known.get(name, {})]
        alive += len(unknown)
        print(f"{name}: {len(chosen)} of {len(found)} mutants, {len(chosen) - len(living)} noticed, {len(unknown)} NOT")
        for what in living:
            print(f"  {what}: {known.get(name, {}).get(what, 'NOT NOTICED')}", flush=True)
    return 1 if alive else 0


if __name__ == "__main__":
    sys.exit(main())
