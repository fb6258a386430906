"""`run.py` starts the right program with the caller's arguments, from any working directory."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def run(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT))
    import run

    monkeypatch.setattr(run, "setup", lambda: None)
    monkeypatch.setattr(run, "PYTHON", Path(sys.executable))
    return run


@pytest.mark.parametrize(
    ("line", "started"),
    [
        ("teach --out pack --lesson 30", "lessons.teaching --out pack --lesson 30"),
        ("formulas", "lessons.formulas"),
        ("samples --out x", "lessons.samples --out x"),
        ("bench knn --help", "tests.bench knn --help"),
        ("notebooks 01 02", "tests.notebook_tools 01 02"),
        ("demo -- --help", "tapip3d_lite demo -- --help"),
    ],
)
def test_arguments_are_passed_on_as_they_are(run, monkeypatch, line, started):
    calls = []
    monkeypatch.setattr(run, "_call", lambda *arguments: calls.append(arguments) or 3)
    monkeypatch.setattr(sys, "argv", ["run.py", *line.split()])
    assert run.main() == 3 and calls == [("-m", *started.split())]


def test_a_tool_runs_from_any_working_directory(run, monkeypatch, tmp_path, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    monkeypatch.setattr(sys, "argv", ["run.py", "teach", "--out", str(tmp_path / "pack")])
    assert run.main() == 0 and (tmp_path / "pack" / "TIMING.md").is_file()
    monkeypatch.setattr(sys, "argv", ["run.py", "teach", "--lesson", "x"])
    assert run.main() == 2 and capfd.readouterr().err.startswith("run.py teach: argument --lesson")


@pytest.mark.parametrize("wrong", [[], ["fly"], ["setup", "--fast"]])
def test_bad_input_is_one_line_and_exit_code_2(wrong, tmp_path):
    result = subprocess.run(
        [sys.executable, str(ROOT / "run.py"), *wrong], cwd=tmp_path, capture_output=True, text=True
    )
    assert result.returncode == 2 and len(result.stderr.splitlines()) == 1


def test_help_names_every_command(run, tmp_path):
    result = subprocess.run([sys.executable, str(ROOT / "run.py"), "-h"], cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 0 and all(f"\n  {name} " in result.stdout for name in run.COMMANDS)


@pytest.mark.parametrize(("unit", "notebooks", "code"), [(0, 0, 0), (1, 0, 1), (0, 3, 3)])
def test_all_tests_run_side_by_side_and_either_may_fail(run, monkeypatch, capfd, unit, notebooks, code):
    script = "import sys; print('of ' + sys.argv[-1]); sys.exit({})"
    codes = {"tests": unit, "notebooks": notebooks}

    def fake(*arguments):
        return {"args": [sys.executable, "-c", script.format(codes[arguments[-1]]), arguments[-1]]}

    monkeypatch.setattr(run, "_python", fake)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("TAPIP3D_MINUTES", "0.2")
    assert run.run_test() == code
    assert capfd.readouterr().out.split("\n")[:2] == ["of tests", "of notebooks"]
