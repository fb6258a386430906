"""Reading the authors' checkpoint file without trusting it.

The file is `torch.save({"cfg": OmegaConf, "weight": state_dict, …})`. A pickle is a program; this reader runs it with an
allow-list of harmless constructors. Classes of configuration libraries become inert records, so OmegaConf need not be
installed, and anything else in the file is refused by name before it is called.
"""

from __future__ import annotations

import pickle
import re
import tarfile
import zipfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from types import FunctionType, SimpleNamespace
from typing import Any

import torch

_HARMLESS = {
    "builtins": {x.__name__ for x in (bool, bytes, complex, dict, float, frozenset, int, list, set, slice, str, tuple)},
    "collections": {"OrderedDict", "defaultdict"},
    "torch": {"Size", "device", *(str(x)[6:] for x in vars(torch).values() if isinstance(x, torch.dtype))},
    "torch._utils": {"_rebuild_tensor", "_rebuild_tensor_v2", "_rebuild_parameter"},
    "numpy": {"dtype", "ndarray"},
    "numpy.core.multiarray": {"scalar", "_reconstruct"},
    "numpy._core.multiarray": {"scalar", "_reconstruct"},
    "_codecs": {"encode"},  # how numpy writes bytes at protocol 2
}
# What these packages define is data to us: recorded, never called.
_RECORDED = {"omegaconf", "box", "typing", "pathlib", "argparse"}
_RECORDED |= {"addict", "easydict", "munch", "yacs", "ml_collections"}


def read_checkpoint(path: str | Path) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """The configuration, as plain dictionaries, and the parameters of a checkpoint {"cfg", "weight", …}.

    Raises:
        ValueError: not such a file, or a refused global in its pickle.
    """
    content = _read_pickle(path)
    content = content if isinstance(content, Mapping) else {type(content).__name__: content}
    missing = " and ".join(key for key in ("cfg", "weight") if key not in content)
    if missing:
        found = ", ".join(map(str, content))
        raise ValueError(f'{path}: expected a checkpoint {{"cfg", "weight"}}, {missing} missing in {found}')
    try:
        cfg = plain(content["cfg"])
        cfg = _resolved(cfg, cfg)
    except RecursionError:
        raise ValueError(f"{path}: the configuration refers to itself; the file is damaged") from None
    weight = content["weight"]
    if not isinstance(weight, Mapping) or not all(isinstance(value, torch.Tensor) for value in weight.values()):
        raise ValueError(f'{path}: expected named tensors in "weight", got {type(weight).__name__} of other things')
    return cfg, dict(weight)


def plain(value: Any) -> Any:
    """Configuration records as plain dictionaries, lists and values."""
    if isinstance(value, _Record):
        for key in ("_content", "_val"):
            if key in value.state:
                return plain(value.state[key])
        return {key: plain(item) for key, item in value.items()} or plain(value.state)
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    return [plain(item) for item in value] if isinstance(value, list | tuple) else value


class _Record(dict):
    """An object of a class that is not there: keeps its state and items, does nothing."""

    def __new__(cls, *arguments: Any, **_options: Any) -> _Record:
        instance = super().__new__(cls)
        instance.state = {"arguments": arguments}
        return instance

    def __init__(self, *_arguments: Any, **_options: Any) -> None:
        super().__init__()

    def __setstate__(self, state: Any) -> None:
        self.state = state if isinstance(state, dict) else {"state": state}

    def __hash__(self) -> int:
        return id(self)


class _Unpickler(pickle.Unpickler):
    """Finds only what `_HARMLESS` lists, and records for configuration classes."""

    def find_class(self, module: str, name: str) -> Any:
        if module == "__builtin__":  # of Python 2
            module, name = "builtins", "int" if name == "long" else name
        if name in _HARMLESS.get(module, ()):
            found = super().find_class(module, name)
            # A pickle may set attributes of what it finds; a function's defaults would stay changed in this process.
            return partial(found) if isinstance(found, FunctionType) else found
        if module.split(".")[0] in _RECORDED:
            return type(name, (_Record,), {})
        raise pickle.UnpicklingError(f"{module}.{name} is refused")


# torch.load does the rest (storages, devices, byte order, the formats before and after 1.6) around this pickle module.
_PICKLE = SimpleNamespace(
    __name__="pickle",
    Unpickler=_Unpickler,
    UnpicklingError=pickle.UnpicklingError,
    load=lambda file, **options: _Unpickler(file, **options).load(),
)


def _read_pickle(path: str | Path) -> Any:
    if not Path(path).is_file():
        raise ValueError(f"{path}: no such file; check the path")
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            if any(name.endswith("constants.pkl") for name in archive.namelist()):
                raise ValueError(f"{path}: a TorchScript program, which could run code; expected a torch.save file")
    elif tarfile.is_tarfile(path):
        raise ValueError(f"{path}: a tar archive of torch before 0.2; load and save it with a newer torch first")
    try:
        return torch.load(path, map_location="cpu", pickle_module=_PICKLE, weights_only=False)
    except Exception as error:  # a damaged pickle fails in any way, an assertion or too little memory among them
        if isinstance(error, pickle.UnpicklingError) and "is refused" in str(error):
            raise ValueError(
                f"{path}: {error}: a checkpoint needs no such thing, and it could run code on this machine"
            ) from None
        raise ValueError(
            f"{path}: not a readable checkpoint ({type(error).__name__}: {error}); it may be truncated or of another format"
        ) from error


def _resolved(value: Any, root: Any) -> Any:
    """OmegaConf's references `${a.b.c}` replaced by what they name."""
    if isinstance(value, dict):
        return {key: _resolved(item, root) for key, item in value.items()}
    if isinstance(value, list):
        return [_resolved(item, root) for item in value]
    named = re.fullmatch(r"\$\{([\w.]+)\}", value) if isinstance(value, str) else None
    if not named:
        return value
    target = root
    for part in named.group(1).split("."):
        if not isinstance(target, dict) or part not in target:
            return value  # a reference into a part we do not need; the strict mapping complains if we do
        target = target[part]
    return _resolved(target, root)
