"""Tables of a scenario whose keys are parameters of the loop: `[design.over]`, `[tune.free]`, `[tune.over]`,
`[sweep.over]`.

    "plant.mass" = ...                   a path of the loop, as one key with dots or as nested tables
    "road.scale" = ...                   the road has a section of its own, here as elsewhere
    "initial.speed_kmh" = ...            speeds may be given in km/h

What stands behind the path differs from table to table; this module knows the paths and the units."""

import dataclasses
import re
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from diffabs.core.pytree import ParameterSpec, parameters
from diffabs.core.values import (
    FORMER_FIELDS,
    ScenarioError,
    format_given,
    read_number,
    read_number_in_range,
    unknown_name_error,
    wrong_kind_error,
)
from diffabs.scenario.registry import KMH, MAX_DEPTH, in_kmh

Ends = tuple[Any, Any]  # low and high, tuples where the parameter is a list

TABLES = (("design", "over"), ("tune", "free"), ("tune", "over"), ("sweep", "over"))


@dataclasses.dataclass(frozen=True)
class ParameterEntry:
    """What was given for a parameter: its path in the loop, the place for messages, and the parameter's unit and range,
    both in the unit in which the value was given, `scale` of which make one in SI; and its shape, () for a number."""

    path: str
    where: str
    given: Any
    spec: ParameterSpec
    shape: tuple[int, ...]
    scale: float

    def single(self, what: str) -> "ParameterEntry":
        """Return this entry. Raises ScenarioError for a parameter that is a list: only single numbers can do `what`."""
        if self.shape:
            raise ScenarioError(f"{self.where} is a list of {self.shape[0]} numbers; only single numbers can {what}")
        return self

    def values(self) -> tuple[float, ...]:
        """Return the numbers that were given, or the one, in SI. Raises ScenarioError, also where there are none."""
        given = self.given if isinstance(self.given, list) else [self.given]
        if not given:
            raise ScenarioError(f"{self.where} = [] is empty; numbers in {self.spec.interval()} are needed")
        return tuple(read_number_in_range(x, self.spec, f"{self.where}.{i}") / self.scale for i, x in enumerate(given))

    def range(self, or_else: str = "") -> Ends:
        """Return low and high in SI, each a tuple where the parameter is a list and one was given.

        or_else: what might have been given instead; such a range is of coordinates, which never reach its ends: they
            may be those of an open range, and must differ.
        Raises ScenarioError."""
        needed = f"a range [low, high] in {self.spec.interval()}"
        if not isinstance(self.given, list):
            raise wrong_kind_error(self.where, self.given, needed + or_else)
        if len(self.given) != 2:
            raise ScenarioError(
                f"{self.where} = {format_given(self.given)} is no range [low, high] in {self.spec.interval()}"
            )
        ends = [self._end(item, f"{self.where}.{i}") for i, item in enumerate(self.given)]
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

    def _end(self, given: Any, path: str) -> Any:
        """A number, or a tuple of as many as the parameter has."""
        if not self.shape or not isinstance(given, list):
            return read_number(given, self.spec, path)
        if len(given) != self.shape[0]:
            have = f"has {len(given)} numbers; the parameter has {self.shape[0]}"
            raise ScenarioError(f"{path} = {format_given(given)} {have}")
        return tuple(read_number(item, self.spec, f"{path}.{i}") for i, item in enumerate(given))


def scale_to_si(value: Any, scale: float) -> Any:
    """Return a number, or a tuple of them, that was given in units of which `scale` make one in SI."""
    return tuple(scale_to_si(item, scale) for item in value) if isinstance(value, tuple) else value / scale


def to_canonical_form(table: dict[str, Any]) -> dict[str, Any]:
    """Bring a scenario to its canonical form: the road in a section of its own, and every such table by dotted path,
    however they were written. Returns the table. Raises ScenarioError."""
    plant = table.get("plant")
    if isinstance(plant, dict) and "road" in plant:
        if "road" in table:
            raise ScenarioError("road is given twice, as a section and in plant")
        table["road"] = plant.pop("road")
    for section, name in TABLES:
        inside = table.get(section)
        if isinstance(inside, dict) and isinstance(inside.get(name), dict):
            inside[name] = flatten_table(inside[name], f"{section}.{name}")
    return table


def forget_replaced_part(table: dict[str, Any], replaced: str) -> None:
    """Another part has other parameters: what was said about those of the one it replaces goes with it."""
    for section, name in TABLES:
        inside = table.get(section)
        if isinstance(inside, dict) and isinstance(inside.get(name), dict):
            inside[name] = {k: v for k, v in inside[name].items() if not k.startswith(f"{canonical_path(replaced)}.")}


def join_path_keys(keys: list[str]) -> list[str]:
    """The keys of an override, with a path in one of these tables as one key."""
    if tuple(keys[:2]) in TABLES and len(keys) > 2:
        return [*keys[:2], canonical_path(".".join(keys[2:]))]
    return keys


def flatten_table(table: Mapping[str, Any], section: str) -> dict[str, Any]:
    """The values by dotted path. Raises ScenarioError for a path that comes twice."""
    found: dict[str, Any] = {}
    pending = list(table.items())
    while pending:
        path, value = pending.pop(0)
        if path.count(".") > MAX_DEPTH:
            raise ScenarioError(f"{section}: {format_given(path)} is nested more than {MAX_DEPTH} deep")
        if isinstance(value, dict) and not {"type", "choices"} & value.keys():
            pending[:0] = [(f"{path}.{key}", item) for key, item in value.items()]
            continue
        path = canonical_path(path)
        if path in found:
            raise ScenarioError(f"{_where(section, path)} is given twice")
        found[path] = value
    return found


def canonical_path(path: str) -> str:
    """A path as messages have it: without the quotes of a key, the road in a section of its own."""
    path = path.replace('"', "").replace("'", "")
    return path.removeprefix("plant.") if path.startswith("plant.road.") else path


def read_entries(
    table: Mapping[str, Any], section: str, there: Mapping[str, tuple[ParameterSpec, tuple[int, ...]]], otherwise: str
) -> Iterator[ParameterEntry]:
    """What was given, by parameter. `there`: spec and shape of what may be, by path of the loop; `otherwise`: what to
    say of a name that is not. Raises ScenarioError."""
    known = {canonical_path(path): (path, spec, shape, 1.0) for path, (spec, shape) in there.items()}
    known |= {f"{k}_kmh": (path, in_kmh(spec), n, KMH) for k, (path, spec, n, _) in known.items() if spec.unit == "m/s"}
    known |= {former: item for key, item in known.items() if (former := _current_path(key)) not in (None, *known)}
    seen = set()
    for key, given in flatten_table(table, section).items():
        if key not in known:
            raise unknown_name_error(f"{_where(section, key)} is {otherwise}", key, known)
        path, spec, shape, scale = known[key]
        if path in seen:
            how = "in m/s and in km/h" if spec.unit in ("m/s", "km/h") else "by its former name, too"
            raise ScenarioError(f"{_where(section, canonical_path(path))} is given twice, {how}")
        seen.add(path)
        yield ParameterEntry(path, _where(section, key), given, spec, shape, scale)


def _current_path(path: str) -> str | None:
    """Return the path of a controller's limit under its older name; None for every other parameter."""
    section, _, name = path.rpartition(".")
    older = {new: old for old, new in FORMER_FIELDS.items()}
    return f"{section}.{older[name]}" if section.startswith("controller") and name in older else None


def parameters_of(loop: Any) -> dict[str, tuple[ParameterSpec, tuple[int, ...]]]:
    """Return spec and shape of every parameter by path."""
    return {path: (spec, np.shape(value)) for path, spec, value in parameters(loop)}


def _where(section: str, path: str) -> str:
    path = path if re.fullmatch(r"[a-zA-Z0-9_.-]{1,60}", path) else format_given(path)
    return f"{section}{' ' if section.startswith('-') else '.'}{path}"
