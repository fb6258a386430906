"""`Trainer`: one training in one folder, which can be stopped at any moment and continued exactly.

Paper: section 4 and appendix (AdamW, one cycle, clipping, memory-saving backward). First the encoder learns to match
(`matching`), then the tracker learns to track. Several processes (torchrun) share the work through DDP.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from tapip3d_lite.clip import Clip
from tapip3d_lite.model.blocks import Block
from tapip3d_lite.model.registry import load_part
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.model.weights import save_weights
from tapip3d_lite.training.backward import add_gradients, losses
from tapip3d_lite.training.config import TrainConfig
from tapip3d_lite.training.data import Batch, FeatureCache
from tapip3d_lite.training.examples import Examples
from tapip3d_lite.training.journal import Journal
from tapip3d_lite.training.matching import Pair, matching_loss
from tapip3d_lite.training.parallel import Group
from tapip3d_lite.training.scores import Accuracy, validate
from tapip3d_lite.training.start import begin_with


class Trainer:
    """Trains a tracker in a folder.

    The folder holds `config.json`, `log.jsonl` (one line a step), `checkpoint.pt`, `features/` of the frozen encoder
    (on a CPU; a GPU encodes anew sooner), and at the end `weights.safetensors`.

    Attributes:
        tracker: what is trained.
        examples: what it is trained on, by step.
        step: steps done, of both stages together.
        recorded: on a GPU, record steps as CUDA graphs.
    """

    recorded: bool = True

    def __init__(
        self,
        folder: str | Path,
        config: TrainConfig,
        clips: Sequence[Path],
        validation: Sequence[Clip] = (),
        device: str = "cpu",
        resume: bool = False,
        workers: int = 0,
        compiled: bool = False,
    ) -> None:
        """Start a training, or take it up again.

        Args:
            folder: made if missing.
            config: the whole recipe.
            clips: training clips (npz with tracks) of any image size.
            validation: held-out clips.
            device: `"cpu"` or `"cuda"`.
            resume: continue from the folder's checkpoint, if there is one.
            workers: processes that make examples while this one trains, for a GPU that would wait for them.
            compiled: let torch compile the tracker's parts: minutes at first, then each step takes a fraction (GPU).

        Raises:
            ValueError: no clips; the folder holds a training already (without `resume`) or one of another recipe; no room.
        """
        if workers < 0:
            raise ValueError(f"Trainer: workers must not be negative, got {workers}; 0 makes examples in this process")
        if not clips:
            raise ValueError("Trainer: no training clips; make some with `training_clips` or `simulate`")
        self.config, self.validation, self.device, self.workers = config, list(validation), device, workers
        self.journal = Journal(folder, config, resume)
        with torch.random.fork_rng():  # the caller's chance is not ours
            torch.manual_seed(config.seed)
            self.tracker = Tracker(config.tracker_config()).to(device).train()
            nn.init.normal_(self.tracker.updater.head.weight, std=config.head)
        if config.init is not None:
            begin_with(self.tracker, config.init)
        self.group, self.step, self.seconds = Group(), 0, 0.0
        self._on_gpu, cache = torch.device(device).type == "cuda", None
        if not config.train_encoder and not self._on_gpu:
            size = self.tracker.config.image_size
            cache = FeatureCache(self.journal.folder / "features", self.tracker.encoder, size)
            cache.check_room(clips)
        self.examples = Examples(config, clips, self.group.rank, cache)
        saved = self.journal.checkpoint(device)
        if saved is not None:
            self.tracker.load_state_dict(saved["model"])
            self.step, self.seconds = saved["step"], saved["seconds"]
        if compiled:
            _compile(self.tracker)
        self._enter_stage(saved)

    @property
    def matching(self) -> bool:
        """Whether the encoder is being taught to match."""
        return self.step < self.config.matching_steps

    def run(
        self,
        stop: Callable[[], bool] = lambda: False,
        watch: Callable[[dict], None] = lambda line: None,
        progress: bool = True,
    ) -> bool:
        """Train until the end, or until `stop()` is true after a step; either way everything is saved.

        Args:
            stop: asked after every step, e.g. by a button.
            watch: called with every line of the log, e.g. by a live plot.
            progress: show a bar with loss, accuracy, speed and remaining time.

        Returns:
            Whether the training is finished.

        Raises:
            FloatingPointError: the loss or a gradient is not finite; the batch is saved in the folder.
        """
        with self.journal.bar(self.step, self.config.total, progress and self.group.leads) as bar:
            for line in self.steps(stop):
                bar.show(line)
                watch(line)
        return self.step == self.config.total

    def steps(self, stop: Callable[[], bool] = lambda: False) -> Iterator[dict]:
        """As `run`, one step at a time, for a caller with something else to do between two: yields lines of the log.

        Args:
            stop: asked when the caller comes back from a step; what there is then is saved.

        Raises:
            FloatingPointError: see `run`.
        """
        halted = False
        while self.step < self.config.total and not halted:
            yield self._one_step()
            halted = self.group.any(stop())
            if halted or self.step == self.config.total or self.step % self.config.save_every == 0:
                self.save()
        if self.step == self.config.total and self.group.leads:
            self._finish()

    def save(self) -> None:
        """Write the checkpoint (atomically)."""
        if self.group.leads:
            state = {
                "model": self.tracker.state_dict(),
                "optimizer": self.optimizer.state_dict(),
                "schedule": self.schedule.state_dict(),
                "step": self.step,
                "seconds": self.seconds,
            }
            self.journal.save(state)

    def example(self) -> list[Pair] | Batch:
        """What the next step looks at."""
        if self._coming is None:
            self._coming = self.examples.stream(self.step, self.workers)
        return next(self._coming)

    def _one_step(self) -> dict:
        started = time.perf_counter()
        self.optimizer.zero_grad()
        line = {"step": self.step + 1, "stage": "matching" if self.matching else "tracking"}
        example = self.example()
        line |= self._match(example) if self.matching else self._track(example)
        self.group.average(self.parameters)
        norm = float(nn.utils.clip_grad_norm_(self.parameters, self._clip_norm))
        if not np.isfinite([line["loss"], norm]).all():
            raise FloatingPointError(self.journal.refuse(line, norm, self._drawn))
        line |= {"norm": norm, "lr": self.schedule.get_last_lr()[0]}
        self.optimizer.step()
        self.schedule.step()
        self.step += 1
        self.seconds += time.perf_counter() - started
        line["seconds"] = self.seconds
        if self.step == self.config.matching_steps:
            self._enter_stage(None)
        elif self.validation and not self.matching and self._due():
            line |= validate(self.tracker, self.validation)
        if self.group.leads:
            self.journal.write(line)
        return line

    def _match(self, pairs: list[Pair]) -> dict:
        self._drawn = {"rgb": [pair.rgb for pair in pairs], "uv": [pair.uv for pair in pairs]}
        pairs = [pair.to(self.device) for pair in pairs]
        with self._precision():
            loss, right = matching_loss(self.tracker.encoder, pairs, self.config.matching)
        loss.backward()
        return {"loss": float(loss.detach()), "right": float(right)}

    def _track(self, batch: Batch) -> dict:
        batch, iterations = batch.to(self.device), self.examples.lengths(self.step)[1]
        self._drawn = {"names": batch.names, "queries": batch.queries, "truth": vars(batch.truth)}
        run = self._add_gradients if self._replay is None else self._replay
        parts, seen = run(batch, iterations)
        return losses(parts) | Accuracy.result(seen)

    def _add_gradients(self, batch: Batch, iterations: int) -> tuple[Tensor, Tensor]:
        accuracy = Accuracy(batch.queries.device)
        options = {"iterations": iterations, "depth_roi": batch.roi, "features": batch.features}
        options |= {"watch": lambda step: accuracy.add(step, batch, iterations)}
        free = load_part("tapip3d_lite.speed.cuda_graph:sync_free")(self.tracker) if self._replay else nullcontext()
        with free, self._precision():
            example = batch.frames, batch.queries, batch.truth
            return add_gradients(self.tracker, *example, self.config.loss, **options), accuracy.totals

    def _precision(self) -> torch.autocast:
        return torch.autocast(self.device, torch.bfloat16, enabled=self.config.precision == "bfloat16")

    def _enter_stage(self, saved: dict | None) -> None:
        """Choose what is trained, and make its optimiser."""
        self._coming = None
        config, encoder = self.config, self.tracker.encoder
        self.tracker.requires_grad_(not self.matching)
        encoder.requires_grad_(self.matching or config.train_encoder)
        self.parameters = [p for p in self.tracker.parameters() if p.requires_grad]
        self.group.share(self.parameters)
        recipe = config.matching if self.matching else config
        self._clip_norm = recipe.clip_norm
        record = self.recorded and self._on_gpu
        step = load_part("tapip3d_lite.speed.cuda_graph:CudaGraphStep") if record else None
        self._replay = step(self._add_gradients, self.parameters) if record else None
        plain = [p for p in self.parameters if p.ndim < 2]  # biases and norms are not decayed
        decayed = [p for p in self.parameters if p.ndim >= 2]
        groups = [{"params": decayed, "weight_decay": recipe.weight_decay}, {"params": plain, "weight_decay": 0.0}]
        steps = config.matching_steps if self.matching else config.steps
        self.optimizer = torch.optim.AdamW(groups, recipe.lr, fused=self._on_gpu or None)
        self.schedule = torch.optim.lr_scheduler.OneCycleLR(
            self.optimizer, recipe.lr, total_steps=steps + 1, pct_start=config.warmup
        )
        if saved is not None and len(saved["optimizer"]["param_groups"]) == 2:
            self.optimizer.load_state_dict(saved["optimizer"])
            self.schedule.load_state_dict(saved["schedule"])

    def _due(self) -> bool:
        done = self.step - self.config.matching_steps
        return done % self.config.evaluate_every == 0 or self.step == self.config.total

    def _finish(self) -> None:
        save_weights(self.tracker, self.journal.folder / "weights.safetensors", half=True)


def _compile(tracker: Tracker) -> None:
    from torch._dynamo import config as dynamo
    from torch._functorch import config as functorch

    dynamo.recompile_limit = 64  # levels differ in size
    functorch.donated_buffer = False  # the queries' neighbourhoods are walked backward once for each window
    parts = [tracker.encoder, tracker.neighborhood, tracker.context]
    parts += [part for part in tracker.updater.modules() if isinstance(part, Block)]  # alike, so compiled once for all
    for part in parts:
        part.compile(dynamic=False)
