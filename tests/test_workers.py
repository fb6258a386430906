"""Worker processes that die: it is noticed, the seed is named, what was finished is kept, and the same call goes on."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import pytest

from tapip3d_lite import SimulationConfig
from tapip3d_lite.simulate.dataset import run_jobs, simulate_dataset

ROOT = Path(__file__).resolve().parents[1]
SIMULATE = ["simulate", "--frames", "4", "--size", "32", "32", "--tracks", "8", "--workers", "2"]


def deadly(seed):
    """A recipe whose third clip ends the process that makes it, once."""
    if seed == 2 and "TAPIP3D_DEADLY" in os.environ and multiprocessing.parent_process():
        time.sleep(0.5)  # the others are done by then
        os.kill(os.getpid(), signal.SIGKILL)
    return SimulationConfig(frames=2, size=(32, 32), tracks=8)


def refuses(job):
    raise ValueError(f"no {job[0].stem}")


def test_a_killed_worker_is_noticed_and_its_seed_named(tmp_path, monkeypatch):
    monkeypatch.setenv("TAPIP3D_DEADLY", "1")
    with pytest.raises(
        BrokenProcessPool, match=r"at work on clip_00000[0-3].*killed, e\.g\. for lack of memory"
    ) as error:
        simulate_dataset(tmp_path, 4, deadly, workers=2, progress=False)
    assert "clip_000002" in str(error.value)
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.glob("clip_*.npz")}
    monkeypatch.delenv("TAPIP3D_DEADLY")
    paths = simulate_dataset(tmp_path, 4, deadly, workers=2, progress=False)
    assert all(path.exists() for path in paths) and all(p.stat().st_mtime_ns == t for p, t in kept.items())
    assert sorted(path.name for path in tmp_path.iterdir()) == [*(path.name for path in paths), "dataset.json"]


def test_what_a_job_raises_ends_the_others():
    jobs = [(Path(f"clip_{i:06d}.npz"),) for i in range(50)]
    with pytest.raises(ValueError, match="no clip_0000"):
        list(run_jobs(refuses, jobs, workers=2))


def test_a_script_without_the_usual_guard_ends_with_a_clear_error(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "from tapip3d_lite import SimulationConfig\n"
        "from tapip3d_lite.simulate import simulate_dataset\n"
        "config = SimulationConfig(frames=2, size=(32, 32), tracks=8)\n"
        "simulate_dataset('clips', 2, config, workers=2, progress=False)\n"
    )
    command = [sys.executable, str(script)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=environment, timeout=120)
    assert result.returncode == 1
    assert 'a script needs `if __name__ == "__main__":`' in result.stderr.strip().splitlines()[-1]


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="the children of a process are found in /proc")
def test_the_command_ends_with_exit_code_1_and_goes_on(tmp_path):
    command = [sys.executable, "-m", "tapip3d_lite", *SIMULATE, "--out", str(tmp_path), "--count"]
    process = subprocess.Popen([*command, "2000"], cwd=ROOT, stderr=subprocess.PIPE, text=True)
    while not any(tmp_path.glob("clip_*.npz")):
        assert process.poll() is None
        time.sleep(0.05)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    victim = max(int(child) for child in children if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes())
    os.kill(victim, signal.SIGKILL)
    error = process.communicate(timeout=60)[1].strip().splitlines()
    assert process.returncode == 1 and error[-1].startswith("error: a worker process ended at work on clip_")
    count = len(list(tmp_path.glob("clip_*.npz")))
    assert subprocess.run([*command, str(count + 1)], cwd=ROOT, capture_output=True).returncode == 0
    assert len(list(tmp_path.glob("clip_*.npz"))) >= count + 1
