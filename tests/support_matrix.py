"""Which Pythons and torches the library runs on, as a table: `python -m tests.support_matrix`.

For each interpreter that this machine has (`python3.10` … on the path, or pyenv's) and each torch, an environment is made
in a temporary folder, the library installed, and a few tests run: gigabytes and many minutes. `--syntax` only compiles the
package with each interpreter, in seconds. `--torch newest 2.9.0` names the versions.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PYTHONS = ("3.10", "3.11", "3.12", "3.13", "3.14")
TESTS = ["geometry", "clip", "model", "metrics", "track", "weights", "simulate"]


def interpreter(version: str) -> str | None:
    """The path of a Python, if there is one."""
    places = sorted((Path.home() / ".pyenv" / "versions").glob(f"{version}.*/bin/python"))
    return str(places[-1]) if places else shutil.which(f"python{version}")


def compiles(python: str) -> str:
    with tempfile.TemporaryDirectory() as cache:
        command = [python, "-X", f"pycache_prefix={cache}", "-m", "compileall", "-q", str(ROOT / "tapip3d_lite")]
        return "compiles" if subprocess.run(command, capture_output=True).returncode == 0 else "DOES NOT COMPILE"


def tested(python: str, torch: str) -> str:
    with tempfile.TemporaryDirectory() as folder:
        own = f"{folder}/bin/python"
        wanted = ["torch" if torch == "newest" else f"torch=={torch}", "pytest", "ruff"]
        steps = [
            [python, "-m", "venv", folder],
            [own, "-m", "pip", "install", "-q", *wanted, str(ROOT)],
            [own, "-m", "pytest", "-q", "-p", "no:cacheprovider", *(f"tests/test_{name}.py" for name in TESTS)],
        ]
        for step in steps:
            done = subprocess.run(step, cwd=ROOT, capture_output=True, text=True)
            if done.returncode:
                return f"fails: {' '.join((done.stdout + done.stderr).split()[-12:])}"
        return done.stdout.strip().splitlines()[-1]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--python", nargs="+", default=PYTHONS)
    parser.add_argument("--torch", nargs="+", default=["2.9.0", "newest"])
    parser.add_argument("--syntax", action="store_true")
    options = parser.parse_args()
    columns = ["package"] if options.syntax else [f"torch {torch}" for torch in options.torch]
    print(f"| Python | {' | '.join(columns)} |\n|---|{'---|' * len(columns)}")
    bad = 0
    for version in options.python:
        if (python := interpreter(version)) is None:
            print(f"| {version} | {' | '.join(['not on this machine'] * len(columns))} |")
            continue
        cells = [compiles(python)] if options.syntax else [tested(python, torch) for torch in options.torch]
        bad += sum("fails" in cell or "NOT" in cell for cell in cells)
        print(f"| {version} | {' | '.join(cells)} |", flush=True)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
