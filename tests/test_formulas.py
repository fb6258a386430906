"""The table of formulas: it is what the code says, and a running tracker has the shapes that it names."""

import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import tapip3d_lite as t3d
from lessons.backward_ways import saving_backward
from lessons.formulas import Formula, Symbol, find_function, formula_table, formulas, main
from tapip3d_lite.evaluation.intervals import bootstrap_interval
from tapip3d_lite.geometry import transform
from tapip3d_lite.model.frames import Frames, frames_from_clip
from tapip3d_lite.recorder import Recorder
from tapip3d_lite.training.loss import LossConfig, Truth

TABLE = Path(__file__).resolve().parents[1] / "notebooks" / "FORMULAS.md"
# All sizes differ, so that no two letters can be mixed up.
DIMS = {
    "B": 2,
    "T": 11,
    "T_": 12,
    "S": 4,
    "N": 23,
    "N_": 6,
    "N_t": 17,
    "K": 3,
    "L": 2,
    "H": 40,
    "W": 64,
    "h": 10,
    "w": 16,
}
DIMS |= {"C": 20, "D": 22, "A": 7, "d": 13, "U": 18, "V": 15, "G": 1 + 2 * 22 + 8 * 33}
CONFIG = t3d.TrackerConfig(
    image_size=(40, 64), window=4, neighbors=3, levels=2, feature_dim=20, token_dim=22, context_heads=7,
    context_head_dim=13, offset_dim=14, virtual_tracks=15, hidden=18, heads=3, head_dim=6, iterations=2, mlp_ratio=1.0,
)  # fmt: skip
CHANGES = (
    {},
    {"space": "camera"},
    {"space": "uvd"},
    {"space": "uvlogd"},
    {"context": "p2n"},
    {"neighborhood": "window"},
)


def run_everything():
    """A tracker in each of the spaces and with each of the parts that the table names: trained, watched, scored."""
    clip = t3d.simulate_clip(seed=3, frames=11, size=(40, 64), tracks=23)
    frames, queries = frames_from_clip(clip), torch.from_numpy(clip.tracks.queries.copy())
    queries[:, 0] = torch.tensor([0, 0, 1, 2, 3, 3] + 17 * [10])  # the first window has 6 tracks
    frames = Frames(*(x.repeat(2, *[1] * (x.ndim - 1)) for x in vars(frames).values()))
    rows = queries.repeat(2, 1, 1)
    still = rows[:, None, :, 1:].repeat(1, 11, 1, 1)
    truth = Truth(still, torch.ones(still.shape[:3], dtype=torch.bool), rows[..., 0].long())
    for changes in CHANGES:
        torch.manual_seed(0)
        tracker = t3d.Tracker(CONFIG.replace(**changes), fast=False)
        saving_backward(tracker, frames, rows, truth, LossConfig())
    tracker = t3d.Tracker(CONFIG)
    with Recorder(tracker, range(23)):
        tracker.track(clip, queries.numpy(), support_grid=0)
    t3d.evaluate(t3d.load_tracker("static").track(clip), clip)
    bootstrap_interval([0.1, 0.2])


def dimensions():
    """The letters' values, once for every level."""
    for level in range(DIMS["L"]):
        yield DIMS | {"h_l": DIMS["h"] >> level, "w_l": DIMS["w"] >> level}


def fits(shape, found, dims):
    wanted = eval(f"list({shape.replace(chr(39), '_')})", {}, dict(dims))
    return list(np.shape(found)) == wanted


def matching_call(formula, frame, result):
    """Whether in this call every tensor of the formula has its shape."""
    names = {**frame.f_globals, **frame.f_locals, "return_": result}
    try:
        values = [eval(s.tensor if s.tensor != "return" else "return_", names) for s in formula.symbols]
    except (NameError, AttributeError, KeyError, TypeError, IndexError):
        return False
    return any(all(fits(s.shape, x, d) for s, x in zip(formula.symbols, values, strict=True)) for d in dimensions())


def watch(wanted, run):
    """Names of the formulas that some call during `run` confirms."""
    by_code, confirmed = {}, set()
    for formula in wanted:
        by_code.setdefault(formula.code().__code__, []).append(formula)

    def look(frame, event, result):
        if event == "return":
            for formula in by_code.get(frame.f_code, ()):
                if formula.name not in confirmed and matching_call(formula, frame, result):
                    confirmed.add(formula.name)

    before = sys.getprofile()
    sys.setprofile(look)
    try:
        run()
    finally:
        sys.setprofile(before)
    return confirmed


def test_the_committed_table_is_what_the_code_says():
    assert TABLE.read_text(encoding="utf-8") == formula_table(), "run `python3 run.py formulas` and commit"


def test_every_shape_is_that_of_a_running_tracker():
    wanted = formulas()
    assert len({f.name for f in wanted}) == len(wanted) > 60
    confirmed = watch(wanted, run_everything)
    assert not [f.name for f in wanted if f.name not in confirmed]


@pytest.mark.parametrize("wrong", ["(3, N)", "(2, N', 3)", "(N, 3, 2)", "(2, N, 3, 1)"])
def test_a_wrong_shape_is_noticed(wrong):
    right = Formula("", "x", "x", "geometry.transform", "return points @", (Symbol("x", "points", "(2, N, 3)"),))

    def run():
        transform(torch.zeros(2, 23, 3), torch.eye(4))

    assert watch([right], run) == {"x"}
    changed = replace(right, symbols=(replace(right.symbols[0], shape=wrong),))
    assert watch([changed], run) == set()


def test_what_the_code_does_not_have_is_refused():
    formula = Formula("", "x", "x", "geometry.transform", "return points @", (Symbol("x", "pixels", "()"),))
    with pytest.raises(ValueError, match="nothing is called 'pixels'"):
        formula.line_of(formula.symbols[0])
    for marker, count in (("nonsense", 0), ("pose", 2)):
        with pytest.raises(ValueError, match=f"found {count}"):
            replace(formula, marker=marker).line()
    for path in ("geometry.nothing", "nothing.transform", "geometry.Array"):
        with pytest.raises(ValueError, match="is no function"):
            find_function(path)


def test_the_lines_are_where_the_text_is():
    root = TABLE.parents[1]
    for formula in formulas():
        lines = Path(formula.code().__code__.co_filename).read_text(encoding="utf-8").splitlines()
        assert formula.marker in lines[formula.line() - 1]
        for symbol in formula.symbols:
            name = re.split(r"[.\[]", symbol.tensor)[0]
            assert re.search(rf"\b{name}\b", lines[formula.line_of(symbol) - 1])
    links = re.findall(r"\]\((.*?)#L\d+\)", TABLE.read_text(encoding="utf-8"))
    assert links and all((TABLE.parent / link).resolve().is_relative_to(root) for link in links)
    assert all((TABLE.parent / link).is_file() for link in links)


def test_the_command_writes_the_table(tmp_path, capsys):
    main(["--out", str(tmp_path / "new" / "F.md")])
    assert (tmp_path / "new" / "F.md").read_text(encoding="utf-8") == formula_table()
    assert "F.md" in capsys.readouterr().out
