"""Lesson 00: bars of scores, the model card in a few words, and the learner's scores in the library's evaluation."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import tapip3d_lite as t3d
from lessons.checker import check
from lessons.guesses import reveal
from lessons.milestone import CLIP, plugged, report
from lessons.n00_exercises import MOVERS, VISIBLE
from lessons.n00_flow import one_frame, patches_figure, repairs_figure
from lessons.n00_scores import HITS, SCALE, SCORES
from lessons.pictures import pipeline, show
from lessons.progress import collect, in_use, progress, reset
from lessons.verdict import Verdict
from lessons.widgets import explore
from tapip3d_lite.figures.flat import label_axes
from tapip3d_lite.files import shipped_weights
from tapip3d_lite.geometry import THRESHOLDS

__all__ = [
    "EXERCISES",
    "card",
    "check",
    "collect",
    "explore",
    "in_use",
    "milestone",
    "one_frame",
    "parts",
    "patches_figure",
    "pipeline",
    "progress",
    "repairs_figure",
    "reset",
    "reveal",
    "scores_bar",
    "show",
]

Array = np.ndarray
EXERCISES = (MOVERS, VISIBLE, HITS, SCORES, SCALE)
_COLORS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7")  # safe for the colour-blind (Okabe and Ito)
_HATCHES = ("", "//", "..", "xx")


def scores_bar(
    scores: Mapping[str, Mapping[str, float]], metrics: Mapping[str, str] | Sequence[str] = ("AJ3D", "APD3D", "OA")
) -> Figure:
    """Scores of several trackers side by side, with the numbers written on the bars.

    Args:
        scores: tracker name to the dictionary that `evaluate` returns.
        metrics: which entries to show; as a mapping, with the words to show them under.
    """
    names = metrics if isinstance(metrics, Mapping) else dict(zip(metrics, metrics, strict=True))
    figure = Figure(figsize=(1.9 * len(names) + 1.5, 2.7), layout="constrained")
    ax = figure.add_subplot()
    step = 0.8 / len(scores)
    for i, (name, values) in enumerate(scores.items()):
        at = np.arange(len(names)) + (i - (len(scores) - 1) / 2) * step
        style = {"color": _COLORS[i % 4], "hatch": _HATCHES[i % 4], "edgecolor": "white"}
        bars = ax.bar(at, [values[m] for m in names], step * 0.92, label=name, **style)
        ax.bar_label(bars, fmt="%.2f", fontsize=8, padding=1)
    ax.set_xticks(range(len(names)), names.values())
    ax.set_ylim(0, 1.1)
    label_axes(ax, "score, 0 to 1", "")
    ax.tick_params(labelsize=8.5)
    ax.legend(fontsize=8, frameon=False, ncols=len(scores), loc="upper center", bbox_to_anchor=(0.5, 1.2))
    return figure


def card(name: str = "lite") -> dict[str, str]:
    """The facts on a shipped tracker's model card, and the sentences of its limits under `"limits"`; empty without one."""
    path = shipped_weights().get(name, Path()).with_suffix(".md") if name in shipped_weights() else None
    if path is None or not path.is_file():
        return {}
    text = path.read_text(encoding="utf-8")
    facts = dict(re.findall(r"^\| ([\w -]+) \| (.+?) \|$", text.split("## ")[0], re.MULTILINE))
    limits = text.split("## Limits")[-1].split("\n## ")[0]
    return facts | {"limits": " ".join(limits.replace("\n- ", " ").split())}


def parts(use: Callable[[str], Callable[..., object]]) -> dict[str, object]:
    """The learner's scores at their places in the library's evaluation."""
    hits, two_scores, factor = (use(f"00.{name}") for name in ("hits", "two_scores", "median_scale"))

    def metrics(p: Array, seen: Array, q: Array, said: Array, intrinsics: Array, scaling: str) -> dict[str, float]:
        """In place of `tapvid3d_metrics`, whose predictions `evaluate` has scaled already."""
        focal = np.sqrt(intrinsics[:, 0, 0] * intrinsics[:, 1, 1]).astype(float)
        rows = [two_scores(hits(p, q, focal, k), seen, said) for k in THRESHOLDS]
        apd, jaccard = np.mean(np.asarray(rows, float), axis=0)
        return {"AJ3D": float(jaccard), "APD3D": float(apd), "OA": float((seen == said).mean())}

    module = "tapip3d_lite.evaluation.evaluate"
    return {
        f"{module}:tapvid3d_metrics": metrics,
        f"{module}:scale_factor": lambda p, q, both, _start, _scaling: factor(p, q, both, both),
    }


def milestone(*lessons: str) -> Verdict:
    """Score two trackers with the learner's functions in the library's evaluation, and compare with the library.

    Passed: each function is the learner's, the evaluation called each, and no score differs.
    """
    calls: dict[str, int] = {}
    with plugged(lessons or ("00",), calls):
        mine = _evaluated()
    library = _library()
    apart = float(np.abs(mine - library).max())
    opening = f"{len(calls)} functions in the evaluation; {mine.size} scores of Lucas-Kanade and static on one clip"
    return report(calls, apart < 1e-3, opening, f"largest difference from the library's scores: {apart:.6f}")


@cache
def _tracks() -> tuple:
    clip = t3d.load_clip(CLIP)
    return clip, [t3d.load_tracker(name).track(clip) for name in ("klt", "static")]


def _evaluated() -> Array:
    clip, tracks = _tracks()
    rows = [t3d.evaluate(one, clip) for one in tracks]
    names = [name for name in rows[0] if name.startswith(("AJ3D", "APD3D", "OA"))]
    return np.array([[row[name] for name in names] for row in rows])


_library = cache(_evaluated)
