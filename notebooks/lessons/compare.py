"""Where two results differ, and what an argument looks like, in few words."""

from __future__ import annotations

import numpy as np

_FLOAT32 = 1e-5  # relative to the largest value: what an answer computed in single precision may be off


def compare(got: object, expected: object, tolerance: float) -> str:
    """Where and how two results differ, in words; empty if they agree.

    Args:
        got: numbers, arrays, tensors, or a tuple of them.
        expected: the same, right.
        tolerance: absolute and relative; single precision is accepted where only precision differs.
    """
    if isinstance(expected, tuple):
        if not isinstance(got, tuple | list) or len(got) != len(expected):
            return f"expected {len(expected)} results, got {describe((got,))}"
        parts = (compare(g, e, tolerance) for g, e in zip(got, expected, strict=True))
        return next((f"result {i}: {p}" for i, p in enumerate(parts) if p), "")
    try:
        a, b = _array(got), _array(expected)
        if a.dtype.kind not in "biuf":
            return f"expected numbers, got {type(got).__name__}"
    except (TypeError, ValueError, RuntimeError):
        return f"expected an array, got {type(got).__name__}"
    if a.shape != b.shape:
        return f"expected shape {b.shape}, got {a.shape}"
    if b.ndim and a.size and a.dtype.kind == "f" and b.dtype.kind in "bi":
        return f"expected whole numbers ({b.dtype}), got {a.dtype}"
    finite = np.abs(b[np.isfinite(b)].astype(float)) if b.size else b
    rounding = _FLOAT32 * max(1.0, float(finite.max(initial=0.0))) if a.dtype.itemsize <= 4 else 0.0
    a, b = a.astype(float), b.astype(float)
    same = np.isclose(a, b, rtol=tolerance, atol=max(tolerance, rounding), equal_nan=True)
    if same.all():
        return ""
    lost = ", among them NaN" if np.isnan(a[~same]).any() else ""
    where = tuple(int(i) for i in np.argwhere(~same)[0])
    place = f"at index {where}: " if where else ""
    share = f" ({(~same).sum()} of {same.size} values differ{lost})" if same.size > 1 or lost else ""
    return f"{place}expected {number(b[where])}, got {number(a[where])}{share}"


def describe(arguments: tuple) -> str:
    """Arguments of a call on one line: small arrays whole, larger ones by their shape."""
    return short(", ".join(_described(a) for a in arguments))


def short(text: str, most: int = 300) -> str:
    """A text's beginning, on one line."""
    line = " ".join(text.split())
    return line if len(line) <= most else f"{line[: most - 2]} …"


def number(value: object) -> str:
    """A number or word as it stands in a sentence."""
    return str(value) if isinstance(value, str | bool | np.bool_) else f"{float(value):.4g}"


def _array(value: object) -> np.ndarray:
    return np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)


def _described(value: object) -> str:
    if isinstance(value, list | tuple) and len(value) > 4:
        return f"{type(value).__name__} of {len(value)}"
    if isinstance(value, list | tuple):
        inside = ", ".join(map(_described, value))
        return f"[{inside}]" if isinstance(value, list) else f"({inside})"
    if hasattr(value, "shape"):
        array = _array(value)
        small = array.size <= 9
        return np.array2string(array, precision=3, suppress_small=True) if small else f"array {array.shape}"
    if callable(value):
        return getattr(value, "__name__", type(value).__name__)
    return f"{value:.4g}" if isinstance(value, float) else repr(value)
