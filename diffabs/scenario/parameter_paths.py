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

from diffabs.core.pytree import Spec
from diffabs.scenario.registry import DEEPEST, KMH, ScenarioError, shown, unknown

TABLES = (("design", "over"), ("tune", "free"), ("tune", "over"), ("sweep", "over"))


@dataclasses.dataclass(frozen=True)
class Entry:
    """What was given for a parameter: its path in the loop, the place for messages, and the parameter's unit and range,
    both in the unit in which the value was given, `scale` of which make one in SI."""

    path: str
    where: str
    given: Any
    spec: Spec
    scale: float


def lifted(table: dict[str, Any]) -> None:
    """Every such table of a scenario by dotted path, however it was written. Raises ScenarioError."""
    for section, name in TABLES:
        inside = table.get(section)
        if isinstance(inside, dict) and isinstance(inside.get(name), dict):
            inside[name] = flat(inside[name], f"{section}.{name}")


def forget(table: dict[str, Any], replaced: str) -> None:
    """Another part has other parameters: what was said about those of the one it replaces goes with it."""
    for section, name in TABLES:
        inside = table.get(section)
        if isinstance(inside, dict) and isinstance(inside.get(name), dict):
            inside[name] = {k: v for k, v in inside[name].items() if not k.startswith(f"{canonical(replaced)}.")}


def joined_keys(keys: list[str]) -> list[str]:
    """The keys of an override, with a path in one of these tables as one key."""
    if tuple(keys[:2]) in TABLES and len(keys) > 2:
        return [*keys[:2], canonical(".".join(keys[2:]))]
    return keys


def flat(table: Mapping[str, Any], section: str) -> dict[str, Any]:
    """The values by dotted path. Raises ScenarioError for a path that comes twice."""
    found: dict[str, Any] = {}
    pending = list(table.items())
    while pending:
        path, value = pending.pop(0)
        if path.count(".") > DEEPEST:
            raise ScenarioError(f"{section}: {shown(path)} is nested more than {DEEPEST} deep")
        if isinstance(value, dict) and not {"type", "choices"} & value.keys():
            pending[:0] = [(f"{path}.{key}", item) for key, item in value.items()]
            continue
        path = canonical(path)
        if path in found:
            raise ScenarioError(f"{_where(section, path)} is given twice")
        found[path] = value
    return found


def canonical(path: str) -> str:
    """A path as messages have it: without the quotes of a key, the road in a section of its own."""
    path = path.replace('"', "").replace("'", "")
    return path.removeprefix("plant.") if path.startswith("plant.road.") else path


def entries(table: Mapping[str, Any], section: str, specs: Mapping[str, Spec], otherwise: str) -> Iterator[Entry]:
    """What was given, by parameter. `specs`: of what may be there, by path of the loop; `otherwise`: what to say of a
    name that is not. Raises ScenarioError."""
    known = {canonical(path): (path, spec, 1.0) for path, spec in specs.items()}
    known |= {f"{key}_kmh": (path, _kmh(spec), KMH) for key, (path, spec, _) in known.items() if spec.unit == "m/s"}
    seen = set()
    for key, given in flat(table, section).items():
        if key not in known:
            raise unknown(f"{_where(section, key)} is {otherwise}", key, known)
        path, spec, scale = known[key]
        if path in seen:
            raise ScenarioError(f"{_where(section, canonical(path))} is given twice, in m/s and in km/h")
        seen.add(path)
        yield Entry(path, _where(section, key), given, spec, scale)


def _kmh(spec: Spec) -> Spec:
    return dataclasses.replace(spec, unit="km/h", low=spec.low * KMH, high=spec.high * KMH)


def _where(section: str, path: str) -> str:
    path = path if re.fullmatch(r"[a-zA-Z0-9_.-]{1,60}", path) else shown(path)
    return f"{section}{' ' if section.startswith('-') else '.'}{path}"
