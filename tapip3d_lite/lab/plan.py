"""`Plan`: what a study consists of, kept in its `study.json`; and the jobs that follow from it, keyed by content.

store/clips/<scene>/         to train on, to watch trainings by, to be judged by
store/encoders/<key>/        pretrained by matching, with the stored features of the clips
store/trainings/s0-<key>/    of a recipe with seed 0; rows and studies with the same recipe share it
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import quote

from tapip3d_lite.files import digest, read_json, write_text
from tapip3d_lite.lab.budgets import Budget, Data, judged_by, simulated
from tapip3d_lite.lab.jobs import Job, step_flops
from tapip3d_lite.lab.provenance import diff, own_code, source_code
from tapip3d_lite.lab.variant import Variant
from tapip3d_lite.training.recipe import TrainConfig

_ENCODER = ("feature_dim", "stride", "center_rgb", "image_size")  # fields that the encoder, or its input, depends on
_MATCHING = (
    "preset", "clips", "matching_steps", "matching", "frames", "sampling", "precision", "average", "warmup", "seed",
)  # fmt: skip


@dataclass
class Plan:
    """What a study was made with; everything but rows and seeds stays as it was.

    Attributes:
        folder, store: of the study, and of what it can share.
        rows: by name.
        seeds: number of trainings of each row.
        budget: what rows have in common.
        code: digests of the sources.
        clips: digests of the clips, once there are some.
        settled: results count as they are, whatever the code that made them was.
        scratch: where a settled study's clips are simulated to be looked at; its own folder may not be writable.
    """

    folder: Path
    store: Path
    rows: dict[str, Variant]
    seeds: int
    budget: Budget
    code: dict[str, str] = field(default_factory=source_code)
    clips: dict[str, str] | None = None
    settled: bool = False
    scratch: Path = Path("runs/store")
    _steps: dict[str, int] = field(default_factory=dict, init=False)  # that fit into the budget's operations

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as `study.json` holds them."""
        rows = {name: row.to_dict() for name, row in self.rows.items()}
        return {
            "rows": rows,
            "budget": self.budget.to_dict(),
            "seeds": self.seeds,
            "clips": self.clips,
            "code": self.code,
        }

    def check_rows(self) -> None:
        """Raise ValueError for a row that cannot be built."""
        for row in self.rows.values():
            if row.given is None:
                self.recipe(row)

    def take_over(self, old: Mapping[str, Any], accept_code: bool) -> None:
        """Refuse (ValueError) an old plan that differs in what must be equal; take over what it knows."""
        ours, rows = self.to_dict(), [name for name in self.rows if name in old["rows"]]
        old = {**old, "budget": {**old["budget"], "recipe": TrainConfig.complete(old["budget"]["recipe"])}}
        if found := diff(*({"budget": x["budget"], "rows": {n: x["rows"][n] for n in rows}} for x in (old, ours))):
            text = ", ".join(f"{name}={a!r} (now {b!r})" for name, (a, b) in found.items())
            raise ValueError(f"Study: {self.folder} was made otherwise: {text}; use its values, other names or folders")
        changed = diff(old["code"], self.code)
        if changed and not accept_code:
            raise ValueError(
                f"Study: {self.folder} was made by other code: {', '.join(changed)} differ; use that code or another folder, or "
                "accept_code=True, which keeps its results and goes on"
            )
        self.clips = old["clips"]

    def save(self) -> None:
        """Write `study.json`; rows and seeds that only an older plan has stay in it."""
        values, file = self.to_dict(), self.folder / "study.json"
        if file.exists():
            old = read_json(file)
            values |= {"rows": {**old["rows"], **values["rows"]}, "seeds": max(old["seeds"], self.seeds)}
        write_text(file, json.dumps(values, indent=1) + "\n")

    def find_clips(self, processes: int, progress: bool) -> Data:
        """The clips, simulated where they are missing; ValueError where an old study had others."""
        data = simulated(self._clips, self.budget, processes, progress)
        self.clips = self._unchanged(**asdict(data))
        self.save()
        return data

    @cached_property
    def judged(self) -> tuple[Path, ...]:
        """The clips that rows are judged by, as from `find_clips`."""
        held_out = judged_by(self._clips, self.budget)
        if not self.settled:  # another machine's last digits may differ, and only what is drawn depends on them
            self._unchanged(held_out=held_out)
        return held_out

    @property
    def _clips(self) -> Path:
        """Where clips are."""
        return (self.scratch if self.settled else self.store) / "clips" / self.budget.scene.__name__

    def _unchanged(self, **clips: tuple[Path, ...]) -> dict[str, str]:
        """Their digests; ValueError where an old study had others."""
        found = {name: digest(*(path.read_bytes() for path in paths)) for name, paths in clips.items()}
        if changed := [name for name in found if found[name] != (self.clips or found)[name]]:
            raise ValueError(
                f"Study: clips ({', '.join(changed)}) differ from those of {self.folder}; use another folder"
            )
        return found

    def recipe(self, row: Variant, seed: int = 0) -> TrainConfig:
        """What is trained for a row and seed, given an encoder; ValueError where the budget's operations fit no step."""
        recipe = replace(row.recipe(self.budget.recipe), seed=seed, matching_steps=0)
        if self.budget.flops is None:
            return recipe
        if row.name not in self._steps:
            self._steps[row.name] = int(self.budget.flops / (cost := step_flops(recipe)))
            if not self._steps[row.name]:
                raise ValueError(
                    f"row {row.name!r}: a step takes {cost:.3g} floating-point operations, more than the budget of "
                    f"{self.budget.flops:.3g} has"
                )
        return replace(recipe, steps=self._steps[row.name])

    def encoders(self, data: Data, device: str) -> list[Job]:
        """The encoders that are still to be trained."""
        jobs = [job for row in self.rows.values() if (job := self._encoder(row, data, device))]
        return [job for job in jobs if not (job.folder / "weights.safetensors").exists()]

    def _encoder(self, row: Variant, data: Data | None, device: str) -> Job | None:
        """The training of a row's encoder, which is every row's unless their sizes differ; None for a given tracker."""
        if row.given is not None:
            return None
        base, wanted = self.budget.recipe, row.recipe(self.budget.recipe)
        sizes = {name: wanted.tracker[name] for name in _ENCODER if name in wanted.tracker}
        kept = {name: getattr(base, name) for name in _MATCHING}
        recipe = TrainConfig(**kept, tracker={**base.tracker, **sizes}, steps=1, validation=0)
        folder = self.store / "encoders" / digest(json.dumps(recipe.to_dict()), self.clips["train"])
        return Job("the encoder", folder, recipe, None, (), data, self.budget, device)

    def trainings(self, data: Data, device: str) -> list[Job]:
        """All that is still to be trained and scored, seed by seed, a job for each row; see `shared`."""
        jobs = []
        for seed in range(self.seeds):
            for row in self.rows.values() if seed == 0 else [row for row in self.rows.values() if row.given is None]:
                job, file = self._training(row, seed, data, device), self.result(row, seed)
                key = self._key(row, job)
                facts = {"key": key, "code": digest(json.dumps(self.code)), "training": job.folder and job.folder.name}
                if not is_scored(file, key):
                    jobs.append(replace(job, rows=((row, file, facts),)))
        return jobs

    def _training(self, row: Variant, seed: int, data: Data | None = None, device: str = "cpu") -> Job:
        """The training of a row with a seed, without what is scored by it."""
        if row.given is not None:
            return Job(row.name, None, None, None, (), data, self.budget, device)
        recipe, encoder = self.recipe(row, seed), self._encoder(row, data, device).folder
        values = recipe.to_dict()
        key = digest(json.dumps([values, own_code(values)]), encoder.name, self.clips["train"])
        folder = self.store / "trainings" / f"s{seed}-{key}"
        return Job(f"{row.name} s{seed}", folder, recipe, encoder, (), data, self.budget, device)

    def _key(self, row: Variant, job: Job) -> str:
        """What a row's scores depend on."""
        given = Path(row.given).read_bytes() if row.given and Path(row.given).is_file() else str(row.given)
        parts = json.dumps([row.to_dict(), self.clips, own_code(row.to_dict())])
        return digest(parts, given, job.folder.name if job.folder else "")

    def result(self, row: Variant, seed: int) -> Path:
        """The file of a row's scores."""
        return self.folder / "results" / f"{quote(row.name, safe=' =,+()')} s{seed}.json"

    def results(self) -> dict[str, dict[int, dict[str, Any]]]:
        """What the files of results hold, by row and seed, without those of an earlier state of the row."""
        found = {}
        for name, row in self.rows.items():
            held = {s: read_json(file) for s in range(self.seeds) if (file := self.result(row, s)).exists()}
            ours = {s: self.settled or x["key"] == self._key(row, self._training(row, s)) for s, x in held.items()}
            found[name] = {s: x for s, x in held.items() if ours[s]}
        return found


def shared(jobs: Iterable[Job]) -> list[Job]:
    """Jobs with those of one training made into one, and no two of one name."""
    found: dict[Path | int, Job] = {}
    for i, job in enumerate(jobs):
        first = found.setdefault(job.folder or i, job)
        if first is not job:
            found[job.folder] = replace(first, rows=first.rows + job.rows)
    counts = Counter(job.name for job in found.values())
    return [replace(x, name=x.name + f" #{i}" * (counts[x.name] > 1)) for i, x in enumerate(found.values(), 1)]


def is_scored(file: Path, key: str) -> bool:
    """Whether a file holds scores with that key."""
    one = read_json(file) if file.exists() else {}
    return "scores" in one and one["key"] == key
