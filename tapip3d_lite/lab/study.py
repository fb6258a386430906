"""`Study`: rows under equal conditions, in a folder: trained, scored, compared.

    folder/study.json             what it was made with: rows, budget, clips, code
    folder/results/<row> s0.json  scores of a row and seed by clip, and costs; a row's failure with its reason
    store/                        what studies can share: clips, encoders with their features, trainings
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from tqdm.auto import tqdm

from tapip3d_lite.files import digest, write_text
from tapip3d_lite.lab.budgets import BUDGETS, Budget, Data, own_clips, simulated
from tapip3d_lite.lab.jobs import STOPPED, Job, do_all, probe
from tapip3d_lite.lab.provenance import changed_code, diff, own_code, source_code
from tapip3d_lite.lab.train import interruptible
from tapip3d_lite.lab.variant import Variant
from tapip3d_lite.training.recipe import TrainConfig
from tapip3d_lite.validate import check_names

_MATCHING = ("preset", "clips", "matching_steps", "matching", "frames", "sampling", "precision", "average", "warmup", "seed")
_ENCODER = ("feature_dim", "stride", "center_rgb", "image_size")  # fields that the encoder, or its input, depends on


class Study:
    """Rows of an experiment that differ in nothing but what they say.

    All rows see the same clips through the same encoder (or one each where they differ in its sizes), and those of one
    seed the same examples, points and augmentations in the same order.

    Attributes:
        folder, store: of the study, and of what it can share with others.
        rows: by name, in order.
        seeds: of the trainings, 0 ... n - 1.
        budget: what the rows have in common.
    """

    def __init__(
        self,
        folder: str | Path,
        rows: Sequence[Variant] | None = None,
        seeds: int | None = None,
        budget: str | Budget | None = None,
        steps: int | None = None,
        minutes: float | None = None,
        flops: float | None = None,
        store: str | Path | None = None,
        data: tuple[str | Path, str | Path] | None = None,
        accept_code: bool = False,
    ) -> None:
        """Plan a study, or open one; nothing is computed yet. What a folder's study has, need not be given again.

        Args:
            folder: made if missing. Rows and seeds may be added to an old study; the rest must be as it was.
            rows: None: those of the folder.
            seeds: number of trainings of each row; by default 3.
            budget: a name of `BUDGETS`, by default `"lab"`, or one's own.
            steps: of every row, in place of the budget's.
            minutes: of training steps of every row, on one core; each row gets as many steps as it makes in this time.
            flops: floating-point operations of the training of every row; each row gets as many steps as these allow.
            store: by default `folder / "store"`.
            data: folders of clips of one's own: to train on, and to be judged by.
            accept_code: go on with results of other code; each result says with which code it was made.

        Raises:
            ValueError: no rows, two of one name, rows that cannot be built, a bad number, or a folder of other rows of
                these names, another budget, clips or code (says what differs).
        """
        self.folder, self._file = Path(folder), Path(folder) / "study.json"
        self.store = Path(store) if store else self.folder / "store"
        old = _read(self._file) if self._file.exists() else None
        if rows is None and old is None:
            raise ValueError(f"Study: {folder} holds no study; give rows, e.g. [Variant('n2n'), Variant('p2n', context='p2n')]")
        stored = {} if old is None else {name: Variant(name, **values) for name, values in old["rows"].items()}
        rows = list(stored.values()) if rows is None else list(rows)
        self.rows = {row.name: row for row in rows}
        if not rows or len(self.rows) < len(rows):
            names = [row.name for row in rows]
            twice = ", ".join(sorted({name for name in names if names.count(name) > 1}))
            raise ValueError(f"Study: two rows are called {twice}; rename one" if names else "Study: no rows; give some")
        seeds = seeds if seeds is not None else old["seeds"] if old else 3
        if isinstance(seeds, bool) or not isinstance(seeds, int) or seeds < 1:
            raise ValueError(f"Study.seeds: expected a number of trainings of at least 1, got {seeds!r}")
        self.seeds = range(seeds)
        self.budget = _chosen(budget, old)
        limits = {name: value for name, value in {"steps": steps, "minutes": minutes, "flops": flops}.items() if value}
        if len(limits) > 1 or any(x is not None and x <= 0 for x in (steps, minutes, flops)):
            raise ValueError(f"Study: expected one of steps, minutes, flops, and a positive number, got {limits}")
        if steps:
            self.budget = replace(self.budget, recipe=replace(self.budget.recipe, steps=steps))
        limit = old["limit"] if old and not limits else {k: v for k, v in limits.items() if k != "steps"}
        data = [str(Path(one).resolve()) for one in data] if data else old["data"] if old else None
        for row in rows:
            if row.given is None:
                row.recipe(self.budget.recipe)
        own = {name: own_code(row.to_dict()) for name, row in self.rows.items()}
        code = source_code() | {module: code for one in own.values() for module, code in one.items()}
        self._plan = {"budget": self.budget.to_dict(), "limit": limit, "data": data, "seeds": seeds, "code": code}
        self._plan |= {"rows": {name: row.to_dict() for name, row in self.rows.items()}, "clips": None, "steps": {}}
        if old is not None:
            self._compare(old, accept_code)

    def _compare(self, old: dict[str, Any], accept_code: bool) -> None:
        """Refuse an old study that was made otherwise; take over what it knows."""
        same_rows = {name: old["rows"][name] for name in self.rows if name in old["rows"]}
        now = {"rows": {name: self._plan["rows"][name] for name in same_rows}}
        names = ("budget", "limit", "data")
        found = diff({**{k: old[k] for k in names}, "rows": same_rows}, {**{k: self._plan[k] for k in names}, **now})
        if found:
            text = ", ".join(f"{name}={a!r} (now {b!r})" for name, (a, b) in found.items())
            raise ValueError(f"Study: {self.folder} was made otherwise: {text}; use its values, other names or another folder")
        changed = changed_code(old["code"], self._plan["code"])
        if changed and not accept_code:
            raise ValueError(
                f"Study: {self.folder} was made by other code: {', '.join(changed)} differ; use that code or another "
                "folder, or accept_code=True, which keeps its results and goes on"
            )
        self._plan |= {"clips": old["clips"], "steps": old["steps"], "rows": {**old["rows"], **self._plan["rows"]}}
        self._plan |= {"seeds": max(old["seeds"], self._plan["seeds"])}

    @property
    def code(self) -> str:
        """A digest of the code."""
        return digest(json.dumps(self._plan["code"], sort_keys=True))

    def run(
        self,
        jobs: int = 1,
        device: str = "cpu",
        stop: Callable[[], bool] = lambda: False,
        progress: bool = True,
    ) -> bool:
        """Train and score what is missing; go on exactly where an earlier call ended, however it ended.

        A row that fails is marked with its reason, and the others go on; the next call tries it again.

        Args:
            jobs: trainings at once, in processes of one thread each. 1: in this process. A script that asks for more
                needs the usual `if __name__ == "__main__":`, and custom parts a module that processes can import.
            device: `"cpu"` or `"cuda"`.
            stop: asked now and then; all is saved when it is true, as after Ctrl-C.
            progress: show one bar over all steps.

        Returns:
            Whether all rows are finished; rows that failed count as finished.

        Raises:
            ValueError: clips that are too few or have changed, a budget into which no step fits, a full disk.
        """
        if jobs < 1:
            raise ValueError(f"Study.run: expected at least one job, got {jobs}")
        (self.folder / "results").mkdir(parents=True, exist_ok=True)
        data = self._clips(jobs, progress)
        with interruptible() as interrupted:
            work = partial(self._work, jobs, lambda: stop() or interrupted(), progress)
            failed = work(list({job.folder: job for job in self._encoders(data, device)}.values()))
            if failed is None:
                return False
            if failed:
                raise ValueError(f"Study: the encoder could not be trained: {'; '.join(failed.values())}")
            self._divide(data, device)
            todo = self._trainings(data, device)
            failed = work(todo)
        for job in todo if failed else ():
            for row, file, facts in job.rows if job.name in failed else ():
                if not _scored(file, facts["key"]):
                    write_text(file, json.dumps({**facts, "row": row["name"], "failed": failed[job.name]}, indent=1) + "\n")
        return failed is not None

    def _work(self, jobs: int, stop: Callable[[], bool], progress: bool, todo: list[Job]) -> dict[str, str] | None:
        """Do jobs under one bar; the reasons of those that failed, or None where it was stopped."""
        done = {job.name: 0 for job in todo}
        with tqdm(total=sum(job.steps for job in todo), unit="step", disable=not (progress and todo)) as bar:

            def tell(name: str, steps: int) -> None:
                done[name] = steps
                bar.set_description(f"{sum(x > 0 for x in done.values())} of {len(todo)} · {name}", refresh=False)
                bar.update(sum(done.values()) - bar.n)

            ended = do_all(todo, jobs, tell, stop)
        if STOPPED in ended.values():
            return None
        return {name: reason for name, reason in ended.items() if reason != "done"}

    def _clips(self, jobs: int, progress: bool) -> Data:
        """The clips; those of an old study must be what they were."""
        if self._plan["data"]:
            data = own_clips(*self._plan["data"], self.budget)
        else:
            data = simulated(self.store / "clips" / self.budget.scene.__name__, self.budget, jobs, progress)
        found = {name: digest(*(path.read_bytes() for path in paths)) for name, paths in asdict(data).items()}
        if self._plan["clips"] not in (None, found):
            changed = ", ".join(diff(self._plan["clips"], found))
            raise ValueError(f"Study: clips differ from those that {self.folder} was made with: {changed}; use another folder")
        self._plan["clips"] = found
        self._save()
        return data

    def _save(self) -> None:
        write_text(self._file, json.dumps(self._plan, indent=1) + "\n")

    def _recipe(self, row: Variant, seed: int) -> TrainConfig:
        """What is trained for a row and seed, given an encoder."""
        recipe = replace(row.recipe(self.budget.recipe), seed=seed, matching_steps=0)
        return replace(recipe, steps=self._plan["steps"].get(_steps_key(recipe), recipe.steps))

    def _encoder(self, row: Variant, data: Data, device: str) -> Job:
        """The training of the encoder that a row needs: the same one unless the row's sizes need another."""
        base, wanted = self.budget.recipe, row.recipe(self.budget.recipe)
        sizes = {name: wanted.tracker[name] for name in _ENCODER if name in wanted.tracker}
        kept = {name: getattr(base, name) for name in _MATCHING}
        recipe = TrainConfig(**kept, tracker={**base.tracker, **sizes}, steps=1, validation=0).to_dict()
        folder = self.store / "encoders" / digest(json.dumps(recipe), self._plan["clips"]["train"])
        return Job("the encoder", folder, recipe, None, (), data, self._plan["budget"], device)

    def _encoders(self, data: Data, device: str) -> list[Job]:
        found = [self._encoder(row, data, device) for row in self.rows.values() if row.given is None]
        return [job for job in found if not (job.folder / "weights.safetensors").exists()]

    def _divide(self, data: Data, device: str) -> None:
        """Where time or operations are what rows have in common: the steps that each may make."""
        for row in self.rows.values():
            key = None if row.given is not None else _steps_key(self._recipe(row, 0))
            if not self._plan["limit"] or key is None or key in self._plan["steps"]:
                continue
            job = self._training(row, 0, data, device)
            with tempfile.TemporaryDirectory(dir=self.folder) as folder:
                seconds, flops = probe(job, Path(folder))
            limit = self._plan["limit"]
            steps = int(limit["flops"] / flops if "flops" in limit else 60 * limit["minutes"] / seconds)
            if steps < 1:
                need = f"{seconds / 60:.2g} minutes and {flops:.2g} operations"
                raise ValueError(f"Study: one step of row {row.name!r} takes {need}, more than the budget {limit}; give more")
            self._plan["steps"][key] = steps
            self._save()

    def _training(self, row: Variant, seed: int, data: Data, device: str) -> Job:
        """The training of a row with a seed, without what is scored by it."""
        if row.given is not None:
            return Job(row.name, None, None, None, (), data, self._plan["budget"], device)
        recipe, encoder = self._recipe(row, seed), self._encoder(row, data, device).folder
        values = recipe.to_dict()
        key = digest(json.dumps(values), encoder.name, self._plan["clips"]["train"], json.dumps(own_code(values)))
        folder = self.store / "trainings" / f"s{seed}-{key}"
        return Job(f"{row.name} s{seed}", folder, values, encoder, (), data, self._plan["budget"], device)

    def _trainings(self, data: Data, device: str) -> list[Job]:
        """All that is to be trained and scored, seed by seed; rows of one recipe share a job."""
        found: dict[Any, Job] = {}
        for seed in self.seeds:
            for row in self.rows.values():
                if row.given is not None and seed > 0:
                    continue
                job = self._training(row, seed, data, device)
                facts = {"key": self._key(row, job), "code": self.code, "folder": job.folder and str(job.folder)}
                if _scored(self._result(row, seed), facts["key"]):
                    continue
                job = found.get(job.folder or row.name, job)
                rows = (*job.rows, ({"name": row.name, **row.to_dict()}, self._result(row, seed), facts))
                found[job.folder or row.name] = replace(job, rows=rows)
        return list(found.values())

    def _key(self, row: Variant, job: Job) -> str:
        """What a row's scores depend on."""
        given = Path(row.given).read_bytes() if row.given and Path(row.given).is_file() else str(row.given)
        parts = [json.dumps(x) for x in (row.to_dict(), self._plan["clips"], own_code(row.to_dict()))]
        return digest(*parts, given, job.folder.name if job.folder else "")

    def _result(self, row: Variant, seed: int) -> Path:
        return self.folder / "results" / f"{quote(row.name, safe=' =,+()')} s{seed}.json"

    def results(self) -> dict[str, dict[int, dict[str, Any]]]:
        """What stands in the files of results, by row and seed; a tracker that is not trained has the seed 0 alone."""
        found = {}
        for row in self.rows.values():
            files = {seed: self._result(row, seed) for seed in self.seeds}
            found[row.name] = {seed: _read(file) for seed, file in files.items() if file.exists()}
        return found


def _read(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: not readable ({error}); delete it, and the study makes it again") from error


def _steps_key(recipe: TrainConfig) -> str:
    return digest(json.dumps({**recipe.to_dict(), "steps": 0, "seed": 0}))


def _scored(file: Path, key: str) -> bool:
    """Whether a file holds scores with that key."""
    one = _read(file) if file.exists() else {}
    return "scores" in one and one["key"] == key


def _chosen(budget: str | Budget | None, old: dict[str, Any] | None) -> Budget:
    if isinstance(budget, Budget):
        return budget
    if budget is None and old is not None:
        return Budget.from_dict(old["budget"])
    check_names("Study.budget", [budget or "lab"], BUDGETS)
    return BUDGETS[budget or "lab"]
