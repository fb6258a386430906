"""Misuses of the command line and of the Python interface: each ends in one line that says what is wrong."""

import io
import os
import shlex
import signal
import sys

import numpy as np
import pytest

import tapip3d_lite as t3d
from tapip3d_lite import lab
from tapip3d_lite.__main__ import main
from tapip3d_lite.refusals import refusals
from tests.tiny import SIZES


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder of files, good and bad."""
    folder = tmp_path_factory.mktemp("misuse")
    clip = t3d.simulate_clip(seed=2, frames=6, size=(32, 48), tracks=8)
    clip.save(folder / "clip.npz")
    whole = (folder / "clip.npz").read_bytes()
    (folder / "cut.npz").write_bytes(whole[:3000])
    (folder / "flipped.npz").write_bytes(whole[:2000] + bytes([whole[2000] ^ 255]) + whole[2001:])
    (folder / "empty.npz").write_bytes(b"")
    (folder / "text.npz").write_text("hello")
    (folder / "folder.npz").mkdir()
    t3d.load_clip(folder / "clip.npz", points=False).save(folder / "plain.npz")
    np.savez(folder / "objects.npz", video=np.array([None]))
    np.savez(folder / "other.npz", a=np.zeros(3))
    arrays = {key: getattr(clip, key) for key in ("video", "depths", "intrinsics", "extrinsics")}
    np.savez(folder / "transposed.npz", **arrays | {"intrinsics": clip.intrinsics.swapaxes(1, 2)})
    np.savez(folder / "dark.npz", **arrays | {"depths": 0 * clip.depths})
    np.savez(folder / "fps.npz", **arrays, fps=np.array([1.0, 2.0]))
    t3d.save_weights(t3d.Tracker(t3d.TrackerConfig.preset("lite", **SIZES)), folder / "tiny.safetensors")
    (folder / "cut.safetensors").write_bytes((folder / "tiny.safetensors").read_bytes()[:900])
    (folder / "run").mkdir()
    (folder / "run" / "config.json").write_text('{"steps": "many"}')
    (folder / "run" / "log.jsonl").write_text('{"step": 1}\n[]\nnull\n{"step": "x", "loss": {}}\n')
    (folder / "wrong.json").write_text('{"lite": {"static-camera": 5}}')
    (folder / "list.json").write_text("[1, 2]")
    (folder / "latin.json").write_bytes(b'{"a": "\xe9"}')
    (folder / "deep.json").write_text("[" * 10**5)
    (folder / "study.toml").write_text("rows = 5\n")
    (folder / "study2.toml").write_text("[rows.a]\nnonsense = 1\n")
    (folder / "film.mp4").write_bytes(b"no film")
    os.mkfifo(folder / "pipe")  # nobody ever writes into it
    (folder / "tum").mkdir()
    (folder / "tum" / "rgb.txt").write_text("1.0 absent.png\n")
    (folder / "tum" / "depth.txt").write_text("1.0 absent.png\n")
    (folder / "tum" / "groundtruth.txt").write_text("1.0 a b c d e f g\n")
    return folder


COMMAND_LINES = """

fly
--fly
track
track absent.npz
track cut.npz
track flipped.npz
track empty.npz
track text.npz
track folder.npz
track objects.npz
track other.npz
track transposed.npz
track dark.npz
track fps.npz
track film.mp4
track tum
track /dev/null
track .
track run
track tiny.safetensors
track wrong.json
track clip.npz extra
track clip.npz --grid x
track clip.npz --grid
track clip.npz --grid -1 --no-own-queries --tracker static
track clip.npz --grid 0 --no-own-queries --tracker static
track clip.npz --nonsense 3
track clip.npz --tracker nonsense
track clip.npz --tracker clip.npz
track clip.npz --tracker cut.safetensors
track clip.npz --tracker run
track clip.npz --tracker ""
track clip.npz --format nonsense
track clip.npz --format tum
track clip.npz --format davis
track clip.npz --tracker tiny.safetensors --space moon
track clip.npz --tracker tiny.safetensors --space uvd
track clip.npz --tracker tiny.safetensors --size 0 0
track clip.npz --tracker tiny.safetensors --size -32 32
track clip.npz --tracker tiny.safetensors --size 32
track clip.npz --tracker tiny.safetensors --crop 0 0 0 0
track clip.npz --tracker tiny.safetensors --crop 0 0 100 100
track clip.npz --tracker tiny.safetensors --crop 10 10 5 5
track clip.npz --tracker tiny.safetensors --device cuda
track clip.npz --tracker tiny.safetensors --device mps
track clip.npz --tracker tiny.safetensors --device tpu
track clip.npz --tracker tiny.safetensors --device xla:7
track clip.npz --tracker tiny.safetensors --device ""
track clip.npz --tracker tiny.safetensors --device meta
track clip.npz --tracker static --device tpu
track clip.npz --tracker static --out tracks.xyz
track clip.npz --tracker static --out tracks
track clip.npz --tracker static --out folder.npz
track clip.npz --tracker static --out /proc/nowhere/o.npz
track clip.npz --tracker static --out text.npz/o.npz
track clip.npz --tracker static --html page.txt
track clip.npz --tracker static --html /proc/nowhere/o.html
track clip.npz --tracker static --png picture.jpg
track clip.npz --tracker static --png /proc/nowhere/o.png
track clip.npz --tracker static --out a.csv text.npz/o.csv
track clip.npz --tracker static --pixels /dev/null
track clip.npz --tracker static --pixels pipe
track clip.npz --tracker static --mask clip.npz --dense
track clip.npz --tracker static --mask absent.png
track clip.npz --tracker static --frame 99
track clip.npz --tracker static --grid 99999999999999999999
track pipe
evaluate
evaluate absent.npz
evaluate plain.npz
evaluate plain.npz --tracker
evaluate clip.npz --tracker nonsense
evaluate clip.npz --device tpu --tracker tiny.safetensors
evaluate clip.npz cut.npz --tracker static
evaluate clip.npz --format x
benchmark --split nonsense
benchmark --split
benchmark --tracker
benchmark --figure o.jpg
benchmark --out pipe --tracker static --count 1
benchmark --count 0
benchmark --count -3
benchmark --count x
benchmark --tracker nonsense --count 1
benchmark --space moon --count 1
benchmark --out wrong.json --tracker static --count 1
benchmark --out list.json --tracker static --count 1
benchmark --out latin.json --tracker static --count 1
benchmark --out deep.json --tracker static --count 1
benchmark --out folder.npz --tracker static --count 1
benchmark --device tpu --tracker tiny.safetensors --count 1
demo absent.npz
demo clip.npz --tracker nonsense
demo clip.npz --out text.npz --tracker static
check
check absent.npz
check cut.npz
check dark.npz
check transposed.npz
check clip.npz --format tum
convert clip.npz
convert clip.npz clip.mat
convert absent.npz o.npz
convert cut.npz o.npz
convert clip.npz /proc/nowhere/o.npz
convert clip.npz o.npz --depth absent.npy
convert clip.npz o.npz --frames 0 0 0
convert clip.npz o.npz --frames 0 3
convert tum o.npz --format tum
convert tum o.npz --frames 5 2 1
convert film.mp4 o.npz
simulate
simulate --out x --count 0
simulate --out x --count x
simulate --out x --first-seed -1
simulate --out x --workers -1
simulate --out x --workers 0.5
simulate --out x --workers 0
simulate --out x --count 99999999999999999999
simulate --out x --fps 1e200
simulate --out x --size 99999999 99999999
simulate --out x --frames 9999999999
simulate --out x --tracks 999999999999
simulate --out x --camera moon
simulate --out x --size 32
simulate --out x --size 4 4
simulate --out x --frames 0
simulate --out x --fps nan
simulate --out x --fps inf
simulate --out x --tracks 0
simulate --out x --shapes teapot
simulate --out x --cuont 3
simulate --out text.npz --count 1
simulate --out /proc/nowhere --count 1
train
train --out x --preset nonsense
train --out x --preset
train --out x --matching.pairs 99999999999
train --out x --batch 99999999999999999999
train --out x --sampling.tracks 999999999999
train --out x --device cuda
train --out x --device mps
train --out x --device tpu
train --out x --compiled
train --out x --lr nan
train --out x --lr inf
train --out x --lr -1
train --out x --steps 0
train --out x --steps x
train --out x --batch 0
train --out x --frames 8 40
train --out x --frames 8
train --out x --frames 8 4
train --out x --seed -1
train --out x --threads 0
train --out x --threads -1
train --out x --init absent
train --out x --init cut.safetensors
train --out x --init tiny.safetensors
train --out x --workers -1
train --out x --clips 0
train --out x --precision float8
train --out x --matching.pairs 0
train --out x --matching-steps -1
train --out x --loss nonsense
train --out x --loss no.such:Loss
train --out x --tracker neighbors 0
train --out x --tracker nonsense 1
train --out x --tracker context no.such:Part
train --out x --tracker neighbors
train --out x --average -1
train --out x --evaluate-every 0
train --out run --resume
train --out absent --resume
train --out text.npz
card
card absent wrong.json --hardware x
card run wrong.json --hardware x
card run list.json --hardware x
curves
curves absent
curves run --out picture.txt
curves run --out /proc/nowhere/o.png
curves run
curves clip.npz
curves pipe
curves wrong.json
curves list.json
lab fly
lab run
lab run absent.toml
lab run study.toml
lab run study2.toml
lab table nonsense
lab table list.json
lab table latin.json
lab run clip.npz
lab run coordinates --device tpu
lab run coordinates --budget ""
lab run coordinates --seeds 0
lab report absent
lab table run
import absent.pth o.safetensors
import clip.npz o.safetensors
import tiny.safetensors o.safetensors
import empty.npz o.safetensors
import cut.npz /proc/nowhere/o.safetensors
""".splitlines()[1:]


NOTHING_WRONG = {"lab run"}  # it lists the studies


def call(capfd, line):
    """Exit code and standard error of a command line."""
    code, before = 0, sys.argv
    signal.setitimer(signal.ITIMER_PROF, 60)  # of computing; ends the test's process
    sys.argv = ["tapip3d_lite", *shlex.split(line)]
    try:
        main()
    except SystemExit as error:
        code = error.code or 0
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        sys.argv = before
    return code, capfd.readouterr().err


@pytest.mark.parametrize("line", [line for line in COMMAND_LINES if line not in NOTHING_WRONG])
def test_a_misused_command_says_one_line(capfd, place, monkeypatch, line):
    def began(*_):
        raise AssertionError("the work began")

    monkeypatch.chdir(place)
    for module in ("simulate.dataset", "evaluation.lite_splits"):
        monkeypatch.setattr(f"tapip3d_lite.{module}.run_jobs", began)
    before = sorted(place.rglob("*"))
    code, error = call(capfd, line)
    assert code == 2, (code, error)
    assert error.count("\n") == 1 and error.startswith("error: ") and len(error) < 900, error
    assert "Traceback" not in error and "tyro" not in error and "-X dev" not in error
    left = [path for path in place.rglob("*") if path not in before]
    assert not left, left


def test_an_interrupt_that_a_half_written_file_hides_is_one(capfd):
    with pytest.raises(SystemExit, match="130"), refusals():
        try:
            raise KeyboardInterrupt
        finally:
            raise ValueError("Can't close the ZIP file while there is an open writing handle on it")
    assert capfd.readouterr().err == "interrupted; what was finished is kept\n"


def test_a_terminal_without_our_letters_shows_the_rest(monkeypatch):
    terminal = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", terminal)
    with refusals():
        print("lite · mean", flush=True)
    assert terminal.buffer.getvalue() == b"lite \\xb7 mean\n"


WRONG = {
    "clip": "5 None 'clip.npz' tracks video",
    "queries": "5 'a' [[1,2]] np.zeros((3,3)) np.full((1,4),np.nan) [[0.5,0,0,1]] [[-1,0,0,1]] [[[1],[2,3]]] {'a':1} [None]",
    "space": "5 'moon' True ['world'] b'world'",
    "iterations": "0 -1 1.5 'a' True [2]",
    "support_grid": "-1 1.5 'a' [4]",
    "bidirectional": "'yes' 5 []",
    "depth_roi": "'all' (1,) (1,2,3) 5 ('a','b')",
    "visible_threshold": "2 -1 'a' np.nan [0.5]",
    "size": "5 (32,) (32.5,32) 'ab' (32,32,3)",
    "crop": "5 (0,0,0,0) (0,0,1) (0,0,99,99) 'abcd' (0.5,0,8,8)",
    "progress": "'yes' 3",
}
CALLS = {  # the rest of the call: the argument stands for the star
    "tiny.track(*)": ["clip"],
    **{f"tiny.track(clip, {name}=*)": [name] for name in [*WRONG][1:]},
    "tiny.stream(*)": ["queries"],
    "tiny.stream(clip.queries, support_grid=*)": ["support_grid"],
    "tiny.stream(clip.queries, iterations=*)": ["iterations"],
    "t3d.load_tracker('static').track(*)": ["clip"],
    "t3d.load_tracker('klt').track(clip, *)": ["queries"],
    "t3d.check_queries(clip, *)": ["queries"],
    "t3d.resolve_queries(clip, *)": ["queries"],
    "t3d.resolve_queries(*, None)": ["clip"],
    "t3d.evaluate(tracks, *)": ["clip"],
    "t3d.check_clip(*)": ["clip"],
    "t3d.estimate_poses(*)": ["clip"],
    "t3d.steady_clip(*)": ["clip"],
    "t3d.grid_queries(*)": ["clip"],
    "t3d.export_tracks(tracks, 'o.npz', *)": ["clip"],
}
EXPRESSIONS = (
    [
        (call.replace("*", value), name)
        for call, names in CALLS.items()
        for name in names
        for value in WRONG[name].split()
    ]
    + [
        (f"t3d.Clip(**arrays | {{'{key}': {value}}})", key)
        for key, values in {
            "video": "5 None 'a' video[0] video/255 video[...,:2] video[:0] [[1],[2,3]]",
            "depths": "5 None 'a' depths[0] depths[:3] 0*depths -depths depths*np.nan depths.astype(complex) depths.astype(object)",
            "intrinsics": "5 None K[0] K[:3] K.swapaxes(1,2) -K K*np.nan K*2 K[:,:2]",
            "extrinsics": "5 None E[0] E[:3] E.swapaxes(1,2)+np.eye(4) E*2 E*np.nan E[:,:3] -E",
            "queries": WRONG["queries"],
            "tracks": "5 'a' video [tracks]",
            "name": "5 None b'a' ['a']",
            "fps": "0 -1 'a' None np.nan np.inf [1] 1j",
            "extras": "5 [1] 'a' {'video':5} {1:2} {'a':object}",
        }.items()
        for value in values.split()
    ]
    + [
        (f"t3d.Tracks(**track_arrays | {{'{key}': {value}}})", key)
        for key, values in {
            "xyz": "5 None 'a' tracks.xyz[0] tracks.xyz[...,:2] [[1],[2,3]]",
            "visible": "5 None 'a' tracks.visible[0] tracks.visible*2 tracks.xyz",
            "queries": "5 None 'a' clip.queries[:2] clip.queries*np.nan clip.queries.T",
            "visible_logits": "5 'a' tracks.xyz",
            "dynamic": "5 'a' tracks.visible",
        }.items()
        for value in values.split()
    ]
    + [
        ("t3d.load_clip(5)", "path"),
        ("t3d.load_clip(None)", "path"),
        ("t3d.load_clip([1])", "path"),
        ("t3d.load_clip('')", ""),
        ("t3d.load_clip('clip.npz', 5)", "format"),
        ("t3d.load_clip('clip.npz', 'nonsense')", "format"),
        ("t3d.load_clip('clip.npz', frames=5)", "frames"),
        ("t3d.load_clip('clip.npz', frames=slice(5, 2))", "frames"),
        ("t3d.load_clip('clip.npz', points='no')", "points"),
        ("t3d.load_clip('a\\0b')", ""),
        ("t3d.load_clip(b'clip.npz')", "path"),
        ("t3d.save_clip(5, 'o.npz')", "clip"),
        ("t3d.save_clip(clip, 5)", "path"),
        ("t3d.load_tracks(5)", "path"),
        ("t3d.load_tracks('clip.npz')", "coords"),
        ("t3d.grid_queries(clip, 'a')", "side"),
        ("t3d.grid_queries(clip, 0)", "side"),
        ("t3d.grid_queries(clip, 2.5)", "side"),
        ("t3d.grid_queries(clip, 4, 99)", "frame"),
        ("t3d.grid_queries(clip, 4, 'a')", "frame"),
        ("t3d.grid_queries(clip, 4, 0, 'a')", "margin"),
        ("t3d.grid_queries(clip, 4, 0, np.nan)", "margin"),
        ("t3d.queries_from_pixels(5, [[0, 0, 0]])", "clip"),
        ("t3d.queries_from_pixels(clip, 5)", "pixels"),
        ("t3d.queries_from_pixels(clip, [[0, 99, 0]])", "pixels"),
        ("t3d.queries_from_pixels(clip, [['a', 'b', 'c']])", "pixels"),
        ("t3d.simulate_clip('a')", "seed"),
        ("t3d.simulate_clip(None)", "seed"),
        ("t3d.simulate_clip(1.5)", "seed"),
        ("t3d.simulate_clip(-1)", "seed"),
        ("t3d.simulate_clip(0, 5)", "config"),
        ("t3d.simulate_clip(0, frames='a')", "frames"),
        ("t3d.simulate_clip(0, size=5)", "size"),
        ("t3d.simulate_clip(0, colour=5)", "colour"),
        ("t3d.simulate_clip(0, occluder='yes')", "occluder"),
        ("t3d.evaluate(5, clip)", "pred"),
        ("t3d.evaluate(None, clip)", "pred"),
        ("t3d.evaluate(tracks, t3d.load_clip('plain.npz'))", "tracks"),
        ("t3d.evaluate(tracks.select([0, 1]), clip)", "pred"),
        ("t3d.tapvid3d_metrics(5, 5, 5, 5, 5)", "gt_xyz"),
        ("t3d.tapvid3d_metrics(tracks.xyz, 5, tracks.xyz, tracks.visible, K)", "gt_visible"),
        ("t3d.tapvid3d_metrics(tracks.xyz, tracks.visible, 'a', tracks.visible, K)", "xyz"),
        ("t3d.tapvid3d_metrics(tracks.xyz, tracks.visible, tracks.xyz[1:], tracks.visible, K)", "xyz"),
        ("t3d.tapvid3d_metrics(tracks.xyz, tracks.visible, tracks.xyz, tracks.visible[1:], K)", "visible"),
        ("t3d.tapvid3d_metrics(tracks.xyz, tracks.visible, tracks.xyz, tracks.visible, 5)", "intrinsics"),
        ("t3d.tapvid3d_metrics(tracks.xyz, tracks.visible, tracks.xyz, tracks.visible, K, scaling='a')", "scaling"),
        ("t3d.tapvid3d_metrics(tracks.xyz, tracks.visible, tracks.xyz, tracks.visible, K, scaling=5)", "scaling"),
        ("t3d.tapvid3d_metrics(tracks.xyz, tracks.visible, tracks.xyz, tracks.visible, K, queries=5)", "queries"),
        ("t3d.tapvid2d_metrics(5, 5, 5, 5, 5)", "gt"),
        ("t3d.load_tracker(5)", "name"),
        ("t3d.load_tracker(None)", "name"),
        ("t3d.load_tracker('nonsense')", "nonsense"),
        ("t3d.load_tracker('lite', 5)", "device"),
        ("t3d.load_tracker('lite', 'tpu')", "device"),
        ("t3d.load_tracker('lite', fast='yes')", "fast"),
        ("t3d.load_tracker('lite', parts=5)", "parts"),
        ("t3d.load_weights(5)", "path"),
        ("t3d.load_weights('cut.safetensors')", "cut.safetensors"),
        ("t3d.load_weights('tiny.safetensors', 'tpu')", "device"),
        ("t3d.save_weights(5, 'o')", "tracker"),
        ("t3d.save_weights(tiny, 5)", "path"),
        ("t3d.save_weights(tiny, 'folder.npz')", "folder.npz"),
        ("t3d.load_official(5)", "path"),
        ("t3d.load_official('clip.npz')", "clip.npz"),
        ("t3d.from_official_state(5, {})", "cfg"),
        ("t3d.from_official_state({}, 5)", "state"),
        ("t3d.from_official_state({}, {})", ""),
        ("t3d.Recorder(5, [0])", "tracker"),
        ("t3d.check_queries(clip, [[99, 0, 0, 1]])", "queries"),
        ("t3d.check_queries(clip, [[0, 1e6, 0, 0]])", "queries"),
        ("t3d.Recorder(tiny, columns='a')", "columns"),
        ("t3d.Tracker(5)", "config"),
        ("t3d.Tracker(None)", "config"),
        ("t3d.TrackerConfig.preset('nonsense')", "preset"),
        ("t3d.TrackerConfig.preset(5)", "preset"),
        ("t3d.TrackerConfig(space=5)", "space"),
        ("t3d.TrackerConfig(levels='a')", "levels"),
        ("t3d.TrackerConfig(levels=0)", "levels"),
        ("t3d.TrackerConfig(neighbors=2.5)", "neighbors"),
        ("t3d.TrackerConfig(image_size=128)", "image_size"),
        ("t3d.TrackerConfig(image_size=('a', 'b'))", "image_size"),
        ("t3d.export_tracks(5, 'o.npz', clip)", "tracks"),
        ("t3d.export_tracks(tracks, 5, clip)", "path"),
        ("t3d.export_tracks(tracks, 'o.xyz', clip)", "o.xyz"),
        ("t3d.carry(5, clip, clip)", "tracks"),
        ("t3d.carry(tracks, 5, clip)", "source"),
        ("t3d.carry(tracks, clip, 5)", "target"),
        ("t3d.carry(tracks, clip, clip.cut(0, 3))", "target"),
        ("clip.cut(0, 99)", "stop"),
        ("clip.cut('a', 3)", "start"),
        ("clip.cut(0.5, 3)", "start"),
        ("clip.points('moon')", "space"),
        ("clip.save('o.mat')", "o.mat"),
        ("clip.save(5)", "path"),
        ("tracks.save(5)", "path"),
        ("tiny.track(clip, size=(0, 0))", "images of (0, 0)"),
        ("tiny.track(clip, size=(-32, 32))", "images of (-32, 32)"),
        ("t3d.figures.tracks_3d(5, tracks)", "clip"),
        ("t3d.figures.tracks_3d(clip, 5)", "tracks"),
        ("t3d.figures.overview(5, tracks)", "clip"),
        ("t3d.figures.contact_sheet(None)", "clips"),
        ("t3d.figures.contact_sheet([])", "clips"),
        ("t3d.figures.contact_sheet(clip, frames='a')", "frames"),
        ("t3d.figures.frame_with_tracks(clip, None, 1)", "tracks"),
        ("t3d.figures.frame_with_tracks(clip, tracks, 1, tail='a')", "tail"),
        ("t3d.figures.frame_with_tracks(clip, tracks, 1, ax='a')", "ax"),
        ("t3d.figures.depth_map(clip, 1, ax='a')", "ax"),
        ("t3d.figures.tracks_3d(clip, tracks, tail=0.5)", "tail"),
        ("tracks.select('a')", "select"),
        ("tracks.select(1.5)", "select"),
        ("tracks.select(2**63)", "select"),
        ("tracks.save('x.npz', clip='a')", "clip"),
        ("t3d.track_many(None, clip)", "tracker"),
        ("t3d.grid_queries(clip, 2**63)", "side"),
        ("t3d.SimulationConfig(shapes=np.array('a'))", "shapes"),
        ("t3d.tapvid3d_metrics(tracks.xyz, tracks.visible, tracks.xyz, tracks.visible, {})", "intrinsics"),
        ("t3d.tapvid3d_metrics(tracks.xyz, tracks.visible, tracks.xyz, tracks.visible, 'a')", "intrinsics"),
        ("t3d.stereo_depth(clip.video, clip.video, np.zeros((3, 3)), 0.2)", "intrinsics"),
        ("t3d.Clip(clip.video, clip.depths, clip.intrinsics, clip.extrinsics, fps=1e-30)", "fps"),
        ("t3d.Clip(clip.video, clip.depths, clip.intrinsics, clip.extrinsics, name='a\\0')", "name"),
        (
            "t3d.Clip(clip.video, clip.depths, clip.intrinsics, clip.extrinsics, extras={'a' * 70000: np.zeros(1)})",
            "extras",
        ),
        ("t3d.figures.overview(clip, 5)", "tracks"),
        ("t3d.figures.save_png(5, 'o.png')", "figure"),
        ("t3d.figures.save_png(t3d.figures.overview(clip, tracks), 'o.jpg')", "o.jpg"),
        ("t3d.figures.save_html(5, 'o.html')", "figure"),
        ("lab.Variant(5)", "name"),
        ("lab.Variant('a', nonsense=5)", "nonsense"),
        ("lab.Study(5)", "folder"),
        ("lab.Study('new', 5)", "rows"),
        ("lab.Study('new', [lab.Variant('n2n')], seeds='a')", "seeds"),
        ("lab.Study('new', [lab.Variant('n2n')], budget='a')", "budget"),
    ]
)


@pytest.fixture(scope="module")
def names(place):
    clip = t3d.load_clip(place / "clip.npz")
    arrays = {key: getattr(clip, key) for key in ("video", "depths", "intrinsics", "extrinsics")}
    video, depths, intrinsics, extrinsics = arrays.values()
    track_arrays = {key: getattr(clip.tracks, key) for key in ("xyz", "visible", "queries")}
    return {
        "t3d": t3d, "lab": lab, "np": np, "clip": clip, "tracks": clip.tracks, "arrays": arrays, "video": video,
        "depths": depths, "K": intrinsics, "E": extrinsics, "track_arrays": track_arrays,
        "tiny": t3d.load_tracker(place / "tiny.safetensors"),
    }  # fmt: skip


@pytest.mark.parametrize(("expression", "argument"), EXPRESSIONS, ids=[text for text, _ in EXPRESSIONS])
def test_a_misused_function_names_the_argument(names, place, monkeypatch, expression, argument):
    monkeypatch.chdir(place)
    before = sorted(place.rglob("*"))
    with pytest.raises(ValueError) as error:  # noqa: PT011 (the argument is looked for below)
        eval(expression, dict(names))
    assert argument in str(error.value) and len(str(error.value)) < 2000, str(error.value)
    assert sorted(place.rglob("*")) == before
