"""The folder of a training: its recipe, a log with one line a step, a checkpoint; and the progress bar.

Files are written so that a kill at any moment leaves a folder from which the training continues exactly.
"""

from __future__ import annotations

import contextlib
import json
import time
from pathlib import Path
from typing import Any

import torch
from tqdm.auto import tqdm

from tapip3d_lite.files import atomic_path, locked, read_json, write_text
from tapip3d_lite.saved import read_saved
from tapip3d_lite.training.recipe import TrainConfig
from tapip3d_lite.validate import changed

_SAVED = ("model", "optimizer", "step", "position", "seconds")
_SMOOTH = 0.98  # of the running means that the bar shows


class RunFolder:
    """The folder `path` of one training."""

    def __init__(self, path: str | Path, config: TrainConfig, resume: bool) -> None:
        """Make the folder, or check that it belongs to this training.

        A folder that holds a training already (without `resume`), or one of another recipe, is a ValueError.
        """
        check_folder(path, config, resume)
        self.path = Path(path)
        self._log, self._checkpoint, recipe = (self.path / x for x in ("log.jsonl", "checkpoint.pt", "config.json"))
        if not recipe.exists():
            write_text(recipe, json.dumps(config.to_dict(), indent=2) + "\n")

    def checkpoint(self, repair: bool = True) -> dict[str, Any] | None:
        """Load the newest checkpoint, if there is one; ValueError if it is damaged.

        `repair` cuts the log back to it, and deletes what a killed process left half-written.
        """
        saved = read_saved(self._checkpoint) if self._checkpoint.exists() else None
        if saved is not None and not (isinstance(saved, dict) and {*_SAVED} <= saved.keys()):
            raise ValueError(f"{self._checkpoint}: no checkpoint of a training (which has {', '.join(_SAVED)})")
        if not repair:
            return saved
        for leftover in self.path.rglob(".*.*.*"):
            leftover.unlink(missing_ok=True)
        if self._log.exists():
            kept = [line for line in read_log(self._log) if saved is not None and line["step"] <= saved["step"]]
            write_text(self._log, "".join(json.dumps(line) + "\n" for line in kept))
        return saved

    def locked(self) -> contextlib.AbstractContextManager[None]:
        """Keep other processes from training here; ValueError if one does."""
        return locked(self.path / ".lock", "train: the folder")

    def save(self, state: dict[str, Any]) -> None:
        """Replace the checkpoint atomically."""
        with atomic_path(self._checkpoint) as temporary:
            torch.save(state, temporary)

    def write(self, line: dict[str, Any]) -> None:
        """Append one step to the log."""
        with open(self._log, "a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def save_failure(self, line: dict[str, Any], norm: float, drawn: dict[str, Any]) -> str:
        """Save the batch of a step whose loss, gradient or weights are not finite; returns the message for the user."""
        path = self.path / f"not_finite_{line['step']}.pt"
        with atomic_path(path) as temporary:
            torch.save({"line": line, "norm": norm, **drawn}, temporary)
        return (
            f"train: loss {line['loss']} and gradient norm {norm} in step {line['step']} are not finite, or make the "
            f"weights so. Its batch is in {path}, the last checkpoint in {self._checkpoint}; lower the learning rate"
        )


def check_folder(path: str | Path, config: TrainConfig, resume: bool) -> None:
    """Raise ValueError where a folder holds a training already (without `resume`), or one of another recipe."""
    recipe = Path(path) / "config.json"
    if not recipe.exists():
        return
    if not resume:
        raise ValueError(f"train: {path} holds a training already; continue with --resume or choose another folder")
    stored, wanted = read_json(recipe, TrainConfig.complete), config.to_dict()  # imports no parts
    if different := changed(stored, wanted):
        raise ValueError(f"train: {path} was begun with another recipe: {different}; use its own")


class Bar(tqdm):
    """A progress bar with running means of loss and accuracy, speed and remaining time."""

    def __init__(self, position: float, total: int, show: bool) -> None:
        """A bar over a schedule of `total` steps, from a position on."""
        super().__init__(total=total, initial=int(position), unit="step", disable=not show, dynamic_ncols=True)
        self._means, self._shown = {}, 0.0

    def show(self, line: dict[str, Any], position: float) -> None:
        """Move on to a position, after a step with this line of the log."""
        for name in ("loss", "right", "apd", "apd_dynamic"):
            if line.get(name) is not None:
                old = self._means.get(name, line[name])
                self._means[name] = _SMOOTH * old + (1 - _SMOOTH) * line[name]
        self.update(int(position) - self.n)
        if time.monotonic() - self._shown > 0.5:
            self._shown = time.monotonic()
            self.set_description(line["stage"], refresh=False)
            shown = ("loss", "right") if line["stage"] == "matching" else ("loss", "apd", "apd_dynamic")
            self.set_postfix({name: f"{self._means[name]:.3f}" for name in shown if name in self._means})


def read_log(path: str | Path) -> list[dict[str, Any]]:
    """The lines of a `log.jsonl`, or of the one in a folder, without a half-written last one; ValueError: there is none."""
    path = Path(path)
    path = path / "log.jsonl" if path.is_dir() else path
    if not path.is_file():
        raise ValueError(f"{path}: no such log; give the folder of a training")
    *texts, last = path.read_text(encoding="utf-8", errors="replace").split("\n")
    try:
        lines = [json.loads(text) for text in texts]
        with contextlib.suppress(json.JSONDecodeError):
            lines.append(json.loads(last))
        for line in lines:
            numbers = [line["step"] + line["seconds"], *(x for key, x in line.items() if key != "stage")]
            if not all(isinstance(x, int | float | None) for x in numbers) or not isinstance(line["stage"], str):
                raise ValueError(f"a line holds {line}"[:200])
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        raise ValueError(f"{path}: no log of a training ({error}); give the folder of one") from error
    return lines
