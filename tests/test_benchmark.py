"""The Lite benchmark: the same clips for everyone, scores that can be resumed, intervals that are right."""

import json
import os
import sys
import tempfile
from dataclasses import fields, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from lessons.samples import SAMPLES, longest_gap
from tapip3d_lite import __main__, trackers
from tapip3d_lite.clip import Tracks
from tapip3d_lite.evaluation import benchmark, lite_splits
from tapip3d_lite.evaluation.baselines import Baseline, KltTracker, StaticTracker
from tapip3d_lite.evaluation.benchmark import difference_table, load_results, run_benchmark, save_results, summary_table
from tapip3d_lite.evaluation.intervals import bootstrap_interval, paired_difference
from tapip3d_lite.evaluation.lite_splits import (
    ALL,
    DRIFT,
    FOLDER,
    HARD,
    SPLITS,
    benchmark_clips,
    differences,
    fingerprint,
    split_file,
)
from tapip3d_lite.figures.curves import score_figure
from tapip3d_lite.geometry import project
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.simulate import render_clip, seeds, simulate_clip, simulate_rollout, simulator
from tapip3d_lite.simulate.rollout import load_rollouts, save_rollouts
from tests.make_benchmark import split_config, split_seed


def same(a, b):
    arrays = [(getattr(a, f.name), getattr(b, f.name)) for f in fields(a)]
    for x, y in arrays:
        if isinstance(x, Tracks):
            assert same(x, y)
        elif isinstance(x, np.ndarray):
            assert x.dtype == y.dtype
            np.testing.assert_array_equal(x, y)
        else:
            assert x == y
    return True


@pytest.fixture(scope="module")
def small():
    """Two cheap clips under the names of a split's."""
    clips = [simulate_clip(seed, frames=4, size=(48, 48), tracks=24) for seed in (3, 4)]
    return [replace(clip, name=f"static-camera-{i:02d}") for i, clip in enumerate(clips)]


# --- rollouts -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "settings",
    [{"occluder": True, "motion_blur": True, "camera": "handheld"}, {"sky": True, "shapes": ("torus", "box")}],
    ids=["blur", "sky"],
)
def test_a_recording_films_the_same_clip_bit_for_bit(tmp_path, settings):
    settings = settings | {"frames": 4, "size": (40, 56), "tracks": 30}
    save_rollouts(
        tmp_path / "r.npz",
        [simulate_rollout(9, **settings), simulate_rollout(8, **settings)],
        [{"mark": np.arange(3)}] * 2,
    )
    (first, marks), (second, _) = load_rollouts(tmp_path / "r.npz")
    np.testing.assert_array_equal(marks["mark"], np.arange(3))
    assert same(render_clip(first), simulate_clip(9, **settings))
    assert render_clip(second).name == "simulated_8"


def test_stereo_is_recorded_too():
    settings = {"frames": 2, "size": (32, 32), "tracks": 5, "stereo_baseline": 0.2}
    one, two = render_clip(simulate_rollout(1, **settings)), simulate_clip(1, **settings)
    np.testing.assert_array_equal(one.extras["video_right"], two.extras["video_right"])


def test_filming_needs_no_physics(monkeypatch):
    rollout = simulate_rollout(5, frames=3, size=(32, 32), tracks=10)
    expected = render_clip(rollout)
    monkeypatch.setattr(simulator, "roll_out", lambda *_: pytest.fail("physics was computed"))
    assert same(render_clip(rollout), expected)
    moved = replace(rollout, states=rollout.states + 0.05)
    assert not np.array_equal(render_clip(moved).video, expected.video)


def test_a_recording_of_another_scene_is_refused():
    rollout = simulate_rollout(5, frames=2, size=(32, 32), tracks=10)
    with pytest.raises(ValueError, match="another version of the simulator"):
        render_clip(replace(rollout, states=rollout.states[..., :-7]))


def test_a_file_without_recordings_is_refused(tmp_path):
    np.savez(tmp_path / "x.npz", video=np.zeros(3))
    with pytest.raises(ValueError, match="not a file of rollouts"):
        load_rollouts(tmp_path / "x.npz")


# --- what is stored -------------------------------------------------------------------------------------------------


def test_seeds_are_kept_apart(monkeypatch, tmp_path):
    ranges = sorted((getattr(seeds, name) for name in dir(seeds) if name.isupper()), key=lambda r: r.start)
    assert len(ranges) == 5
    assert all(a.stop <= b.start for a, b in pairwise(ranges))
    assert {sample.seed for sample in SAMPLES.values()} <= set(seeds.SAMPLES)
    data = pytest.importorskip("tapip3d_lite.training.data")
    drawn = []
    monkeypatch.setattr(data, "simulate_dataset", lambda folder, count, recipe, first, *_: drawn.append(first) or [])
    data.training_clips(tmp_path, 10)
    data.validation_clips(tmp_path, 10)
    assert drawn[0] in seeds.TRAINING and drawn[1] in seeds.VALIDATION


def test_stored_splits_are_what_they_claim_and_small():
    stored = {split: load_rollouts(split_file(split)) for split in ALL}
    used = [rollout.seed for part in stored.values() for rollout, _ in part]
    assert len(set(used)) == 16 * 7 and set(used) <= set(seeds.BENCHMARK)
    assert max(path.stat().st_size for path in FOLDER.rglob("*.npz")) < 5e5
    for split, part in stored.items():
        first = [split_seed(split, 0) + index for index in range(16)]
        assert [rollout.seed for rollout, _ in part] == first  # blindly the first ones, none left out
        for index, (rollout, _) in enumerate(part):
            config = rollout.config
            assert config == split_config(split, index)
            assert (config.frames, config.tracks) == (24, 256)
            assert config.size == ((160, 96) if split == "portrait" else (128, 128))
            assert config.fps >= 100 if split == "slow" else config.fps == 12
            assert rollout.states.dtype == np.float64 and rollout.states.shape[:2] == (24, 1)
            moves = np.abs(np.diff(rollout.extrinsics, axis=0)).max()
            assert (moves > 0) == (config.camera != "static")
    assert {r.config.camera for r, _ in stored["moving-camera"]} == {"linear", "arc", "handheld"}
    assert all(r.config.occluder for r, _ in stored["occlusion"])


def test_hard_clips_are_hard():
    """What each split is there for, in numbers."""
    creeping = benchmark_clips("slow", 3, progress=False)
    for clip in creeping:
        uv, _ = project(clip.tracks.xyz, clip.intrinsics[:1], clip.extrinsics[:1])  # as the first camera would see it
        speed = np.linalg.norm(np.diff(uv, axis=0), axis=-1).mean(0)[clip.tracks.dynamic]
        assert np.median(speed) < 1.0 and (speed > 0.05).mean() > 0.5
    for index, clip in enumerate(benchmark_clips("drift", 4, progress=False)):
        still = clip.tracks.xyz[:, ~clip.tracks.dynamic]
        turned = np.linalg.norm(np.diff(still, axis=0), axis=-1).mean() / np.linalg.norm(still, axis=-1).mean()
        assert 0.2 < np.degrees(turned) / DRIFT[index] < 3  # what rests is said to move
    for clip in benchmark_clips("sensor", 3, progress=False):
        uv, z = project(clip.tracks.xyz, clip.intrinsics, clip.extrinsics)
        seen = clip.tracks.visible
        u, v = np.rint(uv[seen]).astype(int).clip(0, 127).T
        found = clip.depths[np.nonzero(seen)[0], v, u]
        assert (found == 0).mean() > 0.01 or np.median(np.abs(found - z[seen]) / z[seen]) > 2e-3


@pytest.mark.parametrize("split", HARD)
def test_a_hard_clip_films_as_stored(split, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (clip,) = benchmark_clips(split, 1, progress=False)
    assert clip.name == f"{split}-00" and not differences(clip, load_rollouts(split_file(split))[0][1])


def test_occlusions_occur():
    share = {}
    for split in SPLITS:
        dynamic, gaps = [], []
        for rollout, marks in load_rollouts(FOLDER / f"{split}.npz"):
            visible = np.unpackbits(marks["visible"])[: 24 * 256].reshape(24, 256).astype(bool)
            on_moving = round(256 * rollout.config.share_dynamic)
            gaps.append((longest_gap(visible) >= 6).sum())
            dynamic.append(on_moving)
        share[split] = sum(gaps) / sum(dynamic)
    assert share["occlusion"] > 0.25
    assert share["occlusion"] > 1.3 * share["static-camera"]


def test_a_stored_clip_films_as_stored(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (clip,) = benchmark_clips("occlusion", 1, progress=False)
    (rollout, marks), (_, others) = load_rollouts(FOLDER / "occlusion.npz")[:2]
    assert not differences(clip, marks) and differences(clip, others)
    assert clip.name == "occlusion-00" and len(clip) == 24 and rollout.config.occluder


@pytest.fixture
def cache(tmp_path, monkeypatch, small):
    """An empty cache, for a benchmark of the two small clips."""
    rollouts = [simulate_rollout(s, frames=4, size=(48, 48), tracks=24) for s in (3, 4)]
    save_rollouts(tmp_path / "static-camera.npz", rollouts, [fingerprint(clip) for clip in small])
    monkeypatch.setattr(lite_splits, "FOLDER", tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = tmp_path / "tapip3d_lite" / "benchmark"
    folder.mkdir(parents=True)
    return folder


def test_clips_are_filmed_once_and_checked(cache, monkeypatch, small):
    monkeypatch.setattr(os, "cpu_count", lambda: 2)  # two clips, two processes
    filmed = []
    (cache / "static-camera-00-0123456789ab.npz").write_bytes(b"an older version")
    assert all(map(same, benchmark_clips("static-camera", progress=False), small))
    assert len(list(cache.iterdir())) == 2  # and the older version is gone
    monkeypatch.setattr(lite_splits, "render_clip", lambda r: filmed.append(r.seed) or render_clip(r))
    assert same(benchmark_clips("static-camera")[1], small[1])
    assert not filmed
    damaged = next(cache.glob("static-camera-01*"))
    damaged.write_bytes(damaged.read_bytes()[:5000])
    assert same(benchmark_clips("static-camera", progress=False)[1], small[1])
    small[1].save(next(cache.glob("static-camera-00*")))  # a sound file of another clip
    assert same(benchmark_clips("static-camera", 1, progress=False)[0], small[0])
    assert filmed == [4, 3]


def test_another_renderer_is_noticed(cache, monkeypatch, small):
    monkeypatch.setattr(lite_splits, "render_clip", lambda _: replace(small[0], video=255 - small[0].video))
    with pytest.raises(ValueError, match=r"static-camera-00.*video: .*not be comparable"):
        benchmark_clips("static-camera", 1, progress=False)
    assert not list(cache.glob("*"))


def test_fingerprints_forgive_rounding_and_nothing_else(small):
    clip, marks = small[0], fingerprint(small[0])
    tracks = clip.tracks
    rounding = replace(tracks, xyz=tracks.xyz + np.float32(4e-4))
    assert differences(replace(clip, tracks=rounding, depths=clip.depths * np.float32(1.0001)), marks) == []
    changes = {
        "tracks": replace(clip, tracks=replace(tracks, xyz=tracks.xyz + np.float32(0.01))),
        "visible": replace(clip, tracks=replace(tracks, visible=~tracks.visible)),
        "depths": replace(clip, depths=clip.depths + np.float32(0.01)),
        "video": replace(clip, video=clip.video ^ 16),
    }
    for name, changed in changes.items():
        assert [text.split(":")[0] for text in differences(changed, marks)] == [name]
    assert len(differences(small[1].cut(0, 2), marks)) >= 2


@pytest.mark.parametrize("arguments", [("nonsense",), ("occlusion", 0)])
def test_bad_requests(arguments):
    with pytest.raises(ValueError, match=r"static-camera|count"):
        benchmark_clips(*arguments)


# --- intervals ------------------------------------------------------------------------------------------------------


def test_bootstrap_equals_a_loop_and_the_normal_interval():
    values = np.random.default_rng(0).normal(0.6, 0.1, 400)
    got = bootstrap_interval(values, n=4000)
    half = 1.96 * values.std(ddof=1) / np.sqrt(len(values))
    assert got.mean == pytest.approx(values.mean())
    assert (got.mean - got.low, got.high - got.mean) == (pytest.approx(half, rel=0.08), pytest.approx(half, rel=0.08))
    rng, few = np.random.default_rng(5), values[:7]
    means = sorted(np.mean([few[i] for i in rng.integers(7, size=7)]) for _ in range(500))
    exact = bootstrap_interval(few, n=500, seed=5)
    np.testing.assert_allclose(exact[1:], np.quantile(means, [0.025, 0.975]), rtol=1e-12)
    assert exact.high - exact.low < np.ptp(few)


def test_bootstrap_of_special_values():
    assert bootstrap_interval([0.25] * 5) == (0.25, 0.25, 0.25)
    with_nan = bootstrap_interval([0.1, np.nan, 0.5, 0.3])
    assert with_nan == bootstrap_interval([0.1, 0.5, 0.3]) and np.isfinite(with_nan).all()
    one, none = bootstrap_interval([0.4, np.nan]), bootstrap_interval([np.nan])
    assert one.mean == 0.4 and np.isnan(one[1:]).all() and np.isnan(none).all()
    for bad in (np.zeros((2, 2)), 0.5):
        with pytest.raises(ValueError, match="one number a clip"):
            bootstrap_interval(bad)


def test_pairing_takes_out_what_clips_share():
    hard = np.random.default_rng(1).uniform(0, 1, 16)
    gain = paired_difference(hard + 0.05, hard)
    np.testing.assert_allclose(gain, 0.05, atol=1e-12)
    some = paired_difference([0.5, np.nan, 0.8], [0.4, 0.2, np.nan])
    assert some.mean == pytest.approx(0.1) and np.isnan(some.low)
    with pytest.raises(ValueError, match="as many clips"):
        paired_difference([1.0], [1.0, 2.0])


# --- scores ---------------------------------------------------------------------------------------------------------


class Oracle:
    """Returns the truth, counts its calls, and can fail at one of them."""

    def __init__(self, fail_at=None):
        self.calls, self.options, self.fail_at = [], None, fail_at

    def __repr__(self):
        return "oracle"  # not another tracker because it fails at another clip

    def track(self, clip, **options):
        if len(self.calls) == self.fail_at:
            raise KeyboardInterrupt
        self.calls.append(clip.name)
        self.options = options
        return clip.tracks


@pytest.fixture
def two_clips(monkeypatch, small):
    monkeypatch.setattr(benchmark, "benchmark_clips", lambda split, *_, **__: small)


def test_an_interrupted_run_goes_on_where_it_stopped(two_clips, tmp_path):
    out, options = tmp_path / "r.json", {"space": "camera"}
    with pytest.raises(KeyboardInterrupt):
        run_benchmark([("oracle", Oracle(fail_at=1), options)], ["occlusion"], out=out, progress=False)
    assert list(load_results(out)[0]["oracle"]["occlusion"]) == ["static-camera-00"]
    oracle = Oracle()
    scores = run_benchmark([("oracle", oracle, options)], ["occlusion"], out=out, progress=False)["oracle"]
    assert oracle.calls == ["static-camera-01"] and oracle.options == options
    names = [f"{metric}{part}" for metric in benchmark.METRICS for part in ("", "_dynamic", "_static")]
    for clip in scores["occlusion"].values():
        assert [clip[name] for name in names] == pytest.approx([1.0] * 15)
    with pytest.raises(ValueError, match="static-camera"):
        run_benchmark([("oracle", oracle, options)], ["nonsense"], progress=False)


def test_results_survive_the_file(tmp_path):
    results = {"klt": {"occlusion": {"a": {"OA": 0.123456789, "AJ3D": np.nan}}}}
    save_results(tmp_path / "r.json", results, {"klt": "v1"})
    json.loads((tmp_path / "r.json").read_text(), parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    loaded, versions = load_results(tmp_path / "r.json")
    np.testing.assert_equal(loaded, results)
    assert versions == {"klt": "v1"}
    (tmp_path / "r.json").write_text('{"klt": 3}')
    for path in (tmp_path / "r.json", tmp_path / "absent.json"):
        with pytest.raises(ValueError, match="not a readable JSON file"):
            load_results(path)


def test_finished_clips_are_kept_until_the_tracker_changes(two_clips, tmp_path, monkeypatch):
    tracked, out = [], tmp_path / "r.json"

    def track(self, clip, **_):
        tracked.append(clip.name)
        return clip.tracks

    def run(label, tracker):
        return run_benchmark([(label, tracker, {})], ["occlusion"], out=out, progress=False)

    monkeypatch.setattr(Baseline, "track", track)
    first = run("static", StaticTracker())
    assert list(run("klt", KltTracker())) == ["klt"]
    assert run("static", StaticTracker()) == first and len(tracked) == 4
    run("static", StaticTracker(slack=0.5))
    assert len(tracked) == 6
    assert set(load_results(out)[0]) == {"static", "klt"}


def test_learnt_trackers_run_once_a_space_and_again_with_new_weights(two_clips, tmp_path, monkeypatch):
    model, seen = Tracker(TrackerConfig.preset("lite")), []
    monkeypatch.setattr(Tracker, "track", lambda self, clip, space: seen.append(space) or clip.tracks)
    monkeypatch.setattr(trackers, "load_tracker", lambda *_: model)

    def run():
        runs = trackers.tracker_runs(["runs/a.safetensors"], ["world", "camera"])
        return run_benchmark(runs, ["occlusion"], out=tmp_path / "r.json", progress=False)

    assert [*run()] == ["runs/a · world", "runs/a · camera"] and seen == ["world"] * 2 + ["camera"] * 2
    run()
    assert len(seen) == 4
    next(model.parameters()).data += 1
    run()
    assert len(seen) == 8


def made_up(**trackers):
    rng = np.random.default_rng(3)
    hard = rng.uniform(-0.2, 0.2, 16)
    return {
        label: {
            split: {
                f"{split}-{i:02d}": {
                    m + part: mean + hard[i] for m in benchmark.METRICS for part in ("", "_dynamic", "_static")
                }
                for i in range(16)
            }
            for split in SPLITS
        }
        for label, mean in trackers.items()
    }


def test_tables():
    results = made_up(klt=0.4, lite=0.7)
    rows = summary_table(results, ("OA", "absent"), ["occlusion"]).splitlines()
    assert rows[0] == "| split | tracker | OA | absent |" and len(rows) == 4
    want = bootstrap_interval([clip["OA"] for clip in results["klt"]["occlusion"].values()])
    assert rows[2] == (f"| occlusion (16) | klt | {want.mean:.3f} [{want.low:.3f}, {want.high:.3f}] | nan [nan, nan] |")
    del results["klt"]["occlusion"]["occlusion-03"]
    rows = difference_table(results, "lite", "klt", ("AJ3D",)).splitlines()
    assert rows[0] == "| lite - klt | AJ3D |" and len(rows) == 5
    assert rows[4] == "| occlusion (15) | +0.300 [+0.300, +0.300] |"
    with pytest.raises(ValueError, match="no scores of 'lite' on 'nonsense'"):
        benchmark.estimate(results, "lite", "nonsense", "OA")


def test_figure_draws_means_and_intervals():
    results = made_up(klt=0.4, lite=0.7)
    del results["klt"]["occlusion"]
    figure = score_figure(results, ("AJ3D",))
    assert [ax.get_title() for ax in figure.axes] == list(SPLITS)
    spans = [line.get_xdata() for line in figure.axes[1].lines]
    want = benchmark.estimate(results, "klt", "moving-camera", "AJ3D")
    np.testing.assert_allclose(spans[0], want[1:])
    np.testing.assert_allclose(spans[1], want.mean)
    assert [len(ax.lines) for ax in figure.axes] == [8, 8, 4]
    figure.draw_without_rendering()
    with pytest.raises(ValueError, match="no scores"):
        score_figure({"klt": {}})


def test_command(tmp_path, monkeypatch, capsys):
    arguments = ["--tracker", "static", "--split", "static-camera", "--count", 1, "--out", tmp_path / "r.json"]
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(sys, "argv", ["x", "benchmark", *map(str, arguments), "--figure", str(tmp_path / "f.png")])
    __main__.main()
    shown = capsys.readouterr()
    assert "| static-camera (1) | static |" in shown.out and "AJ3D_none_dynamic" in shown.out
    assert "1/1" in shown.err  # a progress bar
    assert (tmp_path / "f.png").read_bytes().startswith(b"\x89PNG")
    assert len(list((tmp_path / "tapip3d_lite" / "benchmark").glob("static-camera-00-*.npz"))) == 1
    assert list(load_results(tmp_path / "r.json")[0]["static"]["static-camera"]) == ["static-camera-00"]
    monkeypatch.setattr(sys, "argv", ["x", "benchmark", "--split", "nonsense"])
    with pytest.raises(SystemExit) as stop:
        __main__.main()
    assert stop.value.code == 2 and "expected one of static-camera" in capsys.readouterr().err


def test_the_cache_needs_no_home(tmp_path, monkeypatch):
    def homeless():
        raise RuntimeError

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", os.devnull)
    assert lite_splits._cache() == tmp_path / "tapip3d_lite" / "benchmark"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", homeless)
    assert lite_splits._cache() == tmp_path / "tapip3d_lite" / "benchmark"
