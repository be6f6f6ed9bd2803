"""Tell by a digest, before anything is traced, whether a program was traced before; or that nobody can tell.

What decides a program is written down as text: the structure of its arguments with everything in it that is no array,
shapes and types of the arrays, this package's own files and what its modules hold at the moment, JAX's settings,
versions. What is from outside the package, or made while it runs, has no such text: `Unknown`, and it is traced."""

import dataclasses
import enum
import functools
import hashlib
import inspect
import os
import pathlib
import sys
import time
import types
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from diffabs.core import provenance

BEGAN = time.time()  # a file that is changed later is not what was loaded
PACKAGE = pathlib.Path(__file__).parents[1]
# What these hold is never part of a program: they only ask for it.
ABOVE = ("cli", "design", "identify", "papers", "plot", "reliability", "scenario", "sweep", "tune")
# Settings of JAX that say where things are kept and told, not what is computed.
ASIDE = ("cache", "cross_host", "debug_log", "dump", "log_", "logging", "proxy", "pprint", "profil", "traceback", "url")
PLAIN = (type(None), bool, int, float, complex, str, bytes)

Say = Callable[[str], None]


class Unknown(Exception):
    """Nobody can tell what this is in another process; why."""


def digest(given: Any, known: Any) -> str:
    """Return a digest of what decides a program of these: of what it is given (parts, solvers, mappings of them)
    arrays count by shape and type, of what is known to it by their numbers. Raises Unknown."""
    whole = hashlib.sha256()

    def say(line: str) -> None:
        whole.update(line.encode() + b"\0")

    _say(given, say, known=False)
    _say(known, say, known=True)
    return whole.hexdigest()


def surroundings() -> str:
    """Return a digest of what decides any program: sources, settings, versions. Raises Unknown where a file of the
    package is newer than what was loaded of it."""
    whole = hashlib.sha256(_sources().encode())
    flags = sorted(f"{name}={value}" for name, value in os.environ.items() if name.startswith("XLA_"))
    for line in (*flags, *_settings(), *_held(), repr(sorted(provenance.versions("jaxlib", "numpy").items()))):
        whole.update(line.encode() + b"\0")
    return whole.hexdigest()


def _say(x: Any, say: Say, known: bool) -> None:
    """`known`: arrays count by their numbers."""
    if type(x) in PLAIN:
        say(f"{type(x).__name__} {x!r}")
    elif isinstance(x, jax.Array | np.ndarray | np.generic | jax.ShapeDtypeStruct):
        _say_array(x, say, known)
    elif isinstance(x, type | types.FunctionType) or hasattr(x, "__wrapped__"):
        say(named(x))
    elif isinstance(x, np.dtype):
        say(f"type {x!r}")
    elif isinstance(x, enum.Enum):
        say(f"{named(type(x))} {x.name}")
    elif isinstance(x, functools.partial):
        _say((x.func, x.args, x.keywords), say, known)
    elif isinstance(x, tuple | list | dict):
        _say_items(x, say, known)
    elif dataclasses.is_dataclass(x):
        _say_fields(x, say, known)
    else:
        raise Unknown(f"a {type(x).__name__}")


def _say_array(x: Any, say: Say, known: bool) -> None:
    if x.dtype == object:
        raise Unknown("an array of objects")
    weak = bool(getattr(x, "weak_type", False))
    say(f"array {x.dtype} {x.shape} {weak} {np.asarray(x).tobytes().hex() if known else ''}")


def _say_items(x: Any, say: Say, known: bool) -> None:
    say(f"{type(x).__name__ if type(x) in (tuple, list, dict) else named(type(x))} {len(x)}")
    for item in x.items() if isinstance(x, dict) else x:
        _say(item, say, known)


def _say_fields(x: Any, say: Say, known: bool) -> None:
    """Of a part; of another dataclass, too, everything that it holds."""
    fields = {field.name: field for field in dataclasses.fields(x)}
    if more := sorted(set(vars(x)) - set(fields)):
        raise Unknown(f"{type(x).__name__}.{more[0]}")
    say(f"{named(type(x))} {len(fields)}")
    for name, field in fields.items():
        say(name)
        _say(getattr(x, name), say, known or "static" in field.metadata)


def named(x: Any) -> str:
    """Return the name of a class or function of this package that stands in its module. Raises Unknown."""
    x = inspect.unwrap(x)
    found: Any = sys.modules.get(x.__module__) if _own(x.__module__) else None
    for part in x.__qualname__.split("."):
        found = getattr(found, part, None)
    if found is None or inspect.unwrap(found) is not x:
        raise Unknown(f"{x.__module__}.{x.__qualname__}")
    return f"{x.__module__}.{x.__qualname__}"


def _own(module: str) -> bool:
    return module.partition(".")[0] == PACKAGE.name


@functools.cache
def _sources() -> str:
    """Of the package's files as they were when this began."""
    whole = hashlib.sha256()
    for path in sorted(path for kind in ("*.py", "*.h", "*.toml") for path in PACKAGE.rglob(kind)):
        if path.stat().st_ctime >= BEGAN:
            raise Unknown(f"{path} is newer than what runs")
        content = path.read_bytes()
        whole.update(f"{path.relative_to(PACKAGE)} {len(content)}\0".encode() + content)
    return whole.hexdigest()


def _settings() -> Iterator[str]:
    for name in sorted(jax.config.values):
        if not any(part in name for part in ASIDE):
            yield f"{name} = {getattr(jax.config, name, None)!r}"


def _held() -> Iterator[str]:
    """What the modules hold that trace: a constant or a function that somebody has put there is not in the files."""
    for name, module in sorted(sys.modules.items()):
        if _own(name) and name != __name__ and (name.split(".")[1:2] or ABOVE)[0] not in ABOVE:
            for key, value in sorted(vars(module).items()):
                if not key.startswith("__"):
                    yield f"{name}.{key} {_seen(value, name)}"


def _seen(x: Any, module: str = "") -> str:
    if type(x) in PLAIN:
        return repr(x)
    if isinstance(x, tuple | list):
        return f"({','.join(map(_seen, x))})"
    if isinstance(x, type):
        return f"{x.__module__}.{x.__qualname__} {_members(x) if x.__module__ == module else ''}"
    plain = inspect.unwrap(x) if callable(x) else x
    code = getattr(plain, "__code__", None)
    return f"{plain.__module__}.{plain.__qualname__} {code.co_firstlineno}" if code else type(x).__name__


def _members(x: type) -> str:
    """Functions and constants of a class."""
    return ",".join(
        f"{key} {_seen(getattr(v, '__func__', v))}" for key, v in vars(x).items() if not key.startswith("__")
    )
