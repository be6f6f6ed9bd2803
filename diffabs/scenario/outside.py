"""Parts from outside: the modules of installed packages, by entry points of the group `diffabs.parts`, and those that a
person names (`--parts`). A scenario file never names one: a file that somebody sends must not import code."""

import contextlib
import dataclasses
import importlib
import importlib.metadata
import os
import sys
import traceback
from collections.abc import Iterable, Iterator
from functools import cache
from types import ModuleType
from typing import Any

ENTRY_POINT_GROUP = "diffabs.parts"

_named: dict[str, ModuleType] = {}


def register_modules(names: Iterable[str]) -> None:
    """Import modules whose parts are to be known from now on, from the Python path or the working directory. Raises
    ValueError, one line, for what is no name of a module, and for one that cannot be imported."""
    for name in names:
        if not all(word.isidentifier() for word in name.split(".")):
            raise ValueError(f"--parts {name} is no name of a Python module, such as dc_servo")
        here = os.getcwd()
        if here not in sys.path:
            sys.path.append(here)  # at the end: nothing here hides a module of Python's
        _named[name] = _import_module(name, f"--parts {name}")


@cache
def installed_modules() -> tuple[ModuleType, ...]:
    """Return the modules of installed packages. Raises ValueError for one that cannot be imported."""
    points = sorted(importlib.metadata.entry_points(group=ENTRY_POINT_GROUP), key=lambda point: point.name)
    return tuple(_import_module(point.value, f"entry point {point.name} of {ENTRY_POINT_GROUP}") for point in points)


def registered_modules() -> tuple[ModuleType, ...]:
    """Return every module with parts from outside, each once."""
    return tuple({module.__name__: module for module in (*installed_modules(), *_named.values())}.values())


def exported_parts(module: ModuleType) -> Iterator[tuple[str, Any]]:
    """Yield the parts of a module by name: classes made with `pytree` here, and named instances; not what is imported
    from diffabs."""
    for name in getattr(module, "__all__", [name for name in vars(module) if not name.startswith("_")]):
        item = getattr(module, name)
        cls = item if isinstance(item, type) else type(item)
        if not dataclasses.is_dataclass(cls):
            continue
        fields: Any = dataclasses.fields(cls)
        if not all({"spec", "part", "static"} & {*field.metadata} for field in fields):
            continue
        if not (isinstance(item, type) and cls.__module__.partition(".")[0] == "diffabs"):
            yield name, item


def describe_outside_error(error: BaseException, names: Iterable[str] | None = None) -> str:
    """Return one line about an error that came through code from outside: its file, line, type and message; nothing for
    another error. That code is the packages that these modules belong to, or all modules with parts."""
    known = names or [module.__name__ for module in registered_modules()]
    outer = {name.partition(".")[0] for name in known} - {"diffabs"}
    frames = [
        f"{frame.f_code.co_filename}, line {line}"
        for frame, line in traceback.walk_tb(error.__traceback__)
        if frame.f_globals.get("__name__", "").partition(".")[0] in outer
    ]
    said = [type(error).__name__, " ".join(str(error).split())]
    return ": ".join([frames[-1], *filter(None, said)]) if frames else ""


def _import_module(name: str, whose: str) -> ModuleType:
    try:
        with contextlib.redirect_stdout(sys.stderr):  # what a module prints is no part of a command's document
            return importlib.import_module(name)
    except ModuleNotFoundError as error:
        where = "" if error.name != name.partition(".")[0] else ", on the Python path or in the working directory"
        raise ValueError(f"{whose}: there is no module {error.name}{where}") from None
    except (Exception, SystemExit) as error:
        line = describe_outside_error(error, [name]) or f"{type(error).__name__}: {error}"
        raise ValueError(f"{whose}: cannot be imported: {line}") from None
