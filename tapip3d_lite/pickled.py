"""Reading pickles from outside without trusting them. A pickle is a program; this reader runs none of its calls.

It carries out the few instructions that build containers. What the program would import is a mere name here, and what it
would call is looked up in a list and made by our own code: numbers, text, numpy's arrays. All else is refused by name.
"""

from __future__ import annotations

import pickletools
import re
from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np

_TYPES = "bool bytes complex dict float frozenset int list long set slice str tuple"
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_VALUES = "BININT BININT1 BININT2 LONG1 LONG4 BINFLOAT BINUNICODE SHORT_BINUNICODE BINUNICODE8 BINBYTES SHORT_BINBYTES"
_VALUES = {*_VALUES.split(), "BINBYTES8", "BYTEARRAY8", *_CONSTANTS}
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


class Refused(ValueError):
    """A pickle names what has no place in a file of numbers."""


class Machine:
    """Carries out a pickle's instructions on a stack; what it reads are containers, numbers, text and `Record`s.

    Sets are lists; types and functions are `Name`s.
    """

    recorded: Collection[str] = ()
    known: dict[str, Collection[str]] = {  # noqa: RUF012
        "builtins": _TYPES.split(),
        "__builtin__": _TYPES.split(),  # of Python 2
        "collections": {"OrderedDict", "defaultdict"},
        "numpy": {"dtype", "ndarray"},
        "numpy.core.multiarray": {"scalar", "_reconstruct"},
        "numpy._core.multiarray": {"scalar", "_reconstruct"},
        "numpy.core.numeric": {"_frombuffer"},
        "numpy._core.numeric": {"_frombuffer"},
        "_codecs": {"encode"},  # how numpy writes bytes at protocol 2
    }

    def __init__(self) -> None:
        self.stack, self.marks, self.memo, self.encoded = [], [], {}, {}

    def run(self, pickled: bytes) -> Any:
        """The one object of a pickle of protocol 2 or later."""
        place = -1
        for instruction, argument, place in pickletools.genops(pickled):  # noqa: B007
            if instruction.name in _VALUES:
                self.stack.append(_CONSTANTS.get(instruction.name, argument))
            elif instruction.name not in ("PROTO", "FRAME", "STOP"):
                self._do(instruction.name, argument, self._take(_TAKES.get(instruction.name, 0)))
        if place + 1 != len(pickled) or len(self.stack) != 1 or self.marks:
            raise ValueError("a pickle of more or fewer objects than one")
        return self.stack[0]

    def made(self, kind: Name, arguments: tuple) -> Any:
        """What a call is replaced by."""
        match tuple(kind):
            case "collections", _ if all(x is None or isinstance(x, Name) for x in arguments):
                return {}
            case "builtins" | "__builtin__", "set" | "frozenset" | "list" | "tuple" if arguments:
                return arguments[0] if isinstance(arguments[0], list) else expected(tuple, arguments[0])
            case "builtins" | "__builtin__", "bytes" if not arguments:
                return b""
            case "_codecs", _:
                text = expected(str, arguments[0])  # each once: a pickle may encode one text a million times
                return self.encoded.setdefault(text, self.encoded.get(text) or text.encode("latin-1"))
            case _, "scalar":
                return _number(*arguments)
            case _, "_frombuffer":
                data, dtype, shape, order = arguments
                return _array(data, dtype, shape, order == "F")
        return Record(kind, arguments)

    def stored(self, *_: Any) -> Any:
        """What lies outside the pickle."""
        raise ValueError("a pickle that refers to another file")

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
                expected(list, stack[-1]).extend(items)
            case "SETITEM" | "SETITEMS":
                _put(expected(dict, stack[-1]), items)
            case "BINPUT" | "LONG_BINPUT" | "MEMOIZE":
                memo[len(memo) if argument is None else argument] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                stack.append(memo[argument])
            case "GLOBAL" | "STACK_GLOBAL":
                stack.append(self._named(*(items or argument.split(" ", 1))))
            case "REDUCE" | "NEWOBJ":
                stack.append(self.made(expected(Name, items[0]), expected(tuple, items[1])))
            case "BUILD" if isinstance(stack[-1], Record):
                stack[-1].state = items[0] if isinstance(items[0], dict) else {"state": items[0]}
            case "BUILD":
                expected(dict, stack[-1])  # torch notes versions of modules as an attribute of a state dict
            case "BINPERSID":
                stack.append(self.stored(*expected(tuple, items[0])))
            case _:
                raise ValueError(f"instruction {name} in a pickle")

    def _named(self, module: str, name: str) -> Name:
        if name not in self.known.get(module, ()) and module.split(".")[0] not in self.recorded:
            raise Refused(f"{module}.{name}"[:200])
        return Name(module, name)


def expected(kind: type, value: Any) -> Any:
    """The value, if it is of a type, else ValueError."""
    if not isinstance(value, kind) or (kind is tuple and isinstance(value, Name)):
        raise ValueError(f"a {kind.__name__} expected in a pickle, got {type(value).__name__}")
    return value


def _put(target: dict, items: list) -> None:
    for key, value in zip(items[::2], items[1::2], strict=True):
        # A dictionary is arbitrarily slow with keys whose hashes the file may choose, as those of long tuples and integers.
        words = isinstance(key, tuple) and len(key) <= 8 and all(isinstance(x, str) for x in key)
        if not (words or key is None or isinstance(key, str) or (isinstance(key, int) and abs(key) < 2**60)):
            raise ValueError(f"a key of type {type(key).__name__} in a pickle")
        target[key] = value


def _number(kind: Record, data: bytes) -> Any:
    """The value of a numpy scalar."""
    array = _array(data, kind, (), False)
    if array.dtype.kind not in "fiub":
        raise ValueError("a numpy scalar that is no number")
    return array.item()


def _array(data: bytes, kind: Record, shape: tuple, fortran: bool) -> np.ndarray:
    code, state = expected(str, expected(Record, kind).arguments[0]), kind.state.get("state", "?|")
    if not re.fullmatch(r"[fiu][248]|[biu]1|c8|c16|[SU]\d{1,6}", code) or state[1] not in ("<", ">", "|", "="):
        raise ValueError(f"an array of dtype {code[:20]}")
    values = np.frombuffer(data, np.dtype(state[1] + code))
    if code == "b1" and values.view(np.uint8).max(initial=0) > 1:
        raise ValueError("a flag that is neither true nor false")
    return values.reshape(expected(tuple, shape), order="F" if fortran else "C")


def with_arrays(value: Any, done: dict[int, Any] | None = None) -> Any:
    """Containers with the arrays that records in them describe; ValueError for one that holds itself, or other records."""
    done = {} if done is None else done
    if not isinstance(value, dict | list | tuple):
        return value
    if id(value) in done:  # each once, though a pickle may hold one list a billion times
        if done[id(value)] is None:
            raise ValueError("a container that holds itself")
        return done[id(value)]
    done[id(value)] = None
    if isinstance(value, Name | Record) and getattr(getattr(value, "kind", None), "name", "") != "_reconstruct":
        raise ValueError(f"{getattr(value, 'kind', value)} stands where data should")
    if isinstance(value, Record):
        _, shape, kind, fortran, data = value.state["state"]
        if kind.arguments[0] == "O8":
            if id(expected(list, data)) in done:
                raise ValueError("one list in several arrays")
            done[id(data)], new = None, np.empty(len(data), object)
            new[:] = [with_arrays(item, done) for item in data]
            new = new.reshape(shape, order="F" if fortran else "C")
        else:
            new = _array(data, kind, shape, fortran)
    elif isinstance(value, dict):
        new = {key: with_arrays(item, done) for key, item in value.items()}
    else:
        new = type(value)(with_arrays(item, done) for item in value)
    done[id(value)] = new
    return new
