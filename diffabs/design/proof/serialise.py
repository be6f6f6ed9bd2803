"""The file of a certificate: JSON that round-trips exactly, and of which nothing is believed."""

import json
import math
import os
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from diffabs.core import files
from diffabs.design.polytopes import Polytope, Schedule

FORMAT, VERSION = "diffabs certificate", 1
LARGEST_FILE, LARGEST_ORDER = 2**24, 64  # bytes; states and inputs together


def listed(value: float | np.ndarray) -> Any:
    """For JSON."""
    return value.tolist() if isinstance(value, np.ndarray) else value


def described(system: Polytope | Schedule) -> dict[str, Any]:
    """For JSON; `coverage`, which no claim rests on, is left out."""
    if isinstance(system, Schedule):
        cells = [described(cell) for cell in system.cells]
        return {"parameter": system.parameter, "nodes": system.nodes.tolist(), "cells": cells}
    corners = [{name: float(value) for name, value in corner.items()} for corner in system.corners]
    names = {"period": system.period, "states": list(system.states), "corners": corners}
    return {"A": system.A.tolist(), "B": system.B.tolist(), **names}


def members(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object. Raises ValueError for a name that comes twice: two readers may take different ones."""
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError(f"a name comes twice among {', '.join(name for name, _ in pairs)}")
    return found


def fields(value: Any, where: str, *names: str) -> list[Any]:
    """The values of an object with exactly these members. Raises ValueError."""
    if not isinstance(value, dict) or set(value) != set(names):
        has = ", ".join(value) if isinstance(value, dict) else type(value).__name__
        raise ValueError(f"{where} must have the members {', '.join(names)} and no other; has {has}")
    return [value[name] for name in names]


def items(value: Any, where: str, kind: type = dict) -> list[Any]:
    """A list of JSON values of one type. Raises ValueError."""
    if not isinstance(value, list) or not all(type(each) is kind for each in value):
        raise ValueError(f"{where} must be a list of {kind.__name__}")
    return value


def number(value: Any, where: str = "a number") -> Any:
    """A finite number or lists of them of equal lengths, as an array. Raises ValueError."""
    array = np.array(value, object)
    if not all(type(each) is float and math.isfinite(each) for each in array.flat):
        raise ValueError(f"{where} must be finite numbers, in lists of equal lengths")
    return array.astype(float)


def text(system: Polytope | Schedule, gain: np.ndarray, claims: Iterable[tuple[str, Mapping[str, Any]]]) -> str:
    """The file of a certificate."""
    data = {
        "format": FORMAT,
        "version": VERSION,
        "system": described(system),
        "gain": gain.tolist(),
        "claims": [{"kind": kind, "data": {k: listed(v) for k, v in data.items()}} for kind, data in claims],
    }
    return json.dumps(data, allow_nan=False, indent=1) + "\n"


def read(path: str | os.PathLike[str]) -> tuple[Polytope | Schedule, np.ndarray, list[tuple[str, dict[str, Any]]]]:
    """System, gain, and (kind, data) of the claims in a file. Raises OSError, or ValueError that names the field."""
    raw = files.content(path, LARGEST_FILE + 1)
    if len(raw) > LARGEST_FILE:
        raise ValueError(f"the file is larger than {LARGEST_FILE} bytes")
    content = raw.decode()
    return read_parts(json.loads(content, parse_int=float, parse_constant=number, object_pairs_hook=members))


def read_parts(value: Any) -> tuple[Polytope | Schedule, np.ndarray, list[tuple[str, dict[str, Any]]]]:
    """The same from JSON. Raises ValueError that names the field."""
    kind, version, system, gain, claims = fields(value, "the file", "format", "version", "system", "gain", "claims")
    if kind != FORMAT or version != VERSION:
        raise ValueError(f"format and version must be {FORMAT!r} and {VERSION}; are {kind!r} and {version!r}")
    found = []
    for i, claim in enumerate(items(claims, "claims")):
        name, data = fields(claim, f"claims[{i}]", "kind", "data")
        if not isinstance(name, str) or not isinstance(data, dict):
            raise ValueError(f"claims[{i}] needs a kind that is a string and data that is an object")
        found.append((name, {key: number(each, f"claims[{i}].data.{key}") for key, each in data.items()}))
    if number(gain, "gain").ndim < 2:
        raise ValueError("gain must be a list of rows, or one of these for each node")
    return read_system(system), number(gain, "gain"), found


def read_system(value: Any) -> Polytope | Schedule:
    """A polytope or a schedule from JSON. Raises ValueError that names the field."""
    if isinstance(value, dict) and "cells" in value:
        parameter, nodes, cells = fields(value, "system", "parameter", "nodes", "cells")
        if not isinstance(parameter, str):
            raise ValueError("system.parameter must be a string")
        found = tuple(read_polytope(each, f"system.cells[{i}]") for i, each in enumerate(items(cells, "system.cells")))
        return Schedule(parameter, np.atleast_1d(number(nodes, "system.nodes")), found)
    return read_polytope(value, "system")


def read_polytope(value: Any, where: str) -> Polytope:
    """A polytope from JSON. Raises ValueError that names the field.

    Its corners stay behind: nothing ties the labels of a file to its matrices, so they are not shown beside a proof.
    """
    A, B, period, states, corners = fields(value, where, "A", "B", "period", "states", "corners")
    if period is not None and not (isinstance(period, float) and 0 < period < math.inf):
        raise ValueError(f"{where}.period must be null or positive [s]")
    for corner in items(corners, f"{where}.corners"):
        items(list(corner.values()), f"values of {where}.corners", float)
        number(list(corner.values()), f"{where}.corners")
    states = tuple(items(states, f"{where}.states", str))
    system = Polytope(number(A, f"{where}.A"), number(B, f"{where}.B"), period, states)
    if len(corners) not in (0, system.vertices) or len(states) not in (0, system.order):
        raise ValueError(f"{where}.corners and {where}.states must be empty or one for each vertex and each state")
    if system.order + system.inputs > LARGEST_ORDER:
        raise ValueError(f"{where} has more than {LARGEST_ORDER} states and inputs")
    return system
