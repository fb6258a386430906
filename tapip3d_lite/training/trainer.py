"""`Trainer`: one training in one folder, which can be stopped at any moment and continued exactly.

Paper: section 4 and appendix (AdamW, one cycle, clipping, memory-saving backward). First the encoder learns to match
(`matching`), then the tracker learns to track. Several processes (torchrun) share the work through DDP.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import nn

from tapip3d_lite.clip import Clip
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.model.weights import save_weights
from tapip3d_lite.training.augment import augment
from tapip3d_lite.training.backward import saving_backward
from tapip3d_lite.training.config import TrainConfig
from tapip3d_lite.training.data import Batch, FeatureCache, make_batch
from tapip3d_lite.training.journal import Journal
from tapip3d_lite.training.matching import draw_pair, matching_loss
from tapip3d_lite.training.motion import random_coordinates
from tapip3d_lite.training.parallel import Group
from tapip3d_lite.training.sampling import draw_frames, load_part, sample_tracks
from tapip3d_lite.training.scores import Accuracy, validate
from tapip3d_lite.training.start import begin_with


class Trainer:
    """Trains a tracker in a folder.

    The folder holds `config.json`, `log.jsonl` (one line a step), `checkpoint.pt`, `features/` of the frozen encoder,
    and at the end `weights.safetensors`. Whatever step s draws depends on the seed and s alone, so a continued run
    goes where an undisturbed one would have gone.

    Attributes:
        tracker: what is trained.
        step: steps done, of both stages together.
    """

    def __init__(
        self,
        folder: str | Path,
        config: TrainConfig,
        clips: Sequence[Path],
        validation: Sequence[Clip] = (),
        device: str = "cpu",
        resume: bool = False,
    ) -> None:
        """Start a training, or take it up again.

        Args:
            folder: made if missing.
            config: the whole recipe.
            clips: training clips (npz with tracks) of any image size.
            validation: held-out clips.
            device: `"cpu"` or `"cuda"`.
            resume: continue from the folder's checkpoint, if there is one.

        Raises:
            ValueError: no clips; the folder holds a training already (without `resume`) or one of another recipe; no room.
        """
        if not clips:
            raise ValueError("Trainer: no training clips; make some with `training_clips` or `simulate`")
        self.config, self.clips, self.validation, self.device = config, list(clips), list(validation), device
        self.size = config.tracker_config().image_size
        self.journal = Journal(folder, config, resume)
        with torch.random.fork_rng():  # the caller's chance is not ours
            torch.manual_seed(config.seed)
            self.tracker = Tracker(config.tracker_config()).to(device).train()
            nn.init.normal_(self.tracker.updater.head.weight, std=config.head)
        if config.init is not None:
            begin_with(self.tracker, config.init)
        self.group, self.step, self.seconds = Group(), 0, 0.0
        self.cache = FeatureCache(self.journal.folder / "features", self.tracker.encoder, self.size)
        if not config.train_encoder:
            self.cache.check_room(self.clips)
        saved = self.journal.checkpoint(device)
        if saved is not None:
            self.tracker.load_state_dict(saved["model"])
            self.step, self.seconds = saved["step"], saved["seconds"]
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

    def lengths(self, step: int) -> tuple[int, int]:
        """Frames and iterations M of a step, the same in all processes."""
        config, rng = self.config, np.random.default_rng([self.config.seed, step])
        if step - config.matching_steps < config.short * config.steps:
            return config.frames[0], config.iterations[0]
        half = config.tracker_config().window // 2
        frames = rng.choice(np.arange(config.frames[0], config.frames[1] + 1, half))
        return int(frames), int(rng.integers(config.iterations[0], config.iterations[1] + 1))

    def draw(self, step: int, slot: int) -> tuple[Clip, torch.Tensor | None]:
        """The clip of one slot of a step's batch, and its features if the encoder is frozen."""
        config, rng = self.config, np.random.default_rng([self.config.seed, step, slot])
        path, wanted = self.clips[rng.integers(len(self.clips))], self.lengths(step)[0]
        chosen = np.zeros(0, int)

        def choose(available: int) -> np.ndarray:
            nonlocal chosen
            chosen = draw_frames(rng, available, wanted, config.sampling.backward)
            return chosen

        clip = load_part(path, choose, config.train_encoder, self.size)
        if config.augment:
            clip = augment(clip, rng, config.augmentation)
        clip = random_coordinates(sample_tracks(clip, rng, config.sampling), rng, config.motion)
        return clip, None if config.train_encoder else self.cache.frames(path, chosen)

    def batch(self, step: int) -> Batch:
        """This process's share of a step's clips."""
        slots = range(self.group.rank * self.config.batch, (self.group.rank + 1) * self.config.batch)
        clips, features = zip(*(self.draw(step, slot) for slot in slots), strict=True)
        return make_batch(list(clips), None if self.config.train_encoder else list(features)).to(self.device)

    def _one_step(self) -> dict:
        started = time.perf_counter()
        self.optimizer.zero_grad()
        line = {"step": self.step + 1, "stage": "matching" if self.matching else "tracking"}
        line |= self._match() if self.matching else self._track()
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

    def _match(self) -> dict:
        rng = np.random.default_rng([self.config.seed, self.step, self.group.rank])
        path, augmentation = self.clips[rng.integers(len(self.clips))], self.config.augmentation
        pair = draw_pair(path, rng, self.config.matching, self.size, augmentation if self.config.augment else None)
        self._drawn = {"rgb": pair.rgb, "uv": pair.uv}
        loss, right = matching_loss(self.tracker.encoder, pair.to(self.device), self.config.matching)
        loss.backward()
        return {"loss": float(loss.detach()), "right": right}

    def _track(self) -> dict:
        batch, accuracy, iterations = self.batch(self.step), Accuracy(), self.lengths(self.step)[1]
        self._drawn = {"names": batch.names, "queries": batch.queries, "truth": vars(batch.truth)}
        options = {"iterations": iterations, "depth_roi": batch.roi, "features": batch.features}
        with torch.autocast(self.device, torch.bfloat16, enabled=self.config.precision == "bfloat16"):
            totals = saving_backward(
                self.tracker,
                batch.frames,
                batch.queries,
                batch.truth,
                self.config.loss,
                watch=lambda step: accuracy.add(step, batch, iterations),
                **options,
            )
        return totals | accuracy.result()

    def _enter_stage(self, saved: dict | None) -> None:
        """Choose what is trained, and make its optimiser."""
        config, encoder = self.config, self.tracker.encoder
        self.tracker.requires_grad_(not self.matching)
        encoder.requires_grad_(self.matching or config.train_encoder)
        self.parameters = [p for p in self.tracker.parameters() if p.requires_grad]
        self.group.share(self.parameters)
        recipe = config.matching if self.matching else config
        self._clip_norm = recipe.clip_norm
        plain = [p for p in self.parameters if p.ndim < 2]  # biases and norms are not decayed
        decayed = [p for p in self.parameters if p.ndim >= 2]
        groups = [{"params": decayed, "weight_decay": recipe.weight_decay}, {"params": plain, "weight_decay": 0.0}]
        steps = config.matching_steps if self.matching else config.steps
        self.optimizer = torch.optim.AdamW(groups, recipe.lr)
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
