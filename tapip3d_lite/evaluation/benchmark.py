"""The Lite benchmark: scores of trackers on clips that no training has seen, with confidence intervals of the means.

Results are nested dictionaries, `results[label][split][clip][metric]`, which JSON can hold as they are.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from tqdm import tqdm

from tapip3d_lite.evaluation.baselines import TrackerLike
from tapip3d_lite.evaluation.evaluate import evaluate, markdown_table
from tapip3d_lite.evaluation.intervals import Estimate, bootstrap_interval, paired_difference
from tapip3d_lite.evaluation.lite_splits import ALL, COUNT, SPLITS, benchmark_clips, check_request, split_file
from tapip3d_lite.files import digest, read_json, write_text
from tapip3d_lite.measures import flawed_on_purpose
from tapip3d_lite.parts import source

Results = dict[str, dict[str, dict[str, dict[str, float]]]]  # label → split → clip → metric → score
METRICS = ("AJ3D_none", "APD3D_none", "AJ3D", "APD3D", "OA")


@flawed_on_purpose()  # poses in `drift`
def run_benchmark(
    runs: Iterable[tuple[str, TrackerLike, Mapping[str, object]]],
    splits: Sequence[str] = SPLITS,
    count: int | None = None,
    out: str | Path | None = None,
    progress: bool = True,
) -> Results:
    """Track and score the clips of some splits.

    Args:
        runs: (label, tracker, options of its `track`), e.g. `("mine", tracker, {"space": "camera"})`.
        splits: some of `lite_splits.ALL`.
        count: only the first so many clips of each split.
        out: JSON file, saved after every clip. Clips that it holds are not tracked again, unless the weights (or a
            baseline's settings) or the benchmark have changed since.
        progress: show bars.

    Returns:
        Results of these runs, with everything that `evaluate` gives: all, `_dynamic` and `_static` points.

    Raises:
        ValueError: unknown split, bad count, an unreadable file, or clips that differ from the benchmark's.
    """
    for split in splits:
        check_request(split, count)
    results, versions = load_results(out) if out and Path(out).exists() else ({}, {})
    wanted = {}
    for label, tracker, options in list(runs):  # all are there, or refused, before the first one works
        version = version_of(tracker, options)
        if versions.get(label) != version:
            results[label], versions[label] = {}, version
        wanted[label] = results[label]
        with tqdm(total=len(splits) * min(count or COUNT, COUNT), desc=label, unit="clip", disable=not progress) as bar:
            for split in splits:
                part = wanted[label].setdefault(split, {})
                for clip in benchmark_clips(split, count, progress):
                    if clip.name not in part:
                        part[clip.name] = evaluate(tracker.track(clip, **options), clip)
                        if out:
                            save_results(out, results, versions)
                    bar.update()
    return wanted


def version_of(tracker: object, options: Mapping[str, object]) -> str:
    """A short digest of all that scores depend on: the benchmark's clips, a tracker's settings, code, weights, options."""
    config, state = getattr(tracker, "config", tracker), tracker.state_dict() if hasattr(tracker, "state_dict") else {}
    seen = [*(split_file(split).read_bytes() for split in ALL), f"{config!r} {sorted(options.items())}"]
    seen += [source(part) for part in getattr(config, "custom", ())]
    weights = (name.encode() + x.cpu().float().contiguous().numpy().tobytes() for name, x in state.items())
    return digest(*seen, *weights)


def save_results(path: str | Path, results: Results, versions: Mapping[str, str | None] | None = None) -> None:
    """Write results as JSON, atomically; `versions` holds each label's digest from `version_of`."""
    rows = {
        label: {"version": (versions or {}).get(label), "scores": _map(scores, lambda x: None if math.isnan(x) else x)}
        for label, scores in results.items()
    }
    write_text(path, json.dumps(rows, indent=1) + "\n")


def load_results(path: str | Path) -> tuple[Results, dict[str, str | None]]:
    """Read what `save_results` wrote: results, and the digest of each label; else ValueError."""

    def read(rows: dict) -> tuple[Results, dict[str, str | None]]:
        results = {x: _map(row["scores"], lambda v: math.nan if v is None else float(v)) for x, row in rows.items()}
        return results, {x: row["version"] for x, row in rows.items()}

    return read_json(path, read)


def _map(scores: dict, change: Callable) -> dict:
    return {k: _map(v, change) if isinstance(v, dict) else change(v) for k, v in scores.items()}


def estimate(results: Results, label: str, split: str, metric: str) -> Estimate:
    """Mean over a split's clips with its 95 % bootstrap interval; ValueError where there is no such label or split."""
    if split not in results.get(label, {}):
        raise ValueError(f"results: no scores of {label!r} on {split!r}; there are {', '.join(results) or 'none'}")
    clips = results[label][split]
    return bootstrap_interval([clips[name].get(metric, math.nan) for name in sorted(clips)])


def summary_table(results: Results, metrics: Sequence[str] = METRICS, splits: Sequence[str] = ALL) -> str:
    """A Markdown table: one row a split (clips) and tracker, means with 95 % bootstrap intervals over clips."""
    rows = [
        [f"{split} ({len(scores[split])})", label, *(show(estimate(results, label, split, m)) for m in metrics)]
        for split in splits
        for label, scores in results.items()
        if split in scores
    ]
    return markdown_table(["split", "tracker", *metrics], rows)


def difference_table(results: Results, ours: str, theirs: str, metrics: Sequence[str] = METRICS) -> str:
    """A Markdown table of ours - theirs, paired by clip, with 95 % intervals; one row a split."""
    one, other = results.get(ours, {}), results.get(theirs, {})
    rows = []
    for split in (split for split in ALL if split in one and split in other):
        common = sorted(one[split].keys() & other[split].keys())
        pairs = ([[scores[split][c].get(m, math.nan) for c in common] for scores in (one, other)] for m in metrics)
        rows.append([f"{split} ({len(common)})", *(show(paired_difference(*pair), "+") for pair in pairs)])
    return markdown_table([f"{ours} - {theirs}", *metrics], rows)


def show(value: Estimate, sign: str = "") -> str:
    """`mean [low, high]` with three decimals."""
    return f"{value.mean:{sign}.3f} [{value.low:{sign}.3f}, {value.high:{sign}.3f}]"
