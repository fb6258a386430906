"""Where results come from: configs in plain values, digests of the code, and what differs between two of either."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import fields, is_dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tapip3d_lite.files import digest, read_json
from tapip3d_lite.official import flatten
from tapip3d_lite.parts import part_name

_ROOT = Path(__file__).parents[1]
# What changes no score.
_UNSEEN = ("figures", "lab", "__main__", "official", "recorder", "check", "export")
_SEEN = ("lab/conditions.py", "lab/jobs.py")


def plain(value: Any) -> Any:
    """What JSON cannot hold: a dataclass as a dictionary, a class or function as `"module:name"`."""
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, Path):
        return str(value)
    return part_name(value, "a part")


def own_code(values: Any) -> dict[str, str]:
    """Digests of the files of the modules, which are imported, whose parts plain values name; `__main__` has none."""
    named = sorted({*re.findall(r'"([^\W\d][\w.]*):[^\W\d][\w.]*"', json.dumps(values))} - {"__main__"})
    return {module: digest(Path(sys.modules[module].__file__).read_bytes()) for module in named}


def diff(one: Any, other: Any) -> dict[str, tuple[Any, Any]]:
    """What differs between two configs: dotted names with both values, None where a value is missing.

    Args:
        one, other: `Variant`, `TrainConfig`, `TrackerConfig`, dictionaries, or folders of trainings or studies.

    Raises:
        ValueError: a folder without a config.
    """
    a, b = flatten(_config(one)), flatten(_config(other))
    return {name: (a.get(name), b.get(name)) for name in {**a, **b} if a.get(name) != b.get(name)}


def _config(source: Any) -> Any:
    if isinstance(source, str | Path):
        for name in ("config.json", "study.json"):
            if (path := Path(source) / name).exists():
                return read_json(path)
        raise ValueError(f"diff: {source} holds neither config.json nor study.json; give another folder")
    return source.to_dict() if hasattr(source, "to_dict") else json.loads(json.dumps(source, default=plain))


@cache
def source_code() -> dict[str, str]:
    """Digests of the library's sources that scores depend on, and versions of packages.

    They are read once, since a process keeps the code that it began with.
    """
    found = {name: version(name) for name in ("torch", "numpy", "mujoco")}
    for path in sorted(_ROOT.rglob("*.py")):
        name = path.relative_to(_ROOT).as_posix()
        if name.removesuffix(".py").split("/")[0] not in _UNSEEN or name in _SEEN:
            found[name] = digest(path.read_bytes())
    return found
