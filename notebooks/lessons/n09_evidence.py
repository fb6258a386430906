"""Lesson 09: a claim about one row of a study on one page, with its setting, its numbers, and what would refute it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tapip3d_lite.evaluation.evaluate import markdown_table
from tapip3d_lite.files import digest, write_text
from tapip3d_lite.lab import Study
from tapip3d_lite.lab.table import TITLES, gaps_by_clip, shown

_WORDS = {
    "better": "supported",
    "worse": "refuted: the difference has the other sign",
    "undecided": "undecided, after Holm's correction over all comparisons of the table",
}


@dataclass(frozen=True, repr=False)
class Evidence:
    """A page of Markdown; a notebook shows it as text.

    Attributes:
        text: the page.
        verdict: `"supported"`, `"refuted: …"` or `"undecided, …"`.
        path: where it was written.
    """

    text: str
    verdict: str
    path: Path

    def __repr__(self) -> str:
        return self.text

    _repr_markdown_ = __repr__


def hearing(study: Study, control: str, against: str) -> str:
    """Whether a study tells a control, which must lose, from a row: in words, with the difference.

    ValueError as for `Study.table`, and where the two rows have no scores with the same seed.
    """
    table = study.table(against)
    one = {row["row"]: row for row in table.rows}[control][table.metrics[0]]
    if "verdict" not in one:
        raise ValueError(f"hearing: {control!r} and {against!r} have no scores with the same seed; run the study first")
    told = one["verdict"] == "worse"
    meaning = "so this study can hear" if told else "so this study is deaf, and its other rows mean nothing yet"
    return f"{control} minus {against}: {shown(one['difference'], '+')}; {'it loses' if told else 'it does not lose'}, {meaning}"


def evidence(
    study: Study, row: str, against: str, control: str, claim: str, refuted_by: Sequence[str], path: str | Path
) -> Evidence:
    """Write what a study says about the claim that a row is better than another one.

    Every number is read from the study; the words alone are the caller's.

    Args:
        study: run, with scores of both rows.
        row, against: the row that the claim is about, and the one that it is compared with.
        control: a row that must lose.
        claim: one sentence.
        refuted_by: what would show that it is wrong; at least one sentence.
        path: of the page.

    Raises:
        ValueError: no sentence that would refute the claim, or what `Study.table` refuses.
    """
    if not claim.strip() or not [sentence for sentence in refuted_by if sentence.strip()]:
        raise ValueError("evidence: a claim that nothing could refute says nothing; name what would")
    table, results, plan = study.table(against), study.results(), study.plan
    found = {one["row"]: one for one in table.rows}
    first = table.metrics[0]
    if "verdict" not in found[row][first]:
        raise ValueError(f"evidence: {row!r} and {against!r} have no scores with the same seed; run the study first")
    verdict, recipe = _WORDS[found[row][first]["verdict"]], plan.budget.recipe
    cells = []
    for metric in table.metrics:
        ours, theirs = found[row][metric], found[against][metric]
        difference = ours["difference"]
        seen = f"{difference['seen']:.3f}"
        cells.append(
            [TITLES.get(metric, metric), shown(theirs), shown(ours), shown(difference, "+"), ours["verdict"], seen]
        )
    head = ["", against, row, "difference", "verdict", "smallest that would be seen"]
    gaps = gaps_by_clip(results, row, against, first)
    worst = min(gaps, key=lambda pair: pair[1])
    costs = [
        f"{title}: {found[against][name] / unit:.3g} → {found[row][name] / unit:.3g}"
        for name, title, unit in (
            ("parameters", "parameters (M)", 1e6),
            ("multiply_adds", "multiply-adds a query and frame (M)", 1e6),
            ("steps", "steps", 1),
        )
        if found[against][name] and found[row][name]
    ]
    lines = [
        f"### Claim: {claim}",
        f"**{verdict[0].upper() + verdict[1:]}**, by {TITLES.get(first, first)} over {plan.seeds} seeds and {len(gaps)} clips; "
        f"{len(table.rows) - 1} rows of the study were compared with {against} in {len(table.metrics)} metrics.",
        f"**Setting.** {recipe.clips} training clips of {recipe.tracker_config().image_size} pixels, one encoder, "
        f"frozen after {recipe.matching_steps} steps of matching; {recipe.frames[1]} frames and {recipe.sampling.tracks} "
        f"tracks an example; seeds 0 to {plan.seeds - 1}. What differs: `{plan.rows[row].to_dict()}`.",
        markdown_table(head, cells),
        *([f"**Costs.** {'; '.join(costs)}."] if costs else []),
        f"**Against it.** The clip on which {row} loses most, or gains least: {worst[0]}, {worst[1]:+.3f}. "
        f"It is behind on {sum(gap < 0 for _, gap in gaps)} of {len(gaps)} clips.",
        f"**Control.** {hearing(study, control, against)}.",
        "**What would refute it.**\n\n" + "\n".join(f"- {sentence}" for sentence in refuted_by if sentence.strip()),
        f"Code {digest(str(sorted(plan.code.items())))}, clips {digest(str(sorted(plan.clips.items())))}.",
    ]
    text = "\n\n".join(lines) + "\n"
    write_text(path, text)
    return Evidence(text, verdict, Path(path))
