"""The command line, as a user calls it."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch

import tapip3d_lite as t3d
from tapip3d_lite.simulate.degrade import wrong_poses
from tests.tiny import ROOT, command


def process(*arguments):
    """A command in a process of its own; `tiny.command` does the same in this one."""
    environment = os.environ | {"COLUMNS": "200", "PYTHONWARNINGS": "error"}
    return subprocess.run(
        [sys.executable, "-m", "tapip3d_lite", *map(str, arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        env=environment,
    )


@pytest.fixture(scope="module")
def clip_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("clip") / "c.npz"
    t3d.simulate_clip(seed=2, frames=6, size=(48, 64), tracks=20).save(path)
    return path


def test_track_writes_result_page_and_picture(clip_file, tmp_path):
    written = ("--out", tmp_path / "o.npz", "--html", tmp_path / "o.html", "--png", tmp_path / "o.png")
    result = process("track", clip_file, "--tracker", "klt", *written)
    assert result.returncode == 0, result.stderr
    assert "AJ3D" in result.stdout and "20 points over 6 frames" in result.stdout
    tracks = t3d.load_tracks(tmp_path / "o.npz")
    expected = t3d.load_tracker("klt").track(t3d.load_clip(clip_file))
    np.testing.assert_array_equal(tracks.xyz, expected.xyz)
    assert "Plotly.newPlot" in (tmp_path / "o.html").read_text()
    assert (tmp_path / "o.png").read_bytes().startswith(b"\x89PNG")


def test_track_on_a_grid(clip_file):
    result = command("track", clip_file, "--tracker", "static", "--no-own-queries", "--grid", "5")
    assert result.returncode == 0, result.stderr
    assert "25 points" in result.stdout and "AJ3D" not in result.stdout


def test_a_steady_clip_is_tracked_better(tmp_path):
    path, scores = tmp_path / "jitters.npz", []
    wrong_poses(t3d.load_clip(ROOT / "data_samples" / "handheld.npz"), 1.0, seed=0, drift=0).save(path)
    for flags in ([], ["--steady"]):
        result = command("track", path, "--tracker", "static", "--out", tmp_path / "out.npz", *flags)
        assert result.returncode == 0, result.stderr
        scores.append(t3d.evaluate(t3d.load_tracks(tmp_path / "out.npz"), t3d.load_clip(path))["AJ3D_none"])
    assert scores[1] > scores[0] + 0.1


def test_evaluate_prints_a_table_with_means(clip_file):
    result = command("evaluate", clip_file, "--tracker", "static", "klt")
    assert result.returncode == 0, result.stderr
    lines = result.stdout.strip().splitlines()
    clip = t3d.load_clip(clip_file)
    expected = t3d.evaluate(t3d.load_tracker("static").track(clip), clip)["AJ3D"]
    assert lines[2].split("|")[2].strip() == f"{expected:.3f}"
    assert [line.split("|")[1].strip() for line in lines[-2:]] == ["static · mean", "klt · mean"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["track", "absent.npz"], "no such file"),
        (["track", "CLIP", "--tracker", "nonsense"], "no tracker 'nonsense'"),
        (["track", "CLIP", "--no-own-queries", "--grid", "0"], "grid_queries"),
        (["simulate", "--out", "x", "--count", "0"], "count"),
        (["evaluate", "PLAIN"], "no true tracks"),
        (["check", "absent.npz"], "no such file"),
        (["check", "CLIP", "--format", "tum"], "format tum is that of a folder"),
        (["convert", "CLIP", "clip.mat"], "written as NAME.npz"),
        (
            ["track", "CLIP", "--out", "tracks.xyz"],
            "this is written as .npz, .csv, .ply, .mp4, .gif, .glb, .rrd, got .xyz",
        ),
        (["import", "absent.pth", "out.safetensors"], "no such file"),
        (["card", "absent", "results.json", "--hardware", "x"], "not a finished training"),
        (["curves", "absent"], "absent"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(clip_file, tmp_path, arguments, message):
    clip = t3d.load_clip(clip_file, points=False)
    clip.save(tmp_path / "plain.npz")
    names = {"CLIP": clip_file, "PLAIN": tmp_path / "plain.npz"}
    result = command(*(names.get(a, a) for a in arguments), cwd=tmp_path)
    assert result.returncode == 2
    assert message in result.stderr and len(result.stderr.strip().splitlines()) == 1


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_missing_gpu_is_an_error_before_clips_are_simulated(tmp_path):
    result = command("train", "--out", tmp_path / "run", "--device", "cuda")
    assert result.returncode == 2 and "no CUDA device" in result.stderr and "leave --device out" in result.stderr
    assert not (tmp_path / "run").exists()


def test_compiling_is_for_a_gpu(tmp_path):
    result = command("train", "--out", tmp_path / "run", "--compiled")
    assert result.returncode == 2 and "add --device cuda, or leave --compiled out" in result.stderr
    assert not (tmp_path / "run").exists()


def test_processes_exit_with_2():
    assert process("fly").returncode == 2
    absent = process("track", "absent.npz")
    assert absent.returncode == 2 and "no such file" in absent.stderr and absent.stderr.count("\n") == 1


def test_usage_errors_also_exit_with_2():
    assert command("fly").returncode == 2
    assert command("track").returncode == 2
    moon = command("simulate", "--out", "x", "--camera", "moon")
    assert moon.returncode == 2
    assert "camera" in moon.stderr and "Traceback" not in moon.stderr


def test_check_names_the_mix_up(clip_file, tmp_path):
    clip = t3d.load_clip(clip_file)
    assert "nothing suspicious" in command("check", clip_file).stdout
    arrays = {k: getattr(clip, k) for k in ("video", "depths", "extrinsics")}
    np.savez(tmp_path / "c.npz", **arrays, intrinsics=clip.intrinsics * np.array([[1 / 64], [1 / 48], [1]]))
    assert "normalised_intrinsics" in command("check", tmp_path / "c.npz").stdout


def test_simulate_writes_and_resumes(tmp_path):
    options = ["simulate", "--out", tmp_path, "--frames", "4", "--size", "32", "32", "--tracks", "8", "--workers", "1"]
    assert command(*options, "--count", "2").returncode == 0
    first = sorted(tmp_path.glob("*.npz"))
    before = [p.stat().st_mtime_ns for p in first]
    assert command(*options, "--count", "3").returncode == 0
    assert len(sorted(tmp_path.glob("*.npz"))) == 3
    assert [p.stat().st_mtime_ns for p in first] == before
