"""`Variant`: one row of a study, which is a recipe (or a given tracker), options of `track`, and a condition of the clips."""

from __future__ import annotations

import inspect
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tapip3d_lite.lab.conditions import check_condition
from tapip3d_lite.lab.provenance import plain
from tapip3d_lite.model.config import SWITCHES, TrackerConfig
from tapip3d_lite.model.track import track as _track
from tapip3d_lite.parts import allowed_parts
from tapip3d_lite.training.recipe import TrainConfig
from tapip3d_lite.validate import check_names, checked

_TRACKER = {field.name for field in fields(TrackerConfig)}
_STUDY = {"preset", "tracker", "init", "clips", "matching_steps", "matching", "minutes", "seed", "validation"}
_TRAIN = {field.name for field in fields(TrainConfig)} - _STUDY
_TRACK = set(inspect.signature(_track).parameters) - {"tracker", "clip", "queries", "progress"}


@dataclass(frozen=True, init=False)
class Variant:
    """One row of a study. Rows with equal fields share their trained weights, whatever they are called.

    Attributes:
        name: of the row.
        given: a tracker that is not trained: a name of `list_trackers()` or a weights file; else None.
        fields: of the tracker (`context="p2n"`) or of its training (`lr=1e-4`, `loss={"discount": 1.0}`) that differ from
            the study's recipe.
        track: options of `track` (`{"iterations": 2}`), and fields of the tracker that a test may change while the
            weights stay (`{"neighbors": 4}`).
        degrade: what is done to the held-out clips, `{"poses": 2.0}`; see `conditions.CONDITIONS`.
    """

    name: str
    given: str | None
    fields: Mapping[str, Any]
    track: Mapping[str, Any]
    degrade: Any

    @checked
    def __init__(
        self,
        name: str,
        tracker: str | Path | None = None,
        track: Mapping[str, Any] | None = None,
        degrade: Any = None,
        **fields: Any,
    ) -> None:
        """A row: its attributes, where `tracker` is `given`; `iterations`, which tracker and training have, is set in both.

        Raises:
            ValueError: no name, a field that neither has (with the nearest ones) or that belongs to the study, fields
                of a tracker that is not trained, an unknown option or condition.
        """
        if not isinstance(name, str) or not name.strip():
            raise ValueError(f"Variant: expected a name, got {name!r}; it heads the row of the table")
        if tracker is not None and fields:
            raise ValueError(f"Variant {name!r}: {tracker} is not trained, so {', '.join(fields)} cannot differ")
        if own := sorted(set(fields) & _STUDY):
            raise ValueError(f"Variant {name!r}: {', '.join(own)} must be equal in all rows; set it in the budget")
        check_names(f"Variant {name!r}", fields, _TRACKER | _TRAIN)
        check_names(f"Variant {name!r}, track", track or {}, _TRACK | _TRACKER)
        values = {"name": name, "given": None if tracker is None else str(tracker), "fields": dict(fields)}
        values |= {"track": dict(track or {}), "degrade": check_condition(degrade)}
        for key, value in values.items():
            object.__setattr__(self, key, value)

    def recipe(self, base: TrainConfig) -> TrainConfig:
        """The study's recipe `base` with this row's fields; ValueError where they do not go together."""
        tracker = {name: value for name, value in self.fields.items() if name in _TRACKER}
        changes = {name: value for name, value in self.fields.items() if name in _TRAIN}
        if "iterations" in tracker:
            tracker["iterations"] = int(np.max(changes["iterations"]))
        for name, value in changes.items():
            part = getattr(base, name)
            if is_dataclass(part) and isinstance(value, Mapping):
                check_names(f"Variant {self.name!r}, {name}", value, {field.name for field in fields(part)})
                changes[name] = replace(part, **value)
        try:
            recipe = replace(base, tracker={**base.tracker, **tracker}, **changes)
            recipe.tracker_config().replace(**self.test_fields())
        except (ValueError, TypeError) as error:
            raise ValueError(f"Variant {self.name!r}: {error}") from error
        return recipe

    def test_fields(self) -> dict[str, Any]:
        """Fields of the tracker that are changed after the training."""
        return {name: value for name, value in self.track.items() if name not in _TRACK}

    def options(self) -> dict[str, Any]:
        """Options of `track`."""
        return {name: value for name, value in self.track.items() if name in _TRACK}

    def to_dict(self) -> dict[str, Any]:
        """Keyword arguments that make the same row, beside its name; plain values, and custom parts by their names."""
        values = {"tracker": self.given, "track": self.track, "degrade": self.degrade} | dict(self.fields)
        return json.loads(json.dumps({k: v for k, v in values.items() if v not in (None, {})}, default=plain))

    @classmethod
    def from_dict(cls, name: str, values: Mapping[str, Any], parts: Sequence[Any] = ()) -> Variant:
        """The inverse of `to_dict`; custom parts and conditions that it names must be among `parts` (see `load_tracker`)."""
        return cls(name, **{**values, **allowed_parts(values, (*SWITCHES, "loss", "degrade"), parts)})
