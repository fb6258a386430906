"""Scores of trackers by name on the Lite benchmark, for `python -m tapip3d_lite benchmark`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from tapip3d_lite.evaluation.baselines import KltTracker, StaticTracker, TrackerLike
from tapip3d_lite.evaluation.benchmark import SPLITS, Results, load_results, run_benchmark, save_results, version_of
from tapip3d_lite.trackers import load_tracker


def score_trackers(
    trackers: Sequence[str | Path] = ("static", "klt"),
    splits: Sequence[str] = SPLITS,
    spaces: Sequence[str] = ("world",),
    count: int | None = None,
    out: str | Path | None = None,
    device: str = "cpu",
    progress: bool = True,
) -> Results:
    """Score trackers on splits of the Lite benchmark, learnt ones in each of some spaces.

    Args:
        trackers: names or weights files, as `load_tracker` takes them.
        splits: some of `SPLITS`.
        spaces: "world", "camera"; baselines know no space and are run once.
        count: only the first so many clips of each split.
        out: JSON file, saved after every clip. Clips that it holds are not tracked again, unless the weights (or a
            baseline's settings) or the benchmark have changed since.
        device: where learnt trackers compute.
        progress: show bars.

    Returns:
        Results of these trackers, labelled `klt` or `lite · world`.

    Raises:
        ValueError: unknown tracker, split or space, or an unreadable file.
    """
    results, versions = load_results(out) if out and Path(out).exists() else ({}, {})
    labels = []
    for name in trackers:
        tracker = load_tracker(name, device=device)
        for label, options in _runs(name, tracker, spaces):
            version = version_of(tracker, options)
            if versions.get(label) != version:
                results[label], versions[label] = {}, version
            save = partial(_save, out, results, versions) if out else None
            run_benchmark(tracker, splits, count, results[label], save, progress=progress, desc=label, **options)
            labels.append(label)
    return {label: results[label] for label in dict.fromkeys(labels)}


def _runs(name: str | Path, tracker: TrackerLike, spaces: Sequence[str]) -> list[tuple[str, dict[str, str]]]:
    """(label, options of `track`) of each run of a tracker."""
    if isinstance(tracker, StaticTracker | KltTracker):
        return [(str(name), {})]
    return [(f"{Path(name).with_suffix('')} · {space}", {"space": space}) for space in spaces]


def _save(out: str | Path, results: Results, versions: dict[str, str | None], _: object) -> None:
    save_results(out, results, versions)
