"""`Trainer`: one training in one folder, which can be stopped at any step and continued exactly.

Paper: section 4 and appendix (AdamW, one cycle, gradient clipping, backward in constant memory). The first stage
pretrains the encoder by matching (`pretrain`, ours), the second trains the tracker. Several processes (torchrun) share
the work: each step uses the mean of their gradients.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from tapip3d_lite.model.registry import fast_step
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.model.weights import save_weights
from tapip3d_lite.model.windows import Step
from tapip3d_lite.parts import make_part
from tapip3d_lite.speed.compiled import compile_parts
from tapip3d_lite.training.backward import add_gradients, losses
from tapip3d_lite.training.data import Batch, FeatureCache
from tapip3d_lite.training.examples import Examples, check_clips
from tapip3d_lite.training.loss import accuracy, step_accuracy
from tapip3d_lite.training.optimizers import make_optimizer
from tapip3d_lite.training.parallel import Group
from tapip3d_lite.training.pretrain import FramePair, matching_loss, take_encoder
from tapip3d_lite.training.recipe import TrainConfig, initial_weights
from tapip3d_lite.training.run_folder import Bar, RunFolder
from tapip3d_lite.training.schedule import Schedule
from tapip3d_lite.training.start import begin
from tapip3d_lite.validate import check_state


class Trainer:
    """Trains a tracker in a folder.

    The folder holds `config.json`, `log.jsonl` (one line a step), `checkpoint.pt`, `features/` of a frozen encoder (only
    on a CPU; a GPU encodes faster than it reads), and at the end `weights.safetensors`.

    Attributes:
        tracker: what is trained.
        average: the mean of its last weights, which is scored and saved.
        examples: its input, by step.
        step: number of steps done, of both stages together.
        schedule: how far the training has come.
    """

    def __init__(
        self,
        folder: str | Path,
        config: TrainConfig,
        clips: Sequence[Path],
        validate: Callable[[Tracker], dict[str, float]] | None = None,
        device: str = "cpu",
        resume: bool = False,
        workers: int = 0,
        compiled: bool = False,
        encoder: str | Path | None = None,
    ) -> None:
        """Start a training, or continue one.

        Args:
            folder: of the training; made if missing.
            config: the recipe.
            clips: training clips (npz files with tracks) of any image size.
            validate: scores the tracker every `config.evaluate_every` steps; the scores are added to the log.
                `lab.held_out_scores` makes such a function.
            device: `"cpu"` or `"cuda"`.
            resume: continue from the folder's checkpoint, if there is one.
            workers: processes that make examples ahead of time; for a GPU, which would otherwise wait for them.
            compiled: compile the tracker's parts, which takes minutes and then makes each step faster (GPU).
            encoder: folder of a training whose encoder is taken over; features of a frozen one are stored there, for all.

        Raises:
            ValueError: no clips, or unusable ones; the folder holds a training already (without `resume`) or one of
                another recipe; no room for features; weights of other sizes to start from.
        """
        if workers < 0:
            raise ValueError(f"Trainer: workers must not be negative, got {workers}; 0 makes examples in this process")
        clips = check_clips(clips, config)  # before there is a folder
        self.config, self.validate, self.device, self.workers = config, validate, device, workers
        self._loss = make_part("TrainConfig.loss", config.loss)
        if isinstance(self._loss, nn.Module):
            self._loss.to(device)
        with torch.random.fork_rng():  # leaves the caller's random generator as it is
            torch.manual_seed(config.seed)
            self.tracker = Tracker(config.tracker_config()).to(device).train()
            begin(self.tracker, config.start, config.head)
        if config.init is not None:
            self.tracker.load_state_dict(initial_weights(config))
        self.folder = RunFolder(folder, config, resume)
        source = Path(encoder or self.folder.path)
        if encoder is not None:
            take_encoder(self.tracker.encoder, source)
        self.group, self.step, self.seconds = Group(device), 0, 0.0
        self._on_gpu, cache = torch.device(device).type == "cuda", None
        if not config.train_encoder and not self._on_gpu:
            size = self.tracker.config.image_size
            cache = FeatureCache(source / "features", self.tracker.encoder, size)
            cache.check_room(clips)
        self.examples = Examples(config, clips, self.group.rank, cache)
        with self.folder.locked() if self.group.is_main else nullcontext():
            saved = self.folder.checkpoint(repair=self.group.is_main)
        if saved is not None:
            check_state(saved["model"], self.tracker.state_dict())
            self.tracker.load_state_dict(saved["model"])
            self.step, self.seconds = saved["step"], saved["seconds"]
        self.schedule = Schedule(config, self.group, 0 if saved is None else saved["position"])
        self.group.copy_from_main(self.tracker.parameters())
        self.average = copy.deepcopy(self.tracker).requires_grad_(False) if config.average else self.tracker
        if config.average and saved is not None:
            self.average.load_state_dict(saved.get("average", saved["model"]))  # older checkpoints have none
        if compiled:
            compile_parts(self.tracker)
        self._enter_stage(saved)

    def run(self, stop: Callable[[], bool] = lambda: False, progress: bool = True) -> bool:
        """Train until the end, or until `stop()` is true after a step; either way everything is saved.

        Returns whether the training is finished. `progress` shows a bar with loss, accuracy, speed and remaining time. If
        the loss, a gradient or a weight is not finite, the batch is saved in the folder, and a FloatingPointError raised.
        """
        with Bar(self.schedule.position, self.config.total, progress and self.group.is_main) as bar:
            for line in self.steps(stop):
                bar.show(line, self.schedule.position)
        return self.schedule.finished

    def steps(self, stop: Callable[[], bool] = lambda: False) -> Iterator[dict]:
        """Train like `run`, and yield each step's line of the log, so that the caller can do something between steps.

        When the caller asks for the next step and `stop()` is true, everything is saved instead.
        """
        with self.folder.locked() if self.group.is_main else nullcontext():
            self.schedule.start_clock()
            halted = False
            while not self.schedule.finished and not halted:
                yield self._one_step()
                halted = self.group.sum(stop()) > 0
                due = halted or self.schedule.finished or self.step % self.config.save_every == 0
                if due and self.group.is_main:
                    parts = {"model": self.tracker, "optimizer": self.optimizer, "average": self.average}
                    state = {name: part.state_dict() for name, part in parts.items()}
                    counts = {"step": self.step, "position": self.schedule.position, "seconds": self.seconds}
                    self.folder.save(state | counts)
            if self.schedule.finished and self.group.is_main:
                save_weights(self.average, self.folder.path / "weights.safetensors", half=True)

    def example(self) -> list[FramePair] | Batch:
        """The input of the next step."""
        if self._coming is None:
            self._coming = self.examples.stream(self.schedule.places(self.step), self.workers)
        return next(self._coming)

    def _one_step(self) -> dict:
        started, before, matching = time.perf_counter(), self.schedule.position, self.schedule.matching
        self.optimizer.zero_grad()
        example = self.example()
        line = {"step": self.step + 1, "stage": "matching" if matching else "tracking"}
        line |= self._match(example) if matching else self._track(example)
        self.group.average(self.parameters)
        norm = float(nn.utils.clip_grad_norm_(self.parameters, self.schedule.recipe.clip_norm))
        if not np.isfinite([line["loss"], norm]).all():
            raise FloatingPointError(self.folder.save_failure(line, norm, self._drawn))
        lr, beta1 = self.schedule.rate()
        for group in self.optimizer.param_groups:
            group |= {"lr": lr} | ({"betas": (beta1, group["betas"][1])} if "betas" in group else {})
        self.optimizer.step()
        if not np.isfinite(float(nn.utils.get_total_norm([p.detach() for p in self.parameters]))):
            raise FloatingPointError(self.folder.save_failure(line, norm, self._drawn))
        self.step += 1
        self._add_to_average()
        self.seconds += time.perf_counter() - started
        line |= {"norm": norm, "lr": lr, "seconds": self.seconds}
        self.schedule.advance(self.step)
        if matching and not self.schedule.matching:
            self._enter_stage(None)
        elif self.validate and not matching and self.schedule.due(before):
            line |= self._scores()
        if self.group.is_main:
            self.folder.write(line)
        return line

    @torch.no_grad()
    def _add_to_average(self) -> None:
        """The average forgets what is older than a tenth of the steps done, or than `config.average` steps."""
        if self.average is not self.tracker:
            share = max(1 / self.config.average, 10 / (self.step + 9))  # 1 in the first step
            torch._foreach_lerp_(list(self.average.parameters()), list(self.tracker.parameters()), share)

    def _match(self, pairs: list[FramePair]) -> dict:
        self._drawn = {"rgb": [pair.rgb for pair in pairs], "uv": [pair.uv for pair in pairs]}
        pairs = [pair.to(self.device) for pair in pairs]
        with self._precision():
            loss, right = matching_loss(self.tracker.encoder, pairs, self.config.matching)
        loss.backward()
        return {"loss": float(loss.detach()), "right": float(right)}

    def _track(self, batch: Batch) -> dict:
        batch = batch.to(self.device)
        self._drawn = {"names": batch.names, "queries": batch.queries, "truth": vars(batch.truth)}
        parts, seen = (self._replay or self._add_gradients)(batch, batch.iterations)
        return losses(parts) | accuracy(seen)

    def _add_gradients(self, batch: Batch, iterations: int) -> tuple[Tensor, Tensor]:
        seen = torch.zeros(2, 2, device=batch.queries.device)

        def watch(step: Step) -> None:
            if step.iteration == iterations - 1:
                seen.add_(step_accuracy(step, batch.truth, batch.dynamic))

        options = {"iterations": iterations, "depth_roi": batch.roi, "features": batch.features, "watch": watch}
        example = batch.frames, batch.queries, batch.truth
        with self._precision():
            return add_gradients(self.tracker, *example, self._loss, **options), seen

    def _precision(self) -> torch.autocast:
        return torch.autocast(self.device, torch.bfloat16, enabled=self.config.precision == "bfloat16")

    def _enter_stage(self, saved: dict | None) -> None:
        """Choose the parameters of a stage, and make their optimiser, or load a saved one."""
        self._coming = None
        matching, recipe = self.schedule.matching, self.schedule.recipe
        self.tracker.requires_grad_(not matching)
        self.tracker.encoder.requires_grad_(matching or self.config.train_encoder)
        self.parameters = [p for p in self.tracker.parameters() if p.requires_grad]
        fast = None if matching else fast_step(self.device, self.config.custom)
        self._replay = None if fast is None else fast(self._add_gradients, self.tracker, self.parameters)
        kind, rates = "adamw" if matching else self.config.optimizer, (recipe.lr, recipe.weight_decay)
        self.optimizer = make_optimizer(self.tracker, self.parameters, kind, *rates, fused=self._on_gpu)
        if saved is not None:
            self.optimizer.load_state_dict(saved["optimizer"])

    def _scores(self) -> dict[str, float]:
        self.average.eval()
        with torch.compiler.set_stance("force_eager"):  # held-out clips have other shapes than parts are compiled for
            scores = self.validate(self.average)
        self.tracker.train()
        return scores
