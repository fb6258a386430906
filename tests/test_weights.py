"""Weight files: the authors' checkpoint is read exactly and without trust, ours round-trip."""

import io
import os
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

import tapip3d_lite as t3d
from tapip3d_lite.official import plain

SHARED = Path(__file__).resolve().parents[2] / "shared" / "golden"
CHECKPOINT = SHARED / "checkpoint_small.pth"
needs_checkpoint = pytest.mark.skipif(
    not CHECKPOINT.exists(), reason="the authors' checkpoint is not beside this checkout"
)


def tiny(**changes):
    torch.manual_seed(0)
    sizes = {"image_size": (32, 48), "window": 4, "levels": 2, "neighbors": 4, "feature_dim": 16, "token_dim": 16}
    return t3d.Tracker(t3d.TrackerConfig.preset("lite").replace(**(sizes | changes))).eval()


@needs_checkpoint
def test_the_authors_checkpoint_gives_the_authors_results():
    tracker = t3d.load_official(CHECKPOINT)
    with np.load(SHARED / "checkpoint_small_expected.npz") as data:
        clip = t3d.Clip(
            np.round(np.moveaxis(data["in.rgb"], 1, -1) * 255).astype(np.uint8),
            *(data[f"in.{key}"] for key in ("depth", "intrinsics", "extrinsics")),
        )
        quantised = np.abs(np.moveaxis(clip.video, -1, 1) / np.float32(255) - data["in.rgb"]).max()
        for space, name in (("world", "raw"), ("camera", "local")):
            options = {"space": space, "iterations": 2, "support_grid": 0, "bidirectional": False, "depth_roi": None}
            tracks = tracker.track(clip, data["in.query_point"], **options)
            error = np.abs(tracks.xyz - data[f"{name}.coords"]).max()
            assert error < (1e-4 if quantised < 1e-6 else 5e-2)


class Danger:
    """Pickles as a call of any importable function."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def dangers(canary):
    code = f"__import__('pathlib').Path({str(canary)!r}).touch()"
    return {
        "os.system": Danger(os.system, f"touch {canary}"),
        "exec": Danger(exec, code),
        "eval": Danger(eval, code),
        "nested": {"state": [torch.zeros(2), {"deep": Danger(eval, code)}]},
        "open": Danger(open, str(canary), "w"),
        "torch.load": Danger(torch.load, str(canary)),
        "torch.hub": Danger(torch.hub.load, "somebody/something", "model"),
        "getattr": Danger(getattr, "os", "system"),
        "numpy.load": Danger(np.load, str(canary)),
        "import": Danger(__import__, "antigravity"),
    }


@pytest.mark.parametrize("kind", dangers("x"))
@pytest.mark.parametrize("legacy", [False, True], ids=["zip", "legacy"])
def test_a_malicious_pickle_is_refused_and_not_run(tmp_path, kind, legacy):
    canary, path = tmp_path / "canary", tmp_path / "bad.pth"
    content = {"cfg": {"model": {}}, "weight": {"a": torch.zeros(3)}, "optimizer": dangers(canary)[kind]}
    torch.save(content, path, _use_new_zipfile_serialization=not legacy)
    with pytest.raises(ValueError, match="before 1.6" if legacy else "refused"):
        t3d.load_official(path)
    assert not canary.exists()


def test_the_same_pickle_would_run_elsewhere(tmp_path):
    canary = tmp_path / "canary"
    torch.save({"a": dangers(canary)["exec"]}, tmp_path / "bad.pth")
    torch.load(tmp_path / "bad.pth", weights_only=False)
    assert canary.exists()  # so the refusals above prove something


def test_a_class_that_pretends_to_be_a_config_is_recorded_and_not_called(tmp_path):
    import sys
    import types

    module = types.ModuleType("omegaconf.fake")
    called = []

    class Node:
        def __reduce__(self):
            return Node.make, (1,)

        @staticmethod
        def make(value):
            called.append(value)

    Node.__module__, Node.__qualname__ = "omegaconf.fake", "Node"
    Node.make.__module__, Node.make.__qualname__ = "omegaconf.fake", "make"
    module.Node, module.make = Node, Node.make
    sys.modules |= {"omegaconf": types.ModuleType("omegaconf"), "omegaconf.fake": module}
    try:
        torch.save({"cfg": Node()}, tmp_path / "c.pth")
        with pytest.raises(ValueError, match="weight missing"):
            t3d.load_official(tmp_path / "c.pth")
    finally:
        del sys.modules["omegaconf"], sys.modules["omegaconf.fake"]
    assert called == []


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda p: None, "no such file"),
        (lambda p: p.write_bytes(b""), "not a readable checkpoint"),
        (lambda p: p.write_bytes(b"\x80\x02}q\x00."), "not a readable checkpoint"),
        (lambda p: p.write_text("hello"), "not a readable checkpoint"),
        (lambda p: torch.save({"cfg": {}}, p), "weight missing"),
        (lambda p: torch.save([1, 2], p), "cfg and weight missing in list"),
        (lambda p: torch.save({"cfg": {"a": "${a}"}, "weight": {}}, p), "refers to itself"),
        (lambda p: torch.save({"cfg": {"model": {"name": "other"}}, "weight": {}}, p), "name"),
    ],
)
def test_other_files_are_value_errors(tmp_path, write, message):
    write(tmp_path / "x.pth")
    with pytest.raises(ValueError, match=message):
        t3d.load_official(tmp_path / "x.pth")


def test_truncated_and_torchscript_archives(tmp_path):
    torch.save({"cfg": {}, "weight": {"a": torch.zeros(1000)}}, tmp_path / "x.pth")
    data = (tmp_path / "x.pth").read_bytes()
    (tmp_path / "cut.pth").write_bytes(data[: len(data) // 2])
    with pytest.raises(ValueError, match="not a readable checkpoint"):
        t3d.load_official(tmp_path / "cut.pth")
    with zipfile.ZipFile(tmp_path / "script.pth", "w") as archive:
        archive.writestr("x/constants.pkl", b"")
    with pytest.raises(ValueError, match="TorchScript"):
        t3d.load_official(tmp_path / "script.pth")


@needs_checkpoint
def test_gpu_files_and_extra_entries_load(tmp_path):
    """The same parameters, tagged as saved from a GPU and with a trainer's luggage beside them."""
    reference = t3d.load_official(CHECKPOINT)
    parameter = torch.nn.Parameter(torch.zeros(3))
    optimizer = torch.optim.AdamW([parameter])
    parameter.grad = torch.ones(3)
    optimizer.step()
    luggage = {"optimizer": optimizer.state_dict(), "step": np.float64(3), "epoch": 7, "dtype": torch.bfloat16}
    with (
        zipfile.ZipFile(CHECKPOINT) as source,
        zipfile.ZipFile(tmp_path / "gpu.pth", "w", zipfile.ZIP_STORED) as target,
    ):
        for name in source.namelist():
            content = source.read(name)
            if name.endswith("data.pkl"):
                content = content.replace(b"X\x03\x00\x00\x00cpu", b"X\x06\x00\x00\x00cuda:0")
            target.writestr(name, content)
    moved = t3d.load_official(tmp_path / "gpu.pth")
    for (name, a), (_, b) in zip(reference.state_dict().items(), moved.state_dict().items(), strict=True):
        assert b.device.type == "cpu"
        torch.testing.assert_close(a, b, rtol=0, atol=0, msg=name)
    torch.save(luggage, tmp_path / "luggage.pth")
    with pytest.raises(ValueError, match="cfg and weight missing in optimizer, step, epoch, dtype"):
        t3d.load_official(tmp_path / "luggage.pth")  # read whole, though it holds no model


def test_plain_configuration_passes_through():
    assert plain({"a": [1, (2, 3)], "b": {"c": None}}) == {"a": [1, [2, 3]], "b": {"c": None}}


def test_our_weights_round_trip(tmp_path):
    tracker = tiny()
    t3d.save_weights(tracker, tmp_path / "w.safetensors")
    again = t3d.load_tracker(tmp_path / "w.safetensors")
    assert again.config == tracker.config and not again.training
    clip = t3d.simulate_clip(seed=1, frames=6, size=(32, 48), tracks=5)
    a, b = (t.track(clip, support_grid=2, iterations=1) for t in (tracker, again))
    np.testing.assert_array_equal(a.xyz, b.xyz)


def test_foreign_and_broken_safetensors(tmp_path):
    from safetensors.torch import save_file

    save_file({"a": torch.zeros(1)}, tmp_path / "foreign.safetensors")
    with pytest.raises(ValueError, match="another program"):
        t3d.load_weights(tmp_path / "foreign.safetensors")
    (tmp_path / "cut.safetensors").write_bytes((tmp_path / "foreign.safetensors").read_bytes()[:20])
    with pytest.raises(ValueError, match="not a readable safetensors"):
        t3d.load_weights(tmp_path / "cut.safetensors")
    save_file({"a": torch.zeros(1)}, tmp_path / "x.safetensors", {"format": "tapip3d_lite", "config": _config(tiny())})
    with pytest.raises(ValueError, match="do not fit"):
        t3d.load_weights(tmp_path / "x.safetensors")
    bits = {name: value.view(torch.int32) for name, value in tiny().state_dict().items()}
    save_file(bits, tmp_path / "bits.safetensors", {"format": "tapip3d_lite", "config": _config(tiny())})
    with pytest.raises(ValueError, match=r"expected torch.float32, got torch.int32"):
        t3d.load_weights(tmp_path / "bits.safetensors")


def _config(tracker):
    import json

    return json.dumps(tracker.config.to_dict())


def test_a_custom_part_cannot_be_saved(tmp_path):
    from tapip3d_lite.model.neighbors import KNearest

    tracker = tiny(neighborhood=lambda config: KNearest(config))
    with pytest.raises(ValueError, match="custom part"):
        t3d.save_weights(tracker, tmp_path / "w.safetensors")
    assert not list(tmp_path.iterdir())


def with_pickle(path, pickled):
    """A checkpoint file whose pickle is the given bytes."""
    torch.save({"a": torch.zeros(2)}, path)
    with zipfile.ZipFile(path) as source:
        entries = {name: source.read(name) for name in source.namelist()}
    with zipfile.ZipFile(path, "w") as target:
        for name, content in entries.items():
            target.writestr(name, pickled if name.endswith("data.pkl") else content)


def test_a_pickle_cannot_change_torch_itself(tmp_path):
    """BUILD sets attributes of any object that a pickle finds, here a function's default arguments."""
    before = torch._utils._rebuild_tensor_v2.__defaults__
    build = b"N}X\x0c\x00\x00\x00__defaults__K\x01K\x02K\x03\x87s\x86b."
    with_pickle(tmp_path / "x.pth", b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n" + build)
    with pytest.raises(ValueError, match=r"x\.pth"):
        t3d.load_official(tmp_path / "x.pth")
    assert torch._utils._rebuild_tensor_v2.__defaults__ == before


@pytest.mark.parametrize(
    "pickled",
    [
        b"\x80\x02c__builtin__\nlist\n\x8a\x06\xff\xff\xff\xff\xff\x7f\x85R.",
        b"\x80\x02K\x05Q.",  # a storage that is no tuple: an assertion inside torch
        b"\x80\x02.",
    ],
    ids=["memory", "storage", "empty"],
)
def test_damaged_pickles_are_value_errors(tmp_path, pickled):
    with_pickle(tmp_path / "x.pth", pickled)
    with pytest.raises(ValueError, match="not a readable checkpoint"):
        t3d.load_official(tmp_path / "x.pth")


@needs_checkpoint
def test_flipped_bytes_never_raise_anything_else(tmp_path):
    rng = np.random.default_rng(0)
    with zipfile.ZipFile(CHECKPOINT) as source:
        pickled = next(source.read(name) for name in source.namelist() if name.endswith("data.pkl"))
    for _ in range(20):
        damaged = bytearray(pickled)
        for place in rng.integers(0, len(damaged), 3):
            damaged[place] = rng.integers(256)
        with_pickle(tmp_path / "x.pth", bytes(damaged))
        with pytest.raises(ValueError, match=r"x\.pth|cfg|state|TrackerConfig"):
            t3d.load_official(tmp_path / "x.pth")  # the storages are not there, so it can never succeed


@pytest.mark.parametrize("weight", [5, [torch.zeros(1)], {"a": 1}])
def test_weights_that_are_no_tensors(tmp_path, weight):
    torch.save({"cfg": {"model": {}}, "weight": weight}, tmp_path / "x.pth")
    with pytest.raises(ValueError, match="named tensors"):
        t3d.load_official(tmp_path / "x.pth")


def test_allowed_numpy_scalars(tmp_path):
    buffer = io.BytesIO()
    torch.save({"a": np.float32(2), "b": np.arange(3)}, buffer)
    (tmp_path / "n.pth").write_bytes(buffer.getvalue())
    with pytest.raises(ValueError, match="missing in a, b"):
        t3d.load_official(tmp_path / "n.pth")
