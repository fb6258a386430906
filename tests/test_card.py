"""The model card repeats what the files say, and nothing else."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import tapip3d_lite as t3d
from tapip3d_lite.evaluation.benchmark import SPLITS, difference_table, estimate, save_results, show
from tapip3d_lite.lab.card import model_card
from tapip3d_lite.training.loss import LossConfig
from tapip3d_lite.training.motion import MotionConfig
from tapip3d_lite.training.recipe import TrainConfig
from tapip3d_lite.training.run_folder import read_log
from tests.tiny import SIZES, recipe

METRICS = [m + part for m in ("AJ3D_none", "APD3D_none", "AJ3D", "APD3D", "OA") for part in ("", "_dynamic", "_static")]


@pytest.fixture
def results():
    generator = torch.Generator().manual_seed(0)
    labels = ("static", "klt", "lite · world", "lite · camera")

    def clip():
        return {metric: float(torch.rand((), generator=generator)) for metric in METRICS}

    return {label: {split: {f"{split}-{i}": clip() for i in range(4)} for split in SPLITS} for label in labels}


@pytest.fixture
def folder(tmp_path, results):
    config = recipe(lr=2e-3, loss=LossConfig(soften=1.5, within=3))
    (tmp_path / "config.json").write_text(json.dumps(config.to_dict()))
    lines = [{"step": s, "stage": "matching" if s <= 4 else "tracking", "seconds": 450.0 * s} for s in range(1, 17)]
    lines[-1] |= {"val_AJ3D_none": 0.4321, "val_APD3D_none": 0.5432, "val_OA": 0.6543}
    (tmp_path / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    tracker = t3d.Tracker(t3d.TrackerConfig.preset("lite", **SIZES))
    tracker.config = replace(tracker.config, visible_threshold=0.35)
    t3d.save_weights(tracker, tmp_path / "weights.safetensors", half=True)
    save_results(tmp_path / "bench.json", results)
    return tmp_path


def test_every_number_comes_from_the_files(folder, results):
    text = model_card(folder, folder / "bench.json", "two cores of a toaster")
    parameters = sum(p.numel() for p in t3d.load_tracker(folder / "weights.safetensors").parameters())
    expected = [f"{parameters / 1e6:.2f} M", "two cores of a toaster", "4 of matching, 12 of tracking", "2.00 h"]
    expected += ["probability 0.35", "AJ3D 0.432, APD3D 0.543, OA 0.654 at step 16", "AdamW 0.002", "images 32x32"]
    expected += ['"lr": 0.002', '"hidden": 32', '"tracks": 6', "--tracker static klt lite --space world camera"]
    assert not [x for x in expected if x not in text]
    for label in results:
        for split in SPLITS:
            row = [show(estimate(results, label, split, m)) for m in ("AJ3D_none", "APD3D_none", "AJ3D", "APD3D", "OA")]
            assert f"| {split} (4) | {label} | {' | '.join(row)} |" in text
    for other in ("static", "klt"):
        assert difference_table(results, "lite · world", other, ("AJ3D_none", "APD3D_none", *METRICS[1:5:3])) in text
    assert "stopped at" not in text
    with open(folder / "log.jsonl", "a") as log:
        log.write('{"step": 15, "stage": "tracking", "seconds": 1.0}\n')
    text = model_card(folder, folder / "bench.json", "two cores of a toaster", command="torchrun x")
    assert "torchrun x\n" in text and "stopped at step 15 of 16" in text
    (folder / "also.md").write_text("Slides by a mile.\n")
    text = model_card(folder, folder / "bench.json", "x", also=folder / "also.md")
    assert "\n\nSlides by a mile.\n\n## Limits\n" in text
    with pytest.raises(ValueError, match="no file"):
        model_card(folder, folder / "bench.json", "x", also=folder / "absent.md")
    assert "--split" not in text
    save_results(folder / "bench.json", {x: rows | {"slow": rows[SPLITS[0]]} for x, rows in results.items()})
    text = model_card(folder, folder / "bench.json", "x")
    assert f"--tracker static klt lite --split {' '.join(SPLITS)} slow --space" in text and "| slow (4) | klt |" in text
    changed = results | {"klt": results["static"]}
    save_results(folder / "bench.json", changed)
    assert model_card(folder, folder / "bench.json", "two cores of a toaster") != text


@pytest.mark.parametrize("preset", ["lite", "paper"])
def test_the_printed_values_make_the_recipe_again(folder, preset):
    motion = MotionConfig(world=0.25, turned=0.0)
    changes = {"frames": (12, 16), "train_encoder": True, "augment": preset == "lite", "motion": motion}
    tracker = {"visible_threshold": 0.5, "neighbors": 12, "context": "p2n", "use_uv": False}
    config = TrainConfig.recipe(preset, tracker=tracker, **changes)
    (folder / "config.json").write_text(json.dumps(config.to_dict()))
    text = model_card(folder, folder / "bench.json", "x")
    changed = json.loads(text.split("```json\n")[1].split("```")[0])
    assert changed.keys() <= {"tracker", *changes} and f"preset `{preset}`, with" in text
    assert TrainConfig.from_dict(TrainConfig.recipe(preset).to_dict() | changed) == config
    assert ("augmented (erase, jitter, blur, depth_blur, reframe, flip_x, flip_y)" in text) == (preset == "lite")
    assert ("images not augmented" in text) == (preset == "paper")


def test_an_unfinished_training_has_no_card(folder):
    (folder / "log.jsonl").write_text("")
    with pytest.raises(ValueError, match="empty"):
        model_card(folder, folder / "bench.json", "x")
    (folder / "weights.safetensors").unlink()
    with pytest.raises(ValueError, match="not a finished training"):
        model_card(folder, folder / "bench.json", "x")
    with pytest.raises(ValueError, match="card"):
        model_card(folder / "absent", folder / "bench.json", "x")


def test_the_shipped_log_is_that_of_the_shipped_card():
    folder = Path(t3d.__file__).parent / "weights"
    last = read_log(folder / "lite.jsonl")[-1]
    scores = "AJ3D {val_AJ3D_none:.3f}, APD3D {val_APD3D_none:.3f}, OA {val_OA:.3f} at step {step}".format(**last)
    text = (folder / "lite.md").read_text()
    assert scores in text and f"{last['seconds'] / 3600:.2f} h of steps" in text
