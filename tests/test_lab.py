"""Studies at tiny sizes: equal conditions, resumed bit for bit, failures, tables, the command line."""

import errno
import json
import shutil
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from safetensors.torch import load_file

from tapip3d_lite import __main__, lab, trackers
from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.geometry import project, unproject
from tapip3d_lite.lab import jobs, papers, plan
from tapip3d_lite.lab.budgets import judged_clip
from tapip3d_lite.lab.claims import judge, with_claims
from tapip3d_lite.lab.conditions import under
from tapip3d_lite.lab.papers import TABLES, open_study
from tapip3d_lite.lab.table import compare
from tapip3d_lite.model.weights import load_weights
from tapip3d_lite.simulate import simulate_clip
from tapip3d_lite.training.data import FeatureCache
from tapip3d_lite.training.examples import Examples
from tapip3d_lite.training.loss import LossConfig
from tapip3d_lite.training.trainer import Trainer
from tests import pack_tables
from tests.lab_conditions import Mean, Mine, darker
from tests.tiny import ROOT

TINY = lab.BUDGETS["tiny"]
TWO = [lab.Variant("n2n"), lab.Variant("p2n", context="p2n")]
ROWS = [*TWO, lab.Variant("klt", tracker="klt"), lab.Variant("1 update", track={"iterations": 1})]


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """A finished study; `store` has the clips and the encoder of all others here."""
    made = lab.Study(tmp_path_factory.mktemp("study"), ROWS, seeds=2, budget="tiny")
    assert made.run(progress=False)
    return made


@pytest.fixture
def store(study, tmp_path):
    """Clips and encoder, without trainings."""
    for name in ("clips", "encoders"):
        shutil.copytree(study.plan.store / name, tmp_path / "store" / name)
    return tmp_path / "store"


def weights(store):
    return {path.parent.name: load_file(path) for path in sorted((store / "trainings").glob("*/weights.safetensors"))}


def same_weights(one, other):
    return one.keys() == other.keys() and all(
        bool((one[name][key] == other[name][key]).all()) for name in one for key in one[name]
    )


def scores(study):
    return {name: {s: x.get("scores") for s, x in seeds.items()} for name, seeds in study.results().items()}


# --- rows ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"contxt": "p2n"}, "no 'contxt'; did you mean context"),
        ({"learning": 1}, "no 'learning'"),
        ({"seed": 3}, "seed must be equal in all rows"),
        ({"tracker": "klt", "context": "p2n"}, "not trained, so context"),
        ({"track": {"iteration": 3}}, "did you mean iterations"),
        ({"degrade": {"pose": 3}}, "did you mean poses"),
        ({"degrade": {"frozen": "time"}}, "frozen must be a part"),
        ({"degrade": lambda clip, seed: clip}, "module 'tests.test_lab' has no '<lambda>'"),
    ],
)
def test_a_row_says_what_it_does_not_know(arguments, message):
    with pytest.raises(ValueError, match=message):
        lab.Variant("row", **arguments)
    with pytest.raises(ValueError, match="expected a name"):
        lab.Variant(" ")


def test_fields_go_where_they_belong():
    fields = {"context": "p2n", "iterations": (1, 3), "lr": 0.1, "loss": {"discount": 0.5}, "average": 0}
    row = lab.Variant("row", **fields, track={"neighbors": 2, "space": "camera"}, degrade=darker)
    recipe = row.recipe(TINY.recipe)
    assert recipe.tracker_config().context == "p2n" and recipe.tracker_config().iterations == 3
    assert (recipe.iterations, recipe.lr, recipe.average) == ((1, 3), 0.1, 0)
    assert recipe.loss == replace(TINY.recipe.loss, discount=0.5)
    assert lab.Variant("x", loss=LossConfig(discount=0.5)).recipe(TINY.recipe).loss.discount == 0.5
    assert row.options() == {"space": "camera"} and row.test_fields() == {"neighbors": 2}
    again = lab.Variant("row", **json.loads(json.dumps(row.to_dict())))
    assert again.recipe(TINY.recipe) == recipe and again.degrade == "tests.lab_conditions:darker"
    with pytest.raises(ValueError, match="did you mean discount"):
        lab.Variant("x", loss={"discont": 1}).recipe(TINY.recipe)
    with pytest.raises(ValueError, match=r"Variant 'x': .*planes"):
        lab.Variant("x", context="planes").recipe(TINY.recipe)


def test_diff_names_what_differs(study):
    found = lab.diff(*TWO)
    assert found == {"context": (None, "p2n")} and lab.diff(TINY.recipe, TINY.recipe) == {}
    assert lab.diff(TINY.recipe, replace(TINY.recipe, lr=1.0, loss=LossConfig(discount=0.1)))["lr"] == (1.5e-3, 1.0)
    one, other = [study.plan.store / "trainings" / x["training"] for x in study.results()["n2n"].values()]
    assert lab.diff(one, other) == {"seed": (0, 1)} and lab.diff(study.plan.folder, study.plan.folder) == {}
    with pytest.raises(ValueError, match="neither"):
        lab.diff(one, "nowhere")


def test_conditions_are_alike_for_all_rows(study):
    path = study.plan.find_clips(1, False).held_out[1]
    clip = judged_clip(path, TINY)
    assert len(clip) == 6 and len(clip.queries) <= 12 and (clip.queries[:, 0] == 0).all()
    made = under(clip, {"grey": True, "frozen": "depths", "poses": 2.0, "grain": 0.01}, 1)
    assert np.ptp(made.video) == 0 and not np.allclose(made.extrinsics, clip.extrinsics)
    np.testing.assert_array_equal(made.depths, under(clip, {"frozen": "depths", "poses": 2.0, "grain": 0.01}, 1).depths)
    np.testing.assert_array_equal(under(clip, "tests.lab_conditions:darker", 1).video, clip.video // 3)
    assert under(clip, None, 1) is clip


def test_points_at_silhouettes_lie_beside_steps_of_depth():
    depth = np.tile(1 / np.linspace(0.6, 0.2, 32, dtype=np.float32)[:, None], (1, 40))  # a floor, straight in 1 / z
    depth[8:20, 10:22] = 1.2
    k = np.array([[40, 0, 20], [0, 40, 16], [0, 0, 1]], np.float32)
    uv = np.stack(np.meshgrid(np.arange(1, 39, 3), np.arange(1, 31, 3)), -1).reshape(-1, 2)
    xyz = unproject(uv.astype(np.float32), depth[uv[:, 1], uv[:, 0]], k)
    queries = np.concatenate([np.zeros((len(uv), 1)), xyz], 1).astype(np.float32)
    tracks = Tracks(np.repeat(xyz[None], 2, 0), np.ones((2, len(uv)), bool), queries)
    cameras = np.repeat(k[None], 2, 0), np.repeat(np.eye(4, dtype=np.float32)[None], 2, 0)
    clip = Clip(np.zeros((2, 32, 40, 3), np.uint8), np.stack([depth, depth]), *cameras, queries, tracks)
    made = under(clip, {"silhouettes": 0.2}, 0)
    assert len(made.queries) == len(made.tracks.queries) == round(0.2 * len(uv)) and (made.depths == clip.depths).all()
    column, row = project(made.queries[:, 1:], k)[0].T
    sides = [np.abs(column - 9.5), np.abs(column - 21.5), np.abs(row - 7.5), np.abs(row - 19.5)]
    assert np.min(sides, 0).max() < 3 and ((column > 6) & (column < 25) & (row > 4) & (row < 23)).all()


# --- equal conditions ---------------------------------------------------------------------------------------------------


def test_rows_of_one_seed_see_the_same_examples(study):
    data, drawn = study.plan.find_clips(1, False), []
    for row in TWO:
        job = study.plan._training(row, 1, data)
        recipe = study.plan.recipe(row, 1)
        trainer = Trainer(job.folder, recipe, data.train, resume=True, encoder=job.encoder)
        drawn.append([trainer.examples[step, step] for step in range(12)])
        cache = FeatureCache(job.encoder / "features", trainer.tracker.encoder, (32, 32))
        other = Examples(study.plan.recipe(row, 0), data.train, cache=cache)[3, 3]
        assert other.queries.shape != drawn[-1][3].queries.shape or (other.queries != drawn[-1][3].queries).any()
    for one, other in zip(*drawn, strict=True):
        assert one.names == other.names and one.iterations == other.iterations
        for a, b in ((one.queries, other.queries), (one.features, other.features), (one.truth.xyz, other.truth.xyz)):
            assert (a == b).all()


def test_one_encoder_one_store_and_weights_that_rows_share(study):
    store = study.plan.store
    (encoder,) = (store / "encoders").iterdir()
    assert len(list((encoder / "features").iterdir())) <= 4 and len(weights(store)) == 4  # 2 recipes x 2 seeds
    assert not list((store / "trainings").glob("*/features"))
    shared = load_file(encoder / "weights.safetensors")
    for state in weights(store).values():
        for name in (x for x in state if x.startswith("encoder.")):
            np.testing.assert_allclose(state[name].float(), shared[name].float(), atol=1e-3)  # stored in 16 bits
    found = study.results()
    assert found["1 update"][1]["training"] == found["n2n"][1]["training"] and found["klt"][0]["training"] is None
    assert scores(study)["1 update"] != scores(study)["n2n"] and list(found["klt"]) == [0]
    other = lab.Study("x", [lab.Variant("wide", feature_dim=8)], budget="tiny").plan
    other.clips = study.plan.clips
    assert other._encoder(other.rows["wide"], None, "cpu").folder.name != encoder.name


def test_the_order_of_work_and_the_number_of_processes_change_nothing(study, store, tmp_path):
    other = lab.Study(tmp_path / "other", TWO[::-1], seeds=1, store=store, budget="tiny")
    assert other.run(jobs=2, progress=False)
    assert scores(other)["p2n"][0] == scores(study)["p2n"][0] and scores(other)["n2n"][0] == scores(study)["n2n"][0]


def test_parts_of_a_users_own_are_rows(store, tmp_path):
    rows = [lab.Variant("class", context=Mean), lab.Variant("name", context="tests.lab_conditions:Mean")]
    rows.append(lab.Variant("fewer", context=Mean, track={"neighbors": 2}))
    made = lab.Study(tmp_path / "own", rows, seeds=1, budget="tiny", store=store)
    assert made.run(progress=False)
    found = scores(made)
    assert found["class"][0] == found["name"][0] and found["fewer"][0] not in (None, found["class"][0])
    assert len(weights(store)) == 1  # one recipe
    again = lab.Study(tmp_path / "own", store=store, parts=[Mean])
    clip = next(iter(found["class"][0]))
    assert again.plan.rows["class"].recipe(TINY.recipe).tracker_config().context is Mean
    assert np.isfinite(again.tracks("class", clip)[1].xyz).all()


def test_a_part_made_of_the_librarys_is_counted_and_scored(study, store, tmp_path):
    made = lab.Study(tmp_path / "own", [lab.Variant("n2n", context=Mine)], seeds=1, budget="tiny", store=store)
    assert made.run(progress=False) and made.results()["n2n"][0].get("failed") is None
    costs = [x.results()["n2n"][0]["costs"]["parameters"] for x in (made, study)]
    assert costs[0] == costs[1]


def test_a_folder_alone_imports_no_code(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "unseen.py").write_text(
        "def darker(clip, seed):\n    return clip\n\n\ndef scene(seed):\n    return None\n"
    )
    row = lab.Variant("dark", tracker="klt", degrade=darker)
    lab.Study(tmp_path / "study", [row], budget="tiny").plan.save()
    file, text = tmp_path / "study/study.json", (tmp_path / "study/study.json").read_text()
    for old, new in (
        ("tests.lab_conditions:darker", "unseen:darker"),
        ("tapip3d_lite.lab.budgets:tiny_scene", "unseen:scene"),
    ):
        assert old in text
        file.write_text(text.replace(old, new))
        with pytest.raises(ValueError, match=r"a file alone imports no code; .* --allow unseen"):
            lab.Study(tmp_path / "study", parts=["tests.lab_conditions"])
        assert "unseen" not in sys.modules
    file.write_text(text.replace("tests.lab_conditions:darker", "unseen:darker"))
    assert lab.Study(tmp_path / "study", parts=["unseen"]).plan.rows["dark"].degrade == "unseen:darker"
    file.write_text(text)
    assert lab.Study(tmp_path / "study", [row]).plan.rows["dark"].degrade == "tests.lab_conditions:darker"
    (tmp_path / "own.json").write_text(json.dumps({"rows": {"dark": row.to_dict()}, "budget": "tiny"}))
    with pytest.raises(ValueError, match="--allow tests"):
        open_study(tmp_path / "own.json")
    assert open_study(tmp_path / "own.json", parts=["tests.lab_conditions"])[0].plan.rows["dark"].degrade


# --- stops, kills and failures --------------------------------------------------------------------------------------------

RUN = """
import sys
from tapip3d_lite import lab
rows = [lab.Variant("n2n"), lab.Variant("p2n", context="p2n")]
lab.Study(sys.argv[1], rows, seeds=1, store=sys.argv[2], budget="tiny").run(progress=False)
"""


def test_a_killed_study_goes_on_bit_for_bit(study, store, tmp_path):
    folder = tmp_path / "killed"
    process = subprocess.Popen([sys.executable, "-c", RUN, str(folder), str(store)], cwd=ROOT)
    end = time.monotonic() + 120
    while not (logs := [p for p in store.glob("trainings/*/log.jsonl") if len(p.read_text().splitlines()) >= 5]):
        assert process.poll() is None and time.monotonic() < end
        time.sleep(0.01)
    process.kill()
    process.wait()
    assert not (logs[0].parent / "weights.safetensors").exists()
    again = lab.Study(folder, store=store)
    assert again.run(progress=False)
    wanted = {name: x for name, x in weights(study.plan.store).items() if name.startswith("s0")}
    assert same_weights(weights(store), wanted) and scores(again)["p2n"][0] == scores(study)["p2n"][0]


def test_stop_saves_and_the_next_call_goes_on(study, store, tmp_path):
    asked = []

    def stop():
        asked.append(0)
        return len(asked) > 8

    half = lab.Study(tmp_path / "half", TWO, seeds=1, budget="tiny", store=store)
    assert not half.run(progress=False, stop=stop)
    assert not half.results()["p2n"]
    with pytest.raises(ValueError, match="no row has scores"):
        half.table()
    assert half.run(progress=False)
    assert {k: v[0] for k, v in scores(half).items()} == {k: scores(study)[k][0] for k in ("n2n", "p2n")}


def test_a_row_that_fails_is_marked_and_the_others_go_on(store, tmp_path):
    rows = [lab.Variant("static", tracker="static"), lab.Variant("missing", tracker="none.safetensors")]
    rows += [
        lab.Variant("explodes", loss={"visibility": 1e299}),
        lab.Variant("half way", tracker="klt", degrade="tests.lab_conditions:broken"),
    ]
    made = lab.Study(tmp_path / "study", rows, seeds=1, budget="tiny", store=store)
    assert made.run(progress=False)
    reasons = {name: x.get(0, {}).get("failed") for name, x in made.results().items()}
    assert reasons["static"] is None and "no tracker 'none.safetensors'" in reasons["missing"]
    assert "not finite" in reasons["explodes"] and reasons["half way"] == "RuntimeError: no such clip"
    assert "**half way** failed: RuntimeError: no such clip" in str(made.table())
    assert made.report(tmp_path / "report").exists()


def test_a_process_that_dies_takes_only_its_row_along(store, tmp_path):
    rows = [lab.Variant("dies", tracker="klt", degrade="tests.lab_conditions:die"), lab.Variant("klt", tracker="klt")]
    made = lab.Study(tmp_path / "study", rows, budget="tiny", store=store)
    assert made.run(jobs=2, progress=False)
    assert "by signal 9" in made.results()["dies"][0]["failed"] and "scores" in made.results()["klt"][0]


def test_a_full_disk_is_one_clear_line(store, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    made = lab.Study(tmp_path / "study", [lab.Variant("klt", tracker="klt")], budget="tiny", store=store)
    with monkeypatch.context() as patch, pytest.raises(ValueError, match="the disk is full; make room"):
        patch.setattr(jobs, "write_text", full)
        made.run(progress=False)
    assert made.run(progress=False)


# --- what a folder's study must agree with ----------------------------------------------------------------------------------


def test_other_rows_budgets_and_code_are_refused_by_name(study):
    folder = study.plan.folder
    with pytest.raises(ValueError, match=r"rows\.p2n\.context='p2n' \(now None\)"):
        lab.Study(folder, [lab.Variant("p2n")])
    with pytest.raises(ValueError, match=r"budget\.recipe\.steps=12 \(now 13\)"):
        lab.Study(folder, TWO, steps=13)
    with pytest.raises(ValueError, match=r"budget\.recipe\.minutes=None \(now 2\)"):
        lab.Study(folder, TWO, minutes=2)
    code = plan.source_code() | {"model/n2n.py": "changed"}
    assert {"model/n2n.py", "lab/jobs.py", "torch"} <= code.keys() and "figures/flat.py" not in code
    made = lab.Study(folder)
    made.plan.code, old = code, json.loads((folder / "study.json").read_text())
    with pytest.raises(ValueError, match=r"other code: model/n2n\.py differ"):
        made.plan.take_over(old, accept_code=False)
    made.plan.take_over(old, accept_code=True)


def test_rows_and_seeds_can_be_added_and_only_they_are_done(study, monkeypatch):
    done, do = [], jobs.do
    monkeypatch.setattr(jobs, "do", lambda job, *rest: done.append(job.name) or do(job, *rest))
    more = lab.Study(study.plan.folder, [*ROWS, lab.Variant("static", tracker="static")])
    assert more.run(progress=False) and done == ["static"] and "static" in more.table().rows[-1]["row"]
    assert list(lab.Study(study.plan.folder).plan.rows) == [*(row.name for row in ROWS), "static"]


def test_depth_from_two_cameras_and_from_few_pixels():
    clip = simulate_clip(seed=3, frames=2, size=(96, 96), tracks=8, stereo_baseline=0.2)
    two, few = under(clip, {"stereo": True}, 0), under(clip, {"sparse": 0.1}, 0)
    away = [np.abs(seen.depths / clip.depths - 1)[clip.depths > 0] for seen in (two, few)]
    assert 0 < np.median(away[0]) < 0.03 and 0.08 < np.mean(away[1] == 0) < 0.5 and np.median(away[1]) < 0.05
    assert np.array_equal(few.depths, under(clip, {"sparse": 0.1}, 0).depths)
    with pytest.raises(ValueError, match="has no right images"):
        under(replace(clip, extras={}), {"stereo": True}, 0)


def test_other_clips_are_refused(study, store, tmp_path):
    shutil.copytree(study.plan.folder, tmp_path / "copy", ignore=shutil.ignore_patterns("store"))
    clips = sorted((store / "clips").glob("*/held_out/*.npz"))
    shutil.copy(clips[0], clips[1])
    with pytest.raises(ValueError, match=r"clips \(held_out\) differ"):
        lab.Study(tmp_path / "copy", store=store).run(progress=False)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rows": [TWO[0], TWO[0]]}, "two rows are called n2n"),
        ({"rows": []}, "expected rows"),
        ({"rows": None}, "holds no study"),
        ({"seeds": 0}, "Study.seeds"),
        ({"budget": "labs"}, "did you mean lab"),
        ({"steps": 5, "minutes": 2}, "at most one of steps, minutes and flops"),
        ({"steps": -1}, "TrainConfig.steps"),
        ({"minutes": 0}, "TrainConfig.minutes"),
        ({"flops": -1}, "Budget.flops"),
        ({"flops": 10}, r"row 'n2n': a step takes .* operations, more than the budget of 10 has"),
    ],
)
def test_bad_plans_are_refused(tmp_path, arguments, message):
    with pytest.raises(ValueError, match=message):
        lab.Study(tmp_path, **({"rows": TWO} | arguments))


def test_more_clips_than_there_are(study, tmp_path):
    with pytest.raises(ValueError, match=r"held_out: expected 2 to \d+ clips"):
        replace(TINY, held_out=10**6)
    with pytest.raises(ValueError, match="expected at least one job"):
        study.run(jobs=0)


def test_equal_time_in_place_of_equal_steps(store, tmp_path):
    made = lab.Study(tmp_path / "minutes", TWO, seeds=1, budget="tiny", minutes=0.02, store=store)
    assert made.run(progress=False) and lab.Study(tmp_path / "minutes", store=store).plan.budget.recipe.minutes == 0.02
    assert all(row["steps"] >= 2 for row in made.table().rows)


def test_a_time_that_no_step_fits_marks_the_row(store, tmp_path):
    made = lab.Study(tmp_path / "minutes", TWO[:1], seeds=1, budget="tiny", minutes=1e-6, store=store)
    assert made.run(progress=False)
    assert "1e-06 minutes fit no step: one takes" in made.results()["n2n"][0]["failed"]


def test_equal_operations_in_place_of_equal_steps(store, tmp_path):
    """A row that costs more a step takes fewer steps; a step's operations are those that its matrices have."""
    costs = [jobs.step_flops(row.recipe(TINY.recipe)) for row in TWO]
    made = lab.Study(tmp_path / "flops", TWO, seeds=1, budget="tiny", flops=7.5 * max(costs), store=store)
    assert made.run(progress=False) and lab.Study(tmp_path / "flops", store=store).plan.budget.flops == 7.5 * max(costs)
    wanted = [int(7.5 * max(costs) / cost) for cost in costs]
    assert [row["steps"] for row in made.table().rows] == wanted and sorted(wanted)[0] == 7 < sorted(wanted)[1]
    twice = replace(TINY.recipe, batch=2)
    assert jobs.step_flops(twice) == pytest.approx(2 * jobs.step_flops(TINY.recipe))
    longer = replace(TINY.recipe, iterations=4)
    assert jobs.step_flops(longer) == pytest.approx(2 * jobs.step_flops(TINY.recipe), rel=0.1)
    along = replace(TINY.recipe, train_encoder=True)
    assert jobs.step_flops(along) > 1.02 * jobs.step_flops(TINY.recipe)


# --- results ------------------------------------------------------------------------------------------------------------


def test_the_table_has_differences_verdicts_and_costs(study):
    table = study.table(against="n2n")
    rows = {row["row"]: row for row in table.rows}
    one = rows["p2n"]["APD3D_none_dynamic"]
    assert one["verdict"] in ("better", "worse", "undecided") and one["difference"]["seeds"] == 2
    ours, theirs = (
        [[x["APD3D_none_dynamic"] for x in study.results()[name][s]["scores"].values()] for s in (0, 1)]
        for name in ("p2n", "n2n")
    )
    ours, theirs = (np.array(x, float) for x in (ours, theirs))
    assert one["difference"]["mean"] == pytest.approx(np.nanmean(ours - theirs)) and one["mean"] == pytest.approx(
        np.nanmean(ours)
    )
    assert rows["n2n"]["parameters"] > rows["p2n"]["parameters"] > 1e4 and rows["klt"]["parameters"] is None
    assert rows["1 update"]["multiply_adds"] < rows["n2n"]["multiply_adds"] and rows["n2n"]["steps"] == 12
    text = table._repr_markdown_()
    assert (
        text.count("\n| ") == len(ROWS) + 1 + ("static" in rows)
        and "minus n2n" in text
        and "smallest difference" in text
    )
    assert str(study.table("klt", "OA")).startswith("| row | seeds | OA | minus klt | verdict |")
    json.dumps(table.to_dict(), allow_nan=False)
    for wrong in ({"against": "n2m"}, {"metric": "AJ3"}):
        with pytest.raises(ValueError, match="did you mean"):
            study.table(**wrong)


def test_the_report_has_all_of_it(study, tmp_path):
    text = study.report(tmp_path, against="klt").read_text()
    for name in ("intervals", "costs", "curves"):
        assert f"]({name}.png)" in text and (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    kept = json.loads((tmp_path / "report.json").read_text())
    assert kept["plan"]["rows"]["p2n"] == {"context": "p2n"} and len(kept["results"]["n2n"]["1"]["scores"]) == 4
    assert abs(kept["gaps"]["p2n"][0][1]) >= abs(kept["gaps"]["p2n"][-1][1]) and "clip_0510" in text


def test_where_two_rows_differ_can_be_looked_at(study):
    assert isinstance(study.draw("n2n", "klt", rank=1, seed=1), Figure)
    widget = study.explore()
    assert bytes(widget.children[-1].value).startswith(b"\x89PNG") and widget.children[2].value == ""
    widget.children[0].children[0].value = "klt"
    assert widget.children[2].value == ""
    with pytest.raises(ValueError, match="rank must be in"):
        study.draw("n2n", "klt", rank=4)
    with pytest.raises(ValueError, match="same seed"):
        study.draw("n2n", "p2n", seed=7)


# --- the command line -----------------------------------------------------------------------------------------------------


def call(monkeypatch, capsys, *words):
    monkeypatch.setattr(sys, "argv", ["tapip3d_lite", "lab", *map(str, words)])
    __main__.main()
    return capsys.readouterr().out


@pytest.mark.skipif(sys.version_info < (3, 11), reason="no tomllib")
def test_from_a_toml_file_to_the_table(store, tmp_path, monkeypatch, capsys):
    file = tmp_path / "own.toml"
    text = 'seeds = 1\nbudget = "tiny"\nstore = "store"\nagainst = "klt"\n[rows.klt]\ntracker = "klt"\n'
    file.write_text(f'{text}[rows."2 poses"]\ntracker = "klt"\ndegrade = {{poses = 3.0}}\n')
    assert "| 2 poses |" in call(monkeypatch, capsys, "run", file)
    assert "minus 2 poses" in call(
        monkeypatch, capsys, "table", tmp_path / "runs/own", "--against", "2 poses", "--metric", "OA"
    )
    assert 'klt: {"tracker": "klt"}, 1 of 1 seeds' in call(monkeypatch, capsys, "list", file)
    assert "wrote" in call(monkeypatch, capsys, "report", file, "--out", tmp_path / "report")
    assert "minus klt" in (tmp_path / "report/report.md").read_text()


def test_the_tables_of_the_paper_have_names(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert "n2n: n2n, world · p2n, world · n2n, camera" in call(monkeypatch, capsys, "list")
    shared = set()
    for name in TABLES:
        made, against = open_study(name)
        assert against in made.plan.rows and str(made.plan.store) == "runs/store"
        recipes = [row.recipe(made.plan.budget.recipe) for row in made.plan.rows.values() if row.given is None]
        if paper := made.paper:
            assert set(paper["rows"]) <= set(made.plan.rows) and all(len(x) == 3 for x in paper["rows"].values())
            assert {row for pair in paper["pairs"] for row in pair} <= set(paper["rows"])
        shared |= {json.dumps(recipe.to_dict(), sort_keys=True) for recipe in recipes}
        assert all(row.given == "lite" for row in made.plan.rows.values()) == (
            made.plan.budget == lab.BUDGETS["shipped"]
        )
    assert len(shared) == 16  # trainings of a seed


@pytest.fixture(scope="module")
def home(study, tmp_path_factory):
    """A folder whose `runs/store` has clips, the encoder and what tables train."""
    folder = tmp_path_factory.mktemp("tables")
    shutil.copytree(study.plan.store, folder / "runs/store")
    return folder


@pytest.mark.parametrize("name", TABLES)
def test_every_table_of_the_paper_runs(name, home, monkeypatch, capsys):
    monkeypatch.chdir(home)
    monkeypatch.setitem(lab.BUDGETS, "tiny", replace(TINY, held_out=2, frames=4, points=8))
    files = sorted((home / "runs/store/trainings").glob("*/weights.safetensors"))
    trained = next(path for path in files if load_weights(path).config.space == "world")
    monkeypatch.setattr(trackers, "shipped_weights", lambda: {"lite": trained})  # the real one takes seconds a row
    text = call(monkeypatch, capsys, "run", name, "--budget", "tiny", "--seeds", "1")
    assert "failed" not in text and all(f"\n| {row} | " in text for row in TABLES[name]["rows"])
    paper = TABLES[name].get("paper")
    if paper:
        assert paper["source"] in text
        one, other = paper["pairs"][0]
        assert f"| {one} minus {other} | APD3D, moving points | " in text
        numbers = paper["rows"][one]
        assert f"| {one} | {' / '.join('–' if x is None else f'{x:.1f}' for x in numbers)} |" in text
    values = json.loads((home / f"runs/{name}, tiny/study.json").read_text())
    assert values["seeds"] == 1 and values["budget"]["held_out"] == 2


def test_shipped_tables_are_read_where_none_was_run(home, tmp_path, monkeypatch, capsys):
    shipped, here = tmp_path / "paper", tmp_path / "here"
    for module in (papers, pack_tables):
        monkeypatch.setattr(module, "PAPER", shipped)
    monkeypatch.setitem(lab.BUDGETS, "tiny", replace(TINY, held_out=2, frames=4, points=8))
    given = {"rows": {"klt": {"tracker": "klt"}, "n2n": {}}, "against": "klt", "seeds": 2, "budget": "tiny"}
    for module in (papers, pack_tables):
        monkeypatch.setattr(
            module, "TABLES", {"n2n": given, "blur": {"rows": {"klt": {"tracker": "klt"}}, "against": "klt"}}
        )
    monkeypatch.chdir(home)
    mine = call(monkeypatch, capsys, "run", "n2n")
    pack_tables.main()
    assert "blur: stays as it is shipped, if it is; no scores of klt" in capsys.readouterr().out
    trained = open_study("n2n")[0].results()["n2n"][0]["training"]
    assert [path.name for path in shipped.glob("store/trainings/*")] == [f"cpu-{trained}"]
    here.mkdir()
    monkeypatch.chdir(here)
    monkeypatch.setattr(plan, "source_code", dict)  # read by a later version of the code …
    recipe = json.loads((shipped / "n2n/study.json").read_text())
    del recipe["budget"]["recipe"]["precision"]  # … that has fields that the older one lacked
    (shipped / "n2n/study.json").write_text(json.dumps(recipe))
    assert call(monkeypatch, capsys, "table", "n2n") == mine
    before = {path: path.read_bytes() for path in shipped.rglob("*") if path.is_file()}
    made, _ = open_study("n2n", shipped=True)
    clip = next(iter(made.results()["n2n"][0]["scores"]))
    assert made.tracks("n2n", clip)[1].xyz.shape[0] == 4
    with pytest.raises(
        ValueError, match=r"weights of row 'n2n', seed 1, are not in .* shipped table has those of seed 0"
    ):
        made.draw("n2n", "klt", seed=1)
    assert "wrote" in call(monkeypatch, capsys, "report", "paper", "--out", "all")
    assert "Without results yet: blur." in (here / "all/report.md").read_text()
    assert "minus klt" in (here / "all/n2n/report.md").read_text()
    assert before == {path: path.read_bytes() for path in shipped.rglob("*") if path.is_file()}


def test_tables_run_together_and_train_once_what_they_share(store, tmp_path, monkeypatch, capsys):
    (tmp_path / "runs").mkdir()
    shutil.move(store, tmp_path / "runs/store")
    monkeypatch.chdir(tmp_path)
    rows = {"n2n": {}, "1 update": {"track": {"iterations": 1}}, "klt": {"tracker": "klt"}}
    tables = {
        name: {"rows": some, "against": "klt", "seeds": 1}
        for name, some in (
            ("K", rows),
            ("blur", {"klt": rows["klt"], "same": {}, "bad": {"lr": 1e3, "clip_norm": 1e9}}),
        )
    }
    monkeypatch.setattr(papers, "TABLES", tables)
    monkeypatch.setattr(papers, "PAPER", tmp_path / "nothing is shipped")
    done, do = [], jobs.do
    monkeypatch.setattr(jobs, "do", lambda job, *rest: done.append(job.name) or do(job, *rest))
    monkeypatch.setitem(lab.BUDGETS, "gpu", TINY)
    assert "lab report paper" in call(monkeypatch, capsys, "run", "paper", "--budget", "gpu")
    assert done == ["n2n s0", "klt #2", "klt #3", "bad s0"]
    first, second = (open_study(name, budget="gpu")[0].results() for name in tables)
    assert first["n2n"][0]["scores"] == second["same"][0]["scores"] != first["1 update"][0]["scores"]
    assert second["bad"][0].get("failed", "").startswith("FloatingPointError")
    call(monkeypatch, capsys, "report", "paper", "--out", "all")
    text = (tmp_path / "all/report.md").read_text()
    assert "[K, gpu](<K, gpu/report.md>), [blur, gpu]" in text and "Without results yet: K, blur." in text


def scored(level, trained=True, seeds=3):
    """Results of a row whose clips and seeds differ a little."""
    rng = np.random.default_rng(0)
    return {
        s: {
            "training": trained or None,
            "costs": {},
            "scores": {f"c{i}": {"APD3D_none": level + 0.01 * rng.normal(), "OA": level} for i in range(20)},
        }
        for s in range(seeds)
    }


def test_claims_of_the_paper_are_judged_by_their_sign():
    results = {"good": scored(0.6), "bad": scored(0.3), "same": scored(0.6), "unknown": scored(0.1)}
    results["good"][0]["scores"]["c0"]["APD3D_none"] += 0.05  # so that it differs from "same", by nothing
    numbers = {"good": (50, 60, None), "bad": (40, 50, 70), "same": (30, 70, 70), "unknown": (None, None, None)}
    pairs = [("bad", "good"), ("same", "bad"), ("same", "good"), ("unknown", "good"), ("bad", "same")]
    paper = {"source": "here", "rows": numbers, "pairs": pairs}
    found = judge(results, paper, ["APD3D_none", "OA"])
    said = {(x["row"], x["against"], x["metric"]): x["verdict"] for x in found}
    assert said[("bad", "good", "APD3D_none")] == "agree" and said[("same", "good", "APD3D_none")] == "undecided"
    assert ("unknown", "good", "APD3D_none") not in said and ("bad", "good", "OA") not in said
    assert said[("bad", "same", "OA")] == "undecided"  # the paper's numbers are equal
    turned = {**paper, "rows": numbers | {"bad": (40, 90, 70)}}
    assert judge(results, turned, ["APD3D_none"])[0]["verdict"] == "disagree"
    table = with_claims(compare(results, "good", ["APD3D_none"]), results, paper)
    assert "| bad minus good | APD3D_none | -10.0 | -30." in str(table) and table.to_dict()["claims"][0]["row"] == "bad"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"rows": {"a": {"contxt": "p2n"}}}, "did you mean context"),
        ({"rowz": {}}, "did you mean rows"),
        ({"rows": ["a"]}, "rows by name"),
        ("{", "not a readable JSON file"),
    ],
)
def test_a_bad_file_is_one_line_and_exit_code_2(tmp_path, monkeypatch, capsys, content, message):
    (tmp_path / "study.json").write_text(content if isinstance(content, str) else json.dumps(content))
    (tmp_path / "study.json").rename(tmp_path / "own.json")
    for file, text in ((tmp_path / "own.json", message), ("n2m", "did you mean n2n")):
        with pytest.raises(SystemExit) as stopped:
            call(monkeypatch, capsys, "table", file)
        shown = capsys.readouterr().err
        assert stopped.value.code == 2 and text in shown and len(shown.strip().splitlines()) == 1
