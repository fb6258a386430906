"""Experiments under equal conditions; what needs both training and evaluation."""

from tapip3d_lite.lab.budgets import BUDGETS, Budget
from tapip3d_lite.lab.contract import check_part
from tapip3d_lite.lab.provenance import diff
from tapip3d_lite.lab.study import Study
from tapip3d_lite.lab.train import held_out_scores, make_trainer
from tapip3d_lite.lab.variant import Variant

__all__ = ["BUDGETS", "Budget", "Study", "Variant", "check_part", "diff", "held_out_scores", "make_trainer"]
