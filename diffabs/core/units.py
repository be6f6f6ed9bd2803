"""Units relative to the loop of a part.

    "control/signal"     a gain: N m for a brake, whose slip is a number; V/rad for a servo
    "control^2 s"        N^2 m^2 s, or V^2 s

`control` is the unit of the plant's control, `signal` the unit of the plant's first output, and so of the target.
"""

import functools
import re
from typing import NamedTuple

from diffabs.core.types import Part

RELATIVE_UNIT = re.compile(r"\b(control|signal)\b")
UNIT_FACTOR = re.compile(r"(/?)\s*([^\s/^]+)(?:\^(\d+))?")


class Units(NamedTuple):
    """The units for the words `control` and `signal` in a loop, and those of the plant's outputs as (name, unit)."""

    control: str
    signal: str
    outputs: tuple[tuple[str, str], ...] = ()


def units_of(plant: Part) -> Units | None:
    """Return the units of a plant's control and first output, or None if the plant declares none."""
    shown = getattr(getattr(plant, "shows", None), "units", None)
    return Units(plant.control_unit, next(iter(shown.values())), tuple(shown.items())) if shown else None


def units_inside(part: object, name: str, units: Units | None) -> Units | None:
    """Return the units for the part in the field `name` of another part.

    They are those of the other part, unless it has a method `units_inside(name, units)`.
    """
    hook = getattr(part, "units_inside", None)
    return hook(name, units) if hook and units else units


@functools.lru_cache(maxsize=1024)
def resolve_unit(unit: str, units: Units | None) -> str:
    """Return a unit with `control` and `signal` replaced: "V s/rad". Commas separate the units of a list's elements."""
    if units is None or not RELATIVE_UNIT.search(unit):
        return unit
    meaning = {"control": units.control, "signal": units.signal}
    return ", ".join(_multiply_units(element, meaning) for element in unit.split(", "))


def unit_at(unit: str, place: int, count: int) -> str:
    """Return the unit of the entry `place` of a list; each of k units applies to count/k entries, in order."""
    units = unit.split(", ")
    return units[place * len(units) // count]


def insert_unit(text: str, units: Units | None) -> str:
    """Return a sentence with the units for ` {control}` and ` {signal}`; a unit that is unknown or 1 is left out."""
    for name in ("control", "signal"):
        unit = getattr(units, name, "1")
        text = text.replace(f" {{{name}}}", "" if unit == "1" else f" {unit}")
    return text


def _multiply_units(unit: str, meaning: dict[str, str]) -> str:
    """Return a product of powers in the order of their first occurrence, with a slash before each negative power."""
    powers: dict[str, int] = {}
    for slash, name, power in UNIT_FACTOR.findall(unit):
        exponent = int(power or 1) * (-1 if slash else 1)
        for inner_slash, inner, inner_power in UNIT_FACTOR.findall(meaning.get(name) or name):
            powers[inner] = powers.get(inner, 0) + exponent * int(inner_power or 1) * (-1 if inner_slash else 1)
    above = [_power(name, n) for name, n in powers.items() if n > 0 and name != "1"]
    below = [f"/{_power(name, -n)}" for name, n in powers.items() if n < 0 and name != "1"]
    return (" ".join(above) or "1") + "".join(below)


def _power(name: str, exponent: int) -> str:
    return name if exponent == 1 else f"{name}^{exponent}"
