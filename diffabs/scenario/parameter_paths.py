"""Tables of a scenario whose keys are parameters of the loop: `[design.over]`, `[tune.free]`, `[tune.over]`,
`[sweep.over]`, and the levels of a grid.

    "plant.mass" = ...                   a path of the loop, as one key with dots or as nested tables
    "road.scale" = ...                   the road has a section of its own, here as elsewhere
    "initial.speed_kmh" = ...            speeds may be given in km/h

A value has one of three forms, with the same meaning in each table that allows it:

    { low = 5.3, high = 6.2 }            an interval; also the text "5.3:6.2", as on the command line
    [5.3, 5.75, 6.2]                     a list of values
    { type = "normal", ... }             a distribution

This module reads paths, units and intervals. The module of each section reads the rest.
"""

import dataclasses
import math
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from diffabs.core.protocols import Objective
from diffabs.core.pytree import ParameterSpec, parameters
from diffabs.core.types import JsonObject, PyTree, Table
from diffabs.host.values import (
    Reader,
    ScenarioError,
    as_plain,
    dotted_path,
    format_given,
    read_as_given,
    read_number,
    read_number_in_range,
    table_reader,
    unknown_name_error,
    wrong_kind_error,
)
from diffabs.loop.closed_loop import Loop
from diffabs.scenario.registry import KMH, MAX_DEPTH, in_kmh
from diffabs.scenario.toml import parse_value

Ends = tuple[Any, Any]  # low and high, tuples where the parameter is a list

INTERVAL_KEYS = ("low", "high")
TABLES = (("design", "over"), ("tune", "free"), ("tune", "over"), ("sweep", "over"), ("sweep", "design", "levels"))


@dataclasses.dataclass(frozen=True)
class ParameterEntry:
    """The value given for one parameter.

    Attributes:
        path: Path of the parameter in the loop.
        where: Place of the value, for messages.
        value: The value, in the unit of `spec`.
        spec: Unit and range of the parameter, in the unit in which the value was given.
        shape: Shape of the parameter, () for a number.
        scale: Factor from SI to the given unit: 3.6 for a speed in km/h, else 1.
    """

    path: str
    where: str
    value: PyTree
    spec: ParameterSpec
    shape: tuple[int, ...]
    scale: float

    def single(self, verb: str) -> "ParameterEntry":
        """Return this entry if the parameter is a single number."""
        if self.shape:
            raise ScenarioError(f"{self.where} is a list of {self.shape[0]} numbers; only single numbers can {verb}")
        return self

    def values(self) -> tuple[float, ...]:
        """Return the given numbers in SI; a single number counts as a list of one."""
        if (ends := interval_ends(self.value, self.where)) is not None:
            raise ScenarioError(f"{self.where} is an interval; a list [{format_given(ends[0])}, ...] is needed")
        numbers = self.value if isinstance(self.value, list) else [self.value]
        if not numbers:
            raise ScenarioError(f"{self.where} = [] is empty; numbers in {self.spec.interval()} are needed")
        return tuple(
            read_number_in_range(x, self.spec, f"{self.where}.{i}") / self.scale for i, x in enumerate(numbers)
        )

    def range(self, or_else: str = "") -> Ends:
        """Return low and high in SI: numbers, or tuples where a list was given for a parameter that is a list.

        Args:
            or_else: Alternative to a range, for messages. A text that is not empty also selects the rules of a free
                parameter of a tuning. Its ends must then differ, and may be ends that the parameter's own range
                excludes.
        """
        needed = f"a range {{ low, high }} in {self.spec.interval()}"
        pair = interval_ends(self.value, self.where)
        if pair is None and not isinstance(self.value, list):
            raise wrong_kind_error(self.where, self.value, needed + or_else)
        # A list of values is no range, so the two ends in a list have one meaning here.
        pair = self.value if pair is None else pair
        if len(pair) != 2:
            raise ScenarioError(f"{self.where} = {format_given(pair)} is not {needed}")
        ends = [self._end(item, f"{self.where}.{name}") for name, item in zip(INTERVAL_KEYS, pair, strict=True)]
        low, high = map(np.asarray, ends)
        closed = dataclasses.replace(self.spec, open_low=False, open_high=False, infinite=True)
        allowed = closed if or_else else self.spec
        if not (allowed.holds(low) and allowed.holds(high)):
            raise ScenarioError(f"{self.where} = {format_given(ends)} is outside {self.spec.interval()}")
        if not (np.all(low < high) or (not or_else and np.all(low <= high))):
            raise ScenarioError(
                f"{self.where} = {format_given(ends)} is {'empty' if or_else else 'inverted'}: {needed}"
            )
        return tuple(scale_to_si(end, self.scale) for end in ends)

    def _end(self, value: object, path: str) -> float | tuple[float, ...]:
        """Return one end of a range: a number, or a tuple with as many numbers as the parameter."""
        if not self.shape or not isinstance(value, list):
            return read_number(value, self.spec, path)
        if len(value) != self.shape[0]:
            have = f"has {len(value)} numbers; the parameter has {self.shape[0]}"
            raise ScenarioError(f"{path} = {format_given(value)} {have}")
        return tuple(read_number(item, self.spec, f"{path}.{i}") for i, item in enumerate(value))


def read_fixed_values(
    table: Table, where: str, allowed: Mapping[str, tuple[ParameterSpec, tuple[int, ...]]]
) -> dict[str, float]:
    """Return the numbers of a table with parameter keys, in SI, by path of the loop."""
    entries = [entry.single("be fixed") for entry in read_entries(table, where, allowed, "no parameter of this loop")]
    return {entry.path: read_number_in_range(entry.value, entry.spec, entry.where) / entry.scale for entry in entries}


class BoxSide(NamedTuple):
    """One parameter of a box.

    Attributes:
        path: Path of the parameter in the loop.
        ends: Range (low, high) in SI.
        label: The path with the unit in which the range was given.
        scale: Factor from SI to that unit.
    """

    path: str
    ends: tuple[float, float]
    label: str
    scale: float


def read_box(table: Table, where: str, loop: Loop) -> list[BoxSide]:
    """Return the sides of a box, widened by a rounding so that it holds the decimal numbers of `table`."""
    sides = []
    for entry in read_entries(table, where, parameters_of(loop), "not a parameter of this loop"):
        if entry.shape:
            raise ScenarioError(f"{entry.where} is a list; a proof varies single numbers")
        low, high = entry.range()
        if not (math.isfinite(low) and math.isfinite(high)):
            raise ScenarioError(f"{entry.where} = {format_given(entry.value)}: both ends must be finite")
        # Zero is exact, and a slip must not be less.
        ends = (low and math.nextafter(low, -math.inf), high and math.nextafter(high, math.inf))
        sides.append(BoxSide(entry.path, ends, f"{entry.path} [{entry.spec.unit or 1}]", entry.scale))
    return sides


def interval_ends(value: object, where: str) -> list[PyTree] | None:
    """Return the ends of an interval `{ low, high }` or "low:high" as given, or None for a value of another form."""
    if isinstance(value, str) and value.count(":") == 1:
        ends = [parse_value(text.strip()) for text in value.split(":")]
        return ends if all(isinstance(end, int | float) for end in ends) else None
    if not isinstance(value, dict) or "type" in value or "choices" in value:
        return None
    if value.keys() != set(INTERVAL_KEYS):
        raise ScenarioError(f"{where} = {format_given(value)} is no interval {{ low = ..., high = ... }}")
    return [value[key] for key in INTERVAL_KEYS]


def interval_table(low: float | tuple, high: float | tuple) -> JsonObject:
    """Return an interval as a TOML value; its ends are numbers or tuples."""
    return dict(zip(INTERVAL_KEYS, as_plain((low, high)), strict=True))


def scale_to_si(value: Any, scale: float) -> Any:
    """Return a number, or a tuple of numbers, in SI.

    Args:
        value: Number or nested tuple of numbers, in the given unit.
        scale: Factor from SI to the given unit.
    """
    return tuple(scale_to_si(item, scale) for item in value) if isinstance(value, tuple) else value / scale


def to_canonical_form(table: JsonObject) -> JsonObject:
    """Return the table of a scenario in canonical form, changed in place.

    The road becomes a section of its own, and the tables with parameter keys get dotted paths.
    """
    plant = table.get("plant")
    if isinstance(plant, dict) and "road" in plant:
        if "road" in table:
            raise ScenarioError("road is given twice, as a section and in plant")
        table["road"] = plant.pop("road")
    for where, inside, name in _find_tables(table):
        inside[name] = flatten_table(inside[name], where)
    return table


def _find_tables(table: JsonObject) -> Iterator[tuple[str, JsonObject, str]]:
    """Yield path, enclosing table and name of each table with parameter keys."""
    for *sections, name in TABLES:
        inside: Any = table
        for section in sections:
            inside = inside.get(section) if isinstance(inside, dict) else None
        if isinstance(inside, dict) and isinstance(inside.get(name), dict):
            yield ".".join([*sections, name]), inside, name


def forget_replaced_part(table: JsonObject, replaced: str) -> list[str]:
    """Remove the entries for parameters of a replaced part from the tables with parameter keys, and return their paths.

    The new part has other parameters. One with the same name may have another meaning, and another range.
    """
    removed = []
    for where, inside, name in _find_tables(table):
        old = [key for key in inside[name] if key.startswith(f"{canonical_path(replaced)}.")]
        inside[name] = {key: value for key, value in inside[name].items() if key not in old}
        removed += [_where(where, key) for key in old]
    return removed


def join_path_keys(keys: list[str]) -> list[str]:
    """Return the keys of an override, with a parameter path joined to one key.

    For example "tune.free.plant.mass" becomes ["tune", "free", "plant.mass"]. Keys outside of the tables with parameter
    keys are returned as they are.
    """
    for table in TABLES:
        if tuple(keys[: (n := len(table))]) == table and keys[n:]:
            return [*table, canonical_path(".".join(keys[n:]))]
    return keys


def flatten_table(table: Table, section: str) -> JsonObject:
    """Return the values of nested tables by dotted path.

    A table with the key `type` or `choices` is a value, and so is a table of `low` and `high` below a dotted path.
    """
    flat: JsonObject = {}
    pending = list(table.items())[::-1]
    while pending:
        path, value = pending.pop()
        if path.count(".") > MAX_DEPTH:
            raise ScenarioError(f"{section}: {format_given(path)} is nested more than {MAX_DEPTH} deep")
        is_interval = isinstance(value, dict) and value.keys() == set(INTERVAL_KEYS) and "." in path
        if isinstance(value, dict) and not is_interval and not {"type", "choices"} & value.keys():
            pending += [(f"{path}.{key}", item) for key, item in list(value.items())[::-1]]
            continue
        path = canonical_path(path)
        if path in flat:
            raise ScenarioError(f"{_where(section, path)} is given twice")
        flat[path] = value
    return flat


def canonical_path(path: str) -> str:
    """Return a path as messages show it: without quotes, and with the road in a section of its own."""
    path = path.replace('"', "").replace("'", "")
    return path.removeprefix("plant.") if f"{path}.".startswith("plant.road.") else path


def read_entries(
    table: Table, section: str, allowed: Mapping[str, tuple[ParameterSpec, tuple[int, ...]]], otherwise: str
) -> Iterator[ParameterEntry]:
    """Yield one entry for each parameter in a table.

    A speed may have the suffix `_kmh`.

    Args:
        allowed: Spec and shape of each allowed parameter by path of the loop.
    """
    by_key = {canonical_path(path): (path, spec, shape, 1.0) for path, (spec, shape) in allowed.items()}
    by_key |= {
        f"{k}_kmh": (path, in_kmh(spec), n, KMH) for k, (path, spec, n, _) in by_key.items() if spec.unit == "m/s"
    }
    paths = set()
    for key, value in flatten_table(table, section).items():
        if key not in by_key:
            head = f"{key.partition('.')[0]}."
            beside = [path for path in by_key if path.startswith(head)]  # a loop has some sixty parameters
            raise unknown_name_error(f"{_where(section, key)} is {otherwise}", key, beside or by_key)
        path, spec, shape, scale = by_key[key]
        if path in paths:
            raise ScenarioError(f"{_where(section, canonical_path(path))} is given twice, in m/s and in km/h")
        paths.add(path)
        yield ParameterEntry(path, _where(section, key), value, spec, shape, scale)


def parameters_of(loop: object) -> dict[str, tuple[ParameterSpec, tuple[int, ...]]]:
    """Return spec and shape of every parameter by path."""
    return {path: (spec, np.shape(value)) for path, spec, value in parameters(loop)}


def _where(section: str, path: str) -> str:
    path = path if re.fullmatch(r"[a-zA-Z0-9_.-]{1,60}", path) else format_given(path)
    return f"{section}{' ' if section.startswith('-') else '.'}{path}"


def metric_reader(
    objectives: Mapping[str, Objective], contents: str, unit: Callable[[Objective], str] = lambda _: "1"
) -> Reader:
    """Return the reader (given, path) -> {metric: number} of a table, which raises ScenarioError for a wrong one.

    Args:
        unit: Function from an objective to the unit of its number.
    """

    def read(table: PyTree, path: str) -> dict[str, float]:
        for name in table_reader(read_as_given, contents)(table, path):
            if name not in objectives:
                raise unknown_name_error(
                    f"{dotted_path(path, name)} is not a metric of this scenario", name, objectives
                )
        return {
            name: read_number_in_range(x, ParameterSpec(unit(objectives[name])), dotted_path(path, name))
            for name, x in table.items()
        }

    return read
