"""Parts from outside of diffabs: modules of installed packages, and modules named with `--parts`.

An installed package registers its module as an entry point of the group `diffabs.parts`. A scenario file cannot name a
module: a file from somebody else must not import code.
"""

import contextlib
import dataclasses
import difflib
import importlib
import importlib.metadata
import os
import pathlib
import sys
import traceback
from collections.abc import Iterable, Iterator
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np

from diffabs.core import protocols
from diffabs.core.types import Part, PyTree
from diffabs.host.values import ScenarioError
from diffabs.loop.closed_loop import Loop
from diffabs.parts.roads.sign import find_wrong_sign

ENTRY_POINT_GROUP = "diffabs.parts"
CONTRACTS = {
    "a plant": protocols.Plant,
    "a road": protocols.Road,
    "a sensor, controller or actuator": protocols.Block,
    "a reference": protocols.Reference,
    "a feedforward": protocols.Feedforward,
    "a stop": protocols.Stop,
    "an objective": protocols.Objective,
}
MIN_METHOD_LIKENESS = 0.6  # least likeness of two names, of which one is probably a misspelling of the other

_named: dict[str, ModuleType] = {}


def register_modules(names: Iterable[str]) -> None:
    """Import modules with parts, which `registered_modules` then returns for the rest of the process.

    The working directory becomes the last entry of the Python path. Raises ValueError without a complete part.
    """
    for name in names:
        if name.endswith(".py"):
            raise ValueError(f"--parts {name} is a file; give the module's name, without folder and .py")
        if not all(word.isidentifier() for word in name.split(".")):
            raise ValueError(f"--parts {name} is not the name of a Python module, such as dc_servo")
        here = os.getcwd()
        if here not in sys.path:
            sys.path.append(here)  # at the end, so that no file here hides a module of the standard library
        module = _import_module(name, f"--parts {name}")
        if fault := _find_incomplete_class(module) or _find_wrong_friction(module):
            raise ValueError(f"--parts {name}: {fault}")
        _named[name] = module


@contextlib.contextmanager
def lend_modules(folder: pathlib.Path, names: Iterable[str]) -> Iterator[None]:
    """Return a context in which `registered_modules` also returns modules of a folder."""
    before = dict(_named)
    sys.path.append(str(folder))
    try:
        _named.update({name: _import_module(name, f"{folder}") for name in names})
        yield
    finally:
        sys.path.remove(str(folder))
        _named.clear()
        _named.update(before)


@cache
def installed_modules() -> tuple[ModuleType, ...]:
    """Return the modules that installed packages register."""
    points = sorted(importlib.metadata.entry_points(group=ENTRY_POINT_GROUP), key=lambda point: point.name)
    return tuple(_import_module(point.value, f"entry point {point.name} of {ENTRY_POINT_GROUP}") for point in points)


def registered_modules() -> tuple[ModuleType, ...]:
    """Return every module with parts from outside, each once."""
    return tuple({module.__name__: module for module in (*installed_modules(), *_named.values())}.values())


def exported_parts(module: ModuleType) -> Iterator[tuple[str, PyTree]]:
    """Yield name and item for each part in a module: a class made with `pytree`, or an instance of such a class.

    Classes imported from diffabs are left out, but their instances are not.
    """
    for name in getattr(module, "__all__", [name for name in vars(module) if not name.startswith("_")]):
        item = getattr(module, name)
        cls = item if isinstance(item, type) else type(item)
        if not dataclasses.is_dataclass(cls):
            continue
        fields: tuple[dataclasses.Field[Any], ...] = dataclasses.fields(cls)
        if not all({"spec", "part", "static"} & {*field.metadata} for field in fields):
            continue
        if not (isinstance(item, type) and cls.__module__.partition(".")[0] == "diffabs"):
            yield name, item


def describe_outside_error(error: BaseException, names: Iterable[str] | None = None) -> str:
    """Return one line about an error raised through outside code: file, line, type and message.

    The line is empty for any other error.

    Args:
        names: Modules whose packages count as outside code; by default all registered modules.
    """
    modules = names or [module.__name__ for module in registered_modules()]
    outer = {name.partition(".")[0] for name in modules} - {"diffabs"}
    frames = [
        f"{frame.f_code.co_filename}, line {line}"
        for frame, line in traceback.walk_tb(error.__traceback__)
        if frame.f_globals.get("__name__", "").partition(".")[0] in outer
    ]
    message = [type(error).__name__, " ".join(str(error).split())]
    return ": ".join([frames[-1], *filter(None, message)]) if frames else ""


def _find_incomplete_class(module: ModuleType) -> str:
    """Return what the first class of a module lacks to be a part; empty if the module has a part, or no class."""
    classes = [item for item in vars(module).values() if isinstance(item, type) and item.__module__ == module.__name__]
    parts = [item if isinstance(item, type) else type(item) for _, item in exported_parts(module)]
    if any(getattr(cls, "family", None) or not _missing_methods(cls)[1] for cls in parts):
        return ""
    if parts:
        cls = parts[0]
        kind, missing = _missing_methods(cls)
        methods = ", ".join(sorted(_public_methods(cls)))
        lacks = f"lacks {', '.join(missing)} of {kind}; it has {methods}"
        return f"there is no part in this module: class {cls.__name__} {lacks}"
    candidates = [cls for cls in classes if _public_methods(cls)]
    return (
        f"there is no part in this module: class {candidates[0].__name__} is not made with @pytree"
        if candidates
        else ""
    )


def _missing_methods(cls: type) -> tuple[str, list[str]]:
    """Return the kind of part whose contract is nearest to a class, and the methods that the class lacks of it.

    The nearest contract has the most methods in common, misspelled ones included, and then the fewest missing. A class
    without methods lacks none: it is an initial state.
    """
    methods = _public_methods(cls)
    if not methods or "rate" in methods:  # `rate` alone is the contract of an anti-windup
        return "", []

    def distance(contract: frozenset[str]) -> tuple[int, int]:
        close = [name for name in contract if difflib.get_close_matches(name, methods, cutoff=MIN_METHOD_LIKENESS)]
        return -len(close), len(contract - methods)

    needed = {kind: _public_methods(contract) for kind, contract in CONTRACTS.items()}
    if any(contract <= methods for contract in needed.values()):
        return "", []
    kind = min(needed, key=lambda kind: distance(needed[kind]))
    return kind, sorted(needed[kind] - methods)


def _public_methods(cls: type) -> frozenset[str]:
    return frozenset(name for name in dir(cls) if not name.startswith("_") and callable(getattr(cls, name)))


def _find_wrong_friction(module: ModuleType) -> str:
    """Return a line about the first road of a module whose friction is no number, empty if there is none.

    A friction that raises an error gives no line: the check of a loop with this road reports it.
    """
    for name, item in exported_parts(module):
        try:
            with contextlib.redirect_stdout(sys.stderr):
                road: Part = item() if isinstance(item, type) else item
                if not hasattr(road, "friction"):
                    continue
                mu = road.friction(0.1, 10.0, 0.0)
            value = np.asarray(mu)
        except (Exception, SystemExit):
            continue
        if value.shape or value.dtype.kind in "OSU":
            description = f"values of shape {value.shape}" if value.shape else repr(mu)
            return f"{name}.friction returns {description}; one number is needed"
    return ""


def _import_module(name: str, whose: str) -> ModuleType:
    try:
        with contextlib.redirect_stdout(sys.stderr):  # a print of the module would break the JSON on stdout
            return importlib.import_module(name)
    except ModuleNotFoundError as error:
        where = "" if error.name != name.partition(".")[0] else ", on the Python path or in the working directory"
        raise ValueError(f"{whose}: there is no module {error.name}{where}") from None
    except (Exception, SystemExit) as error:
        line = describe_outside_error(error, [name]) or f"{type(error).__name__}: {error}"
        raise ValueError(f"{whose}: cannot be imported: {line}") from None


def check_road(loop: Loop) -> None:
    """Raise ScenarioError if modules are registered, and the friction of the loop's road has not the slip's sign."""
    road = getattr(loop.plant, "road", None) if registered_modules() else None
    if road is not None and (line := find_wrong_sign(road)):
        raise ScenarioError(f"road: {line}")
