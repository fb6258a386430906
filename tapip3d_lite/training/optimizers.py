"""The optimisers of a training: AdamW, as in the paper, or Muon for the matrices inside blocks and AdamW for the rest.

    AdamW  w <- w - lr (m / (sqrt(v) + eps) + decay w)                 m, v: means of the gradient and of its square
    Muon   W <- W - lr (0.2 sqrt(max(h, w)) O(M) + decay W)            O(M): momentum M (h, w) with singular values of 1

Muon is torch's, after K. Jordan et al., 2024, but takes all matrices of one size at once. With its factor (Moonlight,
2025) a step of it is as long as one of AdamW, so that both share the learning rate and the decay.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

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
    return _Both(Muon(matrices, lr, weight_decay, adjust_lr_fn="match_rms_adamw"), adamw)


def hidden_matrices(tracker: nn.Module) -> list[nn.Parameter]:
    """Weights of linear layers between hidden features: those of blocks and pools, and of offsets' MLPs all but the first."""
    found = []
    for part in tracker.modules():
        linear = [x.weight for x in part.modules() if isinstance(x, nn.Linear)]
        found += linear if isinstance(part, Block | Pool) else linear[1:] if isinstance(part, OffsetEmbedding) else []
    return found


class Muon(torch.optim.Muon):
    """torch's Muon in a fraction of its calls, which a small tracker waits for: matrices of one size are stacked."""

    @torch.no_grad()
    def step(self) -> None:
        """Update the parameters by their gradients, as torch does with Nesterov's momentum and `match_rms_adamw`."""
        for group in self.param_groups:
            parameters = [p for p in group["params"] if p.grad is not None]
            gradients = [p.grad for p in parameters]
            for p in (p for p in parameters if not self.state[p]):
                self.state[p]["momentum_buffer"] = torch.zeros_like(p)
            momenta = [self.state[p]["momentum_buffer"] for p in parameters]
            torch._foreach_lerp_(momenta, gradients, 1 - group["momentum"])
            torch._foreach_mul_(parameters, 1 - group["lr"] * group["weight_decay"])
            ahead = torch._foreach_lerp(gradients, momenta, group["momentum"])
            for size in {p.shape: None for p in parameters}:
                chosen = [i for i, p in enumerate(parameters) if p.shape == size]
                updates = orthogonal(torch.stack([ahead[i] for i in chosen]), group).to(parameters[0]).unbind()
                length = -0.2 * max(size) ** 0.5 * group["lr"]
                torch._foreach_add_([parameters[i] for i in chosen], updates, alpha=length)


def orthogonal(matrices: Tensor, group: dict[str, Any]) -> Tensor:
    """Matrices (n, h, w) with singular values near 1, in bfloat16, by the iteration of Newton and Schulz."""
    x = matrices.bfloat16()
    if wide := x.shape[1] > x.shape[2]:
        x = x.mT
    x = x / x.norm(dim=(1, 2), keepdim=True).clamp(min=group["eps"])
    a, b, c = group["ns_coefficients"]
    for _ in range(group["ns_steps"]):
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x.mT if wide else x


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
