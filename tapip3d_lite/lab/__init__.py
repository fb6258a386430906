"""Experiments under equal conditions; what needs both training and evaluation."""
