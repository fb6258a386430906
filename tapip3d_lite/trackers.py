"""Trackers by name: shipped weights, weight files, and the baselines without learning."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm.auto import tqdm

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.evaluation.baselines import Baseline, KltTracker, StaticTracker, TrackerLike
from tapip3d_lite.files import shipped_weights
from tapip3d_lite.model.config import INTERCHANGEABLE
from tapip3d_lite.queries import resolve_queries
from tapip3d_lite.validate import check_device, check_names

_BASELINES = {"static": StaticTracker, "klt": KltTracker}


def list_trackers() -> list[str]:
    """Names that `load_tracker` takes: shipped weights first, then the baselines."""
    return sorted(shipped_weights()) + list(_BASELINES)


def load_tracker(
    name: str | Path = "lite", device: Any = "cpu", fast: bool = True, parts: Sequence[Any] | type | str = ()
) -> TrackerLike:
    """A tracker by name, or from a weights file.

    Args:
        name: one of `list_trackers()`, or the path of a `.safetensors` file.
        device: where a learnt tracker computes, `"cpu"` or `"cuda"`.
        fast: compute by the fast forms of a learnt tracker's parts; False: by the clear ones, for the same numbers.
        parts: custom parts that the file may name: classes, e.g. `[MyContext]`, matched by name; or names of modules
            that may be imported for it. A file alone never imports code.

    Raises:
        ValueError: no such device here, neither a known name nor a file, or a file with a custom part that is not among `parts`.
    """
    name = str(name)
    if name in _BASELINES:
        check_device(device)
        return _BASELINES[name]()
    path = shipped_weights().get(name, Path(name))
    if not path.is_file():
        raise ValueError(f"load_tracker: no tracker {name!r}; choose {', '.join(list_trackers())} or a weights file")
    from tapip3d_lite.model.weights import load_weights

    return load_weights(path, device, fast, parts)


def tracker_runs(
    names: Sequence[str], spaces: Sequence[str], device: str = "cpu", parts: Sequence[Any] | type | str = ()
) -> Iterator[tuple]:
    """(label, tracker, options of `track`) of trackers by name: `klt`, and of learnt ones each space, `lite · world`.

    A tracker that was made for another space than these runs in its own alone; `parts` as for `load_tracker`.
    """
    check_names("space", spaces, INTERCHANGEABLE)
    for name in names:
        tracker, label = load_tracker(name, device, True, parts), Path(name).with_suffix("")
        if isinstance(tracker, Baseline):
            yield str(name), tracker, {}
        elif tracker.config.space in INTERCHANGEABLE:
            yield from ((f"{label} · {space}", tracker, {"space": space}) for space in spaces)
        else:
            yield f"{label} · {getattr(tracker.space, 'name', 'own space')}", tracker, {}


def track_many(
    tracker: TrackerLike,
    clip: Clip,
    queries: np.ndarray | None = None,
    block: int = 1024,
    progress: bool = False,
    **options: Any,
) -> Tracks:
    """`tracker.track` of any number of queries, e.g. `dense_queries(clip)`, in the memory of one `block` and the result.

    Tracks of one block help one another, those of two do not. Arguments and errors are those of `track`; `progress`
    shows a bar.
    """
    if block < 1 or not callable(getattr(tracker, "track", None)):
        raise ValueError(
            f"track_many: expected a tracker and a block of at least 1, got {type(tracker).__name__}, {block}"
        )
    queries = resolve_queries(clip, queries)
    starts = range(0, max(len(queries), 1), block)
    options["progress"] = progress and len(starts) == 1
    bar = tqdm(starts, desc="blocks", disable=not progress or len(starts) == 1)
    parts = [tracker.track(clip, queries[start : start + block], **options) for start in bar]
    xyz, visible = (np.concatenate([getattr(part, name) for part in parts], 1) for name in ("xyz", "visible"))
    known = parts[0].visible_logits is not None
    return Tracks(xyz, visible, queries, np.concatenate([part.visible_logits for part in parts], 1) if known else None)
