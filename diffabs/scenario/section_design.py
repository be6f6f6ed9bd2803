"""The section [design] of a scenario: what a gain is asked for, and the ranges over which it is robust.

    Q, R       weights of the integral of x'Qx + u'Ru: a diagonal or a full matrix
    decay      1/s
    damping    of the poles, in [0, 1)
    [design.over]
    "plant.mass" = [5.3, 6.2]              # a path of the loop, as elsewhere in scenarios; low and high, in SI
    "initial.speed_kmh" = [5.0, 50.0]      # or in km/h

A path may be one key with dots or nested tables. Only what the linear model of a loop depends on can have a range."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from diffabs.actuators import Lag, RateLimit
from diffabs.controllers import Sampled
from diffabs.core.blocks import Series
from diffabs.core.loop import Loop
from diffabs.core.pytree import Spec, parameters
from diffabs.linear.slip_model import SlipModel
from diffabs.scenario.parameter_paths import Entry, entries
from diffabs.scenario.registry import ScenarioError, joined, number, shown, unknown, wrong

FIELDS = ("Q", "R", "decay", "damping", "over")
ENTRY = Spec("1")
DECAY = Spec("1/s", low=0.0)
DAMPING = Spec("1", low=0.0, high=1.0, open_high=True)

Range = tuple[float, float]


@dataclasses.dataclass(frozen=True)
class Task:
    """What a gain is asked for: weights (tuples of their rows, or of a diagonal) or None, decay [1/s], damping, and the
    ranges given, in SI, by path of the loop."""

    Q: Any = None
    R: Any = None
    decay: float = 0.0
    damping: float = 0.0
    over: Mapping[str, Range] = dataclasses.field(default_factory=dict)

    def box(self, loop: Loop) -> dict[str, Range]:
        """The ranges by path of the loop's linear model, that of the speed between the loop's start and its stop if
        none was given."""
        start, end = getattr(loop.initial, "speed", None), getattr(loop.stop, "speed", None)
        over, known = dict(self.over), _known(loop)
        if start is not None and end is not None:
            over.setdefault("initial.speed", (float(end), float(start)))
        return {known[path].model: ends for path, ends in over.items()}

    def table(self) -> dict[str, Any]:
        """As values of TOML."""
        weights = {name: _listed(getattr(self, name)) for name in ("Q", "R") if getattr(self, name) is not None}
        over = {path: list(ends) for path, ends in self.over.items()}
        return {**weights, "decay": self.decay, "damping": self.damping, "over": over}


@dataclasses.dataclass(frozen=True)
class _Parameter:
    """What can have a range: its path in the linear model, its values, and whether it is more than one number."""

    model: str
    spec: Spec
    shape: tuple[int, ...] = ()


def read(table: Any, loop: Loop) -> Task:
    """The task of a section. Raises ScenarioError, one line, for whatever is wrong with it."""
    if not isinstance(table, dict):
        raise wrong("design", table, f"a table of {', '.join(FIELDS)}")
    for key in table:
        if key not in FIELDS:
            raise unknown(f"{joined('design', key)} is not a field of design", key, FIELDS)
    weights = {name: _weight(table[name], f"design.{name}") for name in ("Q", "R") if name in table}
    if len(weights) == 1:
        (there,), (missing,) = weights, {"Q", "R"} - set(weights)
        raise ScenarioError(f"design.{missing} is missing: with design.{there}, a cost needs both")
    numbers = {}
    for name, spec in (("decay", DECAY), ("damping", DAMPING)):
        numbers[name] = number(table.get(name, 0.0), spec, f"design.{name}")
        if not spec.holds(numbers[name]):
            raise ScenarioError(f"design.{name} = {shown(numbers[name])} is outside {spec.interval()}")
    return Task(**weights, **numbers, over=_over(table.get("over", {}), loop))


def _weight(given: Any, path: str) -> Any:
    """A weight as a number or nested tuples, which compare; its order is for the model to say."""
    from diffabs.linear.weights import weight

    if not isinstance(given, list):
        if isinstance(given, bool) or not isinstance(given, int | float):
            raise wrong(path, given, "a number, a diagonal or a matrix")
        value = number(given, ENTRY, path)
    elif any(isinstance(row, list) for row in given):
        if not all(isinstance(row, list) and len(row) == len(given) for row in given):
            raise ScenarioError(f"{path} = {shown(given)} is not square: {len(given)} rows need as many numbers each")
        value = tuple(
            tuple(number(x, ENTRY, f"{path}.{i}.{j}") for j, x in enumerate(row)) for i, row in enumerate(given)
        )
    else:
        value = tuple(number(item, ENTRY, f"{path}.{i}") for i, item in enumerate(given))
    if given == []:
        raise ScenarioError(f"{path} = [] is empty")
    try:
        weight(path, value, len(np.atleast_1d(value)), definite=path == "design.R")
    except ValueError as error:
        raise ScenarioError(str(error)) from None
    return value


def _over(table: Any, loop: Loop) -> dict[str, Range]:
    if not isinstance(table, dict):
        raise wrong("design.over", table, "a table of ranges")
    known = _known(loop)
    specs = {path: parameter.spec for path, parameter in known.items()}
    given = entries(table, "design.over", specs, "nothing that the linear model of this loop depends on")
    return {entry.path: _range(entry, known[entry.path].shape) for entry in given}


def _range(entry: Entry, shape: tuple[int, ...]) -> Range:
    """Low and high end in SI, checked in the unit in which they were given."""
    path, given, spec = entry.where, entry.given, entry.spec
    if shape:
        raise ScenarioError(f"{path} is a list of {shape[0]} numbers; only single numbers can have a range")
    if not isinstance(given, list):
        raise wrong(path, given, f"a range [low, high] in {spec.interval()}")
    if len(given) != 2:
        raise ScenarioError(f"{path} = {shown(given)} is no range [low, high] in {spec.interval()}")
    low, high = (number(item, spec, f"{path}.{i}") for i, item in enumerate(given))
    if not spec.holds(np.array([low, high])):
        raise ScenarioError(f"{path} = {shown([low, high])} is outside {spec.interval()}")
    if low > high:
        raise ScenarioError(f"{path} = {shown([low, high])} is inverted: a range [low, high] in {spec.interval()}")
    return low / entry.scale, high / entry.scale


def _known(loop: Loop) -> dict[str, _Parameter]:
    """What can have a range, by path of the loop. The model's names for the rest of the loop are `reduction`'s."""
    if not hasattr(loop.plant, "frozen"):
        return {path: _Parameter(path, spec, np.shape(x)) for path, spec, x in parameters(loop.plant, "plant.")}
    model = {field.name: field.metadata["spec"] for field in dataclasses.fields(SlipModel) if "spec" in field.metadata}
    found = {"initial.speed": _Parameter("speed", model["speed"]), "reference.slip": _Parameter("slip", model["slip"])}
    for path, spec, value in parameters(loop.plant, "plant."):
        found[path] = _Parameter(path, spec, np.shape(value))
    actuators = {"actuator.": loop.actuator}
    if isinstance(loop.actuator, Series):
        actuators = {f"actuator.blocks.{i}.": block for i, block in enumerate(loop.actuator.blocks)}
    for prefix, block in actuators.items():
        if isinstance(block, Lag | RateLimit):
            found |= _one(block, prefix, "time_constant", "actuator.time_constant")
    if isinstance(loop.controller, Sampled):
        found |= _one(loop.controller, "controller.", "delay", "sampling.delay")
    return found


def _one(part: Any, prefix: str, name: str, model: str) -> dict[str, _Parameter]:
    return {path: _Parameter(model, spec) for path, spec, _ in parameters(part, prefix) if path == prefix + name}


def _listed(value: Any) -> Any:
    return [_listed(item) for item in value] if isinstance(value, tuple) else value
