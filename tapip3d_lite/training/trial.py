"""Trial optimisers: keys `muon` (factor of the learning rate) and `cautious` (decay, falling linearly to zero)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import nn

from tapip3d_lite.model.blocks import Block, OffsetEmbedding, Pool
from tapip3d_lite.training.schedule import adamw


def make_optimizer(
    tracker: nn.Module, parameters: Sequence[nn.Parameter], lr: float, weight_decay: float, fused: bool, trial: dict
) -> Any:
    """AdamW, or what a trial wants in its place."""
    if "cautious" in trial:
        vectors, others = [p for p in parameters if p.ndim < 2], [p for p in parameters if p.ndim >= 2]
        groups = [{"params": others, "decay": trial["cautious"]}, {"params": vectors, "decay": 0.0}]
        return CautiousAdamW(groups, lr, weight_decay=0.0)
    if "muon" not in trial:
        return adamw(parameters, lr, weight_decay, fused)
    wanted = {id(p) for p in parameters}
    hidden = [p for p in hidden_matrices(tracker) if id(p) in wanted]
    mine = {id(p) for p in hidden}
    rest = adamw([p for p in parameters if id(p) not in mine], lr, weight_decay, fused)
    scale = {"params": hidden, "scale": trial["muon"]}
    decay = trial.get("muon_decay", weight_decay)
    return Several(torch.optim.Muon([scale], lr, weight_decay=decay, adjust_lr_fn="match_rms_adamw"), rest)


def hidden_matrices(tracker: nn.Module) -> list[nn.Parameter]:
    """Weights of the linear layers inside blocks, pools and offsets' MLPs, but for the latter's first, an embedding's."""
    found = []
    for part in tracker.modules():
        linear = [x for x in part.modules() if isinstance(x, nn.Linear)]
        if isinstance(part, Block | Pool):
            found += linear
        elif isinstance(part, OffsetEmbedding):
            found += linear[1:]
    return [layer.weight for layer in found]


class Several:
    """Optimisers that step together."""

    def __init__(self, *parts: torch.optim.Optimizer) -> None:
        self.parts = parts

    @property
    def param_groups(self) -> list[dict]:
        return [group for part in self.parts for group in part.param_groups]

    def zero_grad(self) -> None:
        for part in self.parts:
            part.zero_grad()

    def step(self) -> None:
        for part in self.parts:
            part.step()

    def state_dict(self) -> dict:
        return {str(i): part.state_dict() for i, part in enumerate(self.parts)}

    def load_state_dict(self, state: dict) -> None:
        for i, part in enumerate(self.parts):
            part.load_state_dict(state[str(i)])


class CautiousAdamW(torch.optim.AdamW):
    """AdamW whose decay acts only where the update shrinks the weight too, and is scaled by each group's `left`."""

    @torch.no_grad()
    def step(self) -> None:
        groups = [g for g in self.param_groups if g["decay"]]
        old = [[p.clone() for p in g["params"]] for g in groups]
        super().step()
        for group, before in zip(groups, old, strict=True):
            amount = group["lr"] * group["decay"] * group.get("left", 1.0)
            for p, w in zip(group["params"], before, strict=True):
                p.sub_(amount * w * ((w - p) * w > 0))
