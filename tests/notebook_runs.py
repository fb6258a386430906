"""The notebooks as a class runs them: `python -m tests.notebook_runs 03 05 --twice --offline --read-only`.

`--twice` runs all cells twice in one kernel; `--sections` runs each section in a kernel of its own, after nothing but what
it says it needs (`lessons.restart`); `--offline` refuses every connection but the kernel's own;
`--read-only` sees the repository and the home folder where nothing can be written (Linux, `unshare`). Stubs are
not filled in unless `--solved`. Ways may be combined. Set TAPIP3D_STEPS and TAPIP3D_MINUTES as `run.py test` does.
"""

import argparse
import copy
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import nbformat
from nbclient.exceptions import CellExecutionError

from lessons.restart import heading, needs, sections
from lessons.teaching import solution_copy
from tests.notebook_tools import FOLDER, ROOT, notebooks, run

OFFLINE = """import socket
_connect = socket.socket.connect
def connect(self, address):
    if self.family != getattr(socket, "AF_UNIX", None) and address[0] not in ("127.0.0.1", "::1", "localhost"):
        raise OSError(f"no network here: {address}")
    return _connect(self, address)
def lookup(host, *rest, **named):
    if host not in ("127.0.0.1", "::1", "localhost", None, ""):
        raise OSError(f"no network here: {host}")
    return _lookup(host, *rest, **named)
_lookup, socket.getaddrinfo, socket.socket.connect = socket.getaddrinfo, lookup, connect
"""


def parts(nb, options):
    """(title, notebook) of each run of a kernel."""
    if options.sections:
        pieces = sections(nb)
        for number, cells in enumerate(pieces):
            if any(nb.cells[i].cell_type == "code" for i in cells):
                chosen = [i for piece in sorted({0, *needs(nb)[number], number}) for i in pieces[piece]]
                part = copy.deepcopy(nb)
                part.cells = [part.cells[i] for i in chosen]
                title = heading(nb.cells[cells[0]])
                yield title[0] if title else "the opening", part
    elif not options.twice:
        yield "all cells", nb
    else:
        again = copy.deepcopy(nb)
        again.cells += copy.deepcopy(nb.cells)
        for i, cell in enumerate(again.cells):
            cell.id = f"cell-{i}"
        yield "all cells, twice", again


def read_only():
    """Begin anew where the repository and the home folder cannot be written."""
    places = " ".join(f"mount --bind {p} {p} && mount -o remount,ro,bind {p} &&" for p in {ROOT, Path.home()})
    command = f"{places} exec {sys.executable} -m tests.notebook_runs {' '.join(sys.argv[1:])}"
    environment = os.environ | {"TAPIP3D_READ_ONLY": "1"}
    os.execvpe("unshare", ["unshare", "--map-root-user", "--mount", "sh", "-c", command], environment)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="beginnings of notebook names; default: all")
    for way in ("twice", "sections", "offline", "read-only", "solved"):
        parser.add_argument(f"--{way}", action="store_true")
    options = parser.parse_args()
    if options.read_only and "TAPIP3D_READ_ONLY" not in os.environ:
        read_only()
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        places = [str(ROOT), str(FOLDER)]
        if options.offline:
            Path(folder, "sitecustomize.py").write_text(OFFLINE)
            places.insert(0, folder)
        os.environ["PYTHONPATH"] = os.pathsep.join(places)
        if options.read_only:
            assert subprocess.run(["touch", ROOT / "x"], capture_output=True).returncode, "it can be written"
            os.environ |= {f"JUPYTER_{kind}_DIR": folder for kind in ("CONFIG", "DATA", "RUNTIME")}
            os.environ["IPYTHONDIR"] = folder
        for path in notebooks():
            if options.names and not path.stem.startswith(tuple(options.names)):
                continue
            nb = nbformat.read(path, as_version=4)
            for title, part in parts(solution_copy(nb) if options.solved else nb, options):
                begun = time.monotonic()
                try:
                    run(part)
                    outcome = "ran"
                except CellExecutionError as error:
                    failed, outcome = failed + 1, f"FAILED: {error.ename}: {error.evalue}"[:600]
                print(f"{path.stem}, {title}: {outcome} ({time.monotonic() - begun:.0f} s)", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
