"""A model card from the files of a training: every number in it is read from one of them."""

from __future__ import annotations

import json
from pathlib import Path

from tapip3d_lite.evaluation.benchmark import METRICS, SPLITS, difference_table, load_results, summary_table
from tapip3d_lite.model.weights import load_weights
from tapip3d_lite.training.augment import augmentations
from tapip3d_lite.training.recipe import TrainConfig
from tapip3d_lite.training.run_folder import read_log

_LIMITS = """- Trained on simulated clips of rigid bodies in rooms, at most {frames} frames an example and images of {height}x{width}
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
) -> str:
    """The model card of a finished training, in Markdown.

    Args:
        folder: of the training: `config.json`, `log.jsonl`, `weights.safetensors`.
        results: JSON that `benchmark --out` wrote.
        hardware: on which it was trained, in words.
        name: of the model.
        command: that made it; None: the one with this recipe's options.
        weights: another file than the folder's own.

    Returns:
        The text.

    Raises:
        ValueError: a file is missing or unreadable, the log is empty, or there are no results.
    """
    folder = Path(folder)
    path = Path(weights) if weights else folder / "weights.safetensors"
    if not (folder / "config.json").exists() or not path.exists():
        raise ValueError(f"card: {folder} is not a finished training; it needs config.json, log.jsonl and {path.name}")
    config = TrainConfig.from_dict(json.loads((folder / "config.json").read_text(encoding="utf-8")))
    log, (scores, _) = read_log(folder), load_results(results)
    if not log or not scores:
        raise ValueError(
            f"card: expected steps in {folder / 'log.jsonl'} and scores in {results}; one of them is empty"
        )
    command = command or f"python -m tapip3d_lite train --out runs/{name}{_flags(config)}"
    compared = [label for label in scores if any(split in scores[label] for split in SPLITS)]
    parts = [
        f"# Model card: `{name}`",
        _facts(config, log, path, hardware),
        f"## Made by\n\n```\n{command}\npython -m tapip3d_lite benchmark --tracker {_trackers(compared)} "
        f"--space world camera --out {Path(results).name}\n```",
        "## Scores\n\nMeans with 95 % bootstrap intervals over clips of the Lite benchmark, whose seeds no training can draw.",
        *(f"{title}:\n\n{_table(scores, part)}" for title, part in _PARTS.items()),
        *_differences(scores, compared, name),
    ]
    return "\n\n".join([*parts, f"## Limits\n\n{_limits(config)}"]) + "\n"


_PARTS = {"All points": "", "Moving points": "_dynamic", "Points at rest": "_static"}


def _limits(config: TrainConfig) -> str:
    model = config.tracker_config()
    height, width = model.image_size
    return _LIMITS.format(frames=config.frames[1], height=height, width=width, window=model.window)


def _table(scores: dict, part: str) -> str:
    return summary_table(scores, tuple(metric + part for metric in METRICS))


def _differences(scores: dict, labels: list[str], name: str) -> list[str]:
    """Tables of the differences to other trackers, paired by clip."""
    own = [label for label in labels if label.rpartition(" · ")[0] == name or label == name]
    others = [label for label in labels if label not in own]
    if not own or not others:
        return []
    metrics = [metric + part for part in ("", "_dynamic") for metric in METRICS[:2]]
    tables = [difference_table(scores, own[0], other, metrics) for other in others]
    return ["Differences, paired by clip:", *tables]


def _facts(config: TrainConfig, log: list[dict], weights: Path, hardware: str) -> str:
    model = load_weights(weights)
    parameters = sum(p.numel() for p in model.parameters())
    held_out = [line for line in log if "val_AJ3D_none" in line]
    rows = {
        "parameters": f"{parameters / 1e6:.2f} M, file {weights.stat().st_size / 1e6:.2f} MB",
        "model": f"preset `{config.preset}`, images {model.config.image_size[0]}x{model.config.image_size[1]}, window "
        f"{model.config.window}, K = {model.config.neighbors}, {model.config.levels} levels from stride {model.config.stride}"
        + (f"; set by hand: {', '.join(f'{k}={v}' for k, v in config.tracker.items())}" if config.tracker else ""),
        "data": f"{config.clips} simulated clips; examples of {_range(config.frames)} frames and {config.sampling.tracks} "
        f"tracks; images {_changes(config)}",
        "steps": _steps(config, log),
        "recipe": f"AdamW {config.lr:g}, weight decay {config.weight_decay:g}, one cycle, M = {_range(config.iterations)}, "
        f"{config.precision}, encoder {'trained along' if config.train_encoder else 'frozen after matching'}, seed {config.seed}"
        + (f"; errors softened from {config.loss.soften:g} pixels on" if config.loss.soften else ""),
        "wall-clock": f"{log[-1]['seconds'] / 3600:.2f} h of steps (evaluations and simulation not counted)",
        "hardware": hardware,
        "visible from": f"probability {model.config.visible_threshold:g}"
        + (f" of being seen and within {config.loss.within:g} pixels" if config.loss.within else ""),
    }
    if held_out:
        last = held_out[-1]
        rows["held-out clips"] = (
            f"AJ3D {last['val_AJ3D_none']:.3f}, APD3D {last['val_APD3D_none']:.3f}, OA {last['val_OA']:.3f} "
            f"at step {last['step']} (unscaled, world, {config.validation} clips)"
        )
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


def _trackers(labels: list[str]) -> str:
    """Names for `--tracker`, from labels of which a learnt tracker has one for each space."""
    return " ".join(dict.fromkeys(label.rpartition(" · ")[0] or label for label in labels))


def _flags(config: TrainConfig) -> str:
    """Options for the fields in which the recipe differs from its preset's."""
    default, own = TrainConfig.recipe(config.preset).to_dict(), config.to_dict()
    flags = "" if config.preset == "lite" else f" --preset {config.preset}"
    for name, value, usual in _leaves(own, default):
        if name == "tracker":  # sizes of images cannot be given on the command line; the table names them
            plain = [f"{k} {v}" for k, v in value.items() if not isinstance(v, list | tuple)]
            flags += f" --tracker {' '.join(plain)}" if plain else ""
        elif value != usual:
            flags += (
                f" --{name.replace('_', '-')} {_words(value)}" if not isinstance(value, bool) else _switch(name, value)
            )
    return flags


def _leaves(own: dict, default: dict, prefix: str = "") -> list[tuple[str, object, object]]:
    leaves = []
    for name, value in own.items():
        if isinstance(value, dict) and isinstance(default.get(name), dict) and name != "tracker":
            leaves += _leaves(value, default[name], f"{prefix}{name}.")
        else:
            leaves.append((prefix + name, value, default.get(name)))
    return leaves


def _words(value: object) -> str:
    return " ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _switch(name: str, value: bool) -> str:
    *path, last = name.replace("_", "-").split(".")
    return f" --{'.'.join([*path, last if value else f'no-{last}'])}"
