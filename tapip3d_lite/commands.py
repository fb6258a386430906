"""Commands for those who train, measure, teach and maintain; `__main__` offers them beside the everyday ones."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

import tapip3d_lite as t3d


def card(
    folder: Positional[Path],
    results: Positional[Path],
    /,
    hardware: Annotated[str, arg(help="what it was trained on, in words")],
    out: Annotated[Path, arg(help="Markdown file")] = Path("MODEL_CARD.md"),
    name: Annotated[str, arg(help="of the model")] = "lite",
    weights: Annotated[Path | None, arg(help="the file, if not the folder's own")] = None,
    command: Annotated[str | None, arg(help="that made it, e.g. with torchrun; default: from the recipe")] = None,
) -> None:
    """Write the model card of a training folder and of results that `benchmark --out` wrote."""
    from tapip3d_lite.files import atomic_path
    from tapip3d_lite.lab.card import model_card

    text = model_card(folder, results, hardware, name, command, weights)
    with atomic_path(out) as temporary:
        temporary.write_text(text, encoding="utf-8")
    print(f"wrote {out}")


def curves(
    folders: Positional[Annotated[tuple[Path, ...], arg(help="of trainings, or their log.jsonl; one row each")]],
    /,
    out: Annotated[Path, arg(help="picture (PNG)")] = Path("learning_curves.png"),
    by: Annotated[str, arg(help="step or minutes")] = "step",
) -> None:
    """Draw the learning curves of trainings, finished or not: matching, loss, accuracy, held-out scores."""
    from tapip3d_lite.training.run_folder import read_log
    from lessons.n06_live import learning_curves

    logs = [(folder.stem if folder.is_file() else folder.resolve().name, read_log(folder)) for folder in folders]
    t3d.figures.save_png(learning_curves(logs, by=by), out)
    print(f"wrote {out}")


def samples(out: Path = Path("data_samples")) -> None:
    """Regenerate the sample clips and their table from seeds."""
    from lessons.samples import write_samples

    write_samples(out)


def import_(checkpoint: Positional[Path], out: Positional[Path], /) -> None:
    """Convert the authors' checkpoint (.pth) to a weights file of ours (.safetensors)."""
    tracker = t3d.load_official(checkpoint)
    t3d.save_weights(tracker, out)
    count = sum(p.numel() for p in tracker.parameters())
    print(f"wrote {out}: {count / 1e6:.2f} M parameters; use it with --tracker {out}")


def picture(
    clip: Positional[Path] = Path("data_samples/arc.npz"), /, out: Path = Path("data_samples/picture.png")
) -> None:
    """Draw the true tracks of a clip over its frames and depth, as in the README."""
    loaded = t3d.load_clip(clip)
    if loaded.tracks is None:
        raise ValueError(f"{clip}: no true tracks to draw; use `track` with --png")
    t3d.figures.save_png(t3d.figures.overview(loaded, loaded.tracks.select(slice(0, None, 3))), out)
    print(f"wrote {out}")


def bench(
    parts: Positional[
        Annotated[tuple[str, ...], arg(help="model iteration knn training scaling gpu memory; default: all")]
    ] = (),
    /,
    quick: Annotated[bool, arg(help="small sizes, about a minute")] = False,
    rounds: Annotated[int | None, arg(help="how often each way is measured")] = None,
    threads: Annotated[int | None, arg(help="of torch; default: its own choice")] = None,
    out: Annotated[Path | None, arg(help="JSON with every measurement")] = None,
    figure: Annotated[Path | None, arg(help="picture (PNG) of stages and memory")] = None,
) -> None:
    """Measure speed and memory against straightforward forms; prints a Markdown table."""
    import json
    from dataclasses import asdict

    import torch

    from tests.bench import bench as measure
    from tapip3d_lite.files import atomic_path

    if threads is not None:
        torch.set_num_threads(threads)
    rows = list(measure.bench(parts or tuple(measure.PARTS), quick, rounds))
    print(measure.table(rows))
    if out:
        with atomic_path(out) as temporary:
            temporary.write_text(json.dumps([asdict(row) for row in rows], indent=1), encoding="utf-8")
        print(f"wrote {out}")
    if figure:
        from tests.bench.speed_figure import speed

        t3d.figures.save_png(speed(rows), figure)
        print(f"wrote {figure}")


def formulas(out: Path = Path("notebooks/FORMULAS.md")) -> None:
    """Write the table "formula → symbol → tensor → shape → file:line" from the code."""
    from tapip3d_lite.files import atomic_path
    from lessons.formulas import formula_table

    with atomic_path(out) as temporary:
        temporary.write_text(formula_table(), encoding="utf-8")
    print(f"wrote {out}")


def teach(
    out: Annotated[Path, arg(help="the pack's folder")],
    notebooks: Annotated[Path, arg(help="folder of the notebooks")] = Path("notebooks"),
    lesson: Annotated[int, arg(help="minutes of a lesson")] = 45,
) -> None:
    """Write a teacher's pack: student and solution versions of all notebooks, and a timing plan."""
    from lessons.teaching import write_pack

    print(f"wrote {len(write_pack(notebooks, out, lesson))} files to {out}; begin with {out / 'TIMING.md'}")
