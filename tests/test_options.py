"""Every option of the public functions and every flag of the command line, once, on the real `lite` and a real sample.

Complete by construction: the options are read from the signatures and from tyro's parsers. An option that no call below
gives with a value other than its default, and a flag that stands in no line below, is a failure.
"""

import inspect
import json
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
import tyro
from matplotlib.figure import Figure

import tapip3d_lite as t3d
from tapip3d_lite import __main__
from tapip3d_lite.files import shipped_weights
from tapip3d_lite.model.stream import Stream
from tapip3d_lite.model.track import track
from tapip3d_lite.training.recipe import TrainConfig

SAMPLE = Path(__file__).resolve().parents[1] / "data_samples" / "arc.npz"
# Those without options, since test_weights has the checkpoints that they need; and what asks for viser, in test_export.
ELSEWHERE = {"from_official_state", "load_official", "serve_tracks"}
SIMULATION = {
    "frames": 4, "fps": 10.0, "size": (32, 40), "camera": "handheld", "handheld": 2.0, "arc": (20.0, 40.0),
    "moving": (3, 5), "resting": (1, 2), "shapes": ("box", "gear"), "speed": 0.9, "drop": 0.8, "sky": True,
    "same_texture": True, "occluder": True, "motion_blur": True, "stereo_baseline": 0.1, "tracks": 9, "share_dynamic": 0.5,
}  # fmt: skip


def shortened(clip, frames=8, tracks=6):
    """The first frames of a clip and a few of its tracks."""
    clip = clip.cut(0, frames)
    some = clip.tracks.select(np.linspace(0, len(clip.queries) - 1, tracks).astype(int))
    return replace(clip, queries=some.queries, tracks=some)


@pytest.fixture(scope="module")
def sample(tmp_path_factory):
    path = tmp_path_factory.mktemp("sample") / "clip.npz"
    shortened(t3d.load_clip(SAMPLE)).save(path)
    return path


@pytest.fixture(scope="module")
def lite():
    return t3d.load_tracker("lite", device="cpu")


def functions(lite, clip):
    """All public functions by name, and what a tracker does."""
    homes = [(t3d, t3d.__all__), (t3d.figures, t3d.figures.__all__)]
    found = {name: getattr(home, name) for home, names in homes for name in names}
    public = {name: x for name, x in found.items() if inspect.isfunction(x) and name not in ELSEWHERE}
    return public | {
        "show_3d": t3d.figures.show_3d,
        "track": track,
        "stream": Stream,
        "push": lite.stream(clip.queries).push,
    }


def arguments(lite, clip, file, folder):
    """One call of each of these functions, with every option."""
    rows, truth, pred = clip.queries, clip.tracks, t3d.load_tracker("static").track(clip)
    tracking = {
        "space": "camera",
        "iterations": 1,
        "support_grid": 2,
        "depth_roi": (0.5, 9.0),
        "visible_threshold": 0.7,
    }
    subset = replace(clip, queries=None, tracks=truth.select([0, 1]))
    both = [t3d.geometry.transform(tracks.xyz, clip.extrinsics) for tracks in (truth, pred)]
    visible = {"gt_visible": truth.visible, "visible": pred.visible}
    solid = visible | dict(zip(("gt_xyz", "xyz"), both, strict=True)) | {"intrinsics": clip.intrinsics}
    flat = visible | {
        name: t3d.geometry.project(xyz, clip.intrinsics)[0] for name, xyz in zip(("gt_uv", "uv"), both, strict=True)
    }
    drawn, page, ax = t3d.figures.overview(clip, pred), t3d.figures.tracks_3d(clip, pred), Figure().add_subplot()
    frame = {
        "image": clip.video[0],
        "depth": clip.depths[0],
        "intrinsics": clip.intrinsics[0],
        "extrinsics": clip.extrinsics[0],
    }
    pred.save(folder / "tracks.npz")
    t3d.save_clip(clip, folder / "images")
    np.save(folder / "depth.npy", clip.depths)
    cpu = torch.device("cpu")
    return {
        "load_clip": {"path": folder / "images", "format": "folder", "depth": folder / "depth.npy", "frames": slice(0, 4),
                      "points": False},
        "save_clip": {"clip": clip, "path": folder / "clip.npz"},
        "export_tracks": {"tracks": pred, "path": folder / "tracks.csv", "clip": clip},
        "load_tracks": {"path": folder / "tracks.npz"},
        "check_queries": {"clip": clip, "queries": rows},
        "grid_queries": {"clip": clip, "side": 3, "frame": 2, "margin": 0.1},
        "queries_from_pixels": {"clip": clip, "pixels": [[1, 20, 30]], "on_invalid": "skip"},
        "has_depth": {"clip": clip, "pixels": [[1, 20, 30]]},
        "dense_queries": {"clip": clip, "frame": 1, "mask": clip.depths[1] > 0, "step": 40},
        "resolve_queries": {"clip": clip, "queries": rows[:2], "grid": 3},
        "stereo_depth": {"left": clip.video, "right": np.roll(clip.video, -3, 2), "intrinsics": clip.intrinsics, "baseline": 0.1, "fill": False},
        "densify_depth": {"depths": clip.depths},
        "filter_depth": {"depths": clip.depths, "edge": 0.1},
        "register_depth": {"depth": clip.depths[0], "depth_intrinsics": clip.intrinsics[0], "intrinsics": clip.intrinsics[0],
                           "color_from_depth": np.eye(4), "size": clip.size},
        "check_clip": {"clip": clip},
        "carry": {"tracks": pred, "source": clip, "target": clip},
        "estimate_poses": {"clip": clip},
        "steady_clip": {"clip": clip},
        "simulate_clip": {"seed": 1, "config": t3d.SimulationConfig(frames=3), **SIMULATION},
        "tapvid3d_metrics": {**solid, "queries": rows, "scaling": "per_trajectory"},
        "tapvid2d_metrics": {**flat, "queries": rows, "mode": "strided"},
        "evaluate": {"pred": pred.select([0, 1]), "clip": subset},
        "list_trackers": {},
        "load_tracker": {"name": shipped_weights()["lite"], "device": cpu, "fast": False, "parts": ["mine"]},
        "save_weights": {"tracker": lite, "path": folder / "lite.safetensors", "half": True},
        "load_weights": {"path": folder / "lite.safetensors", "device": cpu, "fast": False, "parts": ["mine"]},
        "track": {"tracker": lite, "clip": clip, "queries": rows, "bidirectional": False, "progress": True, **tracking,
                  "size": (96, 96), "crop": (0, 8, 120, 128)},
        "track_many": {"tracker": lite, "clip": clip, "queries": rows, "block": 4, "progress": True},
        "stream": {"tracker": lite, "queries": rows, "watch": lambda step: None, "keep": False, **tracking},
        "push": frame,
        "contact_sheet": {"clips": [clip, clip], "frames": 2, "width": 1.0},
        "depth_map": {"clip": clip, "frame": 1, "ax": ax},
        "frame_with_tracks": {"clip": clip, "tracks": pred, "frame": 2, "tail": 1, "truth": truth, "ax": ax},
        "overview": {"clip": clip, "tracks": pred, "columns": 2},
        "save_html": {"figure": page, "path": folder / "page.html"},
        "save_png": {"figure": drawn, "path": folder / "figure.png", "dpi": 50},
        "show_3d": {"figure": page, "twin": drawn},
        "track_colors": {"clip": clip, "tracks": pred},
        "tracks_3d": {"clip": clip, "tracks": pred, "points": 300, "max_tracks": 3, "tail": 2, "title": "tracks"},
        "tracks_3d_static": {"clip": clip, "tracks": pred, "frames": [0, 3], "points": 300},
    }  # fmt: skip


@pytest.fixture(scope="module")
def public(lite, sample, tmp_path_factory):
    """(function, arguments) by name."""
    clip = t3d.load_clip(sample)
    found, given = functions(lite, clip), arguments(lite, clip, sample, tmp_path_factory.mktemp("calls"))
    assert found.keys() == given.keys()
    return {name: (found[name], given[name]) for name in given}


def usual(value, default):
    return value is default or (np.isscalar(value) and value == default)


def test_every_public_option_is_given(public):
    for name, (function, given) in public.items():
        options = inspect.signature(function).parameters.values()
        options = {x.name: x.default for x in options if x.kind is not inspect.Parameter.VAR_KEYWORD}
        missing = [x for x, default in options.items() if x not in given or usual(given[x], default)]
        assert not missing, f"{name}: the call above does not try {missing}"
    fields = asdict(t3d.SimulationConfig())
    assert fields.keys() == SIMULATION.keys() and not [x for x in fields if fields[x] == SIMULATION[x]]


def test_every_public_function_runs_with_its_options(public):
    results = {name: function(**given) for name, (function, given) in public.items()}
    assert results["track"].xyz.shape == (8, 6, 3) and np.isfinite(results["track"].xyz).all()
    assert results["simulate_clip"].video.shape == (4, 32, 40, 3) and len(results["tracks_3d"].frames) == 8
    assert results["load_weights"].config == results["load_tracker"].config
    assert 0 <= results["evaluate"]["OA"] <= 1 and 0 <= results["tapvid3d_metrics"]["AJ3D"] <= 1


def test_methods_take_the_options_of_their_functions(lite, sample):
    clip = t3d.load_clip(sample)
    for method in (lite.track, lite.stream):
        with pytest.raises(TypeError, match="visible_treshold"):
            method(clip, visible_treshold=0.5)


def test_the_bar_of_track_may_be_redrawn_at_every_step(lite, sample, capsys):
    clip = t3d.load_clip(sample)
    wait = lite.updater.register_forward_pre_hook(lambda *_: time.sleep(0.11))  # tqdm redraws after 0.1 s
    try:
        shown = lite.track(clip, progress=True, iterations=2)
    finally:
        wait.remove()
    drawn = capsys.readouterr().err
    assert "tracking" in drawn and "1/" in drawn and "100%" in drawn
    np.testing.assert_array_equal(shown.xyz, lite.track(clip, iterations=2).xyz)


# --- the command line -----------------------------------------------------------------------------------------------


def flags(values, prefix=""):
    """A configuration, as `asdict` gives it, in words of the command line."""
    for name, value in values.items():
        flag = name.replace("_", "-")
        if isinstance(value, dict):
            yield from flags(value, f"{prefix}{flag}.")
        elif isinstance(value, bool):
            yield f"--{prefix}{flag if value else f'no-{flag}'}"
        elif isinstance(value, tuple | list):
            yield from (f"--{prefix}{flag}", *map(str, value))
        elif value is not None:
            yield f"--{prefix}{flag}={value}"


def lines(sample, folder):
    """All lines to try, in their order: the card is of the training and of the benchmark's results before it."""
    recipe = TrainConfig.recipe(
        clips=1, matching_steps=1, steps=1, minutes=0.02, frames=(5, 5), iterations=(1, 1), validation=1, evaluate_every=1,
        train_encoder=True, augment=True, init="lite", tracker={},
    ).to_dict()  # fmt: skip
    run, results = folder / "run", folder / "results.json"
    rows = {name: {"tracker": name} for name in ("static", "klt")}
    (folder / "pixels.csv").write_text("# frame,u,v\n0,10,20\n3,64.5,90\n")
    (folder / "own.json").write_text(json.dumps({"rows": rows}))
    train = ["train", "--out", run, "--data", folder / "clips", "--device", "cpu", "--workers", 0, "--no-compiled"]
    return [
        ["convert", sample, folder / "images", "--format", "npz"],
        ["convert", folder / "images", folder / "short.npz", "--frames", 0, 8, 2, "--depth", folder / "images" / "depth"],
        ["check", sample, "--format", "npz"],
        ["track", sample, "--tracker", "lite", "--format", "npz", "--out", folder / "out.npz", folder / "out.ply", "--html", folder / "out.html",
         "--png", folder / "out.png", "--space", "camera", "--device", "cpu", "--allow", "mine"],
        ["track", sample, "--tracker", "klt", "--pixels", folder / "pixels.csv", "--on-invalid", "skip"],
        ["track", sample, "--tracker", "klt", "--mask", folder / "images" / "rgb" / "000001.png", "--frame", 1, "--step", 20],
        ["track", sample, "--tracker", "klt", "--dense", "--step", 9, "--block", 50],
        ["track", sample, "--grid", 3, "--no-own-queries", "--size", 96, 96, "--crop", 0, 8, 120, 128, "--steady"],
        ["evaluate", sample, "--tracker", "lite", "static", "--format", "npz", "--device", "cpu", "--allow", "mine"],
        ["benchmark", "--tracker", "lite", "--split", "occlusion", "--space", "camera", "--count", 1, "--out", results,
         "--figure", folder / "scores.png", "--device", "cpu", "--allow", "mine"],
        ["demo", sample, "--tracker", "lite", "--format", "npz", "--out", folder / "demo"],
        ["simulate", "--out", folder / "set", "--count", 1, "--first-seed", 1, "--workers", 1, *flags(SIMULATION)],
        [*train, *flags(recipe), "--tracker", "neighbors", 4],
        [*train, "--resume", "--allow", "mine", "--loss", "paper"],
        ["card", run, results, "--hardware", "a core", "--out", folder / "CARD.md", "--name", "mine",
         "--weights", run / "weights.safetensors", "--command", "train", "--allow", "mine",
          "--also", Path(__file__).parents[1] / "README.md"],
        ["lab", "run", folder / "own.json", "--jobs", 1, "--device", "cpu", "--accept-code", "--allow", "mine", "--budget", "tiny",
         "--seeds", 1],
        ["lab", "report", folder / "runs" / "own, tiny", "--against", "klt", "--metric", "OA", "--out", folder / "report"],
        ["curves", run, run / "log.jsonl", "--out", folder / "curves.png", "--by", "minutes"],
    ]  # fmt: skip


@pytest.mark.filterwarnings("ignore:get_parser")
def test_every_flag_is_in_some_line(tmp_path):
    given = {}
    for command, *words in lines("clip.npz", tmp_path):
        given.setdefault(command, set()).update(str(word).partition("=")[0] for word in words)
    for command, function in (__main__.COMMANDS | {"train": __main__._train([])}).items():
        known = [set(action.option_strings) for action in tyro.extras.get_parser(function)._actions]
        missing = [names for names in known if names - {"-h", "--help"} and not names & given.get(command, set())]
        assert not missing, f"{command}: no line above tries {missing}"


def test_every_line_runs(sample, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for line in lines(sample, tmp_path):
        monkeypatch.setattr(sys, "argv", ["tapip3d_lite", *map(str, line)])
        __main__.main()
    shown = capsys.readouterr().out
    for made in ("short.npz", "out.npz", "out.ply", "out.html", "out.png", "scores.png", "CARD.md", "curves.png"):
        assert (tmp_path / made).stat().st_size > 500 and f"wrote {tmp_path / made}" in shown
    assert "9 points over 8 frames with lite" in shown and "static · mean" in shown and "finished: " in shown
    assert sorted(path.name for path in (tmp_path / "set").iterdir()) == ["clip_000001.npz", "dataset.json"]
