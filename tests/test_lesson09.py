"""Lesson 09: its parts against the contract and against loops, its measure of cells, evidence, and a milestone that notices."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import tapip3d_lite as t3d
from lessons import n09, n09_parts
from tapip3d_lite import lab
from tapip3d_lite.simulate import object_maps, render_clip, simulate_rollout
from tests.milestones import notices


@pytest.mark.parametrize("name", ["NearAndAlike", "Vote", "Ripple", "SoftMisses"])
def test_parts_keep_their_contract(name):
    found = lab.check_part(getattr(n09_parts, name))
    assert found.ok, found


def test_the_control_sees_nothing_and_says_so():
    assert list(lab.check_part(n09.Blind).faults) == ["gradient"]


def test_the_vote_finds_the_one_cell_that_is_alike():
    features = torch.zeros(1, 1, 1, 3, 4)
    features[..., 1, 2] = 40.0
    offsets = torch.arange(9.0).view(1, 1, 1, 3, 3)
    said = n09_parts.vote(torch.tensor([[[0.0, 0, 2, 0]]]), features, offsets)
    torch.testing.assert_close(said[0, 0, 0], torch.tensor([3.0, 4, 5, 0, 40]))


def test_most_cells_that_are_nearest_lie_on_the_own_body_and_few_by_lot():
    recording = simulate_rollout(903, t3d.SimulationConfig(frames=4, tracks=48))
    clip, objects = render_clip(recording), object_maps(recording)
    cells = n09.picked(clip, objects, 2, n09_parts.most_alike, t3d.load_tracker("lite"), 5)
    share = {rule: right.mean() for rule, right in cells.right.items()}
    assert share["nearest"] > 0.8 and share["nearest"] > share["alike"] > share["by lot"] and share["by lot"] < 0.2
    assert (np.diff(cells.away["nearest"], axis=1) >= -1e-6).all()
    shown = np.flatnonzero(clip.tracks.dynamic & clip.tracks.visible[2])
    assert len(cells.uv) == len(shown) and cells.pixels["alike"].shape == (len(shown), 5, 2)
    n09.cells_figure(cells, [0, 1]).canvas.draw()
    n09.shares_figure(share, cells.away).canvas.draw()


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    rows = [
        lab.Variant("static", tracker="static"),
        lab.Variant("klt", tracker="klt"),
        lab.Variant("p2n", context="p2n"),
    ]
    made = n09.new_study(tmp_path_factory.mktemp("lesson09"), "one", rows, seeds=2, budget="tiny")
    assert made.run(progress=False)
    return made


def test_evidence_reads_its_numbers_from_the_study(study, tmp_path):
    claim, doubt = "Lucas-Kanade follows moving points better than nobody", "clips in which nothing moves"
    page = n09.evidence(study, "klt", "static", "p2n", claim, [doubt, " "], tmp_path / "page.md")
    one = {row["row"]: row for row in study.table("static").rows}["klt"]["APD3D_none_dynamic"]
    assert page.text == page.path.read_text(encoding="utf-8") == page._repr_markdown_()
    assert claim in page.text and f"- {doubt}\n" in page.text and page.text.count("\n- ") == 1
    assert f"{one['difference']['mean']:+.3f}" in page.text and f"{one['difference']['seen']:.3f}" in page.text
    words = {"better": "supported", "worse": "refuted", "undecided": "undecided"}
    assert page.verdict.startswith(words[one["verdict"]]) and page.verdict[1:] in page.text
    assert len(page.text.split()) < 450  # one page
    assert "**Costs.**" not in page.text  # neither is trained
    said = n09.hearing(study, "p2n", "static")
    lost = {row["row"]: row for row in study.table("static").rows}["p2n"]["APD3D_none_dynamic"]["verdict"] == "worse"
    assert said in page.text and ("deaf" in said) == (not lost) and ("can hear" in said) == lost
    for wrong in ({"refuted_by": [""]}, {"claim": " "}, {"row": "static"}, {"control": "static"}):
        arguments = {"row": "klt", "against": "static", "control": "p2n", "claim": claim, "refuted_by": [doubt]} | wrong
        with pytest.raises(ValueError, match=r"evidence: |hearing: "):
            n09.evidence(study, path=tmp_path / "no.md", **arguments)
    assert not (tmp_path / "no.md").exists()


def test_a_new_study_forgets_trainings_and_keeps_clips_and_encoder(study):
    store = study.plan.store
    kept = sorted(path for name in ("clips", "encoders") for path in (store / name).rglob("*.npz"))
    assert kept and list((store / "trainings").iterdir())
    again = n09.new_study(study.plan.folder.parent, "other", list(study.plan.rows.values()), budget="tiny", seeds=1)
    assert again.plan.store == store and not (store / "trainings").exists() and study.plan.folder.exists()
    assert kept == sorted(path for name in ("clips", "encoders") for path in (store / name).rglob("*.npz"))


def test_the_budget_is_the_laboratorys_but_for_its_sizes():
    made, usual = n09.budget(40), lab.BUDGETS["lab"]
    assert made.recipe.steps == 40 and made.scene is usual.scene and made.recipe.motion == usual.recipe.motion
    assert replace(made.recipe, **{x: getattr(usual.recipe, x) for x in (
        "tracker", "sampling", "clips", "steps", "matching_steps", "average", "evaluate_every", "validation", "save_every"
    )}) == usual.recipe  # fmt: skip


def test_the_milestone_notices_what_is_not_the_references():
    notices(n09, "09", ("least alike", "no root", "zeros", "four alone"))
