"""Checks of the user's arrays: each error names the argument, what was expected, what was received, and a remedy."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import fields
from numbers import Integral, Real
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor


def video_frames(video: np.ndarray, name: str = "Clip.video") -> np.ndarray:
    """A video (T, H, W, 3) uint8 with at least one frame, or ValueError."""
    video = np.asarray(video)
    if video.ndim != 4 or video.shape[-1] != 3 or video.dtype != np.uint8:
        raise ValueError(
            f"{name}: expected (T, H, W, 3) uint8 RGB, got {video.shape} {video.dtype}; move the colour axis last, drop alpha, scale [0, 1] floats by 255"
        )
    if 0 in video.shape:
        raise ValueError(f"{name}: zero frames or pixels in {video.shape}; give at least one frame")
    return video


def check_cameras(intrinsics: np.ndarray, extrinsics: np.ndarray) -> None:
    """Raise ValueError unless intrinsics (T, 3, 3) are [fx s cx; 0 fy cy; 0 0 1], fx and fy > 0, and poses (T, 4, 4) rigid."""
    focal = intrinsics[:, [0, 1], [0, 1]]
    if not (focal > 0).all():
        raise ValueError(f"Clip.intrinsics: fx and fy must be positive, got {focal[(focal <= 0).any(-1)][0].tolist()}")
    error = np.abs(intrinsics[:, [1, 2, 2, 2], [0, 0, 1, 2]] - (0, 0, 0, 1))
    wrong = (error > 1e-4 * np.maximum((focal.max(), 0, 0, 0), 1)).any(-1)
    if wrong.any():
        raise ValueError(
            f"Clip.intrinsics: expected rows [fx s cx], [0 fy cy], [0 0 1], got {intrinsics[wrong][0].tolist()} in frame "
            f"{int(wrong.argmax())}; transpose it, or divide it by its last number"
        )
    rotation = extrinsics[:, :3, :3]
    error = np.abs(rotation @ rotation.swapaxes(-1, -2) - np.eye(3)).max((-1, -2))
    mirrored = np.linalg.det(rotation) < 0
    if (error > 1e-2).any() or mirrored.any() or np.abs(extrinsics[:, 3] - (0, 0, 0, 1)).max() > 1e-4:
        frame = int(np.argmax(error + 10 * mirrored))
        raise ValueError(
            f"Clip.extrinsics: frame {frame} is not a rigid world-to-camera motion (R R^T differs from I by {error[frame]:.2g}, "
            f"det R = {np.linalg.det(rotation[frame]):.2g}, last row {extrinsics[frame, 3].tolist()}); remove scale, use row-major [R|t; 0 0 0 1]"
        )


def check_extras(extras: Mapping[str, np.ndarray], taken: Collection[str]) -> None:
    """Raise ValueError unless a clip's further arrays have names and values that its file can hold."""
    for key, value in extras.items():
        if not isinstance(key, str) or not key.isprintable() or key in {*taken, "", "file", "allow_pickle"}:
            raise ValueError(f"Clip.extras: expected text that is no key of a clip's file, got {key!r}; rename it")
        if (dtype := np.asarray(value).dtype).kind not in "biufcSUmM" or not dtype.itemsize:
            raise ValueError(f"Clip.extras: {key!r}: expected numbers or text, got dtype {dtype}; convert or drop it")


def floats(name: str, value: object, shape: tuple[int | None, ...], finite: bool = False, like: str = "") -> np.ndarray:
    """`value` as float32 of the given shape (None: any length), or ValueError; `finite` refuses NaN and infinity."""
    array = np.asarray(value)
    wanted = "(" + ", ".join("N" if s is None else str(s) for s in shape) + ")" + (f" to match {like}" if like else "")
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name}: expected numbers of shape {wanted}, got dtype {array.dtype}; convert to float32")
    if array.ndim != len(shape) or any(s not in (None, n) for s, n in zip(shape, array.shape, strict=True)):
        raise ValueError(f"{name}: expected shape {wanted}, got {array.shape}; reorder or resize the axes")
    array = array.astype(np.float32, copy=False)
    if finite and not np.isfinite(array).all():
        raise ValueError(
            f"{name}: expected finite numbers, got {int((~np.isfinite(array)).sum())} NaN or infinite; repair or drop those frames or rows"
        )
    return array


def bools(name: str, value: object, shape: tuple[int, ...]) -> np.ndarray:
    """`value` as booleans of the given shape (0 and 1 count), or ValueError."""
    array = np.asarray(value)
    if array.shape != shape:
        raise ValueError(f"{name}: expected shape {shape}, got {array.shape}; reorder or cut the axes")
    if array.dtype != bool and not (array.dtype.kind in "iuf" and np.isin(array, (0, 1)).all()):
        raise ValueError(f"{name}: expected booleans, got dtype {array.dtype}; threshold it first")
    return array.astype(bool, copy=False)


def check_depths(depths: np.ndarray, window: int) -> None:
    """Raise ValueError if in some window of depths (T, H, W) hardly any is known, so that coordinates have no scale."""
    known = (depths > 0).mean((1, 2))
    if np.convolve(known, np.ones(window), "valid").min() < 1e-3 * window:
        raise ValueError(f"Clip.depths: {window} consecutive frames have no valid pixel; leave those frames out")


def check_range(config: object, low: float, high: float, *names: str) -> None:
    """Raise ValueError unless these fields of a config, each a number or a tuple of numbers, are in [low, high]."""
    for name in names:
        value = getattr(config, name)
        if not (low <= np.min(value) and np.max(value) <= high):
            wanted = f"at least {low}" if high == np.inf else f"values in [{low}, {high}]"
            raise ValueError(f"{type(config).__name__}.{name}: expected {wanted}, got {value}")


_KINDS = {"int": Integral, "float": Real, "bool": bool | np.bool_, "str": str}


def check_types(config: object) -> None:
    """Raise ValueError unless a dataclass's numbers, switches and text are such, and finite; lists, of JSON, become tuples."""
    for field in fields(config):
        name, value, kinds = field.name, getattr(config, field.name), [field.type.removesuffix(" | None")]
        if kinds[0].startswith("tuple["):
            kinds, value = kinds[0][6:-1].split(", "), tuple(value) if isinstance(value, list) else value
            object.__setattr__(config, name, value)
        else:
            value = (value,)
        if (value == (None,) and field.type.endswith("| None")) or not set(kinds) <= set(_KINDS):
            continue
        if not isinstance(value, tuple) or len(value) != len(kinds) or not all(map(_fits, kinds, value)):
            got = repr(getattr(config, name))
            raise ValueError(f"{type(config).__name__}.{name}: expected {field.type}, got {got[:80]}")


def _fits(kind: str, value: object) -> bool:
    switch = isinstance(value, _KINDS["bool"])
    fits = isinstance(value, _KINDS[kind]) and switch == (kind == "bool")
    return fits and (kind in ("bool", "str") or abs(value) < 1e300)


def changed(old: Mapping[str, object], new: Mapping[str, object]) -> str:
    """Each value that differs, as `name=old (now new)`; empty where none does."""
    names = [name for name in {**old, **new} if old.get(name) != new.get(name)]
    return ", ".join(f"{name}={old.get(name)!r} (now {new.get(name)!r})" for name in names)


def check_state(state: dict[str, Tensor], wanted: dict[str, Tensor]) -> None:
    """Raise ValueError unless parameters have the names and shapes wanted, and finite values."""
    missing, unknown = sorted(set(wanted) - set(state)), sorted(set(state) - set(wanted))
    if missing or unknown:
        named = (", ".join(names[:9]) + ", …" * (len(names) > 9) or "none" for names in (missing, unknown))
        raise ValueError(
            "parameters do not fit the config: missing parameters: {}, unknown parameters: {}".format(*named)
        )
    for name, value in state.items():
        if value.shape != wanted[name].shape:
            shapes = f"expected shape {tuple(wanted[name].shape)}, got {tuple(value.shape)}"
            raise ValueError(f"parameters do not fit the config: {name}: {shapes}")
        if not value.float().isfinite().all():
            raise ValueError(f"parameter {name} is not finite: its training failed, or the file is damaged")


def check_names(where: str, given: Iterable[str], known: Collection[str]) -> None:
    """Raise ValueError for the first name that is not known; it says which known ones are near."""
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, sorted(known), 3, 0.5)
            hint = f"did you mean {' or '.join(near)}?" if near else f"there are {', '.join(sorted(known))}"
            raise ValueError(f"{where}: no {name!r}; {hint}")
