#!/usr/bin/env python3
"""Set everything up and run it, with nothing but Python 3.10 or newer: `python3 run.py lab`.

Only the standard library is used here, since this file runs before anything is installed. The environment lives in
`.venv` beside this file and is brought up to date whenever `requirements.txt` or `pyproject.toml` changes. Commands run
in this file's folder, from wherever it is called: relative paths in their arguments begin here.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent
VENV = ROOT / ".venv"
PYTHON = VENV / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
STAMP = VENV / "installed.sha256"
COMMANDS = {
    "setup": "make or update the environment, nothing else",
    "lab": "start JupyterLab on the notebooks; options are passed on, e.g. --no-browser --port 9000",
    "test": "style, unit tests, then every notebook on the CPU; --browser also moves sliders in Chromium or Chrome; "
    "other arguments go to pytest, and then notebooks are left out",
    "demo": "track a sample clip, write a 3D page and a picture; arguments as for `python -m tapip3d_lite demo`",
    "notebooks": "run the notebooks and store their fresh outputs; names select some, e.g. 01_lifting",
    "teach": "write a teacher's pack: --out PACK; notebooks with blanks, the same solved, a timing plan",
    "formulas": "write notebooks/FORMULAS.md from the code",
    "samples": "write data_samples/ and the README's picture from their seeds",
    "bench": "measure speed and memory against straightforward forms",
}
MODULES = {  # of the commands that only pass their arguments on
    "demo": ("tapip3d_lite", "demo"),
    "notebooks": ("tests.notebook_tools",),
    "teach": ("lessons.teaching",),
    "formulas": ("lessons.formulas",),
    "samples": ("lessons.samples",),
    "bench": ("tests.bench",),
}


def main() -> int:
    name, *arguments = sys.argv[1:] or [""]
    if name in ("-h", "--help"):
        print("\n".join([__doc__, *(f"  {command:<10} {text}" for command, text in COMMANDS.items())]))
        return 0
    if name not in COMMANDS or (name == "setup" and arguments):
        wrong = (
            "setup takes no arguments" if name in COMMANDS else f"no command {name!r}; there are {', '.join(COMMANDS)}"
        )
        print(f"run.py: {wrong}", file=sys.stderr)
        return 2
    if sys.version_info < (3, 10):  # noqa: UP036 (run.py is what an older Python meets first)
        print(f"Python 3.10 or newer is needed, this is {sys.version.split()[0]}; try python3.11 run.py …")
        return 2
    try:
        setup()
        if name in MODULES:
            return _call("-m", *MODULES[name], *arguments)
        return {"setup": run_setup, "lab": run_lab, "test": run_test}[name](*arguments)
    except subprocess.CalledProcessError as error:
        print(f"run.py: this step failed with exit code {error.returncode}: {' '.join(map(str, error.cmd))}")
        return 1
    except KeyboardInterrupt:
        return 130


def setup() -> None:
    """Make `.venv` if needed and install what `requirements.txt` pins, unless that is already in place."""
    wanted = _fingerprint()
    if PYTHON.exists() and STAMP.exists() and STAMP.read_text() == wanted:
        return
    STAMP.unlink(missing_ok=True)  # an interrupted installation must not look finished
    if not PYTHON.exists() or subprocess.run([PYTHON, "-m", "pip", "--version"], capture_output=True).returncode:
        print(f"Making a virtual environment in {VENV} …", flush=True)
        shutil.rmtree(VENV, ignore_errors=True)
        venv.create(VENV, with_pip=True)
    print("Installing the packages of requirements.txt (a few minutes the first time) …", flush=True)
    pip = [PYTHON, "-m", "pip", "--disable-pip-version-check", "install", "--quiet"]
    subprocess.run([*pip, "-r", ROOT / "requirements.txt"], check=True)
    subprocess.run([*pip, "--no-deps", "--editable", ROOT], check=True)
    STAMP.write_text(wanted)


def run_setup() -> int:
    print(f"Ready: {PYTHON}")
    return 0


def run_lab(*arguments: str) -> int:
    return _call("-m", "jupyterlab", f"--notebook-dir={ROOT / 'notebooks'}", *_root_user(), *arguments)


def run_test(*arguments: str) -> int:
    os.environ.setdefault("TAPIP3D_MINUTES", "0.2")  # how long notebook 06 trains
    os.environ.setdefault("TAPIP3D_STEPS", "20")  # and for how many steps each row of notebook 09
    if "--browser" in arguments:
        # Its driver of 165 MB is only for those who ask; without it the test says that it is skipped.
        _call("-m", "pip", "--disable-pip-version-check", "install", "--quiet", "-r", "requirements-browser.txt")
        os.environ["TAPIP3D_BROWSER"] = "1"
        arguments = tuple(a for a in arguments if a != "--browser")
    if arguments:
        return _call("-m", "pytest", *arguments)
    # Side by side, each on its share of the cores: two programs that want all of them get in one another's way.
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // 2)))
    solved = "tests/test_notebooks.py"  # runs every notebook too, with its exercises solved
    every = ["-m", "pytest", "--nbval-lax", "--nbval-cell-timeout=600", "-p", "no:cacheprovider", solved, "notebooks"]
    with tempfile.TemporaryFile() as report:
        notebooks = subprocess.Popen(**_python(*every), stdout=report, stderr=subprocess.STDOUT)
        try:
            unit = _call("-m", "pytest", f"--ignore={solved}", "tests")
            notebooks.wait()
        finally:
            notebooks.kill()  # where the unit tests were interrupted
        report.seek(0)
        print(report.read().decode(errors="replace"), flush=True)
    return unit or notebooks.returncode


def _call(*arguments: object) -> int:
    return subprocess.run(**_python(*arguments)).returncode


def _python(*arguments: object) -> dict[str, object]:
    """How to run Python in this folder, where it also finds the notebooks' `lessons`."""
    places = [str(ROOT / "notebooks"), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(places)}
    return {"args": [PYTHON, *map(str, arguments)], "cwd": ROOT, "env": environment}


def _root_user() -> list[str]:
    """JupyterLab refuses to run as root unless it is allowed to; containers and CI usually are root."""
    return ["--allow-root"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []


def _fingerprint() -> str:
    parts = [(ROOT / name).read_bytes() for name in ("requirements.txt", "pyproject.toml")]
    return hashlib.sha256(b"\0".join([*parts, sys.version.encode(), str(ROOT).encode()])).hexdigest()


if __name__ == "__main__":
    sys.exit(main())
