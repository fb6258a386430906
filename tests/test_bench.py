"""The bench: measuring itself, each part on tiny sizes, its table, figure and command."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

import tapip3d_lite as t3d
from tests.bench import bench
from tests.bench.speed_figure import speed
from tests.bench.timing import extra_memory, own_clock, ratios, side_by_side, stages

LINUX = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="peak memory is read from /proc")


class Watch:
    """A clock that stands still between runs."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now

    def run(self, seconds):
        self.now += seconds


def test_ways_take_turns():
    order, watch = [], Watch()
    runs = {name: lambda name=name: (order.append(name), watch.run(1 if name == "a" else 3)) for name in "ab"}
    seconds = side_by_side(runs, rounds=2, clock=watch)
    assert order == ["a", "b"] * 3
    assert seconds == {"a": [1, 1], "b": [3, 3]}
    assert ratios([2.0, 6.0, 3.0], [1.0, 1.0, 1.0]) == (2.0, 3.0, 6.0)


def test_waiting_does_not_count_with_one_thread():
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        assert own_clock() is time.perf_counter
        torch.set_num_threads(1)
        seconds = side_by_side({"wait": lambda: time.sleep(0.1)}, rounds=1, clock=own_clock())
    finally:
        torch.set_num_threads(threads)
    assert seconds["wait"][0] < 0.05


def test_stages_add_up_and_leave_no_hooks():
    watch = Watch()

    class Slow(nn.Module):
        def forward(self, x):
            watch.run(2)
            return x

    first, second = Slow(), Slow()
    with stages({"first": first, "second": second}, watch) as spent:
        second(first(second(0)))
    assert spent == {"first": 2, "second": 4}
    assert not first._forward_hooks and not first._forward_pre_hooks


def allocate(mib):
    return lambda: np.ones(mib * 2**20 // 8)


def fail():
    raise SystemExit(1)


@LINUX
def test_extra_memory_is_what_a_run_allocates():
    mib, seconds = extra_memory(allocate, 64)
    assert 63 < mib < 80 and 0 < seconds < 10
    with pytest.raises(RuntimeError, match="fail"):
        extra_memory(fail)


def test_straightforward_is_the_clear_form():
    clear, fast = (bench.make_tracker(fast=x) for x in (False, True))
    assert not (clear.fast or clear.neighborhood.fast or clear.encoder.fast)
    assert fast.fast and fast.neighborhood.fast and fast.encoder.fast
    for a, b in zip(clear.parameters(), fast.parameters(), strict=True):
        assert torch.equal(a, b)


@pytest.fixture(scope="module")
def rows():
    return list(bench.bench(["knn", "training", "gpu"], quick=True, rounds=1))


def test_rows_tell_ways_cases_and_ratios(rows):
    knn = [row for row in rows if row.part == "k-NN"]
    assert {"maps 48x64", "maps 24x32", "all maps"} == {row.case for row in knn}
    assert {"cdist + topk", "brute force", "trees of boxes"} <= {row.way for row in knn}
    for case in {row.case for row in knn}:
        here = [row for row in knn if row.case == case]
        assert here[0].faster is None and all(row.than == here[0].way for row in here[1:])
        for row in here[1:]:
            assert row.faster[1] == pytest.approx(here[0].seconds[0] / row.seconds[0])
    text = bench.table(rows)
    assert text.count("\n") >= len(rows) + 1 and "straightforward" in text
    if not torch.cuda.is_available():
        assert "skipped: torch sees no CUDA device" in text


def test_without_scipy_the_row_is_missing_and_said_so(monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy.spatial", None)
    rows = list(bench.bench(["knn"], quick=True, rounds=1))
    assert not any(row.way == "cKDTree" for row in rows)
    assert "SciPy is not installed" in bench.table(rows)


def test_model_rows_have_stages_equal_numbers_and_memory():
    rows = list(bench.bench_model(quick=True, rounds=1))
    whole = {row.way: row for row in rows if ":" not in row.case}
    assert whole["fast"].values["largest difference"] < 1e-3
    assert whole["fast, bf16"].values["median difference"] > 0
    for way, row in whole.items():
        parts = {r.case.split(": ")[1]: r.seconds[0] for r in rows if ":" in r.case and r.way == way}
        assert 0 < parts.pop(bench.OFFSETS) < parts["context"]
        assert sum(parts.values()) == pytest.approx(row.seconds[0], rel=0.05)
    if sys.platform.startswith("linux"):
        assert all(row.values["MiB"] > 1 for row in whole.values())
    assert speed(rows).axes[0].patches


def test_memory_and_scaling_parts(monkeypatch):
    monkeypatch.setattr(bench, "extra_memory", lambda prepare, *a: (float(prepare(*a)() is not None), 0.5))
    from tapip3d_lite.model import track as inference

    monkeypatch.setattr(inference, "_KEPT", inference._KEPT)  # restored afterwards
    rows = list(bench.bench_memory(quick=True))
    assert [row.values["frames"] for row in rows] == [8, 8, 16, 16] and len(speed(rows).axes[1].lines) == 2
    assert {row.way for row in bench.bench_scaling(quick=True, rounds=1)} >= {"N = 16", "T = 8", "K = 4", "side = 128"}


def test_the_gpu_part_runs_on_any_device(monkeypatch):
    # A card of known rates: how fast a shared machine really is differs from one moment to the next.
    monkeypatch.setattr(bench, "_card", lambda *_: (3e12, 5e9))
    rows = list(bench.bench_gpu(quick=True, rounds=1, device="cpu", backend="eager"))
    assert [row.way for row in rows] == ["fast", "fast, bf16", "fast, bf16, compiled"]
    config = bench.TrackerConfig.preset("paper")
    tokens = 8 * 8 * config.neighbors * config.token_dim  # frames, queries; one level, window and update
    for row, bytes_each in zip(rows, (4, 2, 2), strict=True):
        (seconds,), values = row.seconds, row.values
        assert values["FPS"] == pytest.approx(8 / seconds)
        assert values["times the limit of arithmetic"] * values["TFLOP/s"] == pytest.approx(3)
        assert values["times the limit of bandwidth"] == pytest.approx(seconds * 5e9 / (tokens * bytes_each))


def test_the_limits_of_a_device(monkeypatch):
    taken = {"bf16": [4.0, 2.0], "float32": [0.5, 1.0], "copy": [0.25, 0.125]}
    monkeypatch.setattr(
        bench, "side_by_side", lambda runs, rounds: {way: taken[way] for way, run in runs.items() if np.isfinite(run())}
    )
    assert bench._card("cpu", 2, 64) == (2 * 64**3 / 0.5, 16 * 4 * 64**2 / 0.125)


def test_command_writes_every_measurement(tmp_path):
    out, figure = tmp_path / "bench.json", tmp_path / "bench.png"
    command = [sys.executable, "-W", "error", "-m", "tapip3d_lite", "bench"]
    options = ["--quick", "--rounds", "2", "--threads", "1"]
    root = Path(t3d.__path__[0]).parent
    environment = os.environ | {"PYTHONPATH": str(root)}
    result = subprocess.run(
        [*command, "knn", *options, "--out", str(out), "--figure", str(figure)],
        capture_output=True, text=True, cwd=tmp_path, env=environment, check=True,
    )  # fmt: skip
    assert result.stdout.startswith("| part | case |")
    stored = json.loads(out.read_text())
    assert all(len(row["seconds"]) == 2 for row in stored) and figure.stat().st_size > 5000
    wrong = subprocess.run([*command, "speed"], capture_output=True, text=True, env=environment)
    assert wrong.returncode == 2 and "expected parts among model, iteration, knn" in wrong.stderr


@pytest.mark.parametrize("options", [{"parts": ["speed"]}, {"rounds": 0}])
def test_bad_options(options):
    with pytest.raises(ValueError, match="rounds >= 1"):
        list(bench.bench(**options))
