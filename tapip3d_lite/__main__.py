"""The command line: `python -m tapip3d_lite track IN.npz --out OUT.npz --html OUT.html`.

What cannot work ends with one line on standard error and exit code 2, a lost worker with 1, Ctrl-C with 130.
"""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tqdm import tqdm
from tyro.conf import Positional, arg

import tapip3d_lite as t3d
from tapip3d_lite.evaluation.benchmark import ALL, METRICS, SPLITS, run_benchmark, summary_table
from tapip3d_lite.evaluation.evaluate import mean_scores, score_table
from tapip3d_lite.export import check_export
from tapip3d_lite.files import check_suffix, write_text
from tapip3d_lite.formats import FORMATS
from tapip3d_lite.lab.card import model_card
from tapip3d_lite.lab.table import JUDGED
from tapip3d_lite.queries import QueryChoice
from tapip3d_lite.refusals import later, parsed, refusals
from tapip3d_lite.simulate import simulate_dataset
from tapip3d_lite.trackers import tracker_runs
from tapip3d_lite.training.recipe import TrainConfig

Names, Paths, Box = tuple[str, ...], tuple[Path, ...], tuple[int, int, int, int]
Format = Annotated[str, arg(help="of the clip, if it is not recognised: " + ", ".join(FORMATS[1:]))]
Trackers = Annotated[Names, arg(help="names or weights files")]
Allowed = Annotated[Names, arg(help="modules that may be imported for the custom parts that a file names")]


def track(
    clip: Positional[Path],
    tracker: Annotated[str, arg(help="a name of `list_trackers()` or a weights file")] = "lite",
    format: Format = "auto",
    out: Annotated[
        Paths, arg(help="results: npz (the authors'), csv, ply, mp4, gif, glb or rrd, by their suffix")
    ] = (),
    html: Annotated[Path | None, arg(help="3D page with a time slider")] = None,
    png: Annotated[Path | None, arg(help="picture of frames with tracks")] = None,
    points: tyro.conf.OmitArgPrefixes[QueryChoice] = QueryChoice(),  # noqa: B008  (frozen)
    block: Annotated[int, arg(help="how many points to track at once; fewer take less memory")] = 1024,
    space: Annotated[str | None, arg(help="world or camera; by default the learnt tracker's own")] = None,
    size: Annotated[tuple[int, int] | None, arg(help="height and width to look at (learnt trackers)")] = None,
    crop: Annotated[Box | None, arg(help="left, top, right, bottom to look at, in pixels")] = None,
    steady: Annotated[bool, arg(help="first correct poses and depth scales that jitter")] = False,
    device: Annotated[str, arg(help="cpu or cuda (learnt trackers)")] = "cpu",
    allow: Allowed = (),
) -> None:
    """Track the points of a clip in 3D."""
    checks = [(check_export, path) for path in out]  # before the work, not after it
    for may_write, path, *suffix in (*checks, (check_suffix, html, ".html"), (check_suffix, png, ".png")):
        if path:
            may_write(path, *suffix)
    loaded = t3d.load_clip(clip, format)
    queries, note = points.of(loaded)
    own, given = queries is loaded.queries, replace(loaded, queries=queries)
    seen = t3d.steady_clip(given) if steady else given
    options = {"space": space, "size": size, "crop": crop, "block": block, "progress": sys.stderr.isatty()}
    result = t3d.track_many(t3d.load_tracker(tracker, device, parts=allow), seen, **options)
    result = result if seen is given else t3d.carry(result, seen, given)
    shown = result.visible.mean() if result.visible.size else 0.0
    print(f"{clip}: {len(queries)} points over {len(loaded)} frames with {tracker}, {shown:.0%} visible{note}")
    if loaded.tracks is not None and own:
        scores = t3d.evaluate(result, loaded)
        print("  ".join(f"{name} {scores[name]:.3f}" for name in ("AJ3D", "APD3D", "OA")))
    for path in out:
        t3d.export_tracks(result, path, loaded)
    if html:
        t3d.figures.save_html(t3d.figures.tracks_3d(loaded, result), html)
    if png:
        t3d.figures.save_png(t3d.figures.overview(loaded, result), png)
    for path in filter(None, (*out, html, png)):
        print(f"wrote {path}")


def evaluate(
    clips: Positional[Paths],
    tracker: Trackers = ("lite", "static", "klt"),
    format: Format = "auto",
    device: str = "cpu",
    allow: Allowed = (),
) -> None:
    """Score trackers on clips with true tracks; prints a Markdown table, one row a clip, then the means."""
    if not (clips and tracker):
        raise ValueError("evaluate: name at least one clip and one tracker")
    rows, means = {}, {}
    for name in tracker:
        loaded = t3d.load_tracker(name, device, parts=allow)
        scores = {}
        for path in tqdm(clips, desc=name, leave=False, disable=None):
            clip = t3d.load_clip(path, format)
            scores[f"{name} · {clip.name}"] = t3d.evaluate(loaded.track(clip), clip)
        rows, means = rows | scores, means | {f"{name} · mean": mean_scores(list(scores.values()))}
    print(score_table(rows | means, ("AJ3D", "APD3D", "OA", "AJ3D_none", "APD3D_none", "AJ3D_none_dynamic")))


def benchmark(
    tracker: Trackers = ("lite", "static", "klt"),
    split: Annotated[Names, arg(help="by default the first three; the others are hard: " + ", ".join(ALL))] = SPLITS,
    space: Annotated[Names, arg(help="world, camera or both (learnt trackers)")] = ("world",),
    count: Annotated[int | None, arg(help="only the first clips of each split")] = None,
    out: Annotated[Path | None, arg(help="JSON with every clip's scores; an interrupted run is continued")] = None,
    figure: Annotated[Path | None, arg(help="picture (PNG) of means with intervals")] = None,
    device: Annotated[str, arg(help="cpu or cuda (learnt trackers)")] = "cpu",
    allow: Allowed = (),
) -> None:
    """Score trackers on the Lite benchmark; prints Markdown tables with 95 % bootstrap intervals over clips."""
    if not (tracker and split and space):
        raise ValueError("benchmark: name at least one tracker, one split and one space")
    check_suffix(figure or "scores.png", ".png")
    results = run_benchmark(tracker_runs(tracker, space, device, allow), split, count, out)
    for part in ("", "_dynamic", "_static"):
        print(summary_table(results, tuple(metric + part for metric in METRICS), split) + "\n")
    if figure:
        from tapip3d_lite.figures.curves import score_figure

        t3d.figures.save_png(score_figure(results, splits=split), figure)
        print(f"wrote {figure}")


def demo(
    clip: Positional[Path] = Path("data_samples/arc.npz"),
    tracker: str = "lite",
    format: Format = "auto",
    out: Annotated[Path, arg(help="folder for the page and the picture")] = Path("demo_output"),
) -> None:
    """Track a sample clip and write a 3D page (HTML) and a picture (PNG)."""
    track(clip, tracker=tracker, format=format, html=out / "tracks_3d.html", png=out / "tracks.png")
    print(f"Open {(out / 'tracks_3d.html').resolve()} in a browser and move the time slider.")


def check(clip: Positional[Path], format: Format = "auto") -> None:
    """Look for the usual mistakes in a clip: camera direction, axes, intrinsics, units, depth, order of frames, registration."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        findings = t3d.check_clip(t3d.load_clip(clip, format, points=False))
    lines = [str(warning.message) for warning in said] + [str(finding) for finding in findings]
    print("\n".join(lines) if lines else f"{clip}: nothing suspicious found")


def convert(
    source: Positional[Path],
    out: Positional[Path],
    format: Format = "auto",
    depth: Annotated[str | None, arg(help="npy, npz or folder of depth to take instead; sparse, for TAPVid-3D")] = None,
    frames: Annotated[tuple[int, int, int] | None, arg(help="start, stop and step, of a folder or a video")] = None,
) -> None:
    """Read a clip of any format and write it as npz, or (a name without suffix) as a folder of images."""
    loaded = t3d.load_clip(source, format, depth, slice(*frames or (None,)))
    t3d.save_clip(loaded, out)
    print(f"wrote {out}: {len(loaded)} frames of {loaded.size[1]}x{loaded.size[0]}; next: check {out}")


def simulate(
    out: Annotated[Path, arg(help="dataset folder; an interrupted run is continued")],
    config: tyro.conf.OmitArgPrefixes[t3d.SimulationConfig],
    count: int = 1000,
    first_seed: int = 0,
    workers: Annotated[int | None, arg(help="processes; default: all cores")] = None,
) -> None:
    """Simulate a dataset of small Kubric-like clips with exact 3D tracks."""
    simulate_dataset(out, count, config, first_seed=first_seed, workers=workers)


def train(
    out: Annotated[Path, arg(help="the training's folder")],
    config: Annotated[TrainConfig, arg(name="")],
    data: Annotated[Path | None, arg(help="folder of clips, shared by trainings; missing ones are simulated")] = None,
    resume: Annotated[bool, arg(help="continue from the folder's checkpoint, with its recipe")] = False,
    device: Annotated[str, arg(help="cpu or cuda; several processes: torchrun -m tapip3d_lite train …")] = "cpu",
    workers: Annotated[int | None, arg(help="processes for examples; default: 0 on a CPU, else cores less two")] = None,
    compiled: Annotated[bool, arg(help="compile the tracker's parts, for a GPU: slow to start, then faster")] = False,
    loss: Annotated[str | None, arg(help="paper, pixels, or your own: my_parts:MyLoss")] = None,
    allow: Allowed = (),
) -> None:
    """Train a tracker on simulated clips, by default with the recipe of --preset (lite or paper); Ctrl-C saves and stops, --resume continues exactly there."""
    from tapip3d_lite.lab.train import train as run

    if loss is not None and config.loss != TrainConfig.recipe(config.preset).loss:
        raise ValueError("train: --loss takes the place of all --loss.… settings; give it or them")
    if loss is not None:
        config = replace(config, loss=loss)
    finished, text = run(out, config, data, resume, device, workers, compiled, allow)
    print(text)
    if not finished:
        sys.exit(130)


def card(
    folder: Positional[Path],
    results: Positional[Path],
    hardware: Annotated[str, arg(help="what it was trained on, in words")],
    out: Annotated[Path, arg(help="Markdown file")] = Path("MODEL_CARD.md"),
    name: Annotated[str, arg(help="of the model")] = "lite",
    weights: Annotated[Path | None, arg(help="the file, if not the folder's own")] = None,
    command: Annotated[str | None, arg(help="that made it, shown beside the recipe")] = None,
    also: Annotated[Path | None, arg(help="Markdown file to put before the limits")] = None,
    allow: Allowed = (),
) -> None:
    """Write the model card of a training folder and of results that `benchmark --out` wrote."""
    write_text(out, model_card(folder, results, hardware, name, command, weights, also, allow))
    print(f"wrote {out}")


def curves(
    folders: Positional[Annotated[Paths, arg(help="of trainings, or their log.jsonl; one row each")]],
    out: Annotated[Path, arg(help="picture (PNG)")] = Path("learning_curves.png"),
    by: Annotated[str, arg(help="step or minutes")] = "step",
) -> None:
    """Draw the learning curves of trainings, finished or not: matching, loss, accuracy, held-out scores."""
    from tapip3d_lite.figures.curves import learning_curves
    from tapip3d_lite.training.run_folder import read_log

    check_suffix(out, ".png")
    logs = [(folder.stem if folder.is_file() else folder.resolve().name, read_log(folder)) for folder in folders]
    t3d.figures.save_png(learning_curves(logs, by=by), out)
    print(f"wrote {out}")


def lab(
    action: Positional[Annotated[Literal["run", "table", "report", "list"], arg(help="what to do with the study")]],
    study: Positional[Annotated[str | None, arg(help="TOML or JSON file, folder, table's name, or `paper`")]] = None,
    jobs: Annotated[int, arg(help="trainings at once (run)")] = 1,
    device: Annotated[str, arg(help="cpu or cuda (run)")] = "cpu",
    against: Annotated[str | None, arg(help="the row that others are compared with")] = None,
    metric: Annotated[Names, arg(help="that judge, the first one first")] = JUDGED,
    out: Annotated[Path, arg(help="folder (report)")] = Path("report"),
    budget: Annotated[str | None, arg(help="in place of its own: lab, gpu, tiny (seconds a row) or shipped")] = None,
    seeds: Annotated[int | None, arg(help="trainings of each row, in place of the study's own number")] = None,
    accept_code: Annotated[bool, arg(help="go on with results of other code")] = False,
    allow: Allowed = (),
) -> None:
    """Run a study of rows under equal conditions; its table, its report, its rows, or the paper's tables by name."""
    from tapip3d_lite.lab.papers import TABLES, listed, open_study, report_all, run_all

    if study is None:
        print("\n".join(f"{name}: {' · '.join(values['rows'])}" for name, values in TABLES.items()))
    elif (action, study) == ("report", "paper"):
        print(f"wrote {report_all(out)}")
    elif (action, study) == ("run", "paper"):
        _stop_unless(run_all(jobs, device, accept_code, budget, seeds))
        print("finished; `lab report paper` writes what the tables say")
    else:
        opened, base = open_study(study, accept_code, allow, budget, seeds, shipped=action != "run")
        if action == "run":
            _stop_unless(opened.run(jobs, device))
        if action == "report":
            print(f"wrote {opened.report(out, against or base)}")
        else:
            print(listed(opened) if action == "list" else opened.table(against or base, metric))


def _stop_unless(finished: bool) -> None:
    if not finished:
        print("stopped and saved; the same command goes on")
        sys.exit(130)


def import_(checkpoint: Positional[Path], out: Positional[Path]) -> None:
    """Convert the authors' checkpoint (.pth) to a weights file of ours (.safetensors)."""
    tracker = t3d.load_official(checkpoint)
    t3d.save_weights(tracker, out)
    count = sum(p.numel() for p in tracker.parameters())
    print(f"wrote {out}: {count / 1e6:.2f} M parameters; use it with --tracker {out}")


_FUNCTIONS = (track, evaluate, benchmark, demo, check, convert, simulate, train, card, curves, lab, import_)
COMMANDS = {function.__name__.rstrip("_"): function for function in _FUNCTIONS}


def _train(arguments: list[str]) -> Callable[..., None]:
    """`train` with the defaults of the recipe that `--preset` names."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--preset", default="lite", nargs="?", const="")
    return partial(later(train), config=TrainConfig.recipe(parser.parse_known_args(arguments)[0].preset))


def main() -> None:
    """Run one command; what cannot work ends with one line and exit code 2, a lost worker with 1."""
    with refusals():
        if os.getcwd() not in sys.path:  # as `python -m` does; parts of the user's own are named "module:Class"
            sys.path.append(os.getcwd())
        chosen = {name: later(function) for name, function in COMMANDS.items()} | {"train": _train(sys.argv[1:])}
        about = __doc__.splitlines()[0]
        parsed(lambda: tyro.extras.subcommand_cli_from_dict(chosen, prog="tapip3d_lite", description=about))()


if __name__ == "__main__":
    main()
