"""Reading and writing files; a crash while writing leaves the old file or the new one, never half of one."""

from __future__ import annotations

import hashlib
import os
import tempfile
import zipfile
import zlib
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; rename it onto `path` on success, delete it on any error.

    The parent folder is made when missing.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)  # mkstemp makes it private; a result should be as readable as any file
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file (UTF-8) atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def load_npz(path: str | Path, skip: Collection[str] = (), outline: Collection[str] = ()) -> dict[str, np.ndarray]:
    """The arrays of an npz file without those to skip, only zeros for an `outline`; an unreadable file is a ValueError."""
    try:
        # An open file of our own: np.load leaks the one it opens when the zip turns out to be broken.
        with open(path, "rb") as file:
            data = np.load(file, allow_pickle=False)
            if not isinstance(data, np.lib.npyio.NpzFile):
                raise ValueError("it holds one bare array, not named ones")
            return {k: _outline(data, k) if k in outline else data[k] for k in data.files if k not in skip}
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file; check the path") from None
    except (ValueError, EOFError, OSError, zipfile.BadZipFile, zlib.error, KeyError, NotImplementedError) as error:
        raise ValueError(
            f"{path}: not a readable npz ({error}); it may be truncated, pickled or of another format"
        ) from error


def _outline(data: np.lib.npyio.NpzFile, key: str) -> np.ndarray:
    with data.zip.open(f"{key}.npy") as file:
        major, minor = np.lib.format.read_magic(file)
        shape, _, dtype = getattr(np.lib.format, f"read_array_header_{major}_{minor}")(file)
    return np.broadcast_to(np.zeros((), dtype), shape)


def save_npz(path: str | Path, arrays: Mapping[str, np.ndarray | None]) -> None:
    """Write a compressed npz atomically, without what is None."""
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **{key: value for key, value in arrays.items() if value is not None})


def shipped_weights() -> dict[str, Path]:
    """The weights files that come with the library, by name."""
    return {path.stem: path for path in (Path(__file__).parent / "weights").glob("*.safetensors")}


def digest(*contents: bytes | str) -> str:
    """Twelve letters that identify some contents."""
    total = hashlib.sha256()
    for content in contents:
        total.update(content.encode() if isinstance(content, str) else content)
    return total.hexdigest()[:12]
