"""The bench: its clock, stages and memory, each part on tiny sizes, its table, figure and command. No test bets on speed."""

import json
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from lessons.saved_bytes import SavedBytes
from tests.bench import parts
from tests.bench.__main__ import main
from tests.bench.report import Row, compared, figure, table
from tests.bench.timing import extra_memory, own_clock, ratios, side_by_side, stages
from tests.tiny import ROOT, command

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
    assert order == ["a", "a", "b", "b"] * 2  # each is warmed up, then measured
    assert seconds == {"a": [1, 1], "b": [3, 3]}
    assert ratios([2.0, 6.0, 3.0], [1.0, 1.0, 1.0]) == (2.0, 3.0, 6.0)


def test_waiting_does_not_count_with_one_thread():
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        assert own_clock() is time.perf_counter
        torch.set_num_threads(1)
        seconds = side_by_side({"wait": lambda: time.sleep(0.1) or sum(range(10**6))}, 1, own_clock())
    finally:
        torch.set_num_threads(threads)
    assert 0 < seconds["wait"][0] < 0.09


def test_stages_add_up_and_leave_no_trace():
    watch = Watch()
    first = torch.nn.Linear(1, 1)
    second = SimpleNamespace(work=lambda: watch.run(4))
    forward = first.forward
    first.register_forward_hook(lambda *_: watch.run(1))
    with stages({"a": (first, "forward"), "b": (second, "work")}, watch, rest="rest", whole="whole") as spent:
        first(torch.ones(1))
        second.work()
        with pytest.raises(TypeError):
            second.work("wrong")
    assert spent == {"whole": 5, "a": 0, "b": 4, "rest": 1}  # what a hook does is outside `forward`
    assert first.forward == forward and "forward" not in vars(first)


def allocate(mib):
    return lambda: np.ones(mib * 2**20 // 8)


def fail():
    raise ValueError("no model")


@LINUX
def test_extra_memory_is_what_a_run_allocates():
    ours = np.ones(300 * 2**17)  # 300 MiB: the peak of this process is not the new one's
    mib, seconds = extra_memory(allocate, 64)
    assert ours.all() and 63 < mib < 80 and 0 < seconds < 10
    with pytest.raises(ValueError, match="no model"):
        extra_memory(fail)


def test_saved_bytes_by_hand():
    x = torch.ones(10, requires_grad=True)
    with SavedBytes() as memory:
        y = x.exp()  # keeps its result
        assert memory.now == 40
        z = y.square()  # keeps its input, which is kept already
        assert memory.now == 40
        w = z[:5].exp() + z[5:].detach().exp() * z[5:]  # two results of 5 numbers; views cost nothing
        assert memory.now == 80
        w.sum().backward()
    assert (memory.now, memory.most) == (0, 80)
    plain = torch.ones(10, requires_grad=True)
    z = plain.exp().square()
    (z[:5].exp() + z[5:].detach().exp() * z[5:]).sum().backward()
    assert torch.equal(x.grad, plain.grad)


def test_both_forms_have_the_same_weights():
    for a, b in zip(*(parts.make_tracker(fast=x).parameters() for x in (False, True)), strict=True):
        assert torch.equal(a, b)


def test_rows_are_compared_with_the_way_that_is_asked_for():
    rows = list(compared("p", "c", {"a": [4.0, 2.0], "b": [1.0, 2.0]}, {"b": {"MiB": 3.5}}, than="b"))
    assert rows[0].faster == pytest.approx((0.25, 0.625, 1)) and rows[0].than == "b" and rows[1].faster is None
    assert table([*rows, Row("p", "d")]).splitlines()[2:] == [
        "| p | c | a | 3 | 0.62 (0.25 to 1.00) | b |  |",
        "| p | c | b | 1.5 |  |  | MiB 3.5 |",
        "| p | d |  |  |  |  |  |",
    ]


def test_neighbours_are_compared_with_the_best_other_way(monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy.spatial", None)
    rows = list(parts.bench_knn(quick=True, rounds=1))
    assert rows.pop().case == "cKDTree was not measured: SciPy is not installed"
    assert [row.case for row in rows] == ["maps 48x64"] * 3 + ["maps 24x32"] * 3 + ["all maps"] * 3
    assert [row.way for row in rows[:3]] == ["cdist + topk", "brute force", "trees of boxes"]
    assert all((row.faster is None) == (row.way == "cdist + topk") for row in rows)
    for row in rows[6:]:
        assert row.seconds == pytest.approx(
            [rows[i].seconds[0] + rows[i + 3].seconds[0] for i in range(3) if rows[i].way == row.way]
        )


def test_all_ways_find_the_same_neighbours():
    rng = np.random.default_rng(0)
    queries, maps = (torch.from_numpy(rng.normal(size=s).astype(np.float32)) for s in ((2, 5, 3), (2, 24, 24, 3)))
    ways = parts._knn_ways(queries, maps, 4)
    found = {way: run() for way, run in ways.items() if way != "cKDTree"}
    chosen = torch.stack(found["cdist + topk"])
    for way in ("brute force", "trees of boxes"):
        indices = found[way][1] if isinstance(found[way], tuple) else found[way]
        assert torch.equal(indices.sort(-1).values, chosen.sort(-1).values), way


def test_model_rows_have_stages_equal_numbers_and_memory():
    rows = list(parts.bench_model(quick=True, rounds=1))
    whole = {row.way: row for row in rows if ":" not in row.case}
    assert 0 < whole["fast"].values["largest difference"] < 1e-3  # another form, the same numbers
    assert whole["fast, bf16"].values["median difference"] > 1e-5
    for way in whole:
        stage = {row.case.split(": ")[1]: row.seconds[0] for row in rows if ":" in row.case and row.way == way}
        assert set(stage) == {"encoder", "k-NN", "context", "updater", "the rest"} and min(stage.values()) > 0
    if sys.platform.startswith("linux"):
        assert all(row.values["MiB"] > 1 for row in whole.values())
    left = figure(rows).axes[0]
    assert len(left.patches) == 15 and "16 queries, 1 iteration, fast" in [x.get_text() for x in left.get_yticklabels()]


def test_training_compares_the_forms_and_features_kept():
    rows = list(parts.bench_training(quick=True, rounds=1))
    assert [row.way for row in rows] == ["straightforward", "fast", "fast, features kept"]


def test_the_time_of_a_step_is_put_where_it_was_spent(monkeypatch):
    def busy(trainer, example=parts.Trainer.example):
        end = time.process_time() + 0.5
        while time.process_time() < end:
            pass
        return example(trainer)

    monkeypatch.setattr(parts.Trainer, "example", busy)
    rows = list(parts.bench_step(quick=True, rounds=1))
    frozen = {row.way: row.seconds[0] for row in rows if row.case == "lite"}
    trained = {row.way: row.seconds[0] for row in rows if row.case == "lite, encoder trained"}
    assert min(frozen["data"], trained["data"]) > 0.5
    assert frozen.pop("encoder") == 0 and min(*frozen.values(), *trained.values()) > 0
    kept = {(row.case, row.way): row.values["MB kept"] for row in rows if "MB kept" in row.values}
    for case in ("M = 2, windows: 1", "M = 1, windows: 2"):
        assert kept[case, "saving"] < 1.15 * kept["M = 1, windows: 1", "saving"]
        assert kept[case, "plain"] > 1.4 * kept["M = 1, windows: 1", "plain"]


@LINUX
def test_memory_and_scaling_parts():
    rows = list(parts.bench_memory(quick=True))
    assert [(row.way, row.values["frames"]) for row in rows] == [("features kept", 16), ("streamed", 16)]
    assert all(row.values["MiB"] > 1 for row in rows)
    assert len(figure(rows).axes[1].lines) == 2
    assert {row.way for row in parts.bench_scaling(quick=True, rounds=1)} >= {"N = 16", "T = 8", "K = 4", "side = 128"}


def test_the_gpu_part_runs_on_any_device():
    if not torch.cuda.is_available():
        assert [row.case for row in parts.bench_gpu()] == ["skipped: torch sees no CUDA device"]
    rows = list(parts.bench_gpu(quick=True, rounds=1, device="cpu", backend="eager"))
    assert [row.way for row in rows] == ["fast", "fast, bf16", "fast, bf16, compiled"]
    operations = [row.values["TFLOP/s"] * row.seconds[0] for row in rows]
    assert operations == pytest.approx([operations[0]] * 3) and operations[0] > 0
    assert [row.values["FPS"] for row in rows] == pytest.approx([8 / row.seconds[0] for row in rows])


def bench(*arguments):
    command = [sys.executable, "-W", "error", "-m", "tests.bench", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT)


def test_command_writes_every_measurement(tmp_path):
    out, picture = tmp_path / "bench.json", tmp_path / "bench.png"
    result = bench("knn", "--quick", "--rounds", 2, "--threads", 1, "--out", out, "--figure", picture)
    assert result.returncode == 0 and result.stdout.startswith("| part | case |"), result.stderr
    stored = json.loads(out.read_text())
    assert {len(row["seconds"]) for row in stored if row["way"]} == {2} and picture.stat().st_size > 5000


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (["speed"], "expected parts among model, iteration, knn"),
        (["--rounds", "0"], "argument --rounds: expected a whole number of at least 1, got '0'"),
        (["--threads", "many"], "argument --threads"),
        (["--fast"], "--fast"),
    ],
)
def test_bad_options_are_one_line_and_exit_code_2(wrong, message):
    result = command(*wrong, main=main)
    assert result.returncode == 2 and result.stderr.count("\n") == 1 and message in result.stderr
