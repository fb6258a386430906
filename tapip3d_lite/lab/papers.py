"""Studies by name, as plain values that a TOML or JSON file could hold; and studies from such files."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tapip3d_lite.files import read_json
from tapip3d_lite.lab.study import Study
from tapip3d_lite.lab.variant import Variant
from tapip3d_lite.validate import check_names

TABLES: dict[str, dict[str, Any]] = {
    "n2n": {"rows": {"n2n": {}, "p2n": {"context": "p2n"}}, "against": "n2n"},
}
"""The paper's tables: `rows` by name, each with the arguments of `Variant`; `against`, and other arguments of `Study`."""

_FIELDS = ("folder", "rows", "against", "seeds", "budget", "steps", "minutes", "store")


def open_study(source: str | Path, accept_code: bool = False, parts: Sequence[Any] = ()) -> tuple[Study, str | None]:
    """A study, and the row that others are compared with, from a name of `TABLES`, a TOML or JSON file, or a folder.

    A file's `folder` and `store` are relative to it; without a `folder` the study is in `runs/<name>`. Custom parts that
    files name must be among `parts`, as for `load_tracker`.

    Raises:
        ValueError: neither of these, an unreadable file, unknown fields, or what `Study` refuses.
    """
    path = Path(source)
    if (path / "study.json").exists():
        return Study(path, accept_code=accept_code, parts=parts), None
    if path.suffix not in (".toml", ".json"):
        check_names("lab: no file (.toml, .json), no study's folder, no table of the paper", [str(source)], TABLES)
        values, home = TABLES[str(source)], Path()
        values = {"store": "runs/store", **values}
    else:
        values, home = _parsed(path), path.parent
    check_names(str(source), values, _FIELDS)
    rows = values.get("rows", {})
    if not isinstance(rows, Mapping) or not all(isinstance(row, Mapping) for row in rows.values()):
        raise ValueError(f"{source}: expected rows by name, e.g. [rows.p2n] with context = 'p2n' below, got {rows!r}")
    kept = {k: v for k, v in values.items() if k in ("seeds", "budget", "steps", "minutes")}
    if "store" in values:
        kept["store"] = home / values["store"]
    folder = home / values.get("folder", Path("runs") / path.stem)
    rows = [Variant.from_dict(name, row, parts) for name, row in rows.items()]
    study = Study(folder, rows, **kept, accept_code=accept_code, parts=parts)
    return study, values.get("against")


def _parsed(path: Path) -> dict[str, Any]:
    if path.suffix == ".json":
        return read_json(path)
    try:
        import tomllib

        return tomllib.loads(path.read_text(encoding="utf-8"))
    except ImportError:
        raise ValueError(f"{path}: TOML needs Python 3.11; write the same as JSON") from None
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: not readable: {error}") from error


def listed(study: Study) -> str:
    """Each row with what it sets, and which of its seeds are finished or why it failed; one line a row."""
    lines = []
    for name, seeds in study.results().items():
        row, states = study.plan.rows[name], {seed: x.get("failed", "finished") for seed, x in seeds.items()}
        wanted = range(study.plan.seeds) if row.given is None else [0]
        done = sum(state == "finished" for state in states.values())
        failed = next((f"; failed: {state}" for state in states.values() if state != "finished"), "")
        lines.append(f"{name}: {json.dumps(row.to_dict())}, {done} of {len(wanted)} seeds{failed}")
    return "\n".join(lines)
