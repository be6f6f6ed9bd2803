"""Units that a part cannot know alone, in terms of the loop that it is in.

    "control/signal"     a gain: N m around a brake, whose slip is a number; V/rad around a servo
    "control^2 s"        N^2 m^2 s, or V^2 s

`control` is the unit of the plant's control, `signal` that of the first signal it shows, and so of the target.
"""

import functools
import re
from typing import Any, NamedTuple

RELATIVE_UNIT = re.compile(r"\b(control|signal)\b")
UNIT_FACTOR = re.compile(r"(/?)\s*([^\s/^]+)(?:\^(\d+))?")


class Units(NamedTuple):
    """What the words `control` and `signal` stand for in a loop."""

    control: str
    signal: str


def units_of(plant: Any) -> Units | None:
    """Return the units of a plant's control and first signal; None where it does not say them."""
    shown = getattr(getattr(plant, "shows", None), "units", None)
    return Units(plant.control_unit, next(iter(shown.values()))) if shown else None


@functools.lru_cache(maxsize=1024)
def resolve_unit(unit: str, units: Units | None) -> str:
    """Return a unit with `control` and `signal` worked out: "V s/rad". Without a loop (None) it stays as it is. Units
    of a list's elements are separated by commas."""
    if units is None or not RELATIVE_UNIT.search(unit):
        return unit
    return ", ".join(_multiply_units(one, units._asdict()) for one in unit.split(", "))


def unit_at(unit: str, place: int, count: int) -> str:
    """Return the unit of entry `place` of `count`: of a list of k units each holds for count/k entries, in order."""
    units = unit.split(", ")
    return units[place * len(units) // count]


def insert_unit(text: str, units: Units | None) -> str:
    """Return a sentence with the control's unit in the place of ` {control}`, or nothing where that is not known."""
    return text.replace(" {control}", f" {units.control}" if units and units.control != "1" else "")


def _multiply_units(unit: str, meaning: dict[str, str]) -> str:
    """A product of powers, in the order in which they first occur; those of negative power behind a slash each."""
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
