"""A model card from the files of a training: every number in it is read from one of them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tapip3d_lite.evaluation.benchmark import ALL, METRICS, SPLITS, difference_table, load_results, summary_table
from tapip3d_lite.model.weights import load_weights
from tapip3d_lite.training.augment import augmentations
from tapip3d_lite.training.recipe import TrainConfig
from tapip3d_lite.training.run_folder import read_log

_NAMES = {"adamw": "AdamW", "muon": "Muon and AdamW"}
_PARTS = {"All points": "", "Moving points": "_dynamic", "Points at rest": "_static"}
_LIMITS = """- Trained on simulated clips of rigid bodies in rooms, at most {frames} frames an example and images of {size}
  pixels; on real footage, soft bodies or much longer clips this card measures nothing.
- It expects metric or at least consistent depth, and poses; `check` finds the usual mix-ups.
- Nothing is remembered beyond a window ({window} frames) but the estimate: a point hidden for longer may be lost.
- Scores are means over few clips each: read the intervals, not the third decimal."""


def model_card(
    folder: str | Path,
    results: str | Path,
    hardware: str,
    name: str = "lite",
    command: str | None = None,
    weights: str | Path | None = None,
    also: str | Path | None = None,
    parts: Sequence[Any] = (),
) -> str:
    """The model card of a finished training, in Markdown; ValueError where a file is missing, unreadable or empty.

    `folder` holds `config.json`, `log.jsonl` and the weights, unless these lie elsewhere (`weights`); `results` is what
    `benchmark --out` wrote, `also` a Markdown file to put before the limits. Files cannot know the `hardware`, nor a
    `command` that is to be shown beside the recipe. Custom `parts` that they name must be given, as for `load_tracker`.
    """
    folder = Path(folder)
    path = Path(weights) if weights else folder / "weights.safetensors"
    if not (folder / "config.json").exists() or not path.exists():
        raise ValueError(f"card: {folder} is not a finished training; it needs config.json, log.jsonl and {path.name}")
    if also and not Path(also).is_file():
        raise ValueError(f"card: no file {also}; --also takes Markdown, such as tests.robustness writes")
    config = TrainConfig.read(folder / "config.json", parts)
    log, (scores, _) = read_log(folder), load_results(results)
    if not log or not scores:
        raise ValueError(f"card: expected steps in {folder / 'log.jsonl'} and scores in {results}; one is empty")
    compared = [label for label in scores if any(split in scores[label] for split in ALL)]
    trackers = " ".join(dict.fromkeys(label.rpartition(" · ")[0] or label for label in compared))  # not once a space
    splits = [split for split in ALL if any(split in scores[label] for label in compared)]
    chosen = f" --split {' '.join(splits)}" if set(splits) - set(SPLITS) else ""
    scoring = f"python -m tapip3d_lite benchmark --tracker {trackers}{chosen} --space world camera"
    scoring = f"{scoring} --out {Path(results).name}"
    parts = [
        f"# Model card: `{name}`",
        _facts(config, log, path, hardware, parts),
        "## Made by",
        "\n".join(["```", *([command] if command else []), scoring, "```"]),
        f"The recipe is that of the preset `{config.preset}`, with these values instead:",
        f"```json\n{_changed(config)}\n```",
        "## Scores\n\nMeans with 95 % bootstrap intervals over clips of the Lite benchmark, whose seeds no training can draw.",
        *(f"{title}:\n\n{summary_table(scores, [m + part for m in METRICS])}" for title, part in _PARTS.items()),
        *_differences(scores, compared, name),
        *([Path(also).read_text(encoding="utf-8").strip()] if also else []),
    ]
    model = config.tracker_config()
    size = "x".join(map(str, model.image_size))
    limits = _LIMITS.format(frames=config.frames[1], size=size, window=model.window)
    return "\n\n".join([*parts, f"## Limits\n\n{limits}"]) + "\n"


def _differences(scores: dict, labels: list[str], name: str) -> list[str]:
    """Tables of the differences to other trackers, paired by clip."""
    own = [label for label in labels if label.rpartition(" · ")[0] == name or label == name]
    others = [label for label in labels if label not in own]
    if not own or not others:
        return []
    metrics = [metric + part for part in ("", "_dynamic") for metric in METRICS[:2]]
    tables = [difference_table(scores, own[0], other, metrics) for other in others]
    return ["Differences, paired by clip:", *tables]


def _facts(config: TrainConfig, log: list[dict], weights: Path, hardware: str, parts: Sequence[Any]) -> str:
    tracker, last = load_weights(weights, parts=parts), log[-1]
    model, parameters = tracker.config, sum(p.numel() for p in tracker.parameters())
    rows = {
        "parameters": f"{parameters / 1e6:.2f} M, file {weights.stat().st_size / 1e6:.2f} MB",
        "model": f"preset `{config.preset}`, images {model.image_size[0]}x{model.image_size[1]}, window {model.window}, "
        f"K = {model.neighbors}, {model.levels} levels from stride {model.stride}",
        "data": f"{config.clips} simulated clips; examples of {_range(config.frames)} frames and {config.sampling.tracks} "
        f"tracks; images {_changes(config)}; a poor sensor in {config.sensor:.0%}, wrong poses in {config.motion.wrong:.0%}",
        "steps": _steps(config, log),
        "recipe": f"{_NAMES[config.optimizer]} {config.lr:g}, weight decay {config.weight_decay:g}, one cycle, M = {_range(config.iterations)}, "
        f"{config.precision}, encoder {'trained along' if config.train_encoder else 'frozen after matching'}, seed {config.seed}",
        "wall-clock": f"{last['seconds'] / 3600:.2f} h of steps (evaluations and simulation not counted)",
        "hardware": hardware,
        "visible from": f"probability {model.visible_threshold:g}"
        + (f" of being seen and within {within:g} pixels" if (within := getattr(config.loss, "within", 0)) else ""),
    }
    held_out = [line for line in log if "val_AJ3D_none" in line]
    if held_out:
        scores = "AJ3D {val_AJ3D_none:.3f}, APD3D {val_APD3D_none:.3f}, OA {val_OA:.3f} at step {step}"
        rows["held-out clips"] = scores.format(**held_out[-1]) + f" (unscaled, world, {config.validation} clips)"
    return "| | |\n|---|---|\n" + "\n".join(f"| {name} | {value} |" for name, value in rows.items())


def _steps(config: TrainConfig, log: list[dict]) -> str:
    last, matching = log[-1]["step"], sum(line["stage"] == "matching" for line in log)
    text = f"{matching} of matching, {last - matching} of tracking, batches of {config.batch} in each process"
    if config.minutes is not None:
        return f"{text}; as many as {config.minutes:g} minutes allowed"
    return f"{text}; stopped at step {last} of {config.total}" if last < config.total else text


def _changes(config: TrainConfig) -> str:
    made = [name for name, (share, _) in augmentations(config.augmentation).items() if share > 0]
    return f"augmented ({', '.join(made)})" if config.augment else "not augmented"


def _range(pair: tuple[int, int]) -> str:
    return str(pair[0]) if pair[0] == pair[1] else f"{pair[0]} to {pair[1]}"


def _changed(config: TrainConfig) -> str:
    """What the recipe sets otherwise than its preset does, as JSON for `TrainConfig.from_dict`."""
    usual = TrainConfig.recipe(config.preset).to_dict()
    return json.dumps({name: value for name, value in config.to_dict().items() if value != usual[name]}, indent=1)
