"""Run notebooks, store clean outputs: `python3 run.py notebooks [name …]`; start a JupyterLab for tests."""

import argparse
import json
import os
import re
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import nbformat
from nbclient import NotebookClient

from lessons.restart import needed, with_lines
from lessons.teaching import tags
from tapip3d_lite.files import atomic_path

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "notebooks"
_ASKS = re.compile(r"\bn\d\d\.(?:check|collect|in_use|milestone|progress)\(")  # for the learner's functions
_PATHS = re.compile(r"(?:/[\w.\-]+)*/(?:notebooks|data_samples|tapip3d_lite)(?=/|\b)")


def notebooks():
    return sorted(FOLDER.glob("[0-9][0-9]_*.ipynb"))


def run(nb, folder=FOLDER, timeout=1200):
    """Execute a notebook in place; raises at the first cell that fails."""
    place = {"metadata": {"path": str(folder)}}
    # The kernel cuts printed text by the clock; joined, it is the same in every run.
    NotebookClient(nb, timeout=timeout, kernel_name="python3", resources=place, coalesce_streams=True).execute()
    return nb


def on_the_learners_code(nb):
    """A copy with the code that rests on the exercises, and what that needs; the rest is the same without solutions."""
    code = [cell for cell in nb.cells if cell.cell_type == "code"]
    others = needed([cell.source for cell in code])
    own = {i for i, cell in enumerate(code) if "exercise" in tags(cell) or _ASKS.search(cell.source)}
    own |= {i for i, needs in enumerate(others) if needs & own}
    return nbformat.from_dict({**nb, "cells": [code[i] for i in sorted(own.union(*(others[i] for i in own)))]})


def clean(nb):
    """Keep outputs a reader wants: no warnings, paths of this machine, time stamps or widget state."""
    nb.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    for cell in nb.cells:
        cell.metadata = {key: cell.metadata[key] for key in ("tags", "jupyter") if key in cell.metadata}
        if cell.cell_type != "code":
            continue
        cell.outputs = [o for o in cell.outputs if not (o.output_type == "stream" and o.name == "stderr")]
        for output in cell.outputs:
            if "text" in output:
                output.text = _PATHS.sub(lambda m: m.group().rsplit("/", 1)[-1], output.text)
            data = output.get("data", {})
            # A scene of megabytes that no static viewer draws; its note and its PNG twin stay.
            data.pop("application/vnd.plotly.v1+json", None)
            if "application/vnd.jupyter.widget-view+json" in data:
                # Widget state is not stored, so a stored view would be an empty box.
                del data["application/vnd.jupyter.widget-view+json"]
                data["text/plain"] = "(run the notebook to use this explorer)"
            if "metadata" in output:  # a stream has none
                output.metadata = {}
    return nb


def save(nb, path):
    with atomic_path(path) as temporary:
        nbformat.write(nb, temporary)


@contextmanager
def jupyter_lab(home, command, cwd, **environment):
    """Run JupyterLab as long as the context lasts; gives its own notes: `url`, `token` and more.

    Args:
        home: folder of its log, settings and state.
        command: Python's arguments, e.g. `["-m", "jupyterlab"]`.
        cwd: where it is started.
        environment: more variables.
    """
    places = {f"JUPYTER_{kind}_DIR": str(home / kind.lower()) for kind in ("CONFIG", "DATA", "RUNTIME")}
    with (home / "log").open("w") as log:
        server = subprocess.Popen(
            [sys.executable, *map(str, command), "--no-browser", "--port=0"],
            cwd=cwd,
            env=os.environ | places | environment,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    try:
        yield _notes(server, home)
    finally:
        server.terminate()  # it ends its kernels
        try:
            server.wait(20)
        except subprocess.TimeoutExpired:
            server.kill()
            server.wait()


def _notes(server, home, seconds=60):
    """Wait until the server has written where it listens, and with which token."""
    end = time.monotonic() + seconds
    while not (files := list(home.glob("runtime/jpserver-*[0-9].json"))):
        assert server.poll() is None and time.monotonic() < end, (home / "log").read_text()
        time.sleep(0.05)
    return json.loads(files[0].read_text())


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="parts of notebook names; default: all")
    chosen = parser.parse_args().names
    paths = [p for p in notebooks() if not chosen or any(name in p.stem for name in chosen)]
    if not paths:
        sys.exit(f"no notebook matches {', '.join(chosen)}; there are {', '.join(p.stem for p in notebooks())}")
    for path in paths:
        begun = time.perf_counter()
        nb = with_lines(clean(run(nbformat.read(path, as_version=4))))
        save(nb, path)
        print(f"{path.name}: {time.perf_counter() - begun:.0f} s, {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
