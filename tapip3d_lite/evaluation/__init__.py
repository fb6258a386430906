"""Scores of tracks against the truth, and trackers without learning to compare with."""
