"""The file of a certificate: JSON that round-trips exactly, with a check of every field on reading."""

import math
import os
from collections.abc import Iterable

import numpy as np

from diffabs.core.types import Params, PyTree
from diffabs.host import documents, files
from diffabs.robust.design.polytopes import Polytope, Schedule

CERTIFICATE_FORMAT, CERTIFICATE_VERSION = "diffabs certificate", 1
# As in `design.verify`, so that both read what is written.
MAX_CERTIFICATE_BYTES, MAX_STATES_OR_INPUTS, MAX_LIST_ENTRIES = 2**24, 64, 2**12


def describe_system(system: Polytope | Schedule) -> dict[str, PyTree]:
    """Return a system for JSON, without `coverage`, which no claim needs."""
    if isinstance(system, Schedule):
        cells = [describe_system(cell) for cell in system.cells]
        return {"parameter": system.parameter, "nodes": system.nodes.tolist(), "cells": cells}
    corners = [{name: float(value) for name, value in corner.items()} for corner in system.corners]
    names = {"period": system.period, "states": list(system.states), "corners": corners}
    return {"A": system.A.tolist(), "B": system.B.tolist(), **names}


def read_members(value: object, where: str, *names: str) -> list[PyTree]:
    """Return the values of an object with exactly these members, in the order of `names`."""
    if not isinstance(value, dict) or set(value) != set(names):
        has = ", ".join(value) if isinstance(value, dict) else type(value).__name__
        raise ValueError(f"{where} must have the members {', '.join(names)} and no other; has {has}")
    return [value[name] for name in names]


def read_list(value: object, where: str, kind: type = dict) -> list[PyTree]:
    """Return a list of JSON values of one type, after a check."""
    if not isinstance(value, list) or not all(type(each) is kind for each in value):
        raise ValueError(f"{where} must be a list of {kind.__name__}")
    return value


def read_numbers(value: object, where: str = "a number") -> np.ndarray:
    """Return a finite number, or lists of them of equal lengths, as an array; integers are read as floats."""
    array = np.array(value, object)
    if not all(type(each) is float and math.isfinite(each) for each in array.flat):
        raise ValueError(f"{where} must be finite numbers, in lists of equal lengths")
    return array.astype(float)


def format_certificate(system: Polytope | Schedule, gain: np.ndarray, claims: Iterable[tuple[str, Params]]) -> str:
    """Return the content of a certificate's file."""
    check_cell_size(system.cells[0] if isinstance(system, Schedule) else system, "system")
    arrays = [(kind, {name: np.asarray(value) for name, value in data.items()}) for kind, data in claims]
    nodes = len(system.nodes) if isinstance(system, Schedule) else 0
    longest = max(nodes, len(arrays), *(n for _, data in arrays for value in data.values() for n in value.shape))
    if longest > MAX_LIST_ENTRIES:
        raise ValueError(f"the certificate has a list of {longest} claims, nodes or entries, over {MAX_LIST_ENTRIES}")
    data = {
        "format": CERTIFICATE_FORMAT,
        "version": CERTIFICATE_VERSION,
        "system": describe_system(system),
        "gain": gain.tolist(),
        "claims": [{"kind": kind, "data": {k: v.tolist() for k, v in data.items()}} for kind, data in arrays],
    }
    content = documents.format_document(data, 1) + "\n"
    if len(content) > MAX_CERTIFICATE_BYTES:
        raise ValueError(f"the certificate is larger than {MAX_CERTIFICATE_BYTES} bytes: fewer vertices are needed")
    return content


def read_certificate(
    path: str | os.PathLike[str],
) -> tuple[Polytope | Schedule, np.ndarray, list[tuple[str, dict[str, PyTree]]]]:
    """Return system, gain, and (kind, data) of the claims in a file."""
    raw = files.read_content(path, MAX_CERTIFICATE_BYTES + 1)
    if len(raw) > MAX_CERTIFICATE_BYTES:
        raise ValueError(f"the file is larger than {MAX_CERTIFICATE_BYTES} bytes")
    return certificate_from_json(documents.parse_document(raw.decode(), exact=True))


def certificate_from_json(value: object) -> tuple[Polytope | Schedule, np.ndarray, list[tuple[str, dict[str, PyTree]]]]:
    """Return system, gain, and (kind, data) of the claims in a JSON value."""
    kind, version, system, gain, claims = read_members(
        value, "the file", "format", "version", "system", "gain", "claims"
    )
    if kind != CERTIFICATE_FORMAT or version is True or version != CERTIFICATE_VERSION:
        raise ValueError(
            f"format and version must be {CERTIFICATE_FORMAT!r} and {CERTIFICATE_VERSION}; are {kind!r} and {version!r}"
        )
    pairs = []
    for i, claim in enumerate(read_list(claims, "claims")):
        name, data = read_members(claim, f"claims[{i}]", "kind", "data")
        if not isinstance(name, str) or not isinstance(data, dict):
            raise ValueError(f"claims[{i}] needs a kind that is a string and data that is an object")
        pairs.append((name, {key: read_numbers(each, f"claims[{i}].data.{key}") for key, each in data.items()}))
    if read_numbers(gain, "gain").ndim < 2:
        raise ValueError("gain must be a list of rows, or one of these for each node")
    return read_system(system), read_numbers(gain, "gain"), pairs


def read_system(value: object) -> Polytope | Schedule:
    """Return a polytope or a schedule from a JSON value."""
    if isinstance(value, dict) and "cells" in value:
        parameter, nodes, cells = read_members(value, "system", "parameter", "nodes", "cells")
        if not isinstance(parameter, str):
            raise ValueError("system.parameter must be a string")
        polytopes = tuple(
            read_polytope(each, f"system.cells[{i}]") for i, each in enumerate(read_list(cells, "system.cells"))
        )
        return Schedule(parameter, np.atleast_1d(read_numbers(nodes, "system.nodes")), polytopes)
    return read_polytope(value, "system")


def read_polytope(value: object, where: str) -> Polytope:
    """Return a polytope from a JSON value, without corners: nothing ties such labels of a file to its matrices."""
    A, B, period, states, _ = read_members(value, where, "A", "B", "period", "states", "corners")
    if period is not None and not (isinstance(period, float) and 0 < period < math.inf):
        raise ValueError(f"{where}.period must be null or positive [s]")
    states = tuple(read_list(states, f"{where}.states", str))
    a, b = read_numbers(A, f"{where}.A"), read_numbers(B, f"{where}.B")
    try:
        system = Polytope(a, b, period, states)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None
    check_cell_size(system, where)
    return system


def check_cell_size(cell: Polytope, where: str) -> None:
    """Raise ValueError for a polytope that is too large for a certificate's file."""
    if max(cell.order, cell.inputs) > MAX_STATES_OR_INPUTS:
        raise ValueError(f"{where} has more than {MAX_STATES_OR_INPUTS} states or inputs")
