"""Adjustable numbers of a loop, each with a name, a unit, a range, and the ends of its slider."""

import dataclasses
import math
from collections.abc import Mapping

import numpy as np

from diffabs.core.meanings import field_meanings
from diffabs.core.pytree import ParameterSpec, get, parameters
from diffabs.core.types import Part, Scalar
from diffabs.core.units import unit_at
from diffabs.host.separated import read_decimal
from diffabs.host.values import read_number_in_range, wrong_kind_error
from diffabs.output.explore.friction import FACTOR_PATH
from diffabs.scenario.parameter_paths import canonical_path
from diffabs.scenario.registry import KMH
from diffabs.scenario.scenario import Scenario

SLIDER_STEPS = 1000  # number of steps of a slider
LOGARITHMIC_RATIO = 10.0  # a slider is logarithmic if its ends differ by this factor or more
SLIDER_RATIO = 2.0  # a number without a range in the scenario can be dragged to its value times and over this factor
NARROW_RATIO = 1.25  # a slider with a range also covers the value times and over this factor
SPEED_FIELDS = ("speed", "reference_speed")  # fields of a vehicle that are shown in km/h
FILTERS = ("time_constant", "cutoff")  # parameters of filters, shown at once
LIMITS = ("low", "high", "reference_speed", "period")  # of controllers: rarely dragged
MOST_FIRST = 14  # number of sliders that are shown at once


@dataclasses.dataclass(frozen=True)
class Knob:
    """A single number of the loop.

    Attributes:
        path: Path of the parameter in the loop.
        place: Index in the parameter if it is a list, else None.
        name: Name in scenarios and messages.
        group: Heading on the page.
        label: Label on the page.
        meaning: What the parameter is, as its class says.
        spec: Displayed unit and range.
        scale: Displayed value per SI value.
        low: Lower end of the slider in the displayed unit, or None without a sensible one.
        high: Upper end of the slider in the displayed unit, or None without a sensible one.
    """

    path: str
    place: int | None
    name: str
    group: str
    label: str
    meaning: str
    spec: ParameterSpec
    scale: float
    low: float | None
    high: float | None

    @property
    def key(self) -> str:
        """Path of this number, with its index in a list."""
        return self.path if self.place is None else f"{self.path}.{self.place}"

    def read(self, value: object) -> float:
        """Return a typed or dragged `value`, in the displayed unit, in SI."""
        if isinstance(value, str):
            try:
                value = read_decimal(value)
            except ValueError:
                raise wrong_kind_error(self.name, value.strip(), f"a number in {self.spec.interval()}") from None
        return read_number_in_range(value, self.spec, self.name) / self.scale

    def pick(self, value: Scalar) -> float:
        """Return this number [SI] from the `value` of its parameter."""
        return float(np.asarray(value, float)[() if self.place is None else self.place])

    def text(self, value: float) -> str:
        """Return a `value` [SI] as text in the displayed unit."""
        return f"{value * self.scale:.6g}"

    def words(self, value: float) -> str:
        """Return a `value` [SI] as text in the displayed unit, followed by the unit."""
        return f"{self.text(value)} {unit_words(self.spec.unit)}".rstrip()

    def place_of(self, value: float) -> float:
        """Return the slider position, 0 to `SLIDER_STEPS`, of a `value` [SI].

        Values outside of the slider are put at its nearer end. A number without a slider has position 0.
        """
        if self.low is None or self.high is None or not math.isfinite(value):
            return 0.0
        low, high, at = self._line(self.low), self._line(self.high), value * self.scale
        if self._logarithmic and at * self.low <= 0:
            return 0.0 if self.low > 0 else float(SLIDER_STEPS)
        return float(np.clip(SLIDER_STEPS * (self._line(at) - low) / (high - low), 0, SLIDER_STEPS))

    def value_at(self, place: float) -> float:
        """Return the value [SI] at a slider position `place`, 0 to `SLIDER_STEPS`.

        Between the ends of the slider, the displayed value is rounded to five digits. The number must have a slider:
        `low` and `high` are not None.
        """
        assert self.low is not None
        assert self.high is not None
        part = place / SLIDER_STEPS
        # The ends are exact: exp(log(x)) would round them out of the range.
        if part in (0.0, 1.0):
            return (self.high if part else self.low) / self.scale
        on = self._line(self.low) * (1 - part) + self._line(self.high) * part
        sign = math.copysign(1.0, self.low)
        shown = sign * math.exp(sign * on) if self._logarithmic else on
        return float(f"{shown:.5g}") / self.scale  # rounded, so that the displayed value is the simulated one

    @property
    def _logarithmic(self) -> bool:
        low, high = self.low, self.high
        if low is None or high is None or low * high <= 0:
            return False
        return max(abs(low), abs(high)) >= LOGARITHMIC_RATIO * min(abs(low), abs(high))

    def _line(self, shown: float) -> float:
        """Return the coordinate of a displayed value in which the slider is linear."""
        return math.copysign(1.0, shown) * math.log(abs(shown)) if self._logarithmic else shown


def knobs(scenario: Scenario) -> dict[str, Knob]:
    """Return every number of a scenario's loop by its key."""
    by_key: dict[str, Knob] = {}
    for path, spec, value in parameters(scenario.loop):
        tail = path.rpartition(".")[2]
        scale = KMH if spec.unit == "m/s" and tail in SPEED_FIELDS and is_vehicle(scenario.loop.plant) else 1.0
        name = canonical_path(path) + ("_kmh" if scale != 1.0 else "")
        group, _, label = canonical_path(path).partition(".")
        label = label.removeprefix(f"{group}.").replace("_", " ")
        label = "friction factor" if path == FACTOR_PATH else label
        meaning = field_meanings(type(get(scenario.loop, path.rpartition(".")[0]))).get(tail, "")
        values = np.asarray(value, float)
        if values.ndim > 1:
            continue  # a matrix has no sliders
        for place in np.ndindex(values.shape):
            at = place[0] if place else None
            suffix = "" if at is None else f".{at}"
            unit = "km/h" if scale != 1.0 else unit_at(spec.unit, at or 0, values.size)
            shown_spec = dataclasses.replace(spec, unit=unit, low=spec.low * scale, high=spec.high * scale)
            low, high = _slider_ends(
                shown_spec, float(values[place]) * scale, _range_in_scenario(scenario, path, at, scale)
            )
            words = label if at is None else f"{label} {at + 1}"
            knob = Knob(path, at, name + suffix, group, words, meaning, shown_spec, scale, low, high)
            by_key[knob.key] = knob
    return by_key


def is_vehicle(plant: Part) -> bool:
    """Return whether a plant shows the speed of a wheel; such a plant's speeds are displayed in km/h."""
    return any(name.endswith("wheel_speed") for name in plant.shows.units)


def unit_words(unit: str) -> str:
    """Return a unit as the page shows it, or "" for plain numbers."""
    return "" if unit == "1" else unit.replace("^2", "²")


def first_knobs(scenario: Scenario, by_key: Mapping[str, Knob]) -> list[str]:
    """Return the keys of the numbers that the page shows at once, at most `MOST_FIRST`, sorted by group.

    In order of priority they are mass, speed, friction, tuned parameters, filters, gains, parameters that vary in the
    scenario, and numbers of the start. Gains are left out if the scenario tunes a parameter of the controller. Numbers
    without a slider are left out, too.
    """
    tune, over = scenario.tune, [*scenario.design.over, *scenario.tune.over, *scenario.sweep.over]
    paths = [*filter(None, (mass_path(scenario),)), "initial.speed", FACTOR_PATH, *tune.free]
    paths += [knob.path for knob in by_key.values() if knob.path.rpartition(".")[2] in FILTERS]
    if not any(path.startswith("controller.") for path in tune.free):
        tails = {knob.path: knob.path.rpartition(".")[2] for knob in by_key.values()}
        paths += [path for path, tail in tails.items() if path.startswith("controller.") and tail not in LIMITS]
    paths += [*over, *(knob.path for knob in by_key.values() if knob.group == "initial")]
    keys = [knob.key for path in dict.fromkeys(paths) for knob in by_key.values() if knob.path == path]
    usable = [key for key in keys if by_key[key].low is not None]
    groups = list(dict.fromkeys(by_key[key].group for key in usable))
    return sorted(usable[:MOST_FIRST], key=lambda key: groups.index(by_key[key].group))


def mass_path(scenario: Scenario) -> str | None:
    """Return the path of the mass that differs between vehicles or riders, or None.

    A mass that the scenario varies has priority over the plant's first one. If the loop has no mass, the same rule
    selects a moment of inertia.
    """
    over = {*scenario.design.over, *scenario.tune.over, *scenario.sweep.over}
    for unit in ("kg", "kg m^2"):
        paths = [path for path, spec, value in parameters(scenario.loop) if spec.unit == unit and not np.ndim(value)]
        if paths:
            return next((path for path in paths if path in over), paths[0])
    return None


def _range_in_scenario(scenario: Scenario, path: str, place: int | None, scale: float) -> tuple[float, float] | None:
    """Return the range in which the scenario tunes or varies a parameter, in the displayed unit, or None."""
    tuned, varied = scenario.tune.free.get(path), scenario.design.over.get(path)
    values = scenario.tune.over.get(path)
    interval = tuned or varied or ((min(values), max(values)) if values else None)
    if interval is None:
        return None
    ends = [np.asarray(end, float) for end in interval]
    low, high = (float(end if place is None or not end.ndim else end[place]) for end in ends)
    return low * scale, high * scale


def _slider_ends(
    spec: ParameterSpec, value: float, interval: tuple[float, float] | None
) -> tuple[float | None, float | None]:
    """Return the ends of a slider that contains the value and stays in the range, or (None, None)."""
    if not math.isfinite(value):
        return None, None
    around = sorted((value / SLIDER_RATIO, value * SLIDER_RATIO)) if value else [-1.0, 1.0]
    if not value and math.isfinite(spec.low) and math.isfinite(spec.high):
        around = [spec.low, spec.high]
    ends = [*around] if interval is None else [*interval, value * NARROW_RATIO, value / NARROW_RATIO]
    low, high = max(min(ends), spec.low), min(max(ends), spec.high)
    span = high - low
    # An open end is no valid value, so the slider stops short of it.
    low = low + 1e-3 * span if spec.open_low and low == spec.low else low
    high = high - 1e-3 * span if spec.open_high and high == spec.high else high
    return (low, high) if low < high else (None, None)
