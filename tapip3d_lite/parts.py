"""Parts by name: `"module:Class"` to what it names and back; and the permission that a file needs to name one.

Python code and a command line may name what they like. A file may not: what it names is imported only where the caller
allows it, since importing is running.
"""

from __future__ import annotations

import inspect
import logging
from collections.abc import Iterable, Mapping
from importlib import import_module
from operator import attrgetter
from typing import Any

LOG = logging.getLogger("tapip3d_lite")


def find_part(what: str, part: Any, names: Iterable[str]) -> Any:
    """A built-in name or a custom part as it is; of `"module:name"` the object, whose module is imported.

    Raises:
        ValueError: neither one of the built-in `names`, nor importable, nor something that can be called or is a space.
    """
    if isinstance(part, str) and ":" in part:
        part = import_part(part, what)
    elif isinstance(part, str) and part in names:
        return part
    if callable(part) or all(hasattr(part, name) for name in ("lift", "from_world", "to_world", "to_pixels")):
        return part
    raise ValueError(f'{what}: expected one of {", ".join(names)}, "module:Class" or a custom part; got {part!r}')


def import_part(name: str, what: str = "part") -> Any:
    """What `"module:name"` names, whose module is imported; one that cannot be, or lacks the name, is a ValueError."""
    module, _, path = name.partition(":")
    try:
        found = import_module(module)
    except (Exception, SystemExit) as error:  # a user's module may raise anything
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise ValueError(f"{what}: {name!r}: module {module!r} cannot be imported ({reason})") from error
    try:
        return attrgetter(path)(found)
    except AttributeError as error:
        raise ValueError(f"{what}: {name!r}: module {module!r} has no {path!r}") from error


def part_name(part: Any, what: str = "part") -> str:
    """The name of a part in files: a built-in one's own, of a class or function `"module:qualname"`.

    An instance or a lambda has none, which is a ValueError: nothing could make it anew.
    """
    if isinstance(part, str):
        return part
    if not (inspect.isclass(part) or inspect.isfunction(part)) or part.__name__ == "<lambda>":
        raise ValueError(f"{what} is a custom part and has no name; give its class, or save its state_dict yourself")
    return f"{part.__module__}:{part.__qualname__}"


def allowed_parts(values: Mapping[str, Any], switches: Iterable[str], parts: Any) -> dict[str, Any]:
    """The custom parts that a file's `values` name for some switches, as objects, by switch.

    Args:
        values: read from a file.
        switches: keys to look at.
        parts: what the caller allows: classes and functions, which are matched by their names and not imported;
            `"module:Class"`; or names of modules that may be imported, with all that they contain.

    Raises:
        ValueError: a part that is not allowed, and how to allow it.
    """
    named = {name: values[name] for name in switches if isinstance(values.get(name), str) and ":" in values[name]}
    parts = parts if isinstance(parts, list | tuple) else [parts]
    return {name: _allowed(name, value, parts) for name, value in named.items()}


def _allowed(what: str, name: str, parts: Iterable[Any]) -> Any:
    home, _, path = name.partition(":")
    modules = [part for part in parts if isinstance(part, str) and ":" not in part]
    given = [import_part(x) if isinstance(x, str) else x for x in parts if not isinstance(x, str) or ":" in x]
    short = path.rpartition(".")[2]
    by_name = {part_name(part, "parts: an instance"): part for part in given}
    alike = [part for part in given if part.__name__ == short]  # moved since, e.g. from a notebook to a file
    if name in by_name or len(alike) == 1:
        return by_name.get(name, alike[-1])
    for module in modules:
        if _inside(home, module) or home == "__main__":
            found = import_part(name if home != "__main__" else f"{module}:{path}", what)
            if _inside(getattr(found, "__module__", None) or "", module):  # not what the module itself imports
                return found
    where = "the module that holds it" if home == "__main__" else home
    raise ValueError(
        f"{what}: {name!r} is a custom part, and a file alone imports no code; allow it by parts=[{short}], or on the "
        f"command line by --allow {where}"
    )


def _inside(module: str, package: str) -> bool:
    return module == package or module.startswith(f"{package}.")


def make_part(what: str, part: Any, **arguments: Any) -> Any:
    """An instance of a class; anything else as it is.

    The class is called with the values of `arguments`, or with none where it has no constructor of its own; one that
    takes others is a ValueError.
    """
    if not isinstance(part, type):
        return part
    maker = next(base for base in part.__mro__ if "__init__" in vars(base))
    values = () if maker.__name__ in ("object", "Module") else tuple(arguments.values())
    try:
        inspect.signature(part).bind(*values)
    except TypeError as error:
        wanted = ", ".join(arguments)
        raise ValueError(
            f"{what}: {part.__name__}{inspect.signature(part)} must be made by {part.__name__}({wanted}): {error}"
        ) from error
    return part(*values)


def source(part: Any) -> str:
    """The code of a custom part, as far as it is at hand."""
    try:
        return inspect.getsource(part)
    except (OSError, TypeError):
        return repr(part)
