"""The parts by family and name, and the construction of a part from the values of a scenario.

A part belongs to a family on two conditions. Its class has all methods of the family's contract in `core.protocols`,
and the family's package exports it. Its name in scenarios is the kebab-case of its Python name: `QuarterCar` is
`quarter-car`, `SNOW` is `snow`. To add a part, write its class and export it.

A module from outside may hold parts of all families. Such a part belongs to the family whose contract has the most
methods among the contracts that fit. The attribute `family` of its class overrides this.
"""

import dataclasses
import inspect
import math
from collections.abc import Iterable, Iterator
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np

from diffabs.core import blocks, protocols
from diffabs.core.channels import Channels
from diffabs.core.meanings import field_meanings
from diffabs.core.pytree import ParameterSpec, children
from diffabs.core.types import JsonObject, Part, PyTree, Scalar, Table
from diffabs.core.units import Units, resolve_unit, units_inside, units_of
from diffabs.host.values import (
    READER_BY_TYPE,
    ScenarioError,
    as_plain,
    dotted_path,
    format_given,
    kebab_case,
    read_number,
    read_number_in_range,
    read_whole,
    unknown_name_error,
    wrong_kind_error,
)
from diffabs.loop.closed_loop import Loop
from diffabs.parts import actuators, controllers, objectives, plants, references, roads, sensors, stops
from diffabs.scenario import outside
from diffabs.scenario.defaults import braking

KMH = 3.6  # km/h in a m/s
MAX_DEPTH = 16  # parts inside parts; more is a mistake, and Python's stack is finite
OUTSIDE_HINT = "a part of a module of your own needs --parts MODULE"
MAX_STATIC = 10_000_000  # largest static whole number: such numbers become shapes of arrays
DEFAULT_UNITS = units_of(braking().plant)  # units in which `list` shows a part outside of a loop


def _methods(cls: type) -> frozenset[str]:
    return frozenset(n for n in dir(cls) if not n.startswith("_") and callable(getattr(cls, n)))


# A family: the modules that export its parts, and the methods of its contract. An initial state is a record without
# methods, so its contract is empty and a class without public methods fits.
FAMILIES: dict[str, tuple[tuple[ModuleType, ...], frozenset[str]]] = {
    "plant": ((plants,), _methods(protocols.Plant)),
    "road": ((roads,), _methods(protocols.Road)),
    "tyre": ((roads,), _methods(protocols.Tyre)),
    "pads": ((plants,), _methods(protocols.Pads)),
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


def family_types(family: str) -> Table:
    """Return a family's parts, also those from outside, by name: classes with their defaults, and named constants."""
    try:
        modules = outside.registered_modules()
    except ValueError as error:
        raise ScenarioError(str(error)) from None
    return {**_packaged_parts(family), **_outside_parts(family, modules)}


def register_parts(names: Iterable[str]) -> None:
    """Import modules, and add their parts to the families.

    Args:
        names: Dotted names of Python modules.

    Raises:
        ScenarioError: A module cannot be imported, has no parts, or uses a name that another part already has.
    """
    try:
        outside.register_modules(names)
    except ValueError as error:
        raise ScenarioError(str(error)) from None
    part_ids = {id(item) for family in FAMILIES for item in family_types(family).values()}
    for module in outside.registered_modules():
        if module.__name__ in names and not part_ids & {id(part) for part in _parts_of(module).values()}:
            raise ScenarioError(f"--parts {module.__name__}: there is no part in this module")


@cache
def _outside_parts(family: str, modules: tuple[ModuleType, ...]) -> Table:
    """Return the parts of outside modules by name. Raises ScenarioError for a name that is already used."""
    parts: JsonObject = {}
    for module in modules:
        for exported, part in _parts_of(module).items():
            name = kebab_case(exported)
            if family not in _families_of(type(part)):
                continue
            if name in _packaged_parts(family) or name in parts:
                whose = "diffabs" if name in _packaged_parts(family) else "another module"
                raise ScenarioError(f"parts of {module.__name__}: a {family} {name} exists already, in {whose}")
            parts[name] = part
    return parts


@cache
def _parts_of(module: ModuleType) -> Table:
    """Return an instance of every part that a module exports. Raises ScenarioError for a field without default."""
    try:
        return {name: item() if isinstance(item, type) else item for name, item in outside.exported_parts(module)}
    except TypeError as error:
        raise ScenarioError(f"parts of {module.__name__}: {error}: every field needs a default") from None


def _families_of(cls: type) -> set[str]:
    """Return the families of a part from outside.

    Among the contracts that fit, the one with the most methods decides. The contract of a block belongs to three
    families, so a plain block is in all three.
    """
    if family := getattr(cls, "family", None):
        return {family}
    fits = {name: len(contract) for name, (_, contract) in FAMILIES.items() if contract and contract <= _methods(cls)}
    if not fits:
        return set() if _methods(cls) else {"initial"}
    return {name for name, size in fits.items() if size == max(fits.values())}


@cache
def _packaged_parts(family: str) -> Table:
    """Return the parts of diffabs itself by name."""
    modules, contract = FAMILIES[family]
    parts = {}
    for exported, item in ((n, x) for module in modules for n, x in vars(module).items()):
        cls = item if isinstance(item, type) else type(item)
        if dataclasses.is_dataclass(cls) and (contract <= _methods(cls) if contract else not _methods(cls)):
            parts[kebab_case(exported)] = item() if isinstance(item, type) else item
    return parts


def name_of(family: str, part: object) -> str:
    """Return the name of a part in scenarios: that of a named constant, else that of the part's class."""
    named = (name for name, item in family_types(family).items() if item is part)
    return next(named, kebab_case(type(part).__name__))


def family_of(field: str, enclosing: str) -> str:
    """Return the family of the parts in a field.

    `road` and `roads` hold roads, and `front_tyre` a tyre. Any other field, such as `blocks`, holds parts of the
    enclosing family.
    """
    names = (field, field.removesuffix("s"), field.rpartition("_")[2])
    return next((name for name in names if name in FAMILIES), enclosing)


def type_name(section: PyTree) -> str | None:
    """Return the name of the type in a section: the section itself if it is a bare word, else its `type`, or None."""
    return section.get("type") if isinstance(section, dict) else section


def describe_missing_inner_parts(family: str, section: object, path: str) -> list[str]:
    """Return a line for each enclosed part of the same family whose type the table does not give.

    Such a part would get the default type of the enclosing class, whatever the scenario has there. A named constant
    brings its own parts.
    """
    name, lines = type_name(section), []
    part = family_types(family).get(name) if isinstance(name, str) else None
    is_class = part is not None and name == kebab_case(type(part).__name__)
    for field in () if part is None else dataclasses.fields(part):
        if "part" not in field.metadata:
            continue
        inner = section.get(field.name) if isinstance(section, dict) else None
        where, inner_family = f"{path}.{field.name}", family_of(field.name, family)
        if field.metadata.get("named") and inner is None:
            names = {"type", *vars(part)}
            items = (
                {key: item for key, item in section.items() if key not in names} if isinstance(section, dict) else {}
            )
            for key, item in items.items():
                lines += describe_missing_inner_parts(inner_family, item, f"{path}.{key}")
        elif isinstance(getattr(part, field.name), tuple):
            items = inner.items() if isinstance(inner, dict) else enumerate(inner if isinstance(inner, list) else ())
            for key, item in items:
                lines += describe_missing_inner_parts(inner_family, item, f"{where}.{key}")
        elif is_class and inner_family == family and type_name(inner) is None:
            lines.append(f"{where} is missing: {name} encloses another {family}; give its type")
        else:
            lines += describe_missing_inner_parts(inner_family, inner, where)
    return lines


def part_summary(part: object) -> str:
    """Return the first paragraph of a part's docstring, on one line."""
    return " ".join((inspect.getdoc(type(part)) or "").split("\n\n")[0].split())


def unit_of(objective: object, plant: object = None) -> str:
    """Return the unit of an objective's value; empty if the objective declares none. Signals are those of the plant."""
    return resolve_unit(getattr(objective, "unit", ""), units_of(plant) or DEFAULT_UNITS)


def build_part(family: str, section: object, default: object, path: str, units: Units | None = None) -> PyTree:
    """Return the part that a table, or the bare name of a type, describes.

    A type selects its own default fields; a table without `type` changes fields of `default`. Ranges of numbers are
    checked later, by `diffabs.check`.

    Args:
        default: Part with the default fields; None if a type is required.
    """
    types = family_types(family)
    table = {"type": section} if isinstance(section, str) else section
    if not isinstance(table, dict):
        raise wrong_kind_error(path, section, f"a table, or the name of a type ({', '.join(types)}),")
    name = table.get("type")
    if name is None and default is None:
        raise unknown_name_error(f"{path}.type is missing", path.rpartition(".")[2].replace("_", "-"), types)
    if name is not None and not isinstance(name, str):
        raise wrong_kind_error(f"{path}.type", name, f"one of {', '.join(types)}")
    if name is not None and name not in types:
        error = unknown_name_error(f"{path}.type = {format_given(name)} is unknown", name, types)
        raise ScenarioError(f"{error}; {OUTSIDE_HINT}")
    template = default if name is None else types[name]
    return fill_part(template, {k: v for k, v in table.items() if k != "type"}, family, path, units)


def fill_part(template: Any, table: JsonObject, family: str, path: str, units: Units | None = None) -> PyTree:
    """Return a copy of a part with the fields of a table; a speed may have the key `<field>_kmh`."""
    if path.count(".") > MAX_DEPTH:
        raise ScenarioError(f"{format_given(path)}: parts are nested more than {MAX_DEPTH} deep")
    fields = {field.name: field for field in dataclasses.fields(template)}
    # Every field in m/s may also be given as <field>_kmh.
    edge = {f"{n}_kmh": f for n, f in fields.items() if "spec" in f.metadata and f.metadata["spec"].unit == "m/s"}
    values = {}
    by_name = {key: value for key, value in table.items() if key not in fields and key not in edge}
    by_name = by_name if any(field.metadata.get("named") for field in fields.values()) else {}
    for key, value in table.items():
        where = join_path(path, key)
        if key in by_name:
            continue
        if key not in fields and key not in edge:
            whose = f"a field of {name_of(family, template)}" if path else "a section"
            if path and (inner := _find_inner_field(template, key)):
                raise ScenarioError(f"{where} is not {whose}; did you mean {path}.{inner}?")
            raise unknown_name_error(f"{where} is not {whose}", key, fields if path else (*fields, *OTHER_SECTIONS))
        field = fields[key] if key in fields else edge[key]
        if field.name in values:
            raise ScenarioError(f"{join_path(path, field.name)} is given twice, in m/s and in km/h")
        if key in edge:
            values[field.name] = read_number_in_range(value, in_kmh(field.metadata["spec"]), where) / KMH
        else:
            values[field.name] = _value(value, field, template, (family, where), units)
    part = dataclasses.replace(template, **values) if values else template
    # The parts by name come last, because the units in them may depend on other fields.
    return _with_named_parts(part, by_name, family, path, units) if by_name else part


def _with_named_parts(part: Any, table: JsonObject, family: str, path: str, units: Units | None) -> PyTree:
    """Return a part with those of a table in its field of parts by name."""
    field = next(field for field in dataclasses.fields(part) if field.metadata.get("named"))
    old, inner = getattr(part, field.name), family_of(field.name, family)
    parts = dict(old) if isinstance(old, dict) else {}
    for name, section in table.items():
        if old and name not in parts and type_name(section) is None:
            names = [*parts, *(other.name for other in dataclasses.fields(part) if other is not field)]
            error = unknown_name_error(f"{join_path(path, name)} is no part of {name_of(family, part)}", name, names)
            raise ScenarioError(f"{error}; a new part needs a type")
        units_there = units_inside(part, name, units)
        parts[name] = build_part(inner, section, parts.get(name), join_path(path, name), units_there)
    return dataclasses.replace(part, **{field.name: parts})


def _find_inner_field(part: Part, key: str) -> str:
    """Return the path of a field of this name in a part inside this one, or an empty text."""
    pending = [("", part)]
    while pending:
        path, owner = pending.pop(0)
        for field in dataclasses.fields(owner):
            if path and field.name == key:
                return f"{path}.{key}"
            value = getattr(owner, field.name)
            if "part" in field.metadata and dataclasses.is_dataclass(value):
                pending.append((f"{path}.{field.name}".removeprefix("."), value))
    return ""


def build_loop(sections: JsonObject) -> Loop:
    """Return the loop of a scenario's sections; a section that is left out gets the plant's usual part."""
    plant = fill_part(braking(), {"plant": sections["plant"]}, "", "").plant if "plant" in sections else braking().plant
    usual_parts, units = getattr(plant, "usual_parts", dict), units_of(plant)
    usual = usual_parts()
    for name, part in usual.items():
        if not dataclasses.is_dataclass(part) and not isinstance(part, tuple):
            whose = f"usual_parts of plant {name_of('plant', plant)}"
            raise wrong_kind_error(f"{whose}: {name}", part, "a part, or a tuple of parts,")
    parts = {"plant": plant, **usual}
    needed = [f.name for f in dataclasses.fields(Loop) if dataclasses.MISSING is f.default is f.default_factory]
    for family in (name for name in needed if name not in parts):
        if family not in sections:
            hint = f"there is {', '.join(family_types(family))}"
            raise ScenarioError(f"{family} is missing: plant {name_of('plant', plant)} has no usual one; {hint}")
        parts[family] = build_part(family, sections[family], None, family, units)
    return fill_part(Loop(**parts), sections, "", "", units)


# Sections of a scenario that are not fields of a loop.
OTHER_SECTIONS = ("road", "solver", "objective", "design", "tune", "sweep", "assess", "title", "description")


def join_path(path: str, key: str) -> str:
    """Return a dotted path; the road of the plant has the path `road`."""
    return "road" if (path, key) == ("plant", "road") else dotted_path(path, key)


def _value(
    value: PyTree, field: dataclasses.Field[Any], template: Any, place: tuple[str, str], units: Units | None
) -> Any:
    (family, path), default = place, getattr(template, field.name)
    if "part" in field.metadata:
        inner, units = family_of(field.name, family), units_inside(template, field.name, units)
        if isinstance(default, tuple):
            return _parts(inner, value, default, path, units)
        return build_part(inner, value, default, path, units)
    if "static" in field.metadata:
        if low_high := _whole_range(field, default):
            return read_whole(value, *low_high, path)
        if type(default) not in READER_BY_TYPE:
            raise wrong_kind_error(path, value, f"a value like {format_given(default)}")
        static = READER_BY_TYPE[type(default)](value, path)
        return Channels({**default, **static}) if isinstance(default, Channels) else static
    return _numbers(value, np.ndim(default), field.metadata["spec"].around(units), path)


def _whole_range(field: dataclasses.Field[Any], value: Scalar) -> tuple[int, int] | None:
    """Return the range of a static whole number, by its class's default; None for a value of another kind."""
    if type(value) is not int:
        return None
    default = value if field.default is dataclasses.MISSING else field.default
    return (1 if default >= 1 else -MAX_STATIC), MAX_STATIC


def _numbers(value: object, depth: int, spec: ParameterSpec, path: str) -> float | np.ndarray:
    """Return a number (`depth` 0), or the array of lists that are nested `depth` deep."""
    if not depth:
        return read_number(value, spec, path)
    if not isinstance(value, list):
        raise wrong_kind_error(path, value, f"a list of {'lists of ' * (depth - 1)}numbers in {spec.interval()}")
    rows = [_numbers(item, depth - 1, spec, f"{path}.{i}") for i, item in enumerate(value)]
    if len({np.shape(row) for row in rows}) > 1:
        raise ScenarioError(f"{path} = {format_given(value)} has rows of different lengths")
    return np.array(rows, float)


def _parts(
    family: str, value: object, default: tuple[PyTree, ...], path: str, units: Units | None
) -> tuple[PyTree, ...]:
    """Return a tuple of parts from a list, or from a table that changes default parts by number or adds the next."""
    if isinstance(value, list) and value:
        return tuple(build_part(family, item, None, f"{path}.{i}", units) for i, item in enumerate(value))
    if not isinstance(value, dict):
        raise wrong_kind_error(path, value, "a list of parts")
    parts = list(default)
    for key, item in value.items():
        if key not in map(str, range(len(parts) + 1)):
            raise unknown_name_error(f"{join_path(path, key)} is not there", key, map(str, range(len(parts))))
        place = int(key)
        old = parts[place] if place < len(parts) else None
        parts[place : place + 1] = [build_part(family, item, old, f"{path}.{key}", units)]
    return tuple(parts)


def in_kmh(spec: ParameterSpec) -> ParameterSpec:
    """Return the spec of a speed in km/h."""
    return dataclasses.replace(spec, unit="km/h", low=spec.low * KMH, high=spec.high * KMH)


def describe_part(family: str, part: Part) -> dict[str, JsonObject]:
    """Return by name "meaning", "default", "unit", "range", "low" and "high" of each field, as plain values.

    A default that is a part is given by its name. An infinite end of a range is None.
    """
    rows, meanings = {}, field_meanings(type(part))
    for field in dataclasses.fields(part):
        value, spec = getattr(part, field.name), field.metadata.get("spec")
        spec = spec and spec.around(DEFAULT_UNITS)
        row = {
            "default": dict(value) if type(value) is Channels else value,
            "unit": "",
            "range": "",
            "low": None,
            "high": None,
        }
        if "part" in field.metadata:
            inner = family_of(field.name, family)
            items = tuple(value.values()) if isinstance(value, dict) else value
            names = (
                [name_of(inner, item) for item in items] if isinstance(items, tuple | list) else name_of(inner, items)
            )
            row |= {"default": names, "range": f"any {inner}"}
        elif spec is not None:
            ends = {"low": spec.low, "high": spec.high}
            ends = {name: end if math.isfinite(end) else None for name, end in ends.items()}
            row |= {"default": np.asarray(value, float).tolist(), "unit": spec.unit, "range": spec.interval(), **ends}
        elif ends := _whole_range(field, getattr(part, field.name)):
            low, high = ends
            row |= {"range": f"[{low}, {high}]", "low": low, "high": high}
        rows[field.name] = {"meaning": meanings.get(field.name, ""), **row}
    return rows


def part_choices(part: Part, path: str = "") -> Iterator[tuple[str, JsonObject]]:
    """Yield path and choices of each part: its type, and its fields that are not parameters.

    The given part comes first, then every part inside it.

    Args:
        path: Path of the part; empty for a whole loop, which itself is not yielded.
    """
    if isinstance(part, tuple | list):
        for i, item in enumerate(part):
            yield from part_choices(item, f"{path}.{i}")
        return
    fields = dataclasses.fields(part)
    if path:
        fixed = {field.name: as_plain(getattr(part, field.name)) for field in fields if "static" in field.metadata}
        yield path, {"type": kebab_case(type(part).__name__), **fixed}
    for name, field, value in children(part, f"{path}." if path else ""):
        if field is None or "part" in field.metadata:
            yield from part_choices(value, name)
