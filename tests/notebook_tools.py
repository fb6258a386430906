"""Run notebooks, store clean outputs: `python -m tests.notebook_tools [name …]`."""

import argparse
import re
import sys
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient

from tapip3d_lite.files import atomic_path

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "notebooks"
_PATHS = re.compile(r"(?:/[\w.\-]+)*/(?:notebooks|data_samples|tapip3d_lite)(?=/|\b)")


def notebooks():
    return sorted(FOLDER.glob("[0-9][0-9]_*.ipynb"))


def run(nb, folder=FOLDER, timeout=1200):
    """Execute a notebook in place; raises at the first cell that fails."""
    place = {"metadata": {"path": str(folder)}}
    # The kernel cuts printed text by the clock; joined, it is the same in every run.
    NotebookClient(nb, timeout=timeout, kernel_name="python3", resources=place, coalesce_streams=True).execute()
    return nb


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


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="parts of notebook names; default: all")
    chosen = parser.parse_args().names
    paths = [p for p in notebooks() if not chosen or any(name in p.stem for name in chosen)]
    if not paths:
        sys.exit(f"no notebook matches {', '.join(chosen)}; there are {', '.join(p.stem for p in notebooks())}")
    for path in paths:
        begun = time.perf_counter()
        nb = clean(run(nbformat.read(path, as_version=4)))
        save(nb, path)
        print(f"{path.name}: {time.perf_counter() - begun:.0f} s, {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
