"""Datasets of simulated clips (being written)."""


def simulate_dataset() -> None:
    """Write a folder of clips."""
    raise NotImplementedError
