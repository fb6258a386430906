#!/usr/bin/env python3
"""Set everything up and run it, with nothing but Python 3.10 or newer: `python3 run.py lab`.

Only the standard library is used here, since this file runs before anything is installed. The environment lives in
`.venv` beside this file and is brought up to date whenever `requirements.txt` or `pyproject.toml` changes.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
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
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True, metavar="setup | lab | test | demo | notebooks")
    for name, text in COMMANDS.items():
        commands.add_parser(name, help=text, description=text)
    # Everything behind the command belongs to the program it starts: JupyterLab, pytest, tapip3d_lite.
    chosen, arguments = parser.parse_known_args()
    if chosen.command == "setup" and arguments:
        parser.error(f"setup takes no arguments, got {' '.join(arguments)}")
    if sys.version_info < (3, 10):  # noqa: UP036 (run.py is what an older Python meets first)
        print(f"Python 3.10 or newer is needed, this is {sys.version.split()[0]}; try python3.11 run.py …")
        return 2
    try:
        setup()
        return globals()[f"run_{chosen.command}"](*arguments)
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
    os.environ.setdefault("TAPIP3D_MINUTES", "0.4")  # how long notebook 06 trains
    if "--browser" in arguments:
        # Its driver of 165 MB is only for those who ask; without it the test says that it is skipped.
        _call("-m", "pip", "--disable-pip-version-check", "install", "--quiet", "-r", "requirements-browser.txt")
        os.environ["TAPIP3D_BROWSER"] = "1"
        arguments = tuple(a for a in arguments if a != "--browser")
    if arguments:
        return _call("-m", "pytest", *arguments)
    unit = _call("-m", "pytest", "tests")
    notebooks = _call("-m", "pytest", "--nbval-lax", "--nbval-cell-timeout=300", "-p", "no:cacheprovider", "notebooks")
    return unit or notebooks


def run_demo(*arguments: str) -> int:
    return _call("-m", "tapip3d_lite", "demo", *arguments)


def run_notebooks(*names: str) -> int:
    return _call("-m", "tests.notebook_tools", *names)


def _call(*arguments: object) -> int:
    return subprocess.run([PYTHON, *map(str, arguments)], cwd=ROOT).returncode


def _root_user() -> list[str]:
    """JupyterLab refuses to run as root without being told; containers and CI usually are root."""
    return ["--allow-root"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []


def _fingerprint() -> str:
    parts = [(ROOT / name).read_bytes() for name in ("requirements.txt", "pyproject.toml")]
    return hashlib.sha256(b"\0".join([*parts, sys.version.encode(), str(ROOT).encode()])).hexdigest()


if __name__ == "__main__":
    sys.exit(main())
