"""Lesson 06: errors beside those of zero motion, films that hide something, and what a training's steps can prove."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
from matplotlib.figure import Figure

from lessons.guesses import SHOW, Revealed
from lessons.guesses import reveal as reveal_known
from lessons.verdict import Verdict
from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.lab.conditions import under

_SHOWN = ("video", "depths", "intrinsics", "extrinsics")
COLORS = ("#000000", "#0072b2", "#e69f00", "#d55e00", "#cc79a7", "#009e73")  # of Okabe and Ito
MARKS = "osD^vP"


def grey(clip: Clip) -> Clip:
    """Every pixel of the film has one grey: nothing to see, all depths to feel."""
    return under(clip, {"grey": True}, 0)


def frozen(clip: Clip, what: Sequence[str] = _SHOWN) -> Clip:
    """Parts of the film stand still at its first frame; by default all of them."""
    return reduce(lambda film, part: under(film, {"frozen": part}, 0), what, clip)


def errors(tracks: Tracks, clip: Clip, dynamic: bool = True) -> np.ndarray:
    """Mean 3D error (m) in each frame after the first, over visible points that move (or do not); nan where none is."""
    counts = clip.tracks.visible & (clip.tracks.dynamic == dynamic)
    gap = np.linalg.norm(tracks.xyz - clip.tracks.xyz, axis=-1)
    total, number = (gap * counts).sum(1)[1:], counts.sum(1)[1:]
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)


@dataclass(frozen=True)
class Ratio:
    """An error divided by zero motion's, with a 95 % bootstrap interval over clips."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.2f} [{self.low:.2f}, {self.high:.2f}]"

    def below(self, limit: float) -> bool:
        """Whether the whole interval lies below a limit."""
        return self.high < limit


def ratio(runs: Sequence[Tracks], still: Sequence[Tracks], clips: Sequence[Clip], draws: int = 2000) -> Ratio:
    """Error of moving points over that of zero motion: mean over clips, divided by the mean over clips.

    Args:
        runs: tracks of each clip.
        still: zero motion's.
        clips: with the truth.
        draws: of the bootstrap.
    """
    pairs = np.array(
        [[np.nanmean(errors(x, clip)) for x in pair] for *pair, clip in zip(runs, still, clips, strict=True)]
    )
    picks = np.random.default_rng(0).integers(0, len(pairs), (draws, len(pairs)))
    sums = np.nansum(pairs[picks], 1)  # (draws, 2)
    total = np.nansum(pairs, 0)
    return Ratio(float(total[0] / total[1]), *map(float, np.quantile(sums[:, 0] / sums[:, 1], [0.025, 0.975])))


def verdict(steps: int, enough: int, result: Ratio) -> Verdict:
    """What a training shows: learnt, not learnt, or undecided, because it made too few steps to learn at all.

    Args:
        steps: of tracking that it made.
        enough: that it needs.
        result: its error over zero motion's.
    """
    facts = f"{steps} steps of tracking, error of moving points {result} of zero motion's"
    if result.below(1.0):
        return Verdict("passed", f"learnt: {facts}; the whole interval lies below 1.")
    if steps < enough:
        more = f"about {enough} are needed. The time was short or the machine busy: set MINUTES higher, and run again."
        return Verdict("not attempted", f"undecided: {facts}; {more} Until then nothing below is shown, nor refuted.")
    return Verdict("wrong", f"not learnt: {facts}, although {enough} steps should do.")


def reveal(guess: float | str | None, truth: float | str, **options: object) -> Revealed:
    """As `guesses.reveal`; a guess about what could not be decided is not scored."""
    undecided = truth == "undecided" and guess is not None
    return reveal_known(SHOW if undecided else guess, truth, **options)


def lives_on(live: Ratio, without_colour: Ratio, without_depth: Ratio) -> str:
    """Which input a tracker cannot do without: `"colour"`, `"depth"` or `"both"`; `"undecided"` if it has learnt nothing.

    An input counts if at least a quarter of the gain over zero motion is lost without it.
    """
    gain = 1 - live.value
    if gain < 0.1:
        return "undecided"
    lost = [(film.value - live.value) / gain for film in (without_colour, without_depth)]
    words = [word for word, share in zip(("colour", "depth"), lost, strict=True) if share >= 0.25]
    return "both" if len(words) == 2 else words[0] if words else "neither"


def controls_figure(found: Mapping[str, Mapping[str, Ratio]]) -> Figure:
    """Errors over zero motion's with intervals: one panel a tracker, one row a film.

    Args:
        found: tracker to film to ratio; all with the same films.
    """
    figure = Figure(figsize=(4.6 * len(found), 2.9), layout="constrained")
    axes = figure.subplots(1, len(found), squeeze=False, sharey=True, sharex=True)[0]
    most = max(1.25, *(1.05 * value.high for films in found.values() for value in films.values()))
    for ax, (tracker, films) in zip(axes, found.items(), strict=True):
        for row, value in enumerate(films.values()):
            color, mark = COLORS[1 + row % 5], MARKS[row % len(MARKS)]
            ax.plot([value.low, value.high], [row, row], color=color, lw=2)
            ax.plot(value.value, row, mark, color=color, ms=7)
            ax.annotate(
                f"{value.value:.2f}", (value.value, row), (0, 7), textcoords="offset points", ha="center", size=9
            )
        ax.axvline(1, color=COLORS[0], ls="--", lw=1)
        ax.set_yticks(range(len(films)), list(films))
        ax.set(xlim=(0, most), ylim=(len(films) - 0.5, -0.7), title=tracker, xlabel="error over that of zero motion")
        ax.spines[["top", "right"]].set_visible(False)
    return figure


def error_figure(runs: Mapping[str, Sequence[Tracks]], clips: Sequence[Clip]) -> Figure:
    """Error of moving points (cm) in each frame after the query, mean over clips; one line for each of the runs."""
    figure = Figure(figsize=(7.2, 3.4), layout="constrained")
    ax = figure.subplots()
    for (name, tracks), color, mark in zip(runs.items(), COLORS, MARKS, strict=False):
        curve = 100 * np.nanmean([errors(t, c) for t, c in zip(tracks, clips, strict=True)], 0)
        ax.plot(
            range(1, len(curve) + 1),
            curve,
            "--" if name == "zero motion" else "-",
            marker=mark,
            color=color,
            label=name,
        )
    ax.set(xlabel="frames after the query", ylabel="error of moving points (cm)", ylim=(0, None))
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(frameon=False)
    return figure


def memory_figure(panels: Mapping[str, tuple[Sequence[int], Mapping[str, Sequence[float]]]]) -> Figure:
    """Megabytes kept for the backward pass: for each panel, named by its horizontal axis, x and a line for each way."""
    figure = Figure(figsize=(7.8, 3.0), layout="constrained")
    axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for ax, (label, (x, ways)) in zip(axes, panels.items(), strict=True):
        for (name, y), color, mark in zip(ways.items(), (COLORS[3], COLORS[1]), MARKS, strict=False):
            ax.plot(x, y, "-", marker=mark, color=color, label=name)
        ax.set(xlabel=label, ylim=(0, None), xticks=x)
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("kept for backward (MB)")
    axes[0].legend(frameon=False)
    return figure
