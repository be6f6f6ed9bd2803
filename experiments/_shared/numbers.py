"""The numbers of a study as a file beside its page, `numbers.json`, with which later runs are compared.

    {"format": "diffabs numbers 1", "tolerance": 1e-06, "tables": {"critical_lag": [{"at": "50 km/h", ...}, ...], ...}}

The file holds what `run.py` prints, without times, counts of work, and versions. A run with the default config writes
it. Of a study in parts, "tables" has a table for each part, and a run writes that of its part.
"""

import json
import math
import pathlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from diffabs.host import documents

FILE = "numbers.json"
TOLERANCE = 1e-6  # relative, and absolute below 1: other processors and versions of JAX round differently
SEARCH_TOLERANCE = 1e-3  # of numbers behind a search, whose end the rounding moves
LEFT_OUT = ("config", "figures", "versions", "seconds", "minutes", "rollouts", "samples per rollout")  # or beginnings


def store_numbers(
    run_file: str, results: Mapping[str, Any], tolerance: float = TOLERANCE, part: str = ""
) -> pathlib.Path:
    """Write the numbers of a study's results, or of its part, beside its `run.py`; return the path of the file."""
    path = pathlib.Path(run_file).with_name(FILE)
    tables = _tables(results)
    if part:
        others = documents.read_document(path)["tables"] if path.exists() else {}
        tables = dict(sorted({**others, part: tables}.items()))
    content = {"tolerance": tolerance, "tables": tables}
    path.write_text(documents.format_document(documents.stamp("numbers", content), 1) + "\n", encoding="utf-8")
    return path


def store_parts(
    run_file: str, parts: Mapping[str, Callable[[], Mapping[str, Any]]]
) -> dict[str, Callable[[list[str]], Any]]:
    """Return the parts of a study for `run_part`; each stores its numbers after its run."""
    return {
        name: lambda _, name=name, main=main: store_numbers(run_file, main(), SEARCH_TOLERANCE, name)
        for name, main in parts.items()
    }


def find_differences(path: pathlib.Path, results: Mapping[str, Any], part: str = "") -> list[str]:
    """Return a line for each number of a study's results that differs from its file by more than the tolerance."""
    stored = documents.read_document(path)
    tables = stored["tables"][part] if part else stored["tables"]
    return list(_differences(tables, _tables(results), stored["tolerance"], ""))


def _tables(results: Mapping[str, Any]) -> Any:
    return _without_times(json.loads(documents.format_document(results)))


def _without_times(value: Any) -> Any:
    if isinstance(value, list):
        return [_without_times(item) for item in value]
    if not isinstance(value, dict):
        return value
    return {name: _without_times(item) for name, item in value.items() if not name.startswith(LEFT_OUT)}


def _differences(stored: Any, now: Any, tolerance: float, path: str) -> Iterator[str]:
    if isinstance(stored, dict) and isinstance(now, dict) and stored.keys() == now.keys():
        for name in stored:
            yield from _differences(stored[name], now[name], tolerance, f"{path}.{name}")
    elif isinstance(stored, list) and isinstance(now, list) and len(stored) == len(now):
        for i, (old, new) in enumerate(zip(stored, now, strict=True)):
            yield from _differences(old, new, tolerance, f"{path}.{i}")
    else:
        are_numbers = all(isinstance(x, int | float) and not isinstance(x, bool) for x in (stored, now))
        if not (math.isclose(stored, now, rel_tol=tolerance, abs_tol=tolerance) if are_numbers else stored == now):
            yield f"{path.lstrip('.')}: {stored} in the file, {now} here"
