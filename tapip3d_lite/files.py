"""Reading and writing files; a crash while writing leaves the old file or the new one, never half of one."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import re
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np

from tapip3d_lite.archive import Archive
from tapip3d_lite.pickled import Machine, Refused, with_arrays
from tapip3d_lite.validate import checked

try:
    import fcntl
except ImportError:  # Windows, where nothing is locked
    fcntl = None

T = TypeVar("T")
_HEAD = 2**10  # bytes in which an array's header must end
_HEADER = re.compile(
    rb"\{ *'descr': *'(\|O|[<>|=]?[?biufcSUVMm]\d*(?:\[\w+\])?)', *'fortran_order': *(True|False), "
    rb"*'shape': *\(((?:\d+, *)*\d*)\),? *\}\s*"
)


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; rename it onto `path` on success, delete it on any error.

    The parent folder is made when missing. A link is written through, and a file that is there keeps its permissions; what
    is no regular file is a ValueError.
    """
    path = Path(os.path.realpath(path))
    if path.exists() and not path.is_file():
        raise ValueError(f"{path}: expected the name of a file, but this is a folder or a device; name another")
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        mode = path.stat().st_mode & 0o777 if path.exists() else 0o666 & ~umask  # mkstemp makes it private
        temporary.chmod(mode)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def locked(path: str | Path, what: str) -> Iterator[None]:
    """Hold a lock file while the block runs; ValueError that says `what` is in use if another process does.

    It holds the owner's number. The system releases it however a process ends, so one that is left over locks nothing.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "a+") as file:
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not (path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat())):
                raise BlockingIOError  # its owner has just removed it
        except BlockingIOError:
            file.seek(0)
            raise ValueError(
                f"{what} is in use by process {file.read(20) or 'unknown'} ({path}); wait for it, or choose another folder"
            ) from None
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def regular(path: str | Path) -> Path:
    """The path of a regular file; ValueError for a device or a pipe, of which no end is known, and where there is none."""
    if not Path(path).is_file():
        raise ValueError(f"{path}: no such file, or a folder, a device or a pipe; check the path")
    return Path(path)


def for_opencv(path: str | Path) -> str:
    """A path as text; ValueError where it is no UTF-8, of which OpenCV dies."""
    try:
        return str(path).encode() and str(path)
    except UnicodeEncodeError:
        raise ValueError(f"{path!r}: this name is no UTF-8, which OpenCV needs; rename it") from None


def write_text(path: str | Path, text: str) -> None:
    """Write a text file (UTF-8) atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_json(path: str | Path, make: Callable[[dict], T] = dict) -> T:
    """What `make` makes of the dictionary in a JSON file; an unreadable file, or one that it cannot use, is a ValueError."""
    try:
        return make(json.loads(regular(path).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
        raise ValueError(f"{path}: not a readable JSON file ({error}); repair it, or choose another") from error


def load_npz(
    path: str | Path, skip: Collection[str] = (), outline: Collection[str] = (), objects: Collection[str] = ()
) -> dict[str, np.ndarray]:
    """The arrays of an npz file without those to skip, only zeros for an `outline`; an unreadable file is a ValueError.

    Memory is taken only for what the file's length and each array's header agree upon. Arrays of `objects` are pickles,
    and read as `load_objects` does.
    """
    regular(path)
    try:
        with open(path, "rb") as file:
            archive, arrays = Archive(file), {}
            for member, size in archive.sizes.items():
                key = member.removesuffix(".npy")
                if key == member:
                    raise ValueError(f"it holds {member}, which is no array")
                if key in objects:
                    arrays[key] = load_objects(f"{path}: {key}", io.BytesIO(archive.read(member)))
                elif key not in skip:
                    dtype, shape, order, start = _npy_header(archive.head(member, _HEAD), size)
                    zeros = np.broadcast_to(np.zeros((), dtype), shape) if key in outline else None
                    arrays[key] = _array(archive.read(member), dtype, shape, order, start) if zeros is None else zeros
            return arrays
    except (ValueError, TypeError, OSError, MemoryError, zlib.error) as error:
        raise ValueError(f"{path}: not a readable npz ({error}); truncated, pickled or of another format?") from error


def npz_keys(path: str | Path) -> set[str]:
    """The names of an npz file's arrays; none where it is no readable one."""
    try:
        with open(regular(path), "rb") as file:
            return {name.removesuffix(".npy") for name in Archive(file).sizes}
    except (ValueError, OSError):
        return set()


def map_npy(path: str | Path) -> np.ndarray:
    """The array of an npy file, read from the disk where it is used; an unreadable file is a ValueError."""
    try:
        size = regular(path).stat().st_size
        with open(path, "rb") as file:
            dtype, shape, order, start = _npy_header(file.read(_HEAD), size)
        return np.memmap(path, dtype, "r", start, shape, order)
    except (ValueError, TypeError, OSError) as error:
        raise ValueError(f"{path}: not a readable npy ({error}); it may be truncated or of another format") from error


def load_objects(path: str | Path, file: BinaryIO) -> Any:
    """The content of an open npy file: an array, or the dictionary that `np.save` pickled as an array of no dimension.

    Raises:
        ValueError: not an npy file, damaged, or a pickle that asks for more than arrays and plain containers.
    """
    try:
        data = file.read()
        dtype, shape, order, start = _npy_header(data[:_HEAD], len(data), objects=True)
        if not dtype.hasobject:
            return _array(bytearray(data), dtype, shape, order, start)
        value = with_arrays(Machine().run(data[start:]))
        return value.item() if isinstance(value, np.ndarray) and value.shape == () else value
    except Refused as error:
        raise ValueError(f"{path}: it names {error}, which such a file does not need: refused") from None
    except Exception as error:  # a damaged pickle fails in any way
        raise ValueError(f"{path}: not a readable file of arrays ({type(error).__name__}: {error})") from None


def _npy_header(head: bytes, size: int, objects: bool = False) -> tuple[np.dtype, tuple[int, ...], str, int]:
    """dtype, shape, order and start of the data of an npy file of `size` bytes, from its first ones."""
    wide = 2 if head[6:7] == b"\1" else 4
    start = 8 + wide + int.from_bytes(head[8 : 8 + wide], "little")
    found = _HEADER.fullmatch(head[8 + wide : start]) if head[:6] == b"\x93NUMPY" else None
    if found is None or start > len(head):
        raise ValueError("an array without a header that is known, perhaps of objects")
    dtype, shape = np.dtype(found[1].decode()), tuple(map(int, found[3].replace(b",", b" ").split()))
    count = math.prod(shape)
    if dtype.hasobject and objects:
        return dtype, shape, "C", start  # a pickle follows
    if (
        dtype.hasobject
        or not dtype.itemsize
        or start + count * dtype.itemsize != size
        or math.prod(x or 1 for x in shape) > count + 2**24
    ):
        raise ValueError(f"an array of shape {shape} and {dtype} in {size} bytes")
    return dtype, shape, "F" if found[2] == b"True" else "C", start


def _array(data: bytearray, dtype: np.dtype, shape: tuple[int, ...], order: str, start: int) -> np.ndarray:
    array = np.frombuffer(data, dtype, offset=start) if len(data) > start else np.empty(0, dtype)
    array = array.view(np.uint8) != 0 if dtype.kind == "b" else array  # other bytes would be neither true nor false
    return np.require(array.reshape(shape, order=order), requirements="A")


def check_suffix(path: str | Path, *allowed: str) -> str:
    """The suffix of a path, in lower case; ValueError unless it is one of those allowed."""
    suffix = Path(path).suffix.lower()
    if suffix not in allowed:
        raise ValueError(f"{path}: this is written as {', '.join(allowed)}, got {suffix or 'no suffix'}; rename it")
    return suffix


@checked
def save_npz(path: str | Path, arrays: Mapping[str, np.ndarray | None]) -> None:
    """Write a compressed npz atomically, without what is None; another suffix is a ValueError."""
    check_suffix(path, ".npz")
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
        for key, value in arrays.items():
            if value is not None:
                with archive.open(f"{key}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, np.asanyarray(value), allow_pickle=False)


def shipped_weights() -> dict[str, Path]:
    """The weights files that come with the library, by name."""
    return {path.stem: path for path in (Path(__file__).parent / "weights").glob("*.safetensors")}


def digest(*contents: bytes | str) -> str:
    """Twelve letters that identify some contents."""
    total = hashlib.sha256()
    for content in contents:
        total.update(content.encode() if isinstance(content, str) else content)
    return total.hexdigest()[:12]
