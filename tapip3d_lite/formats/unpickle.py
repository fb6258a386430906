"""Object arrays of npy files, read by a pickle machine that builds data and cannot run code.

A pickle is a program. This one may name a handful of NumPy's constructors; in their place stand inert records of what
they were given, from which arrays are made afterwards. Any other name is refused before anything is called.
"""

from __future__ import annotations

import pickle
import re
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np


class _Record:
    """A call in the pickle: its arguments and the state set afterwards, as data."""

    def __init__(self, *arguments: Any) -> None:
        self.arguments, self.state = arguments, None

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Bytes:
    """`_codecs.encode(text, "latin1")` and `bytes()`: how protocols 0 to 2 write bytes."""

    def __new__(cls, text: str = "", _encoding: str = "") -> bytes:
        return text.encode("latin1")


_Dtype, _Array, _Scalar, _Buffer = (type(name, (_Record,), {}) for name in ("_Dtype", "_Array", "_Scalar", "_Buffer"))
_FOUND = {("numpy", "dtype"): _Dtype, ("numpy", "ndarray"): _Record, ("_codecs", "encode"): _Bytes}
_FOUND |= {("__builtin__", "bytes"): _Bytes, ("builtins", "bytes"): _Bytes}
for _core in ("numpy.core", "numpy._core"):
    _FOUND |= {(f"{_core}.multiarray", "_reconstruct"): _Array, (f"{_core}.multiarray", "scalar"): _Scalar}
    _FOUND[f"{_core}.numeric", "_frombuffer"] = _Buffer  # protocol 5


class _Machine(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> type:
        if (module, name) not in _FOUND:
            raise pickle.UnpicklingError(f"it names {module}.{name}, which such a file does not need: refused")
        return _FOUND[module, name]


def load_objects(path: str | Path, file: BinaryIO) -> Any:
    """The content of an open npy file: an array, or the dictionary that `np.save` pickled as an array of no dimension.

    Raises:
        ValueError: not an npy file, damaged, or a pickle that asks for more than arrays and plain containers.
    """
    try:
        major, minor = np.lib.format.read_magic(file)
        shape, fortran, dtype = getattr(np.lib.format, f"read_array_header_{major}_{minor}")(file)
        if not dtype.hasobject:
            return _shaped(file.read(), dtype, shape, fortran)
        value = _built(_Machine(file).load())
        return value.item() if isinstance(value, np.ndarray) and value.shape == () else value
    except Exception as error:  # a damaged pickle fails in any way
        raise ValueError(f"{path}: not a readable file of arrays ({type(error).__name__}: {error})") from None


def _built(value: Any) -> Any:
    """Records as arrays and scalars, inside containers too."""
    if isinstance(value, _Array):
        _, shape, dtype, fortran, data = value.state
        if not dtype.arguments[0].startswith("O"):
            return _shaped(data, _dtype(dtype), shape, fortran)
        array = np.empty(len(data), object)
        array[:] = [_built(item) for item in data]
        return array.reshape(shape, order="F" if fortran else "C")
    if isinstance(value, _Buffer):
        data, dtype, shape, order = value.arguments
        return _shaped(data, _dtype(dtype), shape, order == "F")
    if isinstance(value, _Scalar):
        return _shaped(value.arguments[1], _dtype(value.arguments[0]), (), False)[()]
    if isinstance(value, dict):
        return {key: _built(item) for key, item in value.items()}
    if isinstance(value, _Record | type):
        raise pickle.UnpicklingError(f"{value!r} stands where data should")
    return type(value)(map(_built, value)) if isinstance(value, list | tuple) else value


def _dtype(record: Any) -> np.dtype:
    code, order = record.arguments[0], record.state[1]
    if not re.fullmatch(r"[biufcSU]\d+", code):
        raise pickle.UnpicklingError(f"an array of dtype {code} is refused")
    return np.dtype(order + code)


def _shaped(data: bytes, dtype: np.dtype, shape: tuple[int, ...], fortran: bool) -> np.ndarray:
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C").copy()
