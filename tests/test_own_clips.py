"""Clips that others wrote: a training uses what it can, and refuses the rest by name before it starts."""

import zipfile
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import tapip3d_lite as t3d
from tapip3d_lite.files import load_npz
from tapip3d_lite.lab import make_trainer
from tapip3d_lite.model.frames import Frames
from tapip3d_lite.training.data import SamplingConfig
from tapip3d_lite.training.examples import Examples, check_clips
from tapip3d_lite.training.loss import LossConfig, Truth, step_loss
from tapip3d_lite.training.pretrain import MatchingConfig, draw_pair
from tapip3d_lite.training.run_folder import read_log
from tapip3d_lite.training.trainer import Trainer
from tests.tiny import recipe


@pytest.fixture
def write(tmp_path, clips):
    """Write a clip's file with some arrays changed: by a value, a function of the old one, or left out (None)."""

    def write(name, source=0, /, **changes):
        arrays = load_npz(clips[source])
        for key, change in changes.items():
            arrays[key] = change(arrays[key]) if callable(change) else change
        path = tmp_path / f"{name}.npz"
        np.savez_compressed(path, **{key: value for key, value in arrays.items() if value is not None})
        return path

    return write


def batch(path, **options):
    return Examples(recipe(train_encoder=True, **options), path if isinstance(path, list) else [path]).batch(20, 20)


def tensors(made):
    return [*vars(made.frames).values(), *vars(made.truth).values(), made.queries, made.dynamic]


def same(one, other):
    return all(torch.equal(a, b) for a, b in zip(tensors(one), tensors(other), strict=True))


def test_a_training_on_clips_that_do_not_say_what_moves(tmp_path, write):
    paths = [write(f"own{i}", i, dynamic=None) for i in range(3)]
    held_out = [t3d.load_clip(path) for path in paths[1:]]
    config = recipe(matching_steps=1, steps=3, evaluate_every=2)
    trainer = make_trainer(tmp_path / "run", config, [str(path) for path in paths[:2]], held_out)
    assert trainer.run(progress=False)
    lines = read_log(tmp_path / "run")
    scored = [line for line in lines if "val_APD3D_none" in line]
    assert [line["step"] for line in scored] == [3, 4] and all(np.isfinite(line["loss"]) for line in lines)
    assert {name for name in scored[0] if name.startswith("val_")} == {"val_AJ3D_none", "val_APD3D_none", "val_OA"}
    assert lines[-1]["apd"] is not None and lines[-1]["apd_dynamic"] is None


def hide(xyz, visible, unknown=np.nan):
    """A third of the tracks is never seen, and where a point is hidden its place is unknown."""
    visible = visible & (np.arange(visible.shape[1]) % 3 > 0)
    return {"tracks": np.where(visible[..., None], xyz, unknown), "visible": visible}


@pytest.mark.parametrize("unknown", [np.nan, np.inf])
def test_hidden_tracks_and_unknown_places_are_harmless(tmp_path, clips, write, unknown):
    paths = []
    for i in range(2):
        arrays = load_npz(clips[i])
        paths.append(write(f"hidden{i}", i, **hide(arrays["tracks"], arrays["visible"], unknown)))
    trainer = Trainer(tmp_path / "run", recipe(matching_steps=2, steps=4, batch=2), paths)
    assert any(trainer.examples.batch(step, step).truth.xyz.isnan().any() for step in range(2, 6))
    assert trainer.run(progress=False)
    changed = trainer.tracker.state_dict()
    assert len(read_log(tmp_path / "run")) == 6 and all(x.isfinite().all() for x in changed.values())


def test_an_unknown_place_is_no_error_and_has_no_gradient():
    torch.manual_seed(0)
    eye = torch.eye(4).expand(1, 4, 4, 4)
    frames = Frames(torch.zeros(1, 4, 3, 32, 32), torch.ones(1, 4, 32, 32), eye[..., :3, :3], eye)
    xyz, truth = torch.rand(1, 4, 3, 3, requires_grad=True), torch.rand(1, 4, 3, 3) + 1
    step = SimpleNamespace(
        scene=SimpleNamespace(frames=frames), start=0, coords=xyz, columns=torch.arange(3), iteration=0,
        active=torch.ones(1, 3, dtype=torch.bool), xyz=xyz, logits=torch.zeros(1, 4, 3),
    )  # fmt: skip
    visible, times = torch.ones(1, 4, 3, dtype=torch.bool), torch.zeros(1, 3, dtype=torch.long)
    whole = step_loss(step, Truth(truth, visible, times), 1, LossConfig())[0]
    truth[:, 2, 1], visible[:, 2, 1] = torch.nan, False
    part = step_loss(step, Truth(truth, visible, times), 1, LossConfig())[0]
    part.backward()
    assert 0 < part < whole
    zero = (xyz.grad == 0).all(-1)[0]
    assert zero[2, 1] and zero.sum() == 1 and xyz.grad.isfinite().all()


def test_clips_of_any_size_length_and_number_of_tracks_meet_in_one_batch(tmp_path, clips, write):
    few = load_npz(clips[1])
    cut = {name: few[name][:6] for name in ("video", "depths", "intrinsics", "extrinsics")}
    cut |= {name: few[name][:6, :5] for name in ("tracks", "visible")} | {"dynamic": few["dynamic"][:5]}
    large = {name: lambda x: x.repeat(2, 1).repeat(2, 2) for name in ("video", "depths")}
    large["intrinsics"] = lambda k: np.diag([2, 2, 1]).astype(np.float32) @ k
    paths = [clips[0], write("short", 1, **cut, query_point=None), write("large", 2, **large)]
    assert load_npz(paths[2])["video"].shape == (8, 64, 64, 3)
    assert Trainer(tmp_path / "run", recipe(matching_steps=2, steps=4, batch=4), paths).run(progress=False)
    names = {name for step in range(4) for name in batch(paths, batch=4).names}
    assert len(names) > 1


def test_the_room_for_features_is_that_of_all_clips(tmp_path, clips, write, monkeypatch):
    cut = {name: lambda x: x[:6] for name in ("video", "depths", "intrinsics", "extrinsics", "tracks", "visible")}
    paths = [clips[0], write("short", 1, **cut, query_point=None)]
    size = (8 + 6) * 16 * 16 * 16 * 2
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=size - 1))
    with pytest.raises(ValueError, match="features of 2 clips"):
        Trainer(tmp_path / "full", recipe(), paths)
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=size))
    Trainer(tmp_path / "room", recipe(), paths)


@pytest.mark.parametrize(
    "changes",
    [
        {"intrinsics": lambda k: k[0]},
        {"fps": None},
        {"query_point": None},
        {"visible": lambda v: v.astype(np.uint8), "dynamic": lambda d: d.astype(float)},
        {"more": np.arange(3), "labels": np.array(["a", "b"])},
        {name: lambda x: x.astype(np.float64) for name in ("depths", "intrinsics", "extrinsics", "tracks")},
    ],
    ids=["one camera", "no fps", "no queries", "numbers", "extra keys", "float64"],
)
def test_what_a_clip_may_be_is_as_good_as_what_we_write(clips, write, changes):
    path = write("own", **changes, name=None)
    check_clips([path], recipe())
    made = batch(path)
    assert same(made, batch(clips[0])) and made.names == ("own",)
    assert draw_pair(path, np.random.default_rng(0), MatchingConfig(), (32, 32)).uv.isfinite().all()
    if "query_point" not in changes:
        assert len(t3d.load_clip(path)) == 8


def test_one_pose_for_all_frames(clips, write):
    arrays = load_npz(clips[0])
    still = np.repeat(arrays["extrinsics"][:1], 8, 0)
    one, all_of_them = write("one", extrinsics=still[0], name=None), write("all", extrinsics=still, name=None)
    assert same(batch(one), batch(all_of_them)) and np.array_equal(t3d.load_clip(one, points=False).extrinsics, still)


def test_a_point_outside_the_image_is_hidden_whatever_the_file_says(clips, write):
    arrays = load_npz(clips[0])
    xyz = arrays["tracks"].copy()
    xyz[:, ::2] += 100
    path = write("outside", tracks=xyz, visible=np.ones_like(arrays["visible"]))
    check_clips([path], recipe())
    made = batch(path, batch=8)
    assert made.queries[..., 1:].abs().max() < 50
    assert not made.truth.visible[(made.truth.xyz.abs() > 50).any(-1)].any()


REFUSED = {
    "no tracks": ({"tracks": None, "visible": None}, "no `tracks` and `visible`.*leave this clip out"),
    "no visible": ({"visible": None}, "no `tracks` and `visible`"),
    "no video": ({"video": None}, "video missing, the file has"),
    "no camera": ({"extrinsics": None}, "extrinsics missing"),
    "bad camera": ({"extrinsics": lambda e: e * 2}, "not a rigid world-to-camera motion"),
    "NaN camera": ({"intrinsics": lambda k: k * np.nan}, "Clip.intrinsics: expected finite numbers"),
    "float video": ({"video": lambda v: v / 255}, "scale .* floats by 255"),
    "no frames": ({"video": lambda v: v[:0]}, "give at least one frame"),
    "other depths": ({"depths": lambda d: d[:, :16]}, r"depths: expected shape \(8, 32, 32\).*got \(8, 16, 32\)"),
    "flat depths": ({"depths": lambda d: d[0]}, r"depths: expected shape \(8, 32, 32\)"),
    "other frames": ({"tracks": lambda x: x[:5], "visible": lambda v: v[:5]}, "Clip.tracks: expected 8 frames"),
    "no track frames": ({"tracks": lambda x: x[:0], "visible": lambda v: v[:0]}, "Clip.tracks: expected 8 frames"),
    "flat tracks": ({"tracks": lambda x: x[0, 0]}, "Tracks.xyz: expected shape"),
    "other visible": ({"visible": lambda v: v[:, :3]}, "Tracks.visible: expected shape"),
    "other dynamic": ({"dynamic": lambda d: d[:3]}, "Tracks.dynamic: expected shape"),
    "NaN where visible": ({"tracks": lambda x: x * np.nan}, "positions are NaN where `visible` is true; set it false"),
    "all hidden": ({"visible": lambda v: v & False}, "no track is visible.*in 20% of any 4 frames; lower `seen`"),
    "zero tracks": ({"tracks": lambda x: x[:, :0], "visible": lambda v: v[:, :0], "dynamic": None}, "no track is vis"),
    "bad fps": ({"fps": np.array(0.0)}, "Clip.fps"),
    "pickled": ({"more": np.array([{}])}, "not a readable npz"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_used_is_refused_by_name_before_there_is_a_folder(tmp_path, clips, write, case):
    changes, message = REFUSED[case]
    path = write("own", **changes)
    with pytest.raises(ValueError, match=rf"1 of 3 clips cannot be used.*\n{path}: (?!{path}).*{message}"):
        Trainer(tmp_path / "run", recipe(), [clips[1], path, clips[2]])
    assert not (tmp_path / "run").exists()


def test_files_that_are_no_clips_are_refused_by_name(tmp_path, clips):
    paths = {name: tmp_path / f"{name}.npz" for name in ("missing", "text", "empty", "bare", "half", "folder")}
    paths["text"].write_text("no clip")
    paths["empty"].touch()
    with open(paths["bare"], "wb") as file:
        np.save(file, np.zeros(3))
    paths["half"].write_bytes(clips[0].read_bytes()[:5000])
    paths["folder"].mkdir()
    for name, path in paths.items():
        what = "no such file" if name in ("missing", "folder") else "not a readable npz"
        with pytest.raises(ValueError, match=rf"1 of 2 clips cannot be used.*\n{path}: {what}"):
            Trainer(tmp_path / "run", recipe(), [clips[0], path])
    with pytest.raises(ValueError, match="6 of 6 clips") as caught:
        check_clips(list(paths.values()), recipe())
    assert len(str(caught.value).splitlines()) == 6  # enough to see what is wrong


def test_short_clips_are_counted_and_named(tmp_path, clips, write):
    cut = {name: lambda x: x[:5] for name in ("video", "depths", "intrinsics", "extrinsics", "tracks", "visible")}
    short = [write(f"short{i}", i, **cut) for i in range(2)]
    with pytest.raises(ValueError, match="2 of 3 clips cannot be used; repair them or leave them out") as caught:
        Trainer(tmp_path / "run", recipe(), [clips[0], *short])
    text = str(caught.value)
    assert all(f"{path}: 5 frames, but an example has up to 6; lower `frames`" in text for path in short)
    Trainer(tmp_path / "run", recipe(frames=(4, 5)), [clips[0], *short])  # 4 frames, as lengths are whole half windows


def damage(path, name, share):
    """Overwrite one array's bytes from a share of them on; the rest of the file stays readable."""
    with zipfile.ZipFile(path) as archive:
        info = archive.getinfo(f"{name}.npy")
    data = bytearray(path.read_bytes())
    names = sum(data[info.header_offset + i] for i in (26, 28))  # lengths, behind which the array begins
    begin = info.header_offset + 30 + names + int(share * info.compress_size)
    data[begin : begin + 40] = b"\xff" * 40
    path.write_bytes(data)
    return path


def test_damaged_bytes(clips, write):
    broken = damage(write("tracks"), "tracks", 0)
    with pytest.raises(ValueError, match=f"{broken}: not a readable npz"):
        check_clips([broken], recipe())
    broken = damage(write("video"), "video", 0.5)
    assert check_clips([broken, clips[0]], recipe()) == [broken, clips[0]]  # images are not read
    examples = Examples(recipe(train_encoder=True), [broken, clips[1]])
    with pytest.warns(UserWarning, match=f"{broken}: not a readable npz.*another example is drawn"):
        names = {examples.batch(step, step).names for step in range(5, 11)}
    assert names == {(t3d.load_clip(clips[1]).name,)}


def test_frames_without_a_visible_track_are_not_drawn(clips, write):
    """In a long clip a point is seen in few frames: every example has them, and depends on its step alone."""
    names = ("video", "depths", "intrinsics", "extrinsics", "tracks", "visible")
    long = {name: lambda x: np.concatenate([x] * 5) for name in names}
    long["visible"] = lambda v: np.concatenate([v & False, v & False, v, v & False, v & False])
    path = write("long", **long)
    check_clips([path], recipe())
    examples = [Examples(recipe(train_encoder=True, batch=2), [path]) for _ in range(2)]
    made = [examples[0].batch(step, step) for step in range(20, 40)]
    assert all(x.truth.visible.any(1).all() for x in made)
    assert all(
        same(examples[1].batch(step, step), x) for step, x in reversed(list(zip(range(20, 40), made, strict=True)))
    )
    config = recipe(sampling=SamplingConfig(tracks=6, seen=0.9), frames=(4, 12))
    with pytest.raises(ValueError, match=r"in 90% of any \d+ frames; lower `seen`"):
        check_clips([path], config)


@pytest.mark.filterwarnings("ignore:.*another example is drawn:UserWarning")
def test_examples_without_depth_are_drawn_again(tmp_path, clips, write):
    """A window without depth, and one of a single pixel, have no scale; a frame without depth is harmless."""
    long = {
        name: lambda x: np.concatenate([x] * 3) for name in ("video", "intrinsics", "extrinsics", "tracks", "visible")
    }
    long["depths"] = lambda d: np.concatenate([d, 0 * d, d]) * (np.arange(24) != 2)[:, None, None]
    path = write("holes", **long)
    options = {"train_encoder": True, "frames": (6, 6), "matching_steps": 2, "steps": 30}
    whole = Examples(recipe(**options), [path])
    with pytest.warns(UserWarning, match=f"{path}: .*no.* valid pixel.*another example is drawn"):
        made = [whole.batch(step, step) for step in range(2, 32)]
    half = [(x.frames.depths > 0).flatten(2).any(-1)[0] for x in made]
    assert all(x[:4].any() and x[2:].any() for x in half) and not all(x.all() for x in half)
    alone = Examples(recipe(**options), [path])
    assert all(same(alone.batch(step, step), x) for step, x in reversed(list(zip(range(2, 32), made, strict=True))))
    trainer = Trainer(tmp_path / "run", recipe(**options | {"steps": 8}), [path])
    assert trainer.run(progress=False)
    empty = write("empty", depths=lambda d: 0 * d)
    with pytest.raises(ValueError, match=f"none of 100 could be used; the last: {empty}: Clip.depths: no valid pixel"):
        batch(empty)


@pytest.mark.filterwarnings("ignore:.*another example is drawn:UserWarning")
def test_augmentation_that_hides_the_only_track(tmp_path, clips, write):
    arrays = load_npz(clips[0])
    best = arrays["visible"].mean(0).argmax()
    one = {name: arrays[name][:, best : best + 1] for name in ("tracks", "visible")} | {"dynamic": None}
    path = write("one", **one, query_point=None)
    config = recipe(train_encoder=True, augment=True, matching_steps=2, steps=5, batch=2)
    assert Trainer(tmp_path / "run", config, [path]).run(progress=False)


def test_two_frames_that_share_no_point_are_no_pair(write):
    path = write("blink", visible=lambda v: np.eye(*v.shape, dtype=bool) & v)
    with pytest.raises(ValueError, match="no point is visible in both"):
        draw_pair(path, np.random.default_rng(0), MatchingConfig(), (32, 32))


def test_held_out_clips_that_cannot_be_scored_are_refused_before_the_training(tmp_path, clips, write):
    plain = t3d.load_clip(write("plain", tracks=None, visible=None))
    with pytest.raises(ValueError, match="clip 'simulated_0' has no true tracks"):
        make_trainer(tmp_path / "run", recipe(), clips, [plain])
    dark = t3d.load_clip(write("dark", depths=lambda d: d * (np.arange(8) > 5)[:, None, None]))
    with pytest.raises(ValueError, match="4 consecutive frames have no valid pixel"):
        make_trainer(tmp_path / "run", recipe(), clips, [dark])
    assert not (tmp_path / "run").exists()
    arrays = load_npz(clips[0])
    hidden = t3d.load_clip(write("hidden", **hide(arrays["tracks"], arrays["visible"])))
    nothing = {name: lambda x: x[:, :0] for name in ("tracks", "visible")} | {"dynamic": lambda d: d[:0]}
    nobody = t3d.load_clip(write("nobody", **nothing, query_point=lambda q: q[:0]))
    trainer = make_trainer(tmp_path / "run", recipe(matching_steps=0, steps=1), clips, [hidden, nobody])
    assert trainer.run(progress=False) and np.isfinite(read_log(tmp_path / "run")[-1]["val_APD3D_none"])
