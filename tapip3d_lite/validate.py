"""Checks of the user's arrays: each error names the argument, what was expected, what was received, and a remedy."""

from __future__ import annotations

import difflib
import inspect
import re
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import fields
from functools import wraps
from numbers import Integral, Real
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor

_RIGID = 1e-4  # above it a tracker's coordinates differ by more than a millimetre
_PLAUSIBLE = 1000.0  # times the lower decile of the depths


def video_frames(video: np.ndarray, name: str = "Clip.video") -> np.ndarray:
    """A video (T, H, W, 3) uint8 with at least one frame, or ValueError."""
    video = as_array(name, video)
    if video.ndim != 4 or video.shape[-1] != 3 or video.dtype != np.uint8:
        raise ValueError(
            f"{name}: expected (T, H, W, 3) uint8 RGB, got {video.shape} {video.dtype}; move the colour axis last, drop alpha, scale [0, 1] floats by 255"
        )
    if 0 in video.shape:
        raise ValueError(f"{name}: zero frames or pixels in {video.shape}; give at least one frame")
    return video


def check_cameras(intrinsics: np.ndarray, extrinsics: np.ndarray) -> np.ndarray:
    """The poses (T, 4, 4), with a warning made rigid where rounding (4 digits in a file) has left them almost so.

    ValueError unless intrinsics (T, 3, 3) are [fx s cx; 0 fy cy; 0 0 1], fx and fy > 0, and poses rigid.
    """
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
    if (error > _RIGID).any():
        u, _, v = np.linalg.svd(rotation.astype(np.float64))
        extrinsics = extrinsics.copy()
        extrinsics[:, :3, :3] = u @ v
        warnings.warn(
            f"Clip.extrinsics: rotations of {int((error > _RIGID).sum())} frames are not orthonormal (R R^T differs from I by up to "
            f"{error.max():.2g}); the nearest rotations are taken. Write poses with 7 digits",
            stacklevel=5,
        )
    return extrinsics


def check_about(clip: Any, taken: Collection[str]) -> None:
    """Raise ValueError unless a clip's name, frame rate and tracks are such, and its further arrays have names and values that its file can hold."""
    for name in ("name", "fps", "tracks", "extras"):
        check_type(f"Clip.{name}", clip.__dataclass_fields__[name].type, getattr(clip, name))
    if not 1e-3 <= clip.fps <= 1e6:
        raise ValueError(f"Clip.fps: expected a number from 0.001 to 1e6, got {clip.fps!r}")
    if "\0" in clip.name:
        raise ValueError(f"Clip.name: a file cannot hold the character 0 in {clip.name!r}; drop it")
    for key, value in clip.extras.items():
        if (
            not isinstance(key, str)
            or not key.isprintable()
            or key in {*taken, "", "file", "allow_pickle"}
            or len(key) > 99
        ):
            raise ValueError(
                f"Clip.extras: expected short text that is no key of a clip's file, got {key!r:.60}; rename it"
            )
        if (dtype := np.asarray(value).dtype).kind not in "biufcSUmM" or not dtype.itemsize:
            raise ValueError(f"Clip.extras: {key!r}: expected numbers or text, got dtype {dtype}; convert or drop it")


def floats(
    name: str, value: object, shape: tuple[int | None, ...], finite: bool = False, like: str = "", far: bool = False
) -> np.ndarray:
    """`value` as float32 of the given shape (None: any length), or ValueError; `finite` refuses NaN and infinity.

    With `far`, float64 beyond 1,000 stays: places in a world whose origin is far away, which float32 would round by 0.1 mm and more.
    """
    array = as_array(name, value)
    wanted = "(" + ", ".join("N" if s is None else str(s) for s in shape) + ")" + (f" to match {like}" if like else "")
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name}: expected numbers of shape {wanted}, got dtype {array.dtype}; convert to float32")
    if array.ndim != len(shape) or any(s not in (None, n) for s, n in zip(shape, array.shape, strict=True)):
        raise ValueError(f"{name}: expected shape {wanted}, got {array.shape}; reorder or resize the axes")
    if not (far and array.dtype == np.float64 and np.nanmax(np.abs(array), initial=0) > 1e3):
        array = array.astype(np.float32, copy=False)
    if finite and not np.isfinite(array).all():
        raise ValueError(
            f"{name}: expected finite numbers, got {int((~np.isfinite(array)).sum())} NaN or infinite; repair or drop those frames or rows"
        )
    return array


def as_array(name: str, value: object) -> np.ndarray:
    """`value` as an array, or ValueError."""
    try:
        return np.asarray(value)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{name}: expected an array, got rows of different lengths or no numbers ({error})") from None


def known_depths(depths: np.ndarray) -> np.ndarray:
    """Depths with 0 where they are unknown: not positive, not finite, or a mark for the sky such as 65504 or 1e10.

    A warning counts such marks: what lies beyond 1,000 times the lower decile of the depths, and infinity if frequent.
    ValueError where nothing is left of several frames.
    """
    known = np.isfinite(depths) & (depths > 0)
    if not known.any():
        if len(depths) == 1:  # one frame may be one of a stream
            return np.zeros_like(depths)
        raise ValueError(
            "Clip.depths: no valid pixel in the whole clip (all 0, negative or non-finite); check the file's unit and key"
        )
    values = depths[known][:: max(known.sum() // 10_000, 1)]
    limit = _PLAUSIBLE * np.partition(values, len(values) // 10)[len(values) // 10]
    beyond, infinite = known & (depths > limit), np.isposinf(depths)
    known &= ~beyond
    if beyond.any() or infinite.mean() > 0.01:
        marks = beyond | infinite
        warnings.warn(
            f"Clip.depths: {int(marks.sum())} pixels ({marks.mean():.1%}) lie beyond {limit:.4g} or at infinity, as the sky's "
            "often do; they are taken as unknown. Set them to 0 where that is right",
            stacklevel=5,
        )
    return depths if known.all() or not depths[~known].any() else np.where(known, depths, np.float32(0))


def bools(name: str, value: object, shape: tuple[int, ...]) -> np.ndarray:
    """`value` as booleans of the given shape (0 and 1 count), or ValueError."""
    array = as_array(name, value)
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


_KINDS = {"bool": bool | np.bool_, "type": type, "str": str, "None": type(None), "Path": PathLike}
_KINDS |= {"slice": slice, "Mapping": Mapping}
_OURS = {"Clip", "Tracks", "Tracker", "TrackerConfig", "SimulationConfig", "Figure", "Axes"}  # other words fit anything


def check_types(config: object) -> None:
    """Raise ValueError unless a dataclass's values are of their types, numbers finite; lists, of JSON, become tuples."""
    for field in fields(config):
        if field.type.startswith("tuple") and isinstance(getattr(config, field.name), list):
            object.__setattr__(config, field.name, tuple(getattr(config, field.name)))
        check_type(f"{type(config).__name__}.{field.name}", field.type, getattr(config, field.name))


def check_type(name: str, annotation: str, value: object) -> None:
    """Raise ValueError unless a value is of the type that an annotation says, as far as its words are known here."""
    if not any(_is(kind, value) for kind in re.split(r" \| (?![^\[]*\])", annotation)):
        raise ValueError(f"{name}: expected {annotation}, got {value!r}"[:300])


def _is(kind: str, value: object) -> bool:
    if kind.startswith("tuple[") and "..." not in kind:
        kinds = kind[6:-1].split(", ")
        return isinstance(value, tuple | list) and len(value) == len(kinds) and all(map(_is, kinds, value))
    kind = kind.partition("[")[0].rpartition(".")[2]
    if kind in ("int", "float"):
        number = isinstance(value, Integral if kind == "int" else Real) and not isinstance(value, _KINDS["bool"])
        return number and abs(value if isinstance(value, Integral) else float(value)) < 1e300  # float32 has no 1e300
    if kind == "tuple":
        return isinstance(value, tuple | list)
    if kind in ("Sequence", "Collection"):
        return isinstance(value, Collection) and not isinstance(value, str)
    if kind in _KINDS:
        return isinstance(value, _KINDS[kind])
    return kind not in _OURS or kind in {c.__name__ for c in type(value).__mro__}


def checked(function: Callable) -> Callable:
    """A function that first compares arguments with its annotations: a ValueError names one of another type."""
    signature = inspect.signature(function)

    @wraps(function)
    def call(*given: object, **named: object) -> object:
        for name, value in signature.bind(*given, **named).arguments.items():
            if signature.parameters[name].kind in (1, 3):  # neither *names nor **options
                check_type(f"{function.__qualname__}: {name}", str(signature.parameters[name].annotation), value)
        return function(*given, **named)

    return call


def changed(old: Mapping[str, object], new: Mapping[str, object]) -> str:
    """Each value that differs, as `name=old (now new)`; empty where none does."""
    names = [name for name in {**old, **new} if old.get(name) != new.get(name)]
    return ", ".join(f"{name}={old.get(name)!r} (now {new.get(name)!r})" for name in names)


def check_device(device: object) -> None:
    """Raise ValueError unless torch can compute on a device, such as `"cpu"`, here."""
    import torch

    try:
        torch.ones(1, device=device).item()
    except Exception as error:  # torch has many ways to say that there is no such device
        why, name = str(error).partition("\n")[0].partition(". ")[0], str(device).upper()
        raise ValueError(f"device: torch sees no {name} device ({why}); leave --device out to use the CPU") from None


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
        if value.is_floating_point() != wanted[name].is_floating_point():
            raise ValueError(
                f"parameters do not fit the config: {name}: expected {wanted[name].dtype}, got {value.dtype}"
            )
        if not value.float().isfinite().all():
            raise ValueError(f"parameter {name} is not finite: its training failed, or the file is damaged")


def check_names(where: str, given: Iterable[str], known: Collection[str]) -> None:
    """Raise ValueError for the first name that is not known; it says which known ones are near."""
    for name in given:
        if not isinstance(name, str) or name not in known:
            near = difflib.get_close_matches(str(name), sorted(known), 3, 0.5)
            hint = f"did you mean {' or '.join(near)}?" if near else f"there are {', '.join(sorted(known))}"
            raise ValueError(f"{where}: no {name!r}; {hint}")
