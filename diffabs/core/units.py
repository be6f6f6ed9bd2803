"""Units relative to the loop of a part.

    "control/signal"     a gain: N m for a brake, whose slip is a number; V/rad for a servo
    "control^2 s"        N^2 m^2 s, or V^2 s

`control` is the unit of the plant's control, `signal` the unit of the plant's first output, and so of the target.
"""

import functools
import re
from collections.abc import Iterable
from typing import NamedTuple

from diffabs.core.types import Part

RELATIVE_UNIT = re.compile(r"\b(control|signal)\b")
UNIT_FACTOR = re.compile(r"(/?)\s*([^\s/^]+)(?:\^(\d+))?")


class Units(NamedTuple):
    """The units for the words `control` and `signal` in a loop; also of the plant's outputs and controls by name.

    A word is empty, and stays in a unit, if the plant has several inputs of different units.
    """

    control: str
    signal: str
    outputs: tuple[tuple[str, str], ...] = ()
    controls: tuple[tuple[str, str], ...] = ()

    def of_channel(self, control: str, output: str) -> "Units":
        """Return the units inside a channel; an empty name keeps the word's unit."""
        return self._replace(
            control=dict(self.controls).get(control, self.control), signal=dict(self.outputs).get(output, self.signal)
        )


def control_units(plant: Part) -> dict[str, str]:
    """Return the unit of each control by name; the name of a single one is "control"."""
    controls = getattr(plant, "controls", None)
    return {"control": plant.control_unit} if controls is None else dict(controls.units)


def units_of(plant: Part) -> Units | None:
    """Return the units of a plant's controls and of the outputs with a target, or None if the plant declares none."""
    shown = getattr(getattr(plant, "shows", None), "units", None)
    if not shown:
        return None
    tracked = getattr(plant.shows, "tracked", None) or (next(iter(shown)),)
    controls = control_units(plant)
    control, signal = _common(controls.values()), _common(shown[name] for name in tracked)
    return Units(control, signal, tuple(shown.items()), tuple(controls.items()))


def _common(units: Iterable[str]) -> str:
    """Return the unit, if all are the same, or else an empty text."""
    first, *others = {*units}
    return "" if others else first


def channel_unit(unit: str, control: str, output: str) -> str:
    """Return a relative unit whose words name a channel, "signal[level_1] s"; an empty name keeps the word."""
    for word, name in (("control", control), ("signal", output)):
        unit = re.sub(rf"\b{word}\b(?!\[)", f"{word}[{name}]" if name else word, unit)
    return unit


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
    meaning |= {f"control[{name}]": text for name, text in units.controls}
    meaning |= {f"signal[{name}]": text for name, text in units.outputs}
    return ", ".join(_multiply_units(element, meaning) for element in unit.split(", "))


def unit_at(unit: str, place: int, count: int) -> str:
    """Return the unit of the entry `place` of a list; each of k units applies to count/k entries, in order."""
    units = unit.split(", ")
    return units[place * len(units) // count]


def insert_unit(text: str, units: Units | None) -> str:
    """Return a sentence with the units for ` {control}` and ` {signal}`; a unit that is unknown or 1 is left out."""
    for name in ("control", "signal"):
        unit = getattr(units, name, "1")
        text = text.replace(f" {{{name}}}", "" if unit in ("", "1") else f" {unit}")
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
