"""Reading what `torch.save` wrote without trusting it: a zip of a pickle, which is a program, and of tensors' bytes.

This reader carries out the few instructions that build containers. What the program would import is a mere name here,
and what it would call is looked up in a list and built by our own code: tensors from the archive's bytes, numbers.
Objects of configuration libraries become inert records, so these need not be installed. All else is refused by name.
"""

from __future__ import annotations

import math
import pickletools
import re
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tapip3d_lite.archive import Archive

_TYPES = "bool bytes complex dict float frozenset int list long set slice str tuple"
_STORAGES = {"CharStorage": torch.int8, "ByteStorage": torch.uint8}
_STORAGES |= {f"{x}Storage": getattr(torch, x.lower()) for x in ("Double", "Float", "Half", "BFloat16", "Long", "Int")}
_STORAGES |= {"ShortStorage": torch.int16, "BoolStorage": torch.bool}
_DTYPES = {str(x)[6:] for x in vars(torch).values() if isinstance(x, torch.dtype)}
_ARRAYS = {"scalar", "_reconstruct"}
_KNOWN = {
    "builtins": _TYPES.split(),
    "__builtin__": _TYPES.split(),  # of Python 2
    "collections": {"OrderedDict", "defaultdict"},
    "torch": {"Size", "device", *_DTYPES, *_STORAGES},
    "torch._utils": {"_rebuild_tensor", "_rebuild_tensor_v2", "_rebuild_parameter"},
    "numpy": {"dtype", "ndarray"},
    "numpy.core.multiarray": _ARRAYS,
    "numpy._core.multiarray": _ARRAYS,
    "_codecs": {"encode"},  # how numpy writes bytes at protocol 2
}
_RECORDED = {"omegaconf", "box", "typing", "pathlib", "argparse"}
_RECORDED |= {"addict", "easydict", "munch", "yacs", "ml_collections"}
_MOST = 2**22  # bytes of a pickle; each makes at most some hundred in memory
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_VALUES = "BININT BININT1 BININT2 LONG1 LONG4 BINFLOAT BINUNICODE SHORT_BINUNICODE BINUNICODE8 BINBYTES SHORT_BINBYTES"
_VALUES = {*_VALUES.split(), "BINBYTES8", *_CONSTANTS}
_MARKED = -1  # all since the last mark
_TAKES = {"APPEND": 1, "APPENDS": _MARKED, "ADDITEMS": _MARKED, "SETITEM": 2, "SETITEMS": _MARKED}
_TAKES |= {"TUPLE": _MARKED, "TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3, "FROZENSET": _MARKED}
_TAKES |= {"REDUCE": 2, "NEWOBJ": 2, "BUILD": 1, "BINPERSID": 1, "STACK_GLOBAL": 2}


class Name(NamedTuple):
    """What a pickle wanted to import."""

    module: str
    name: str


class Record(dict):
    """An object that a pickle describes: its items, its class, the arguments it is made of, and its state."""

    def __init__(self, kind: Name, arguments: tuple) -> None:
        super().__init__()
        self.kind, self.arguments, self.state = kind, arguments, {}


def read_saved(path: str | Path) -> Any:
    """The content of a file that `torch.save` wrote: containers, numbers, text, tensors on the CPU, and `Record`s.

    Sets are lists; types and functions are `Name`s.

    Raises:
        ValueError: no such file, a damaged one, one that would import something else, a TorchScript program, a file of
            torch before 1.6, or a pickle of more than 4 MiB.
    """
    if not Path(path).is_file():
        raise ValueError(f"{path}: no such file; check the path")
    try:
        with open(path, "rb") as file:
            return _Reader(Archive(file)).content()
    except _Refused as error:
        raise ValueError(
            f"{path}: {error} is refused: a checkpoint needs no such thing, and it could run code on this machine"
        ) from None
    except Exception as error:  # the instructions of a damaged pickle fail in any way
        raise ValueError(
            f"{path}: not a readable checkpoint ({error or type(error).__name__}); it may be truncated, or of torch before "
            "1.6: load and save that with a newer torch"
        ) from error


class _Refused(Exception):
    """What has no place in a file of tensors."""


class _Reader:
    """Carries out a pickle's instructions on a stack."""

    def __init__(self, archive: Archive) -> None:
        sizes = archive.sizes
        if any(name.endswith("constants.pkl") or "/code/" in name for name in sizes):
            raise _Refused("a TorchScript program")
        pickles = [name for name in sizes if name.count("/") == 1 and name.endswith("/data.pkl")]
        if len(pickles) != 1 or sizes[pickles[0]] > _MOST:
            raise ValueError(f"one data.pkl of at most {_MOST} bytes expected, got {len(pickles)}")
        self.archive, self.folder = archive, pickles[0].removesuffix("data.pkl")
        order = self.folder + "byteorder"
        if order in sizes and archive.read(order) != sys.byteorder.encode():
            raise ValueError("numbers in another byte order")
        self.stack, self.marks, self.memo, self.storages = [], [], {}, {}

    def content(self) -> Any:
        """The one object of the pickle."""
        pickled, place = bytes(self.archive.read(self.folder + "data.pkl")), -1
        for instruction, argument, place in pickletools.genops(pickled):  # noqa: B007
            if instruction.name in _VALUES:
                self.stack.append(_CONSTANTS.get(instruction.name, argument))
            elif instruction.name not in ("PROTO", "FRAME", "STOP"):
                self._do(instruction.name, argument, self._take(_TAKES.get(instruction.name, 0)))
        if place + 1 != len(pickled) or len(self.stack) != 1 or self.marks:
            raise ValueError("a pickle of more or fewer objects than one")
        return self.stack[0]

    def _take(self, count: int) -> list:
        if count == _MARKED:
            items, self.stack = self.stack, self.marks.pop()
            return items
        if count > len(self.stack):
            raise ValueError("a pickle that takes what is not there")
        items = self.stack[len(self.stack) - count :]
        del self.stack[len(self.stack) - count :]
        return items

    def _do(self, name: str, argument: Any, items: list) -> None:
        stack, memo = self.stack, self.memo
        match name:
            case "MARK":
                self.marks.append(stack)
                self.stack = []
            case "EMPTY_LIST" | "EMPTY_SET":
                stack.append([])
            case "EMPTY_DICT":
                stack.append({})
            case "EMPTY_TUPLE" | "TUPLE" | "TUPLE1" | "TUPLE2" | "TUPLE3" | "FROZENSET":
                stack.append(tuple(items))
            case "APPEND" | "APPENDS" | "ADDITEMS":
                _as(list, stack[-1]).extend(items)
            case "SETITEM" | "SETITEMS":
                _put(_as(dict, stack[-1]), items)
            case "BINPUT" | "LONG_BINPUT" | "MEMOIZE":
                memo[len(memo) if argument is None else argument] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                stack.append(memo[argument])
            case "GLOBAL" | "STACK_GLOBAL":
                stack.append(_known(*(items or argument.split(" ", 1))))
            case "REDUCE" | "NEWOBJ":
                stack.append(self._made(_as(Name, items[0]), _as(tuple, items[1])))
            case "BUILD" if isinstance(stack[-1], Record):
                stack[-1].state = items[0] if isinstance(items[0], dict) else {"state": items[0]}
            case "BUILD":
                _as(dict, stack[-1])  # torch notes versions of modules as an attribute of a state dict
            case "BINPERSID":
                stack.append(self._storage(*_as(tuple, items[0])))
            case _:
                raise ValueError(f"instruction {name} in a pickle")

    def _made(self, kind: Name, arguments: tuple) -> Any:
        """What a call is replaced by."""
        match tuple(kind):
            case "torch._utils", "_rebuild_parameter":
                return _as(Tensor, arguments[0])
            case "torch._utils", _:
                return _tensor(*arguments[:4])
            case "collections", _ if all(x is None or isinstance(x, Name) for x in arguments):
                return {}
            case "builtins" | "__builtin__", "set" | "frozenset" | "list" | "tuple" if arguments:
                return arguments[0] if isinstance(arguments[0], list) else _as(tuple, arguments[0])
            case "torch", "Size":
                return _as(tuple, arguments[0])
            case (("numpy.core.multiarray" | "numpy._core.multiarray"), "scalar"):
                return _number(*arguments)
        return Record(kind, arguments)

    def _storage(self, kind: str, type_: Name, key: str, _device: str, count: int) -> Tensor:
        name, dtype = f"{self.folder}data/{key}", _STORAGES[_as(Name, type_).name]
        if kind != "storage" or type_.module != "torch" or self.archive.sizes[name] != count * dtype.itemsize:
            raise ValueError(f"{kind} {key} of {count} {dtype} in {self.archive.sizes[name]} bytes")
        if (name, dtype) not in self.storages:
            data = self.storages.setdefault(name, self.archive.read(name) if name not in self.storages else None)
            wide = torch.uint8 if dtype == torch.bool else dtype
            found = torch.frombuffer(data, dtype=wide) if data else torch.empty(0, dtype=wide)
            self.storages[name, dtype] = found.ne(0) if dtype == torch.bool else found  # else neither true nor false
        return self.storages[name, dtype]


def _as(kind: type, value: Any) -> Any:
    if not isinstance(value, kind) or (kind is tuple and isinstance(value, Name)):
        raise ValueError(f"a {kind.__name__} expected in a pickle, got {type(value).__name__}")
    return value


def _known(module: str, name: str) -> Name:
    if name not in _KNOWN.get(module, ()) and module.split(".")[0] not in _RECORDED:
        raise _Refused(f"{module}.{name}"[:200])
    return Name(module, name)


def _put(target: dict, items: list) -> None:
    for key, value in zip(items[::2], items[1::2], strict=True):
        # A dictionary is arbitrarily slow with keys whose hashes the file may choose, as those of long tuples and integers.
        words = isinstance(key, tuple) and len(key) <= 8 and all(isinstance(x, str) for x in key)
        if not (words or key is None or isinstance(key, str) or (isinstance(key, int) and abs(key) < 2**60)):
            raise ValueError(f"a key of type {type(key).__name__} in a pickle")
        target[key] = value


def _tensor(storage: Tensor, offset: int, size: tuple[int, ...], stride: tuple[int, ...]) -> Tensor:
    count, values = _as(Tensor, storage).numel(), (offset, *_as(tuple, size)[:64], *_as(tuple, stride)[:64])
    if not all(type(x) is int and 0 <= x < 2**48 for x in values) or not len(size) == len(stride) <= 8:
        raise ValueError("a tensor of no shape")
    if math.prod(size) == 0:
        return storage.new_empty([min(x, 2**16) for x in size])
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if last >= count or math.prod(size) > count:
        raise ValueError(f"a tensor of shape {size} in a storage of {count} numbers")
    return storage.as_strided(size, stride, offset)


def _number(kind: Record, data: Any) -> Any:
    """The value of a numpy scalar, whose bytes are Latin-1 text at protocol 2."""
    data = _as(str, data.arguments[0])[:16].encode("latin-1") if isinstance(data, Record) else _as(bytes, data)
    code, order = _as(str, _as(Record, kind).arguments[0]), kind.state.get("state", "?|")[1]
    if not re.fullmatch("[fiu][248]|[iub]1", code) or len(data) != int(code[1]) or order not in ("<", ">", "|", "="):
        raise ValueError("a numpy scalar that is no number")
    return np.frombuffer(data, order + code)[0].item()
