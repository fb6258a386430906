"""AdamW whose learning rate goes through one cosine cycle.

Paper: appendix (training): 5e-4, weight decay 5e-4 except for biases and norms, 5 % of the steps for the warm-up.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import nn


def adamw(parameters: Sequence[nn.Parameter], lr: float, weight_decay: float, fused: bool = False) -> torch.optim.AdamW:
    """AdamW that does not decay biases and the parameters of norms, which are vectors.

    Args:
        parameters: to be trained.
        lr: learning rate; `set_rate` replaces it in every step.
        weight_decay: of matrices and of the kernels of convolutions.
        fused: update all parameters in one kernel (GPU).
    """
    vectors = [p for p in parameters if p.ndim < 2]
    others = [p for p in parameters if p.ndim >= 2]
    groups = [{"params": others, "weight_decay": weight_decay}, {"params": vectors, "weight_decay": 0.0}]
    return torch.optim.AdamW(groups, lr, fused=fused or None)


def one_cycle(position: float, steps: int, peak: float, warmup: float) -> tuple[float, float]:
    """Learning rate and beta1 in one step, to the bit those of torch's `OneCycleLR(total_steps=steps + 1)`.

    A function of the position rather than torch's counter, so that elapsed time can take the place of steps.

    Args:
        position: steps done, from 0; need not be whole.
        steps: number of steps of the cycle.
        peak: greatest learning rate.
        warmup: share of the steps in which the learning rate rises.

    Returns:
        The learning rate, which rises from peak / 25 and falls to peak / 250,000; beta1, between 0.95 and 0.85.
    """
    top = warmup * (steps + 1) - 1  # position of the peak
    start, end = peak / 25, peak / 25 / 1e4
    if top > 0 and position <= top:
        share = position / top
        return _cosine(start, peak, share), _cosine(0.95, 0.85, share)
    share = (position - top) / (steps - top)
    return _cosine(peak, end, share), _cosine(0.85, 0.95, share)


def set_rate(optimizer: torch.optim.Optimizer, lr: float, beta1: float) -> None:
    """Set learning rate and beta1 of all parameters."""
    for group in optimizer.param_groups:
        group |= {"lr": lr, "betas": (beta1, group["betas"][1])}


def _cosine(start: float, end: float, share: float) -> float:
    return end + (start - end) / 2.0 * (math.cos(math.pi * share) + 1)
