"""Where a lesson keeps what it trains."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path


@cache
def folder(name: str) -> Path:
    """`../runs/NAME`, or, where nothing can be written there, a folder of that name among the temporary ones; says so."""
    place = Path("../runs") / name
    try:
        place.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=place).close()
    except OSError as error:
        print(f"{place}: {error.strerror}; what this lesson trains is kept elsewhere, as long as temporary files are")
        place = Path(tempfile.gettempdir()) / "tapip3d_lite" / name
        place.mkdir(parents=True, exist_ok=True)
    return place
