"""Reading what `torch.save` wrote without trusting it: a zip of a pickle (see `pickled`), and of tensors' bytes.

Tensors are made from the archive's bytes by our own code. Objects of configuration libraries become inert records, so
these need not be installed.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from tapip3d_lite.archive import Archive
from tapip3d_lite.files import regular
from tapip3d_lite.pickled import Machine, Name, Refused, expected

_STORAGES = {"CharStorage": torch.int8, "ByteStorage": torch.uint8}
_STORAGES |= {f"{x}Storage": getattr(torch, x.lower()) for x in ("Double", "Float", "Half", "BFloat16", "Long", "Int")}
_STORAGES |= {"ShortStorage": torch.int16, "BoolStorage": torch.bool}
_DTYPES = {str(x)[6:] for x in vars(torch).values() if isinstance(x, torch.dtype)}
_MOST = 2**22  # bytes of a pickle; each makes at most some hundred in memory


def read_saved(path: str | Path) -> Any:
    """The content of a file that `torch.save` wrote: what `pickled.Machine` makes, and tensors on the CPU.

    Raises:
        ValueError: no such file, a damaged one, one that would import something else, a TorchScript program, a file of
            torch before 1.6, or a pickle of more than 4 MiB.
    """
    regular(path)
    try:
        with open(path, "rb") as file:
            reader = _Reader(Archive(file))
            return reader.run(bytes(reader.archive.read(reader.folder + "data.pkl")))
    except Refused as error:
        raise ValueError(
            f"{path}: {error} is refused: a checkpoint needs no such thing, and it could run code on this machine"
        ) from None
    except Exception as error:  # the instructions of a damaged pickle fail in any way
        raise ValueError(
            f"{path}: not a readable checkpoint ({error or type(error).__name__}); it may be truncated, or of torch before "
            "1.6: load and save that with a newer torch"
        ) from error


class _Reader(Machine):
    recorded = ("omegaconf", "box", "typing", "pathlib", "argparse", "addict", "easydict", "munch", "yacs")
    recorded += ("ml_collections",)
    known = Machine.known | {
        "torch": {"Size", "device", *_DTYPES, *_STORAGES},
        "torch._utils": {"_rebuild_tensor", "_rebuild_tensor_v2", "_rebuild_parameter"},
    }

    def __init__(self, archive: Archive) -> None:
        super().__init__()
        sizes = archive.sizes
        if any(name.endswith("constants.pkl") or "/code/" in name for name in sizes):
            raise Refused("a TorchScript program")
        pickles = [name for name in sizes if name.count("/") == 1 and name.endswith("/data.pkl")]
        if len(pickles) != 1 or sizes[pickles[0]] > _MOST:
            raise ValueError(f"one data.pkl of at most {_MOST} bytes expected, got {len(pickles)}")
        self.archive, self.folder, self.storages = archive, pickles[0].removesuffix("data.pkl"), {}
        order = self.folder + "byteorder"
        if order in sizes and archive.read(order) != sys.byteorder.encode():
            raise ValueError("numbers in another byte order")

    def made(self, kind: Name, arguments: tuple) -> Any:
        match tuple(kind):
            case "torch._utils", "_rebuild_parameter":
                return expected(Tensor, arguments[0])
            case "torch._utils", _:
                return _tensor(*arguments[:4])
            case "torch", "Size":
                return expected(tuple, arguments[0])
        return super().made(kind, arguments)

    def stored(self, kind: str, type_: Name, key: str, _device: str, count: int) -> Tensor:
        name, dtype = f"{self.folder}data/{key}", _STORAGES[expected(Name, type_).name]
        if kind != "storage" or type_.module != "torch" or self.archive.sizes[name] != count * dtype.itemsize:
            raise ValueError(f"{kind} {key} of {count} {dtype} in {self.archive.sizes[name]} bytes")
        if (name, dtype) not in self.storages:
            data = self.storages.setdefault(name, self.archive.read(name) if name not in self.storages else None)
            wide = torch.uint8 if dtype == torch.bool else dtype
            found = torch.frombuffer(data, dtype=wide) if data else torch.empty(0, dtype=wide)
            self.storages[name, dtype] = found.ne(0) if dtype == torch.bool else found  # else neither true nor false
        return self.storages[name, dtype]


def _tensor(storage: Tensor, offset: int, size: tuple[int, ...], stride: tuple[int, ...]) -> Tensor:
    count = expected(Tensor, storage).numel()
    values = (offset, *expected(tuple, size)[:64], *expected(tuple, stride)[:64])
    if not all(type(x) is int and 0 <= x < 2**48 for x in values) or not len(size) == len(stride) <= 8:
        raise ValueError("a tensor of no shape")
    if math.prod(size) == 0:
        return storage.new_empty([min(x, 2**16) for x in size])
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if last >= count or math.prod(size) > count:
        raise ValueError(f"a tensor of shape {size} in a storage of {count} numbers")
    return storage.as_strided(size, stride, offset)
