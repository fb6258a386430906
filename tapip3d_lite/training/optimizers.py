"""The optimisers of a training: AdamW, as in the paper, or Muon for the matrices inside blocks and AdamW for the rest.

    AdamW  w <- w - lr (m / (sqrt(v) + eps) + decay w)                 m, v: means of the gradient and of its square
    Muon   W <- W - lr (0.2 sqrt(max(h, w)) O(M) + decay W)            O(M): momentum M (h, w) with singular values of 1

Muon is torch's, after K. Jordan et al., 2024. With its factor (Moonlight, 2025) a step of it is as long as one of AdamW,
so that both share the learning rate and the decay.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import nn

from tapip3d_lite.model.blocks import Block, OffsetEmbedding, Pool

OPTIMIZERS = ("adamw", "muon")


def make_optimizer(
    tracker: nn.Module, parameters: Sequence[nn.Parameter], kind: str, lr: float, weight_decay: float, fused: bool
) -> Any:
    """An optimiser like torch's, one of `OPTIMIZERS`, for some of a tracker's parameters; `fused`: AdamW in one kernel (GPU).

    Biases and the parameters of norms, which are vectors, do not decay (paper: appendix, training; decay 5e-4).
    """
    chosen = {id(weight) for weight in hidden_matrices(tracker)} if kind == "muon" else set()
    matrices, rest = ([p for p in parameters if (id(p) in chosen) is inside] for inside in (True, False))
    vectors, others = [p for p in rest if p.ndim < 2], [p for p in rest if p.ndim >= 2]
    groups = [{"params": others, "weight_decay": weight_decay}, {"params": vectors, "weight_decay": 0.0}]
    adamw = torch.optim.AdamW(groups, lr, fused=fused or None)
    if not matrices:
        return adamw
    return _Both(torch.optim.Muon(matrices, lr, weight_decay, adjust_lr_fn="match_rms_adamw"), adamw)


def hidden_matrices(tracker: nn.Module) -> list[nn.Parameter]:
    """Weights of linear layers between hidden features: those of blocks and pools, and of offsets' MLPs all but the first."""
    found = []
    for part in tracker.modules():
        linear = [x.weight for x in part.modules() if isinstance(x, nn.Linear)]
        found += linear if isinstance(part, Block | Pool) else linear[1:] if isinstance(part, OffsetEmbedding) else []
    return found


class _Both:
    """Two optimisers that step as one."""

    def __init__(self, *parts: torch.optim.Optimizer) -> None:
        self.parts = parts

    @property
    def param_groups(self) -> list[dict[str, Any]]:
        return [group for part in self.parts for group in part.param_groups]

    def zero_grad(self) -> None:
        for part in self.parts:
            part.zero_grad()

    def step(self) -> None:
        for part in self.parts:
            part.step()

    def state_dict(self) -> dict[str, Any]:
        return {str(i): part.state_dict() for i, part in enumerate(self.parts)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for i, part in enumerate(self.parts):
            part.load_state_dict(state[str(i)])
