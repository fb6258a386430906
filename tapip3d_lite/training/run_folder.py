"""The folder of a training: its recipe, a log with one line a step, a checkpoint; and the progress bar.

Files are written so that a kill at any moment leaves a folder from which the training continues exactly.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from tqdm.auto import tqdm

from tapip3d_lite.files import atomic_path
from tapip3d_lite.training.recipe import TrainConfig

_SMOOTH = 0.98  # of the running means that the bar shows


class RunFolder:
    """The folder of one training.

    Attributes:
        path: of the folder.
    """

    def __init__(self, path: str | Path, config: TrainConfig, resume: bool) -> None:
        """Make the folder, or check that it belongs to this training.

        Args:
            path: of the folder.
            config: the recipe.
            resume: whether the folder may hold a training of this recipe already.

        Raises:
            ValueError: the folder holds a training already (without `resume`), or one of another recipe.
        """
        self.path = Path(path)
        recipe = self.path / "config.json"
        wanted = json.loads(json.dumps(config.to_dict()))
        if recipe.exists():
            stored = json.loads(json.dumps(TrainConfig.from_dict(json.loads(recipe.read_text())).to_dict()))
            different = [f"{k}={stored.get(k)!r} (now {wanted.get(k)!r})" for k in wanted if stored.get(k) != wanted[k]]
            if not resume:
                raise ValueError(
                    f"train: {path} holds a training already; continue it with --resume, or choose another folder"
                )
            if different:
                raise ValueError(f"train: {path} was begun with another recipe: {', '.join(different)}; use its own")
        else:
            with atomic_path(recipe) as temporary:
                temporary.write_text(json.dumps(wanted, indent=2) + "\n")

    def checkpoint(self, device: str) -> dict[str, Any] | None:
        """Load the newest checkpoint, if there is one, and cut the log back to it."""
        path = self.path / "checkpoint.pt"
        saved = torch.load(path, map_location=device, weights_only=True) if path.exists() else None
        self._cut_log(0 if saved is None else saved["step"])
        return saved

    def save(self, state: dict[str, Any]) -> None:
        """Replace the checkpoint atomically."""
        with atomic_path(self.path / "checkpoint.pt") as temporary:
            torch.save(state, temporary)

    def write(self, line: dict[str, Any]) -> None:
        """Append one step to the log."""
        with open(self.path / "log.jsonl", "a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def save_failure(self, line: dict[str, Any], norm: float, drawn: dict[str, Any]) -> str:
        """Save the batch of a step whose loss or gradient is not finite; returns the message for the user."""
        path = self.path / f"not_finite_{line['step']}.pt"
        with atomic_path(path) as temporary:
            torch.save({"line": line, "norm": norm, **drawn}, temporary)
        return (
            f"train: loss {line['loss']} and gradient norm {norm} in step {line['step']} are not finite; the weights are "
            f"unchanged. Its batch is in {path}, the last checkpoint in {self.path / 'checkpoint.pt'}; "
            "lower the learning rate"
        )

    def _cut_log(self, step: int) -> None:
        """Drop lines after the checkpoint's step, and a half-written last line."""
        path = self.path / "log.jsonl"
        if not path.exists():
            return
        kept = [line for line in read_log(path) if line["step"] <= step]
        with atomic_path(path) as temporary:
            temporary.write_text("".join(json.dumps(line) + "\n" for line in kept), encoding="utf-8")


class Bar:
    """A progress bar with running means of loss and accuracy, speed and remaining time."""

    def __init__(self, bar: tqdm) -> None:
        self.bar, self.means, self.shown = bar, {}, 0.0

    @classmethod
    @contextlib.contextmanager
    def open(cls, position: float, total: int, show: bool) -> Iterator[Bar]:
        """A bar over a schedule of `total` steps, from a position on."""
        with tqdm(total=total, initial=int(position), unit="step", disable=not show, dynamic_ncols=True) as bar:
            yield cls(bar)

    def show(self, line: dict[str, Any], position: float) -> None:
        """Move on to a position, after a step with this line of the log."""
        for name in ("loss", "right", "apd", "apd_dynamic"):
            if line.get(name) is not None:
                old = self.means.get(name, line[name])
                self.means[name] = _SMOOTH * old + (1 - _SMOOTH) * line[name]
        self.bar.update(int(position) - self.bar.n)
        if time.monotonic() - self.shown > 0.5:
            self.shown = time.monotonic()
            self.bar.set_description(line["stage"], refresh=False)
            shown = ("loss", "right") if line["stage"] == "matching" else ("loss", "apd", "apd_dynamic")
            self.bar.set_postfix({name: f"{self.means[name]:.3f}" for name in shown if name in self.means})


def read_log(path: str | Path) -> list[dict[str, Any]]:
    """The lines of a `log.jsonl`, or of the one in a folder, without a half-written last line.

    Raises:
        ValueError: there is no log.
    """
    path = Path(path)
    path = path / "log.jsonl" if path.is_dir() else path
    if not path.exists():
        raise ValueError(f"{path}: no such log; give the folder of a training")
    lines = []
    for text in path.read_text(encoding="utf-8").splitlines():
        with contextlib.suppress(json.JSONDecodeError):
            lines.append(json.loads(text))
    return lines
