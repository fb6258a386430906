"""Mutants of the code that must be right: do its tests notice a changed operator, number, argument or statement?

`python -m tests.code_mutants --list` shows how many there are; `python -m tests.code_mutants geometry metrics` runs the
tests that belong to these files against every mutant (hours for all; `--sample 20` takes as many of each file, with
`--seed`). A mutant that passes is printed: it is equivalent, and stands with its reason in
`tests/data/equivalent_mutants/code.json`, or shows a hole in the tests. Mutants live in a copy of the package.
"""

import argparse
import ast
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.mutants import mutants

ROOT = Path(__file__).resolve().parents[1]
KNOWN = ROOT / "tests" / "data" / "equivalent_mutants" / "code.json"
SECONDS = 900  # for the tests of one mutant: an endless loop is noticed, too
TESTS = {  # file of the library, and the tests that hold it
    "geometry": ("geometry.py", ["test_geometry.py", "test_clip.py"]),
    "neighbors": ("model/neighbors.py", ["test_neighborhoods.py", "test_knn.py"]),
    "n2n": ("model/n2n.py", ["test_model.py", "test_fast.py"]),
    "loss": ("training/loss.py", ["test_training.py", "test_matching_loss.py"]),
    "metrics": ("evaluation/metrics.py", ["test_metrics.py"]),
}


def real_mutants(source: str) -> list[tuple[str, str]]:
    """The mutants of a file that differ in more than words for readers."""
    return [(what, text) for what, text in mutants(source) if _bare(text) != _bare(source)]


def _bare(source: str) -> str:
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(getattr(node, "body", None), list):
            body = [n for n in node.body if not (isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant))]
            node.body = [n for n in body if not isinstance(n, ast.Pass)] or [ast.Pass()]
    return ast.unparse(tree)


def passes(name: str, text: str, copy: Path) -> bool:
    """Whether a file's tests pass with this text in its place, in a copy of the repository."""
    file, tests = TESTS[name]
    place = copy / "tapip3d_lite" / file
    good = place.read_text(encoding="utf-8")
    place.write_text(text, encoding="utf-8")
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-x",
        "-p",
        "no:cacheprovider",
        *(f"tests/{test}" for test in tests),
    ]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(copy), str(copy / "notebooks")])}
    try:
        done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, timeout=SECONDS)
        return done.returncode == 0
    except subprocess.TimeoutExpired:
        return False
    finally:
        place.write_text(good, encoding="utf-8")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", choices=[*TESTS, []], default=[])
    parser.add_argument("--sample", type=int, help="mutants of each file; default: all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--list", action="store_true", help="only say how many there are")
    options = parser.parse_args()
    known, alive = json.loads(KNOWN.read_text(encoding="utf-8")) if KNOWN.exists() else {}, 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".git", ".venv", "runs", "__pycache__"))
        for name in options.names or TESTS:
            source = (ROOT / "tapip3d_lite" / TESTS[name][0]).read_text(encoding="utf-8")
            found = real_mutants(source)
            print(f"{name}: {len(found)} mutants", flush=True)
            if options.list:
                continue
            if not passes(name, source, copy):
                print(f"  the tests fail on the code as it is: {' '.join(TESTS[name][1])}")
                return 2
            count = min(options.sample or len(found), len(found))
            for what, text in random.Random(options.seed).sample(found, count):
                if passes(name, text, copy):
                    reason = known.get(name, {}).get(what)
                    alive += reason is None
                    print(f"  {what}: {reason or 'NOT NOTICED'}", flush=True)
    return 1 if alive else 0


if __name__ == "__main__":
    sys.exit(main())
