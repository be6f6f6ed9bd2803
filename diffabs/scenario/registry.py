"""Which parts there are, by family and name, and how the values of a scenario become one.

A part is found by its shape among the names that its family's package exports: whoever has the methods of the family's
contract is listed, under the kebab-case of its name (`QuarterCar` is `quarter-car`, `SNOW` is `snow`). Writing a part
and exporting it is thus all that it takes to use it in a scenario. Parts from outside are in modules of their own, all
families in one: such a part is of the family whose contract asks most of it, or of its `family`, if it says one."""

import dataclasses
import inspect
import math
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np

from diffabs import actuators, controllers, objectives, plants, references, roads, sensors, stops
from diffabs.core import blocks, protocols
from diffabs.core.loop import Loop
from diffabs.core.pytree import ParameterSpec
from diffabs.core.units import Units, resolve_unit, units_of
from diffabs.core.values import (
    FORMER_FIELDS,
    ScenarioError,
    dotted_path,
    format_given,
    kebab_case,
    read_number,
    read_number_in_range,
    read_whole,
    unknown_name_error,
    wrong_kind_error,
)
from diffabs.scenario import outside
from diffabs.scenario.defaults import braking

KMH = 3.6  # km/h in a m/s
MAX_DEPTH = 16  # parts inside parts; more is a mistake, and Python's stack is finite
MAX_FILE_BYTES = 10_000_000  # of a whole number that shapes arrays
DEFAULT_UNITS = units_of(braking().plant)  # in which parts are listed that are in no loop


def _methods(cls: type) -> frozenset[str]:
    return frozenset(n for n in dir(cls) if not n.startswith("_") and callable(getattr(cls, n)))


# A family: the modules that export its parts, and the methods by which they are told. An initial state has none.
FAMILIES: dict[str, tuple[tuple[ModuleType, ...], frozenset[str]]] = {
    "plant": ((plants,), _methods(protocols.Plant)),
    "road": ((roads,), _methods(protocols.Road)),
    "initial": ((plants,), frozenset()),
    "sensor": ((sensors, blocks), _methods(protocols.Block)),
    "reference": ((references,), _methods(protocols.Reference)),
    "feedforward": ((controllers,), _methods(protocols.Feedforward)),
    "controller": ((controllers,), _methods(protocols.Block)),
    "antiwindup": ((controllers,), frozenset({"rate"})),
    "actuator": ((actuators, blocks), _methods(protocols.Block)),
    "stop": ((stops,), _methods(protocols.Stop)),
    "objective": ((objectives,), _methods(protocols.Objective)),
}


def family_types(family: str) -> Mapping[str, Any]:
    """The parts of a family by name, with their defaults: one of each class, and the named constants; also those from
    outside. Raises ScenarioError for a module of those that does not import, or that takes a name twice."""
    try:
        modules = outside.registered_modules()
    except ValueError as error:
        raise ScenarioError(str(error)) from None
    return {**_packaged_parts(family), **_outside_parts(family, modules)}


def register_parts(names: Iterable[str]) -> None:
    """Find the parts of these modules, too, from now on. Raises ScenarioError for a module that does not import, has no
    parts, or takes a name twice."""
    try:
        outside.register_modules(names)
    except ValueError as error:
        raise ScenarioError(str(error)) from None
    there = {id(item) for family in FAMILIES for item in family_types(family).values()}
    for module in outside.registered_modules():
        if module.__name__ in names and not there & {id(part) for part in _parts_of(module).values()}:
            raise ScenarioError(f"--parts {module.__name__}: there is no part in this module")


@cache
def _outside_parts(family: str, modules: tuple[ModuleType, ...]) -> Mapping[str, Any]:
    """Parts from outside by name. Raises ScenarioError."""
    found: dict[str, Any] = {}
    for module in modules:
        for exported, part in _parts_of(module).items():
            name = kebab_case(exported)
            if family not in _families_of(type(part)):
                continue
            if name in _packaged_parts(family) or name in found:
                whose = "diffabs" if name in _packaged_parts(family) else "another module"
                raise ScenarioError(f"parts of {module.__name__}: there is a {family} {name} already, of {whose}")
            found[name] = part
    return found


@cache
def _parts_of(module: ModuleType) -> Mapping[str, Any]:
    """An instance of every part that a module exports. Raises ScenarioError for a field without default."""
    try:
        return {name: item() if isinstance(item, type) else item for name, item in outside.exported_parts(module)}
    except TypeError as error:
        raise ScenarioError(f"parts of {module.__name__}: {error}: every field needs a default") from None


def _families_of(cls: type) -> set[str]:
    """Of those whose methods it has, the family that asks for most; blocks alone are alike in three."""
    if said := getattr(cls, "family", None):
        return {said}
    fits = {name: len(contract) for name, (_, contract) in FAMILIES.items() if contract and contract <= _methods(cls)}
    if not fits:
        return set() if _methods(cls) else {"initial"}
    return {name for name, size in fits.items() if size == max(fits.values())}


@cache
def _packaged_parts(family: str) -> Mapping[str, Any]:
    """The parts of diffabs itself."""
    modules, contract = FAMILIES[family]
    found = {}
    for exported, item in ((n, x) for module in modules for n, x in vars(module).items()):
        cls = item if isinstance(item, type) else type(item)
        if dataclasses.is_dataclass(cls) and (contract <= _methods(cls) if contract else not _methods(cls)):
            found[kebab_case(exported)] = item() if isinstance(item, type) else item
    return found


def name_of(family: str, part: Any) -> str:
    """The name of a named constant, else that of the part's class."""
    named = (name for name, item in family_types(family).items() if item is part)
    return next(named, kebab_case(type(part).__name__))


def family_of(field: str, enclosing: str) -> str:
    """The family of the parts in a field: `road` and `roads` hold roads, `blocks` the same as the part they are in."""
    return next((name for name in (field, field.removesuffix("s")) if name in FAMILIES), enclosing)


def type_name(given: Any) -> Any:
    """The type that a section of a scenario names, as a bare word or in its table; None where it names none."""
    return given.get("type") if isinstance(given, dict) else given


def inner_fields(family: str, name: str) -> list[str]:
    """The fields of a part that hold one part of its own family: the controller that `sampled` runs."""
    part = family_types(family)[name]
    own = [field.name for field in dataclasses.fields(part) if "part" in field.metadata]
    return [field for field in own if family_of(field, "") == family and not isinstance(getattr(part, field), tuple)]


def part_summary(part: Any) -> str:
    """The first paragraph of a part's docstring, on one line."""
    return " ".join((inspect.getdoc(type(part)) or "").split("\n\n")[0].split())


def unit_of(objective: Any, plant: Any = None) -> str:
    """The unit of what an objective measures on a plant, without one on the usual; empty where it does not say."""
    return resolve_unit(getattr(objective, "unit", ""), units_of(plant) or DEFAULT_UNITS)


def build_part(family: str, given: Any, default: Any, path: str, units: Units | None = None) -> Any:
    """The part that a table, or the bare name of a type, describes.

    A table without `type` describes `default` with some fields changed; default None means that a type is needed.
    `units` are those of the loop, for messages.
    Raises ScenarioError; ranges are left to `diffabs.check`.
    """
    there = family_types(family)
    table = {"type": given} if isinstance(given, str) else given
    if not isinstance(table, dict):
        raise wrong_kind_error(path, given, f"a table, or the name of a type ({', '.join(there)}),")
    name = table.get("type")
    if name is None and default is None:
        raise unknown_name_error(f"{path}.type is missing", path.rpartition(".")[2].replace("_", "-"), there)
    if name is not None and not isinstance(name, str):
        raise wrong_kind_error(f"{path}.type", name, f"one of {', '.join(there)}")
    if name is not None and name not in there:
        raise unknown_name_error(f"{path}.type = {format_given(name)} is unknown", name, there)
    template = default if name is None else there[name]
    return fill_part(template, {k: v for k, v in table.items() if k != "type"}, family, path, units)


def fill_part(template: Any, table: dict[str, Any], family: str, path: str, units: Units | None = None) -> Any:
    """A copy of a part with the fields of a table. Raises ScenarioError for an unknown field or a wrong type."""
    if path.count(".") > MAX_DEPTH:
        raise ScenarioError(f"{format_given(path)}: parts are nested more than {MAX_DEPTH} deep")
    fields = {field.name: field for field in dataclasses.fields(template)}
    edge = {f"{n}_kmh": f for n, f in fields.items() if "spec" in f.metadata and f.metadata["spec"].unit == "m/s"}
    values = {}
    for key, given in table.items():
        where = join_path(path, key)
        if family == "controller" and key not in fields and FORMER_FIELDS.get(key) in fields:
            key = FORMER_FIELDS[key]
        if key not in fields and key not in edge:
            whose = f"a field of {name_of(family, template)}" if path else "a section"
            if path and (inner := _find_inner_field(template, key)):
                raise ScenarioError(f"{where} is not {whose}; did you mean {path}.{inner}?")
            raise unknown_name_error(f"{where} is not {whose}", key, fields if path else (*fields, *OTHER_SECTIONS))
        field = fields[key] if key in fields else edge[key]
        if field.name in values:
            how = "in m/s and in km/h" if field.metadata["spec"].unit == "m/s" else "by its former name, too"
            raise ScenarioError(f"{join_path(path, field.name)} is given twice, {how}")
        if key in edge:
            values[field.name] = read_number_in_range(given, in_kmh(field.metadata["spec"]), where) / KMH
        else:
            values[field.name] = _value(given, field, getattr(template, key), (family, where), units)
    return dataclasses.replace(template, **values) if values else template


def _find_inner_field(part: Any, key: str) -> str:
    """Return the path of a field of this name in a part inside this one; empty without one."""
    pending = [("", part)]
    while pending:
        path, one = pending.pop(0)
        for field in dataclasses.fields(one):
            if path and field.name == key:
                return f"{path}.{key}"
            value = getattr(one, field.name)
            if "part" in field.metadata and dataclasses.is_dataclass(value):
                pending.append((f"{path}.{field.name}".removeprefix("."), value))
    return ""


def build_loop(sections: dict[str, Any]) -> Loop:
    """The loop of the sections of a scenario; what is left out is as the plant says that it usually is, or is missing.
    Raises ScenarioError."""
    plant = fill_part(braking(), {"plant": sections["plant"]}, "", "").plant if "plant" in sections else braking().plant
    own, units = getattr(plant, "usual_parts", dict), units_of(plant)
    parts = {"plant": plant, **own()}
    needed = [f.name for f in dataclasses.fields(Loop) if dataclasses.MISSING is f.default is f.default_factory]
    for family in (name for name in needed if name not in parts):
        if family not in sections:
            there = f"there is {', '.join(family_types(family))}"
            raise ScenarioError(f"{family} is missing: plant {name_of('plant', plant)} has no usual one; {there}")
        parts[family] = build_part(family, sections[family], None, family, units)
    return fill_part(Loop(**parts), sections, "", "", units)


# What a scenario has besides the fields of a loop.
OTHER_SECTIONS = ("road", "solver", "objective", "design", "tune", "sweep", "title", "description")


def join_path(path: str, key: str) -> str:
    """A dotted path; the road of the plant has a section of its own."""
    return "road" if (path, key) == ("plant", "road") else dotted_path(path, key)


def _value(given: Any, field: dataclasses.Field[Any], default: Any, place: tuple[str, str], units: Units | None) -> Any:
    family, path = place
    if "part" in field.metadata:
        inner = family_of(field.name, family)
        if isinstance(default, tuple):
            return _parts(inner, given, default, path, units)
        return build_part(inner, given, default, path, units)
    if "static" in field.metadata:
        if isinstance(default, int) and not isinstance(default, bool):
            return read_whole(given, 1, MAX_FILE_BYTES, path)
        if type(given) is not type(default):
            raise wrong_kind_error(path, given, f"a value like {format_given(default)}")
        return given
    spec: ParameterSpec = field.metadata["spec"].around(units)
    if np.ndim(default) == 0:
        return read_number(given, spec, path)
    if not isinstance(given, list):
        raise wrong_kind_error(path, given, f"a list of numbers in {spec.interval()}")
    return np.array([read_number(item, spec, f"{path}.{i}") for i, item in enumerate(given)], float)


def _parts(family: str, given: Any, default: tuple[Any, ...], path: str, units: Units | None) -> tuple[Any, ...]:
    """A list of parts; or a table by number, which changes some of the default ones, or adds the next."""
    if isinstance(given, list) and given:
        return tuple(build_part(family, item, None, f"{path}.{i}", units) for i, item in enumerate(given))
    if not isinstance(given, dict):
        raise wrong_kind_error(path, given, "a list of parts")
    parts = list(default)
    for key, item in given.items():
        if key not in map(str, range(len(parts) + 1)):
            raise unknown_name_error(f"{join_path(path, key)} is not there", key, map(str, range(len(parts))))
        place = int(key)
        old = parts[place] if place < len(parts) else None
        parts[place : place + 1] = [build_part(family, item, old, f"{path}.{key}", units)]
    return tuple(parts)


def in_kmh(spec: ParameterSpec) -> ParameterSpec:
    """Return what a speed may be, in km/h."""
    return dataclasses.replace(spec, unit="km/h", low=spec.low * KMH, high=spec.high * KMH)


def describe_part(family: str, part: Any) -> dict[str, dict[str, Any]]:
    """A part's fields: default, unit and range of each, as plain values. A default that is a part is its name."""
    rows = {}
    for field in dataclasses.fields(part):
        value, spec = getattr(part, field.name), field.metadata.get("spec")
        spec = spec and spec.around(DEFAULT_UNITS)
        if "part" in field.metadata:
            inner = family_of(field.name, family)
            names = [name_of(inner, item) for item in value] if isinstance(value, tuple) else name_of(inner, value)
            rows[field.name] = {"default": names, "unit": "", "range": f"any {inner}", "low": None, "high": None}
        elif spec is None:
            rows[field.name] = {
                "default": value,
                "unit": "",
                "range": f"[1, {MAX_FILE_BYTES}]",
                "low": 1,
                "high": MAX_FILE_BYTES,
            }
        else:
            ends = {"low": spec.low, "high": spec.high}
            ends = {name: end if math.isfinite(end) else None for name, end in ends.items()}
            default = np.asarray(value, float).tolist()
            rows[field.name] = {"default": default, "unit": spec.unit, "range": spec.interval(), **ends}
    return rows


def part_choices(part: Any, path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Every part below this one by its path: its type, and its fields that are no parameters."""
    if isinstance(part, tuple):
        for i, item in enumerate(part):
            yield from part_choices(item, f"{path}.{i}")
        return
    fields = dataclasses.fields(part)
    if path:
        fixed = {field.name: getattr(part, field.name) for field in fields if "static" in field.metadata}
        yield path, {"type": kebab_case(type(part).__name__), **fixed}
    for field in fields:
        if "part" in field.metadata:
            yield from part_choices(getattr(part, field.name), f"{path}.{field.name}" if path else field.name)
