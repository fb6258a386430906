"""How many lines of the library its tests run: `python -m tests.covered`, or of some: `python -m tests.covered tests/test_clip.py`.

Needs `pip install coverage`. Commands that tests start in processes of their own are counted, too. The last line is the
total; the exit code is 2 below 92 %.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ALL = ["tests", "--ignore=tests/test_notebooks.py"]  # notebooks run what other tests run, too
SETTINGS = """[run]
source = {root}/tapip3d_lite
parallel = true
data_file = {folder}/data
concurrency = multiprocessing,thread
patch = subprocess
[report]
exclude_also = if TYPE_CHECKING:
"""


def main(tests: list[str]) -> int:
    with tempfile.TemporaryDirectory() as folder:
        settings = Path(folder) / "rc"
        settings.write_text(SETTINGS.format(root=ROOT, folder=folder))

        def coverage(*arguments: str) -> int:
            command = [sys.executable, "-m", "coverage", arguments[0], f"--rcfile={settings}", *arguments[1:]]
            return subprocess.run(command, cwd=ROOT, env=os.environ | {"COVERAGE_RCFILE": str(settings)}).returncode

        failed = coverage("run", "-m", "pytest", "-q", "-p", "no:cacheprovider", *(tests or ALL))
        coverage("combine", "-q")
        return coverage("report", "--skip-covered", "--sort=cover", "--fail-under=92") or failed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
