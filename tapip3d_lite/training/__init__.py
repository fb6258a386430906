"""Training: the loss, its memory-saving backward, and augmentations."""
