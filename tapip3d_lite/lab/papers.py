"""Studies by name, as plain values that a TOML or JSON file could hold; and studies from such files."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tapip3d_lite.evaluation.evaluate import markdown_table
from tapip3d_lite.files import read_json, write_text
from tapip3d_lite.lab.claims import CLAIM_HEAD, claim_cells
from tapip3d_lite.lab.study import Study, run_together
from tapip3d_lite.lab.variant import Variant
from tapip3d_lite.validate import check_names


def _table(
    source: str, rows: Mapping[str, tuple], pairs: Sequence[tuple[str, str]] | None = None, **rest: Any
) -> dict[str, Any]:
    """Each row with its arguments and maybe the paper's numbers; without pairs all these are compared with the first."""
    (first, *others), numbers = rows, {name: one[1] for name, one in rows.items() if one[1:]}
    pairs = [(name, first) for name in others if name in numbers] if pairs is None else pairs
    paper = {"paper": {"source": source, "rows": numbers, "pairs": pairs}} if numbers else {}
    return {"rows": {name: one[0] for name, one in rows.items()}, "against": first, **paper, **rest}


def _of_lite(source: str, rows: Mapping[str, tuple], pairs: Sequence[tuple[str, str]] | None = None) -> dict[str, Any]:
    """A table without training: `lite` with options of `track` and conditions."""
    given = {name: ({"tracker": "lite", **one[0]}, *one[1:]) for name, one in rows.items()}
    return _table(source, given, pairs, budget="shipped")


_CAMERA, _WINDOW, _P2N = {"space": "camera"}, {"neighborhood": "window"}, {"context": "p2n"}
_BOTH = {"motion": {"world": 0.5, "still": 1.0}}  # half of the examples in the world's frame, half in the camera's
_MATCHED = {**_WINDOW, "context": "correlation"}
_SENSOR = {
    "degrade": {
        "flicker": 0.01, "noise": 0.01, "grain": 0.002, "step": 0.001, "flying": 0.5, "shadow": 1.5, "dropout": 0.05
    }
}  # fmt: skip
_GREY = {"degrade": {"grey": True}}
_EDGES = {"degrade": {"silhouettes": 0.25}}
_NEAREST, _FIXED = (29.8, 51.6, 70.9), (27.7, 50.0, 67.7)
_SYSTEMS: dict[str, tuple] = {  # with the numbers of LSFOdyssey and of DexYCB
    "TAPIP3D, world": ({}, (72.2, 85.8, None), (30.3, 52.4, 71.3)),
    "TAPIP3D, camera": (_CAMERA, (68.3, 83.2, None)),
    "DELTA-like": ({"space": "uvlogd", "depth_ratio": True, **_MATCHED}, (37.7, 50.1, None), (26.4, 43.3, 72.8)),
    "CoTracker3-like, lifted": ({"space": "uv", **_MATCHED}, (28.4, 35.0, None), (14.9, 26.1, 70.9)),
    "SpatialTracker-like": (
        {"space": "uvd", "neighborhood": "planes", "context": "planes"}, (8.2, 13.3, None), (5.5, 11.4, 66.8)
    ),
    "SceneTracker-like": ({"space": "uvd", "depth_ratio": True, **_MATCHED},),
    **{name: ({"tracker": name},) for name in ("static", "klt", "lite")},
}  # fmt: skip

TABLES: dict[str, dict[str, Any]] = {
    "coordinates": _table(
        "coordinates, LSFOdyssey, true depth; camera and world are one checkpoint there; uv has no row",
        {
            "world": ({}, (70.7, 84.1, 86.6)), "camera": (_CAMERA, (67.1, 81.6, 85.8)),
            "uvlogd": ({"space": "uvlogd"}, (62.9, 77.9, 84.1)), "uvd": ({"space": "uvd"}, (63.4, 77.0, 87.0)),
            "uv": ({"space": "uv"},), "world of both": (_BOTH, (70.7, 84.1, 86.6)),
            "camera of both": ({**_BOTH, "track": _CAMERA}, (67.1, 81.6, 85.8)),
        },
        [
            ("camera", "world"), ("camera of both", "world of both"),
            *((one, other) for other in ("world", "camera") for one in ("uvlogd", "uvd")),
        ],
    ),
    "n2n": _table(
        "N2N, LSFOdyssey, true depth; p2n is its row without N2N",
        {
            "n2n, world": ({}, (70.7, 84.1, 86.6)), "p2n, world": (_P2N, (62.1, 75.1, 88.2)),
            "n2n, camera": (_CAMERA, (67.1, 81.6, 85.8)), "p2n, camera": ({**_P2N, **_CAMERA}, (59.4, 72.7, 88.0)),
        },
        [(f"p2n, {space}", f"n2n, {space}") for space in ("world", "camera")],
    ),
    "neighbours": _table(
        "neighbours, DexYCB, a sensor's depth; its one pair of rows stands beside each of ours",
        {
            f"{name}, {where}": ({**part, **under}, numbers)
            for where, under in {"world": {}, "camera": _CAMERA, "sensor": _SENSOR, "silhouettes": _EDGES}.items()
            for name, part, numbers in (("k-NN", {}, _NEAREST), ("window", _WINDOW, _FIXED))
        },
        [(f"window, {where}", f"k-NN, {where}") for where in ("world", "camera", "sensor", "silhouettes")],
    ),
    "systems": _table(
        "main table, LSFOdyssey, true depth; without SceneTracker and OA",
        {name: one[:2] for name, one in _SYSTEMS.items()},
    ),
    "systems-sensor": _table(
        "main table, DexYCB, a sensor's depth; without SceneTracker and camera space",
        {name: ({**one[0], **_SENSOR}, *one[2:]) for name, one in _SYSTEMS.items()},
    ),
    "learner": _table("", {
        "aligned, Muon": ({},), "random start": ({"start": "random"},), "AdamW": ({"optimizer": "adamw"},),
        "aligned, grey video": (_GREY,), "random start, grey video": ({"start": "random", **_GREY},),
    }),
    "controls": _table("", {
        "n2n": ({},), "grey video": (_GREY,), "frozen depth": ({"degrade": {"frozen": "depths"}},),
        "static": ({"tracker": "static"},), "klt": ({"tracker": "klt"},),
    }),
    "K": _of_lite(
        "K at test, LSFOdyssey; 32, 16, 24, 48 of a training with 32 beside 9, 4, 7, 13 of one with 9",
        {
            f"K = {k}": ({"track": {"neighbors": k}}, *numbers) for k, *numbers in (
                (9, (72.2, 85.8, 86.9)), (4, (67.9, 84.5, 83.6)), (7, (71.1, 85.8, 85.9)), (13, (72.6, 85.3, 88.6)),
                (18,), (32,), (48,),
            )
        },
    ),
    "pose-noise": _of_lite(
        "pose noise, LSFOdyssey; camera space does not see it",
        {
            **{
                f"{x:g}°": ({"degrade": {"poses": x}}, *numbers) for x, *numbers in (
                    (0.0, (72.2, 85.8, 86.9)), (0.25,), (0.5, (70.4, 84.6, 86.8)), (1.0, (67.8, 82.7, 86.4)),
                    (2.0, (64.9, 80.3, 85.7)), (4.0,),
                )
            },
            "camera": ({"track": _CAMERA}, (68.3, 83.2, 86.2)),
        },
        [("0.5°", "0°"), ("1°", "0°"), ("2°", "0°"), ("1°", "camera"), ("2°", "camera")],
    ),
    "blur": _of_lite(
        "blur, estimated depth, which suffers from it there; ours stays true",
        {
            f"blur {x:g}": ({"degrade": {"blur": x}}, (None, apd, None))
            for x, apd in ((0.0, 29.2), (0.5, 21.2), (1.0, 20.6), (2.0, 18.1))
        },
    ),
    "depth": _of_lite(
        "",
        {
            name: ({"degrade": flaws},) for name, flaws in {
                "true": {}, "1 % noise": {"noise": 0.01}, "5 % noise": {"noise": 0.05}, "2 % flicker": {"flicker": 0.02},
                "mixed at silhouettes": {"flying": 0.5, "shadow": 1.5}, "half missing": {"dropout": 0.5},
                "sensor-like": _SENSOR["degrade"], "stereo": {"stereo": True}, "2 % of the pixels": {"sparse": 0.02},
            }.items()
        },
    ),
    "iterations": _of_lite("", {f"M = {m}": ({"track": {"iterations": m}},) for m in (3, 1, 2, 4, 6, 8)}),
    "image-size": _of_lite("", {f"{x} pixels": ({"track": {"size": (x, x)}},) for x in (128, 64, 96, 192, 256)}),
}  # fmt: skip
"""The paper's tables: `rows` by name, each with the arguments of `Variant`; `against`, `paper` (see `claims.with_claims`),
and other arguments of `Study`. The paper's numbers are AJ3D, APD3D and OA; a row whose numbers are not at hand has none."""

PAPER = Path(__file__).parent / "paper"  # the tables' results, and weights of one seed, as they are shipped
_FIELDS = ("folder", "rows", "against", "seeds", "budget", "steps", "minutes", "flops", "store")


def open_study(
    source: str | Path,
    accept_code: bool = False,
    parts: Sequence[Any] = (),
    budget: str | None = None,
    seeds: int | None = None,
    shipped: bool = False,
) -> tuple[Study, str | None]:
    """A study, and the row that others are compared with, from a name of `TABLES`, a TOML or JSON file, or a folder.

    A file's `folder` and `store` are relative to it; without a `folder` the study is in `runs/<name>`. Custom parts that
    files name must be among `parts`, as for `load_tracker`. Another `budget` (which gets a folder of its own) or number
    of `seeds` than the study's can be asked for. `shipped`: to be read, not run, so other code is no obstacle, and a table of
    the paper that has no folder in `runs` yet is the one that the library brings along.

    Raises:
        ValueError: neither of these, an unreadable file, unknown fields, or what `Study` refuses.
    """
    path, paper = Path(source), None
    if (path / "study.json").exists():
        return Study(path, seeds=seeds, budget=budget, accept_code=accept_code or shipped, parts=parts), None
    if path.suffix not in (".toml", ".json"):
        check_names("lab: no file (.toml, .json), no study's folder, no table of the paper", [str(source)], TABLES)
        values, home = {"store": "runs/store", **TABLES[str(source)]}, Path()
        paper, label = values.pop("paper", None), str(source) if budget is None else f"{source}, {budget}"
        if shipped and not (Path("runs") / label / "study.json").exists() and (PAPER / label / "study.json").exists():
            study = Study(PAPER / label, store=PAPER / "store", accept_code=True)
            study.paper, study.plan.settled = paper, True
            return study, values["against"]
    else:
        values, home = _parsed(path), path.parent
    check_names(str(source), values, _FIELDS)
    rows = values.get("rows", {})
    if not isinstance(rows, Mapping) or not all(isinstance(row, Mapping) for row in rows.values()):
        raise ValueError(f"{source}: expected rows by name, e.g. [rows.p2n] with context = 'p2n' below, got {rows!r}")
    kept = {k: v for k, v in values.items() if k in ("seeds", "budget", "steps", "minutes", "flops")}
    if "store" in values:
        kept["store"] = home / values["store"]
    folder = home / values.get("folder", Path("runs") / path.stem)
    rows = [Variant.from_dict(name, row, parts) for name, row in rows.items()]
    if budget is not None:
        kept, folder = {**kept, "budget": budget}, folder.with_name(f"{folder.name}, {budget}")
    if seeds is not None:
        kept["seeds"] = seeds
    study = Study(folder, rows, **kept, accept_code=accept_code or shipped, parts=parts)
    study.paper = paper
    return study, values.get("against")


def run_all(
    jobs: int, device: str, accept_code: bool = False, budget: str | None = None, seeds: int | None = None
) -> bool:
    """Run all tables of the paper, with `budget` in place of `"lab"`; as `Study.run`."""
    budgets = {name: None if "budget" in table else budget for name, table in TABLES.items()}
    studies = [open_study(name, accept_code, (), budgets[name], seeds)[0] for name in TABLES]
    return run_together(studies, jobs, device, lambda: False, progress=True)


def report_all(folder: Path) -> Path:
    """Write the reports of all tables of the paper that have results, and a page of what became of its claims."""
    rows, done, left = [], [], []
    for name, budget in ((name, budget) for name, table in TABLES.items() for budget in (None, "gpu")):
        if budget is not None and not any(
            (place / f"{name}, gpu" / "study.json").exists() for place in (PAPER, Path("runs"))
        ):
            continue
        study, against = open_study(name, accept_code=True, budget=budget, shipped=True)
        label = study.plan.folder.name
        if not any("scores" in one for seeds in study.results().values() for one in seeds.values()):
            left.append(label)
            continue
        done.append(f"[{label}](<{label}/report.md>)")
        study.report(folder / label, against)
        rows += [[done[-1], *cells] for cells in claim_cells(study.table(against).claims)]
    if not done:
        raise ValueError("lab: no table of the paper has results yet; run one, e.g. `lab run n2n`")
    counts = ", ".join(f"{n} {verdict}" for verdict, n in Counter(row[-1] for row in rows).most_common())
    parts = ["# The paper's claims", markdown_table(["table", *CLAIM_HEAD], rows)]
    parts += [f"Of {len(rows)} differences: {counts or 'none'}. All tables: {', '.join(done)}."]
    parts += [f"Without results yet: {', '.join(left)}."] if left else []
    write_text(folder / "report.md", "\n\n".join(parts) + "\n")
    return folder / "report.md"


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
