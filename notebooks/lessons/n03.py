"""Lesson 03: whose cells stand in a neighbourhood, and a search that proves that it missed nothing."""

from __future__ import annotations

from lessons.checker import check
from lessons.guesses import reveal
from lessons.milestone import milestone
from lessons.n02_straightness import to_space
from lessons.n03_around import Around, frame_inside, inside_image
from lessons.n03_cells import Cells, silhouettes, track_objects
from lessons.n03_exercises import EXERCISES
from lessons.n03_figures import (
    Proof,
    neighborhoods_3d,
    proof_view,
    share_curves,
    two_neighborhoods,
)
from lessons.n03_search import exact_search, parts
from lessons.pictures import pipeline, show
from lessons.progress import collect, in_use, progress, reset
from lessons.samples import SAMPLES
from lessons.widgets import explore

__all__ = [
    "EXERCISES",
    "SAMPLES",
    "Around",
    "Cells",
    "Proof",
    "check",
    "collect",
    "exact_search",
    "explore",
    "frame_inside",
    "in_use",
    "inside_image",
    "milestone",
    "neighborhoods_3d",
    "parts",
    "pipeline",
    "progress",
    "proof_view",
    "reset",
    "reveal",
    "share_curves",
    "show",
    "silhouettes",
    "to_space",
    "track_objects",
    "two_neighborhoods",
]
