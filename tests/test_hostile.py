"""Files from outside: each is read, or refused with a ValueError in bounded memory, and no other parser sees it."""

import io
import json
import pickle
import struct
import tracemalloc
import zipfile
import zlib
from contextlib import contextmanager

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

import tapip3d_lite as t3d
from tapip3d_lite import archive
from tapip3d_lite.files import load_npz, load_objects
from tapip3d_lite.official import read_checkpoint
from tapip3d_lite.saved import read_saved
from tests.tiny import SIZES


@pytest.fixture
def alone(monkeypatch):
    """No parser but ours is asked."""
    asked = []
    for place, name in ((torch, "load"), (torch.jit, "load"), (np, "load"), (pickle, "Unpickler"), (pickle, "loads")):
        monkeypatch.setattr(place, name, lambda *_, name=name, **__: asked.append(name))
    yield
    assert not asked


@contextmanager
def within(megabytes):
    """The block takes no more memory than that, of what Python and numpy count."""
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < megabytes * 1e6, f"{peak / 1e6:.0f} MB"


def checkpoint():
    """The bytes of a small checkpoint."""
    buffer = io.BytesIO()
    torch.save({"cfg": {"a": 1}, "weight": {"b": torch.arange(6.0).reshape(2, 3).T}}, buffer)
    return buffer.getvalue()


def npz(write=np.savez_compressed):
    buffer = io.BytesIO()
    write(buffer, a=np.arange(50), b=np.ones((2, 3), np.float32))
    return buffer.getvalue()


def directory(data):
    """Where the directory of a zip begins, and the places of its entries."""
    start = struct.unpack("<I", data[-6:-2])[0]
    places, at = [], start
    while data[at : at + 4] == b"PK\1\2":
        places.append(at)
        at += 46 + sum(struct.unpack("<3H", data[at + 28 : at + 34]))
    return start, places


def changed(data, place, new):
    return data[:place] + new + data[place + len(new) :]


def moved(data, by):
    """A zip with `by` bytes before it, its offsets corrected."""
    start, places = directory(data)
    for place in places:
        offset = struct.unpack("<I", data[place + 42 : place + 46])[0]
        data = changed(data, place + 42, struct.pack("<I", offset + by))
    return bytes(by) + changed(data, len(data) - 6, struct.pack("<I", start + by))


def second_directory(data):
    """The same members once more, under other names, in a second directory; the first one's end record is kept."""
    start, _ = directory(data)
    tail = data[start:].replace(b".pkl", b".txt").replace(b"a.npy", b"c.npy")
    return data + changed(tail, len(tail) - 6, struct.pack("<I", len(data)))


def twice(data):
    """Two entries for the first member."""
    start, places = directory(data)
    entry, count = data[places[0] : places[1]], len(places) + 1
    end = struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, count, count, len(data) - 22 - start + len(entry), start, 0)
    return data[:start] + entry + data[start:-22] + end


def stored(data):
    """The same zip as Python writes it, without descriptors and records for large files."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as source, zipfile.ZipFile(buffer, "w") as target:
        for name in source.namelist():
            target.writestr(name, source.read(name))
    return buffer.getvalue()


TWISTS = {
    "zeros behind": lambda data: data + bytes(69_000),
    "one byte behind": lambda data: data + b"\0",
    "a comment": lambda data: data[:-2] + b"\2\0hi",
    "bytes before": lambda data: bytes(64) + data,
    "bytes before, offsets corrected": lambda data: moved(data, 64),
    "a second directory": second_directory,
    "a member twice": twice,
    "another name in the directory": lambda data: changed(data, directory(data)[1][0] + 46, b"X"),
    "another name before the member": lambda data: changed(data, 30, b"X"),
    "another size in the directory": lambda data: changed(data, directory(data)[1][0] + 24, b"\1\0\0\0"),
    "another checksum in both": lambda data: changed(changed(data, directory(data)[1][0] + 16, b"1234"), 14, b"1234"),
    "encrypted": lambda data: changed(changed(data, directory(data)[1][0] + 8, b"\1\0"), 6, b"\1\0"),
    "another method": lambda data: changed(changed(data, directory(data)[1][0] + 10, b"\x0c\0"), 8, b"\x0c\0"),
    "more members than there are": lambda data: changed(data, len(data) - 14, b"\xfe\0\xfe\0"),
    "a directory of no members": lambda data: changed(data, len(data) - 14, b"\0\0\0\0"),
    "a directory outside": lambda data: changed(data, len(data) - 6, b"\xf0\xff\xff\xff"),
    "cut": lambda data: data[:-40],
    "empty": lambda data: b"",
}


@pytest.mark.parametrize("twist", TWISTS)
@pytest.mark.parametrize("kind", ["npz", "checkpoint"])
def test_a_twisted_zip_is_refused(tmp_path, kind, twist, alone):
    (tmp_path / "x").write_bytes(TWISTS[twist](stored(checkpoint()) if kind == "checkpoint" else npz()))
    with pytest.raises(ValueError, match="not a readable"):
        (read_saved if kind == "checkpoint" else load_npz)(tmp_path / "x")


def test_what_torch_and_numpy_write_is_read(tmp_path, alone):
    for data in (checkpoint(), stored(checkpoint())):
        (tmp_path / "x").write_bytes(data)
        cfg, weight = read_checkpoint(tmp_path / "x")
        assert cfg == {"a": 1} and weight["b"].tolist() == [[0, 3], [1, 4], [2, 5]]
    for write in (np.savez, np.savez_compressed):
        (tmp_path / "x").write_bytes(npz(write))
        arrays = load_npz(tmp_path / "x")
        assert (
            arrays["a"].tolist() == list(range(50)) and arrays["b"].dtype == np.float32 and arrays["b"].shape == (2, 3)
        )


def test_torch_end_records_that_disagree(tmp_path, alone):
    data = checkpoint()
    for place in (-98 + 24, -98 + 32, -98 + 40, -98 + 48, -42 + 8, -12, -10, -6):
        (tmp_path / "x").write_bytes(changed(data, len(data) + place, bytes([data[place] ^ 1])))
        with pytest.raises(ValueError, match="not a readable"):
            read_saved(tmp_path / "x")


@pytest.mark.parametrize("behind", [0, 69_000])
@pytest.mark.filterwarnings("ignore:.*torch.jit")
def test_a_torchscript_program_is_not_run(tmp_path, alone, behind):
    torch.jit.save(torch.jit.script(torch.nn.ReLU()), str(tmp_path / "x.pth"))
    (tmp_path / "x.pth").write_bytes((tmp_path / "x.pth").read_bytes() + bytes(behind))
    with pytest.raises(ValueError, match="not a readable" if behind else "TorchScript program is refused"):
        t3d.load_official(tmp_path / "x.pth")


def with_pickle(path, pickled, **others):
    """A checkpoint file of a pickle and other members."""
    with zipfile.ZipFile(path, "w") as target:
        target.writestr("x/data.pkl", pickled)
        for name, content in others.items():
            target.writestr(f"x/{name}", content)


def text(value):
    return b"X" + struct.pack("<I", len(value)) + value.encode()


DTYPE = b"cnumpy\ndtype\n" + text("%s") + b"\x89\x88\x87R"
SCALAR = b"\x80\x02cnumpy.core.multiarray\nscalar\n"
FORGED = b"(K\x03" + text("|") + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
EIGHT = b"c_codecs\nencode\n" + text("AAAAAAAA") + text("latin1") + b"\x86R"
PICKLES = {
    "object scalar": SCALAR + DTYPE.replace(b"%s", b"O8") + FORGED + EIGHT + b"\x86R.",
    "object scalar that denies it": SCALAR
    + DTYPE.replace(b"%s", b"V8")
    + FORGED.replace(b"K\x00", b"K\x3f")
    + EIGHT
    + b"\x86R.",
    "ndarray at an address": b"\x80\x02cnumpy\nndarray\nK\x01\x85" + DTYPE.replace(b"%s", b"O8") + EIGHT + b"\x87R.",
    "list of bytes": b"\x80\x02c__builtin__\nlist\nc__builtin__\nbytes\nJ\x00\xa3\xe1\x11\x85R\x85R.",
    "bytes": b"\x80\x02c__builtin__\nbytes\n\x8a\x06\xff\xff\xff\xff\xff\x7f\x85R.",
    "tuple keys": b"\x80\x02}" + b"K\x01" * 9 + b"(" + b"K\x01" * 9 + b"tNs.",
    "long mark": b"\x80\x02" + b"(" * 1000 + b".",
    "memo": b"\x80\x02]q\x00h\x01a.",
    "recursion": b"\x80\x02]q\x00h\x00a.",
    "after the end": b"\x80\x02]..",
    "two": b"\x80\x02]].",
    "an attribute of torch": b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n}" + text("__defaults__") + b"Nsb.",
    "copyreg": b"\x80\x02ccopyreg\n_reconstructor\n.",
    "stack global": b"\x80\x04\x8c\x02os\x8c\x06system\x93.",
    "extension": b"\x80\x02\x82\x01.",
    "protocol 0": b"(dp0\nS'cfg'\np1\nI1\ns.",
}


@pytest.mark.parametrize("name", PICKLES)
def test_hostile_pickles(tmp_path, alone, name):
    with_pickle(tmp_path / "x.pth", PICKLES[name].replace(text("%s")[:5], b"X\x02\0\0\0"))
    with within(10), pytest.raises(ValueError, match=r"x\.pth"):
        t3d.load_official(tmp_path / "x.pth")


def test_one_text_or_list_is_not_multiplied(tmp_path, alone):
    encode = b"c_codecs\nencode\nh\0h\1\x86R"
    pickled = b"\x80\x02(" + text("A" * 10**6) + b"q\0" + text("latin1") + b"q\1" + 1000 * encode + b"t."
    with_pickle(tmp_path / "x.pth", pickled)
    with within(20):
        assert len(read_saved(tmp_path / "x.pth")) == 1002
    kind = b"cnumpy\ndtype\n" + text("O8") + b"\x85R(K\3" + text("|") + b"NNNtb"
    array = b"cnumpy.core.multiarray\n_reconstruct\n)R(K\1K\2\x85"
    first, second = array + kind + b"q\2\x89](K\1K\1eq\3tb", array + b"h\2\x89h\3tb"
    pickled = b"\x80\x02(" + first + second + b"t."
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "|O", "fortran_order": False, "shape": ()})
    with pytest.raises(ValueError, match="one list in several arrays"):
        load_objects("x.npy", io.BytesIO(head.getvalue() + pickled))
    found = load_objects("x.npy", io.BytesIO(head.getvalue() + pickled.replace(second, b"")))
    assert found[0].tolist() == [1, 1]


def test_numpy_numbers_are_values(tmp_path, alone):
    buffer = io.BytesIO()
    values = [np.float32(2.5), np.float64(-1), np.int64(7), np.uint8(255), np.bool_(True), np.float16(0.5)]
    torch.save({"cfg": values, "weight": {}, "array": np.arange(3)}, buffer)
    (tmp_path / "x.pth").write_bytes(buffer.getvalue())
    assert read_checkpoint(tmp_path / "x.pth")[0] == [2.5, -1, 7, 255, True, 0.5]


def tensor(size, stride, offset=0, count=4, kind="FloatStorage"):
    """A pickle of one tensor of a storage of `count` numbers."""
    numbers = lambda values: b"(" + b"".join(b"\x8a\x08" + struct.pack("<q", x) for x in values) + b"t"  # noqa: E731
    storage = b"(" + text("storage") + b"ctorch\n" + kind.encode() + b"\n" + text("0") + text("cpu")
    storage += b"\x8a\x08" + struct.pack("<q", count) + b"tQ"
    return (
        b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n("
        + storage
        + numbers([offset])[1:-1]
        + numbers(size)
        + numbers(stride)
        + b"\x89Ntb"[:2]
        + b"tR."
    )


@pytest.mark.parametrize(
    "arguments",
    [
        {"size": (5,), "stride": (1,)},
        {"size": (2,), "stride": (4,)},
        {"size": (4,), "stride": (1,), "offset": 1},
        {"size": (4,), "stride": (-1,), "offset": 3},
        {"size": (10**9, 10**9), "stride": (0, 0)},
        {"size": (0, 10**12), "stride": (1, 2**47), "count": 5},
        {"size": (2,), "stride": (2**62,)},
        {"size": (1,), "stride": (1,), "count": 10**12},
        {"size": (2, 2), "stride": (1,)},
    ],
    ids=str,
)
def test_tensors_stay_inside_their_storage(tmp_path, alone, arguments):
    with_pickle(tmp_path / "x.pth", tensor((4,), (1,)), **{"data/0": bytes(16)})
    assert read_saved(tmp_path / "x.pth").tolist() == [0, 0, 0, 0]
    with_pickle(tmp_path / "x.pth", tensor(**arguments), **{"data/0": bytes(16)})
    with within(10), pytest.raises(ValueError, match="not a readable"):
        read_saved(tmp_path / "x.pth")


def laughs(levels, width=10):
    value = "ha"
    for _ in range(levels):
        value = [value] * width
    return value


@pytest.mark.parametrize(
    "cfg",
    [
        laughs(18),
        {"a": [1] * 100} | {str(i): ["${" + (str(i - 1) if i else "a") + "}"] * 100 for i in range(9)},
        {"a" * 10_000: 1},
        {"model": torch.zeros(3)},
        json.loads("[" * 50 + "]" * 50),
    ],
    ids=["lists", "references", "key", "tensor", "deep"],
)
def test_configurations_that_grow(tmp_path, alone, cfg):
    torch.save({"cfg": cfg, "weight": {}}, tmp_path / "x.pth")
    with within(20), pytest.raises(ValueError, match="cfg"):
        read_checkpoint(tmp_path / "x.pth")


@pytest.mark.parametrize(
    "cfg",
    [
        5,
        {},
        {"model": 5},
        {"model": {"image_size": 5}},
        {"model": {}, "train_dataset": 5},
        {"model": {"encoder": {"stride": "4"}}},
        {"model": {"point_updater": {"hidden_size": 10**9}}},
        {"model": {"name": ["x"]}},
        {"model": {"seq_len": {"a": 1}}},
    ],
    ids=str,
)
def test_configurations_of_other_types(tmp_path, alone, cfg):
    torch.save({"cfg": cfg, "weight": {"a": torch.zeros(1)}}, tmp_path / "x.pth")
    with pytest.raises(ValueError, match=r"cfg|TrackerConfig|state"):
        t3d.load_official(tmp_path / "x.pth")


@pytest.mark.parametrize(
    "change",
    [
        {"hidden": 8192, "time_depth": 64, "space_depth": 64},
        {"hidden": 10**9},
        {"window": 10**9},
        {"levels": 10**6},
        {"image_size": [10**9, 10**9]},
        {"image_size": 5},
        {"hidden": "384"},
        {"iterations": None},
        {"mlp_ratio": float("nan")},
        {"use_uv": 1},
        {"nonsense": 1},
    ],
    ids=str,
)
def test_weights_that_ask_for_another_model(tmp_path, change):
    tracker = t3d.Tracker(t3d.TrackerConfig.preset("lite", **SIZES))
    config = json.dumps(tracker.config.to_dict() | change)
    save_file(tracker.state_dict(), tmp_path / "x.safetensors", {"format": "tapip3d_lite", "config": config})
    with within(50), pytest.raises(ValueError, match=r"x\.safetensors"):
        t3d.load_weights(tmp_path / "x.safetensors")


def deflated(size):
    """A zip of one npy of `size` zeros."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as target:
        head = io.BytesIO()
        np.lib.format.write_array(head, np.zeros(0, np.uint8))
        target.writestr(
            "a.npy", head.getvalue().replace(b"(0,), }" + b" " * 9, f"({size},), }}".encode().ljust(16)) + bytes(size)
        )
    return buffer.getvalue()


def test_npz_bombs(tmp_path, alone, monkeypatch):
    monkeypatch.setattr(archive, "_ROOM", 2**20)
    (tmp_path / "x.npz").write_bytes(deflated(10**5))
    assert not load_npz(tmp_path / "x.npz")["a"].any()
    bomb = deflated(3 * 10**7)
    (tmp_path / "x.npz").write_bytes(bomb)
    with within(3), pytest.raises(ValueError, match=r"0\.0 GB in 0\.03 MB"):
        load_npz(tmp_path / "x.npz")
    start, _ = directory(bomb)  # says that it is small, in both places
    small = struct.pack("<I", 1000)
    (tmp_path / "x.npz").write_bytes(changed(changed(bomb, start + 24, small), 22, small))
    with within(5), pytest.raises(ValueError, match="not a readable"):
        load_npz(tmp_path / "x.npz")


@pytest.mark.parametrize(
    "head",
    [
        "{'descr': '<f4', 'fortran_order': False, 'shape': (100000000000,), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (0, 100000000000), }",
        "{'descr': '|V0', 'fortran_order': False, 'shape': (100000000000,), }",
        "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (-1,), }",
        "{'descr': [('a', '|O')], 'fortran_order': False, 'shape': (1,), }",
        "{'descr': '<f4,O', 'fortran_order': False, 'shape': (1,), }",
        "{'descr': '<f3', 'fortran_order': False, 'shape': (1,), }",
        "-" * 9000 + "1",
        "(" * 9000,
        "{'descr': '<f4', 'fortran_order': False, 'shape': (" + "1, " * 9000,
    ],
    ids=lambda head: head[:70],
)
def test_npy_headers(tmp_path, alone, head):
    with zipfile.ZipFile(tmp_path / "x.npz", "w") as target:
        target.writestr("a.npy", b"\x93NUMPY\1\0" + struct.pack("<H", len(head)) + head.encode() + bytes(4))
    with within(3), pytest.raises(ValueError, match="not a readable npz"):
        load_npz(tmp_path / "x.npz")
    with within(3), pytest.raises(ValueError, match="not a readable npz"):
        load_npz(tmp_path / "x.npz", outline=("a",))


def test_sizes_from_a_header_that_a_stream_wrote(tmp_path, alone):
    """Sizes that follow a deflated member."""

    class Stream(io.RawIOBase):
        def __init__(self):
            self.data = b""

        def writable(self):
            return True

        def write(self, data):
            self.data += bytes(data)
            return len(data)

    stream = Stream()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as target, zipfile.ZipFile(io.BytesIO(npz())) as source:
        for name in source.namelist():
            target.writestr(name, source.read(name))
    (tmp_path / "x.npz").write_bytes(stream.data)
    assert load_npz(tmp_path / "x.npz")["a"].tolist() == list(range(50))


def mutants(data, count, seed):
    """Copies with some bytes changed, removed, doubled or exchanged."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        new = bytearray(data)
        for _ in range(rng.integers(1, 4)):
            at, length, kind = int(rng.integers(len(new))), int(rng.integers(1, 9)), rng.integers(4)
            part = new[at : at + length]
            new[at : at + length] = [
                rng.bytes(len(part)),
                b"",
                part * 2,
                bytes(x ^ 1 << int(rng.integers(8)) for x in part),
            ][kind]
        yield bytes(new)


def test_mutants_are_read_or_refused(tmp_path):
    tracker = t3d.Tracker(t3d.TrackerConfig.preset("lite", **SIZES))
    t3d.save_weights(tracker, tmp_path / "weights")
    small = io.BytesIO()
    torch.save({"cfg": {"a": ["${b}", 1.5]}, "weight": {"b": torch.ones(3)}, "c": np.float32(1)}, small)
    files = [
        (checkpoint(), read_checkpoint, 250),
        (stored(small.getvalue()), read_checkpoint, 250),
        (npz(), load_npz, 150),
        (npz(np.savez), load_npz, 150),
        ((tmp_path / "weights").read_bytes()[:3000], t3d.load_weights, 100),
    ]
    refused = 0
    for data, read, count in files:
        for mutant in mutants(data, count, seed=zlib.crc32(data)):
            (tmp_path / "x").write_bytes(mutant)
            try:
                with within(20):
                    read(tmp_path / "x")
            except ValueError:
                refused += 1
    assert refused > 700


def test_one_nan_in_a_weights_file_is_refused(tmp_path):
    tracker = t3d.Tracker(t3d.TrackerConfig.preset("lite", **SIZES))
    t3d.save_weights(tracker, tmp_path / "good")
    state = tracker.state_dict() | {
        "encoder.head.bias": torch.full_like(tracker.state_dict()["encoder.head.bias"], torch.nan)
    }
    config = json.dumps(tracker.config.to_dict())
    save_file(state, tmp_path / "bad", {"format": "tapip3d_lite", "config": config})
    with pytest.raises(ValueError, match=r"encoder\.head\.bias is not finite"):
        t3d.load_tracker(tmp_path / "bad")
    with torch.no_grad():
        tracker.encoder.head.bias[0] = 1e5  # more than 16 bits hold
    t3d.save_weights(tracker, tmp_path / "large")
    with pytest.raises(ValueError, match="not finite"):
        t3d.save_weights(tracker, tmp_path / "half", half=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad", "good", "large"]


def a_clip(**changes):
    depths = np.ones((3, 8, 8))
    eye = np.tile(np.eye(4), (3, 1, 1))
    return t3d.Clip(np.zeros((3, 8, 8, 3), np.uint8), depths, eye[:, :3, :3] + 0.0, eye, **changes)


@pytest.mark.parametrize(
    ("extras", "message"),
    [
        ({"file": np.zeros(3)}, "no key of a clip's file, got 'file'"),
        ({"allow_pickle": np.array(True)}, "got 'allow_pickle'"),
        ({"video": np.zeros(3)}, "got 'video'"),
        ({"fps": np.zeros(3)}, "got 'fps'"),
        ({5: np.zeros(3)}, "got 5"),
        ({"a\0b": np.zeros(3)}, "got 'a"),
        ({"": np.zeros(3)}, "got ''"),
        ({"a": np.array([None])}, "'a': expected numbers or text, got dtype object"),
        ({"a": {"b": 1}}, "got dtype object"),
        ({"a": np.zeros(2, [("x", "f4"), ("y", "O")])}, "expected numbers or text"),
    ],
)
def test_extras_that_no_file_can_hold(extras, message):
    with pytest.raises(ValueError, match=message):
        a_clip(extras=extras)


def test_extras_come_back(tmp_path):
    extras = {
        "text": np.array("né"),
        "empty": np.zeros((0, 3)),
        "flags": np.array([True]),
        "a/b": np.arange(3),
        "c": [1.5, 2],
    }
    a_clip(extras=extras, name="").save(tmp_path / "c.npz")
    again = t3d.load_clip(tmp_path / "c.npz")
    assert again.name == "" and again.extras.keys() == extras.keys()
    assert all(np.array_equal(again.extras[key], extras[key]) for key in extras)
    with pytest.raises(ValueError, match=r"Clip\.name"):
        a_clip(name=None)
    with pytest.raises(ValueError, match=r"Clip\.fps"):
        a_clip(fps="12")
