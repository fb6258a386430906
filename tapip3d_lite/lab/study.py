"""`Study`: rows under equal conditions, in a folder: trained, scored, compared.

folder/study.json             what it was made with: rows, budget, clips, code
folder/results/<row> s0.json  scores of a row and seed by clip, and costs; or why the row failed
folder/store/                 see `plan`
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from tqdm.auto import tqdm

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.figures.comparisons import where_they_differ
from tapip3d_lite.files import read_json, write_text
from tapip3d_lite.lab.budgets import BUDGETS, Budget, judged_clip
from tapip3d_lite.lab.claims import with_claims
from tapip3d_lite.lab.conditions import under
from tapip3d_lite.lab.jobs import STOPPED, Job, do_all, tracker_of
from tapip3d_lite.lab.plan import Plan, is_scored, shared
from tapip3d_lite.lab.report import explorer, write_report
from tapip3d_lite.lab.table import JUDGED, Table, compare, gaps_by_clip
from tapip3d_lite.lab.train import interruptible
from tapip3d_lite.lab.variant import Variant
from tapip3d_lite.measures import flawed_on_purpose
from tapip3d_lite.training.run_folder import read_log
from tapip3d_lite.validate import check_device, check_names, checked


class Study:
    """Rows of an experiment that differ in nothing but what they say.

    All rows see the same clips through the same encoder (another one only where its sizes differ), and those of one seed
    the same examples, points and augmentations in the same order.
    """

    @checked
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
        accept_code: bool = False,
        parts: Sequence[Any] = (),
    ) -> None:
        """Plan a study, or open one; nothing is computed yet. What a folder's study has, need not be given again.

        Args:
            folder: made if missing. Rows and seeds may be added to an old study; the rest must be as it was.
            rows: None: those of the folder.
            seeds: number of trainings of each row; by default 3.
            budget: a name of `BUDGETS`, by default `"lab"`, or one's own.
            steps: of every row, in place of the budget's.
            minutes, flops: time on one core, or floating-point operations, that the training of every row takes, in
                however many steps.
            store: what studies can share; by default `folder / "store"`.
            accept_code: go on with results of other code; each result says with which code it was made.
            parts: custom parts, or modules, that rows and budget of the folder may name, as for `load_tracker`; what the
                caller gives again needs none.

        Raises:
            ValueError: no rows, two of one name, rows that cannot be built, a bad number, or a folder of other rows of
                these names, another budget, clips or code (says what differs).
        """
        folder = Path(folder)
        old = read_json(folder / "study.json") if (folder / "study.json").exists() else None
        if old is None and rows is None:
            raise ValueError(f"Study: {folder} holds no study; give rows, e.g. [Variant('p2n', context='p2n')]")
        if rows is None:
            rows = [Variant.from_dict(name, values, parts) for name, values in old["rows"].items()]
        names = [row.name for row in rows]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"Study: two rows are called {', '.join(twice)}; rename one")
        changes = {k: v for k, v in (("steps", steps), ("minutes", minutes), ("flops", flops)) if v is not None}
        if not rows or len(changes) > 1:
            raise ValueError(
                f"Study: expected rows, at most one of steps, minutes and flops; got {len(rows)} rows, {changes}"
            )
        seeds = seeds if seeds is not None else old["seeds"] if old else 3
        if not isinstance(seeds, int) or seeds < 1:
            raise ValueError(f"Study.seeds: expected a number of trainings of at least 1, got {seeds!r}")
        budget = _chosen(budget, old, parts)
        flops = changes.pop("flops", budget.flops)
        budget = replace(budget, flops=flops, recipe=replace(budget.recipe, **changes))
        store = Path(store) if store else folder / "store"
        self.plan = Plan(folder, store, dict(zip(names, rows, strict=True)), seeds, budget)
        self.plan.check_rows()
        self.paper: dict[str, Any] | None = None  # what it says of these rows, see `claims`
        if old is not None:
            self.plan.take_over(old, accept_code)

    def run(
        self, jobs: int = 1, device: str = "cpu", stop: Callable[[], bool] = lambda: False, progress: bool = True
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
            ValueError: clips that are too few or have changed, a full disk.
        """
        return run_together([self], jobs, device, stop, progress)

    def results(self) -> dict[str, dict[int, dict[str, Any]]]:
        """What the files of results hold, by row and seed; a tracker that is not trained has the seed 0 alone."""
        return self.plan.results()

    def table(self, against: str | None = None, metric: str | Sequence[str] = JUDGED) -> Table:
        """Scores, differences to a row (by default the first), verdicts and costs; what is not finished is left out.

        Args:
            against: the row that the others are compared with.
            metric: of `evaluate`; several judge in their order.

        Raises:
            ValueError: an unknown row or metric, or no results yet.
        """
        metrics = (metric,) if isinstance(metric, str) else tuple(metric)
        results = self.results()
        table = compare(results, against or next(iter(self.plan.rows)), metrics)
        return with_claims(table, results, self.paper) if self.paper else table

    def report(self, folder: str | Path, against: str | None = None) -> Path:
        """Write the table, curves, intervals, costs and worst clips as Markdown with figures (PNG), and all as JSON.

        Returns the Markdown file. ValueError as for `table`.
        """
        table, results, logs = self.table(against), self.results(), {}
        for name, seeds in results.items():
            training = next((x["training"] for x in seeds.values() if x.get("training") and "scores" in x), None)
            if training and (log := self.plan.store / "trainings" / training / "log.jsonl").exists():
                logs[name] = read_log(log)
        return write_report(Path(folder), table, results, logs, self.plan.to_dict())

    @flawed_on_purpose()
    def tracks(self, row: str, clip: str, seed: int = 0) -> tuple[Clip, Tracks]:
        """A held-out clip as a row saw it, and the row's tracks; ValueError where these were not scored, or weights are missing."""
        found = self.results().get(row, {}).get(seed, {})
        if clip not in found.get("scores", {}):
            raise ValueError(f"Study: row {row!r} has no scores of {clip!r} with seed {seed}; run the study first")
        training = found["training"] and self.plan.store / "trainings" / found["training"]
        if training and not (training / "weights.safetensors").exists():
            raise ValueError(
                f"Study: the weights of row {row!r}, seed {seed}, are not in {training}; a shipped table has those of seed 0"
            )
        index, path = next((i, path) for i, path in enumerate(self.plan.judged) if path.stem == clip)
        variant = self.plan.rows[row]
        seen = under(judged_clip(path, self.plan.budget), variant.degrade, index)
        custom = [] if training is None else self.plan.recipe(variant).custom
        return seen, tracker_of(variant, training, custom=custom).track(seen, **variant.options())

    def draw(self, one: str, other: str, rank: int = 0, seed: int = 0, metric: str = JUDGED[0]) -> Figure:
        """The track on which two rows differ most, in the clip on which they do, or in the next ones (`rank` 1, 2, …)."""
        clips = gaps_by_clip(self.results(), one, other, metric, seed)
        if not 0 <= rank < len(clips):
            raise ValueError(f"Study.draw: rank must be in [0, {len(clips) - 1}], got {rank}")
        seeds = [0 if self.plan.rows[row].given is not None else seed for row in (one, other)]
        seen = [self.tracks(row, clips[rank][0], s) for row, s in zip((one, other), seeds, strict=True)]
        return where_they_differ(dict(zip((one, other), seen, strict=True)))

    def explore(self) -> Any:
        """A widget: choose two rows, a seed and how far down the list of clips to go; it shows what `draw` draws."""
        clips = max(len(x.get("scores", ())) for seeds in self.results().values() for x in seeds.values())
        return explorer(list(self.plan.rows), self.plan.seeds, clips, self.draw)


def run_together(studies: Sequence[Study], jobs: int, device: str, stop: Callable[[], bool], progress: bool) -> bool:
    """`Study.run` for several studies under one bar: what they share is trained once, and none waits for another's end.

    Those that share a store must have one budget.
    """
    if jobs < 1:
        raise ValueError(f"Study.run: expected at least one job, got {jobs}")
    check_device(device)
    plans = [(study.plan, study.plan.find_clips(jobs, progress)) for study in studies]
    with interruptible() as interrupted:
        work = partial(_work, jobs, lambda: stop() or interrupted(), progress)
        failed = work(shared(job for plan, data in plans for job in plan.encoders(data, device)))
        if failed is None:
            return False
        if failed:
            raise ValueError(f"Study: the encoder could not be trained: {'; '.join(failed.values())}")
        todo = shared(job for plan, data in plans for job in plan.trainings(data, device))
        failed = work(todo)
    for job in (job for job in todo if failed and job.name in failed):
        for row, file, facts in (one for one in job.rows if not is_scored(one[1], one[2]["key"])):
            values = {**facts, "row": row.name, "failed": failed[job.name]}
            write_text(file, json.dumps(values, indent=1) + "\n")
    return failed is not None


def _chosen(budget: str | Budget | None, old: dict[str, Any] | None, parts: Sequence[Any]) -> Budget:
    if isinstance(budget, Budget):
        return budget
    if budget is None and old is not None:
        return Budget.from_dict(old["budget"], parts)
    check_names("Study.budget", ["lab" if budget is None else budget], BUDGETS)
    return BUDGETS["lab" if budget is None else budget]


def _work(processes: int, stop: Callable[[], bool], progress: bool, todo: Sequence[Job]) -> dict[str, str] | None:
    """Do jobs under one bar; the reasons of those that failed, or None where it was stopped."""
    done = {job.name: 0 for job in todo}
    with tqdm(total=sum(job.steps for job in todo), unit="step", disable=not (progress and todo)) as bar:

        def tell(name: str, steps: int) -> None:
            done[name] = steps
            bar.set_description(f"{np.count_nonzero(list(done.values()))} of {len(todo)} begun · {name}", refresh=False)
            bar.update(sum(done.values()) - bar.n)

        ended = do_all(todo, processes, tell, stop)
    if STOPPED in ended.values():
        return None
    return {name: reason for name, reason in ended.items() if reason != "done"}
