"""Which parts there are, by family and name, and how the values of a scenario become one.

A part is found by its shape among the names that its family's package exports: whoever has the methods of the family's
contract is listed, under the kebab-case of its name (`QuarterCar` is `quarter-car`, `SNOW` is `snow`). Writing a part
and exporting it is thus all that it takes to use it in a scenario."""

import dataclasses
import inspect
import math
import re
from collections.abc import Iterator, Mapping
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np

from diffabs import actuators, controllers, objectives, plants, references, roads, sensors, stops
from diffabs.core import blocks, protocols
from diffabs.core.loop import Loop
from diffabs.core.pytree import Spec
from diffabs.core.values import ScenarioError, dotted, inside, kebab, number, shown, unknown, whole, wrong
from diffabs.scenario.defaults import around, braking

KMH = 3.6  # km/h in a m/s
DEEPEST = 16  # parts inside parts; more is a mistake, and Python's stack is finite
LARGEST = 10_000_000  # of a whole number that shapes arrays


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


@cache
def types(family: str) -> Mapping[str, Any]:
    """The parts of a family by name, with their defaults: one of each class, and the named constants."""
    modules, contract = FAMILIES[family]
    found = {}
    for exported, item in ((n, x) for module in modules for n, x in vars(module).items()):
        cls = item if isinstance(item, type) else type(item)
        if dataclasses.is_dataclass(cls) and (contract <= _methods(cls) if contract else not _methods(cls)):
            found[kebab(exported)] = item() if isinstance(item, type) else item
    return found


def name_of(family: str, part: Any) -> str:
    """The name of a named constant, else that of the part's class."""
    named = (name for name, item in types(family).items() if item is part)
    return next(named, kebab(type(part).__name__))


def family_of(field: str, enclosing: str) -> str:
    """The family of the parts in a field: `road` and `roads` hold roads, `blocks` the same as the part they are in."""
    return next((name for name in (field, field.removesuffix("s")) if name in FAMILIES), enclosing)


def summary(part: Any) -> str:
    """The first paragraph of a part's docstring, on one line."""
    return " ".join((inspect.getdoc(type(part)) or "").split("\n\n")[0].split())


def unit_of(objective: Any, plant: Any = None) -> str:
    """The unit of what an objective measures: the first bracket of its docstring, as in `[N m]`; else empty. With a
    brake whose control is no torque, that of its control in the place of N m."""
    bracket = re.search(r"\[(.+?)\]", inspect.getdoc(type(objective)) or "")
    unit = bracket.group(1) if bracket else ""
    control = "N m" if plant is None or plant.shows is not protocols.BrakeOutput else plant.control_unit
    if control == "N m":
        return unit
    unit = unit.replace("N^2 m^2", "1" if control == "1" else f"{control}^2").replace("N m", control)
    return re.sub(r"\b1 (?=\S)", "", unit)


def build(family: str, given: Any, default: Any, path: str) -> Any:
    """The part that a table, or the bare name of a type, describes.

    A table without `type` describes `default` with some fields changed; default None means that a type is needed.
    Raises ScenarioError; ranges are left to `diffabs.check`.
    """
    there = types(family)
    table = {"type": given} if isinstance(given, str) else given
    if not isinstance(table, dict):
        raise wrong(path, given, f"a table, or the name of a type ({', '.join(there)}),")
    name = table.get("type")
    if name is None and default is None:
        raise unknown(f"{path}.type is missing", path.rpartition(".")[2].replace("_", "-"), there)
    if name is not None and not isinstance(name, str):
        raise wrong(f"{path}.type", name, f"one of {', '.join(there)}")
    if name is not None and name not in there:
        raise unknown(f"{path}.type = {shown(name)} is unknown", name, there)
    template = default if name is None else there[name]
    return filled(template, {k: v for k, v in table.items() if k != "type"}, family, path)


def filled(template: Any, table: dict[str, Any], family: str, path: str) -> Any:
    """A copy of a part with the fields of a table. Raises ScenarioError for an unknown field or a wrong type."""
    if path.count(".") > DEEPEST:
        raise ScenarioError(f"{shown(path)}: parts are nested more than {DEEPEST} deep")
    fields = {field.name: field for field in dataclasses.fields(template)}
    edge = {f"{n}_kmh": f for n, f in fields.items() if "spec" in f.metadata and f.metadata["spec"].unit == "m/s"}
    values = {}
    for key, given in table.items():
        where = joined(path, key)
        if key not in fields and key not in edge:
            whose = f"a field of {name_of(family, template)}" if path else "a section"
            raise unknown(f"{where} is not {whose}", key, fields if path else (*fields, *OTHERS))
        field = fields[key] if key in fields else edge[key]
        if field.name in values:
            raise ScenarioError(f"{joined(path, field.name)} is given twice, in m/s and in km/h")
        if key in edge:
            values[field.name] = _metres_per_second(given, field.metadata["spec"], where)
        else:
            values[field.name] = _value(given, field, getattr(template, key), family, where)
    return dataclasses.replace(template, **values) if values else template


def loop_of(sections: dict[str, Any]) -> Loop:
    """The loop of the sections of a scenario; what is left out is usual for what the plant shows. Raises
    ScenarioError."""
    usual = braking()
    if "plant" in sections:
        plant = filled(usual, {"plant": sections["plant"]}, "", "").plant
        usual = around(plant)
    return filled(usual, sections, "", "")


# What a scenario has besides the fields of a loop.
OTHERS = ("road", "solver", "objective", "design", "tune", "sweep", "title", "description")


def joined(path: str, key: str) -> str:
    """A dotted path; the road of the plant has a section of its own."""
    return "road" if (path, key) == ("plant", "road") else dotted(path, key)


def _value(given: Any, field: dataclasses.Field[Any], default: Any, family: str, path: str) -> Any:
    if "part" in field.metadata:
        inner = family_of(field.name, family)
        if isinstance(default, tuple):
            return _parts(inner, given, default, path)
        return build(inner, given, default, path)
    if "static" in field.metadata:
        if isinstance(default, int) and not isinstance(default, bool):
            return whole(given, 1, LARGEST, path)
        if type(given) is not type(default):
            raise wrong(path, given, f"a value like {shown(default)}")
        return given
    spec: Spec = field.metadata["spec"]
    if np.ndim(default) == 0:
        return number(given, spec, path)
    if not isinstance(given, list):
        raise wrong(path, given, f"a list of numbers in {spec.interval()}")
    return np.array([number(item, spec, f"{path}.{i}") for i, item in enumerate(given)], float)


def _parts(family: str, given: Any, default: tuple[Any, ...], path: str) -> tuple[Any, ...]:
    """A list of parts; or a table by number, which changes some of the default ones."""
    if isinstance(given, list) and given:
        return tuple(build(family, item, None, f"{path}.{i}") for i, item in enumerate(given))
    if not isinstance(given, dict):
        raise wrong(path, given, "a list of parts")
    parts = list(default)
    for key, item in given.items():
        if key not in map(str, range(len(parts))):
            raise unknown(f"{joined(path, key)} is not there", key, map(str, range(len(parts))))
        parts[int(key)] = build(family, item, parts[int(key)], f"{path}.{key}")
    return tuple(parts)


def _metres_per_second(given: Any, spec: Spec, path: str) -> float:
    """Checked here, in the unit in which it was given."""
    there = dataclasses.replace(spec, unit="km/h", low=spec.low * KMH, high=spec.high * KMH)
    return inside(given, there, path) / KMH


def described(family: str, part: Any) -> dict[str, dict[str, Any]]:
    """A part's fields: default, unit and range of each, as plain values. A default that is a part is its name."""
    rows = {}
    for field in dataclasses.fields(part):
        value, spec = getattr(part, field.name), field.metadata.get("spec")
        if "part" in field.metadata:
            inner = family_of(field.name, family)
            names = [name_of(inner, item) for item in value] if isinstance(value, tuple) else name_of(inner, value)
            rows[field.name] = {"default": names, "unit": "", "range": f"any {inner}", "low": None, "high": None}
        elif spec is None:
            rows[field.name] = {"default": value, "unit": "", "range": f"[1, {LARGEST}]", "low": 1, "high": LARGEST}
        else:
            ends = {"low": spec.low, "high": spec.high}
            ends = {name: end if math.isfinite(end) else None for name, end in ends.items()}
            default = np.asarray(value, float).tolist()
            rows[field.name] = {"default": default, "unit": spec.unit, "range": spec.interval(), **ends}
    return rows


def choices(part: Any, path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Every part below this one by its path: its type, and its fields that are no parameters."""
    if isinstance(part, tuple):
        for i, item in enumerate(part):
            yield from choices(item, f"{path}.{i}")
        return
    fields = dataclasses.fields(part)
    if path:
        fixed = {field.name: getattr(part, field.name) for field in fields if "static" in field.metadata}
        yield path, {"type": kebab(type(part).__name__), **fixed}
    for field in fields:
        if "part" in field.metadata:
            yield from choices(getattr(part, field.name), f"{path}.{field.name}" if path else field.name)
