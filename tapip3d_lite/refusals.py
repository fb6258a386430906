"""What a command says where it cannot go on: one line, and exit code 2, or 1 for a lost worker, 130 for Ctrl-C."""

from __future__ import annotations

import contextlib
import io
import lzma
import os
import re
import sys
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor
from functools import wraps
from typing import Any

import cv2

_EXPECTED = (ValueError, ArithmeticError, OSError, EOFError, RuntimeError, MemoryError, zlib.error, lzma.LZMAError)


@contextlib.contextmanager
def refusals() -> Iterator[None]:
    """Turn what may go wrong in a command into one line and an exit code; `python -X dev` shows where it went wrong."""
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # what OpenCV cannot read, we say
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")  # a terminal without "·" shows the rest
    try:
        yield
    except KeyboardInterrupt:
        _leave("interrupted; what was finished is kept", 130)
    except _EXPECTED as error:
        if isinstance(error.__context__, KeyboardInterrupt):  # it came while a file was written
            _leave("interrupted; what was finished is kept", 130)
        if sys.flags.dev_mode:
            raise
        _leave(f"error: {reason(error)}", 1 if isinstance(error, BrokenExecutor) else 2)


def reason(error: BaseException) -> str:
    """An error in one line: of what the library refuses its own words, else its kind, too."""
    words = " ".join(str(error).split())
    if isinstance(error, MemoryError):
        return f"not enough memory {words}; use smaller images, fewer frames, points or workers"
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or type(error).__name__}: {error.strerror}; check path, permissions and disk"
    if isinstance(error, ValueError | FloatingPointError | BrokenExecutor) and words:
        return words
    return f"{type(error).__name__}: {words}; python -X dev -m tapip3d_lite shows where"


def parsed(parse: Callable[[], Callable[[], None]]) -> Callable[[], None]:
    """What a parser of the command line returns; its box of several lines about a mistake becomes one line."""
    with contextlib.redirect_stderr(io.StringIO()) as said:
        try:
            return parse()
        except SystemExit as error:
            if not error.code:
                raise
    words = re.sub(r"[─-]{10,}", ";", re.sub(r"__tyro-dummy-inner__\.?|[╭╮╰╯│]", "", said.getvalue()))
    _leave("error: " + re.sub(r" ?; (?=;)|^[; ]+|[; ]+$", "", " ".join(words.split())).replace(" ;", ";"), 2)


def later(function: Callable[..., None]) -> Callable[..., Callable[[], None]]:
    """A function that only notes the arguments: calling what it returns does the work, after parsing."""

    @wraps(function)
    def noted(*arguments: Any, **options: Any) -> Callable[[], None]:
        return lambda: function(*arguments, **options)

    return noted


def _leave(text: str, code: int) -> None:
    print(text, file=sys.stderr)
    sys.exit(code)
