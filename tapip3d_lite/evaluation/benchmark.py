"""The Lite benchmark: scores of trackers on clips that no training has seen, with confidence intervals of the means.

Results are nested dictionaries, `results[label][split][clip][metric]`, which JSON can hold as they are.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from tqdm import tqdm

from tapip3d_lite.clip import Clip
from tapip3d_lite.evaluation.baselines import TrackerLike
from tapip3d_lite.evaluation.evaluate import evaluate
from tapip3d_lite.evaluation.intervals import Estimate, bootstrap_interval, paired_difference
from tapip3d_lite.evaluation.lite_splits import COUNT, FOLDER, SPLITS, benchmark_clips, check_split
from tapip3d_lite.files import write_text

__all__ = [
    "METRICS",
    "SPLITS",
    "benchmark_clips",
    "column",
    "difference_table",
    "estimate",
    "load_results",
    "run_benchmark",
    "save_results",
    "summary_table",
]

ClipScores = dict[str, dict[str, float]]  # clip → metric → score
SplitScores = dict[str, ClipScores]  # split → …
Results = dict[str, SplitScores]  # label → …
METRICS = ("AJ3D_none", "APD3D_none", "AJ3D", "APD3D", "OA")


def run_benchmark(
    tracker: TrackerLike,
    splits: Sequence[str] = SPLITS,
    count: int | None = None,
    done: SplitScores | None = None,
    on_clip: Callable[[SplitScores], None] | None = None,
    cache: str | Path | None = None,
    progress: bool = True,
    desc: str = "scoring",
    **track_options: object,
) -> SplitScores:
    """Track and score the clips of some splits.

    Args:
        tracker: any object with a method `track`.
        splits: some of `SPLITS`.
        count: only the first so many clips of each split.
        done: scores of an earlier, interrupted run; their clips are not tracked again, new scores are added in place.
        on_clip: called after every clip with all scores so far, e.g. to save them.
        cache: folder for the rendered clips (1 MB each); under the user's cache folder if None.
        progress: show bars.
        desc: label of the bar.
        track_options: passed to `track`, e.g. `space="camera"`.

    Returns:
        `scores[split][clip][metric]` with everything that `evaluate` gives: all, `_dynamic` and `_static` points.

    Raises:
        ValueError: unknown split, bad count, or clips that differ from the benchmark's.
    """
    for split in splits:
        check_split(split)
    scores = {} if done is None else done
    total = len(splits) * min(count or COUNT, COUNT)
    with tqdm(total=total, desc=desc, unit="clip", disable=not progress) as bar:
        for split in splits:
            part = scores.setdefault(split, {})
            for clip in benchmark_clips(split, count, cache, progress=progress):
                if clip.name not in part:
                    part[clip.name] = _score(tracker, clip, track_options)
                    if on_clip:
                        on_clip(scores)
                bar.update()
    return scores


def _score(tracker: TrackerLike, clip: Clip, options: Mapping[str, object]) -> dict[str, float]:
    return evaluate(tracker.track(clip, **options), clip)


def version_of(tracker: object, options: Mapping[str, object]) -> str:
    """A short digest of everything that scores depend on: the benchmark's clips, a tracker's settings, weights, options."""
    digest = hashlib.sha256()
    for split in SPLITS:
        digest.update((FOLDER / f"{split}.npz").read_bytes())
    digest.update(f"{getattr(tracker, 'config', tracker)!r} {sorted(options.items())}".encode())
    if hasattr(tracker, "state_dict"):
        for name, weights in tracker.state_dict().items():
            digest.update(name.encode() + weights.cpu().float().contiguous().numpy().tobytes())
    return digest.hexdigest()[:12]


def save_results(path: str | Path, results: Results, versions: Mapping[str, str | None] | None = None) -> None:
    """Write results as JSON, atomically; `versions` holds each label's digest from `version_of`."""
    rows = {
        label: {"version": (versions or {}).get(label), "scores": _map(scores, lambda x: None if math.isnan(x) else x)}
        for label, scores in results.items()
    }
    write_text(path, json.dumps(rows, indent=1) + "\n")


def load_results(path: str | Path) -> tuple[Results, dict[str, str | None]]:
    """Read what `save_results` wrote: results, and the digest of each label.

    Raises:
        ValueError: the file is missing or holds something else.
    """
    try:
        rows = json.loads(Path(path).read_text(encoding="utf-8"))
        results = {x: _map(row["scores"], lambda v: math.nan if v is None else v) for x, row in rows.items()}
        return results, {x: row["version"] for x, row in rows.items()}
    except (OSError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: not readable benchmark results ({error}); delete it or name another file") from error


def _map(scores: dict, change: Callable) -> dict:
    return {k: _map(v, change) if isinstance(v, dict) else change(v) for k, v in scores.items()}


def column(results: Results, label: str, split: str, metric: str) -> list[float]:
    """One score for each clip, in the order of their names; NaN where a clip lacks it.

    Raises:
        ValueError: no such label or split.
    """
    if split not in results.get(label, {}):
        raise ValueError(f"results: no scores of {label!r} on {split!r}; there are {', '.join(results) or 'none'}")
    clips = results[label][split]
    return [clips[name].get(metric, math.nan) for name in sorted(clips)]


def estimate(results: Results, label: str, split: str, metric: str) -> Estimate:
    """Mean over a split's clips with its 95 % bootstrap interval."""
    return bootstrap_interval(column(results, label, split, metric))


def summary_table(results: Results, metrics: Sequence[str] = METRICS, splits: Sequence[str] = SPLITS) -> str:
    """A Markdown table: one row a split (clips) and tracker, means with 95 % bootstrap intervals over clips."""
    lines = _head("split", "tracker", *metrics)
    for split in splits:
        for label in (label for label in results if split in results[label]):
            cells = [show(estimate(results, label, split, metric)) for metric in metrics]
            lines.append(f"| {split} ({len(results[label][split])}) | {label} | {' | '.join(cells)} |")
    return "\n".join(lines)


def difference_table(
    results: Results, ours: str, theirs: str, metrics: Sequence[str] = METRICS, splits: Sequence[str] = SPLITS
) -> str:
    """A Markdown table of ours - theirs, paired by clip, with 95 % intervals; one row a split."""
    lines = _head(f"{ours} - {theirs}", *metrics)
    for split in (split for split in splits if all(split in results.get(label, {}) for label in (ours, theirs))):
        common = sorted(results[ours][split].keys() & results[theirs][split].keys())
        cells = []
        for metric in metrics:
            pair = ([results[x][split][clip].get(metric, math.nan) for clip in common] for x in (ours, theirs))
            cells.append(show(paired_difference(*pair), "+"))
        lines.append(f"| {split} ({len(common)}) | {' | '.join(cells)} |")
    return "\n".join(lines)


def show(value: Estimate, sign: str = "") -> str:
    """`mean [low, high]` with three decimals."""
    return f"{value.mean:{sign}.3f} [{value.low:{sign}.3f}, {value.high:{sign}.3f}]"


def _head(*names: str) -> list[str]:
    return ["| " + " | ".join(names) + " |", "|---" * len(names) + "|"]
