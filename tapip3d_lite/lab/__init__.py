"""Experiments under equal conditions; what needs both training and evaluation."""

from tapip3d_lite.lab.contract import check_part
from tapip3d_lite.lab.train import held_out_scores, make_trainer

__all__ = ["check_part", "held_out_scores", "make_trainer"]
