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
from diffabs.core.pytree import ParameterSpec, parameters
from diffabs.core.values import (
    ScenarioError,
    format_given,
    plain_fields,
    range_reader,
    read_as_given,
    read_number,
    table_field,
    table_reader,
    wrong_kind_error,
)
from diffabs.core.values import read_table as read_table
from diffabs.linear.slip_model import SlipModel
from diffabs.scenario.parameter_paths import read_entries

ENTRY = ParameterSpec("1")

Range = tuple[float, float]


def _weight(given: Any, path: str) -> Any:
    """A weight as a number or nested tuples, which compare; its order is for the model to say."""
    from diffabs.linear.weights import as_weight_matrix

    if not isinstance(given, list | int | float) or isinstance(given, bool):
        raise wrong_kind_error(path, given, "a number, a diagonal or a matrix")
    if given == []:
        raise ScenarioError(f"{path} = [] is empty")
    rows = given if isinstance(given, list) and any(isinstance(row, list) for row in given) else ()
    if not all(isinstance(row, list) and len(row) == len(rows) for row in rows):
        raise ScenarioError(f"{path} = {format_given(given)} is not square: {len(rows)} rows need as many numbers each")
    value = _numbers(given, path)
    try:
        as_weight_matrix(path, value, len(np.atleast_1d(value)), definite=path == "design.R")
    except ValueError as error:
        raise ScenarioError(str(error)) from None
    return value


def _numbers(given: Any, path: str) -> Any:
    if not isinstance(given, list):
        return read_number(given, ENTRY, path)
    return tuple(_numbers(item, f"{path}.{i}") for i, item in enumerate(given))


@dataclasses.dataclass(frozen=True)
class DesignTask:
    """What a gain is asked for: weights (tuples of their rows, or of a diagonal) or None, decay [1/s], damping, and the
    ranges given, in SI, by path of the loop."""

    Q: Any = table_field(_weight, None)
    R: Any = table_field(_weight, None)
    decay: float = table_field(range_reader(ParameterSpec("1/s", low=0.0)), 0.0)
    damping: float = table_field(range_reader(ParameterSpec("1", low=0.0, high=1.0, open_high=True)), 0.0)
    over: Mapping[str, Range] = dataclasses.field(default_factory=dict)

    def box(self, loop: Loop) -> dict[str, Range]:
        """The ranges by path of the loop's linear model, that of the speed between the loop's start and its stop if
        none was given."""
        known = _rangeable_parameters(loop)
        return {known[path].model: ends for path, ends in self._with_speed(loop).items()}

    def ranges(self, loop: Loop) -> dict[str, Range]:
        """The ranges by path of the loop, without those of a single value; that of the speed between the loop's start
        and its stop if others are given and none of it."""
        over = self._with_speed(loop) if self.over and hasattr(loop.plant, "frozen") else self.over
        return {path: ends for path, ends in over.items() if ends[0] < ends[1]}

    def _with_speed(self, loop: Loop) -> dict[str, Range]:
        over = dict(self.over)
        start, end = getattr(loop.initial, "speed", None), getattr(loop.stop, "speed", None)
        if start is not None and end is not None:
            over.setdefault("initial.speed", (float(end), float(start)))
        return over

    def table(self) -> dict[str, Any]:
        """As values of TOML."""
        return {name: value for name, value in plain_fields(self).items() if value is not None}


@dataclasses.dataclass(frozen=True)
class _Parameter:
    """What can have a range: its path in the linear model, its values, and whether it is more than one number."""

    model: str
    spec: ParameterSpec
    shape: tuple[int, ...] = ()


def read_design_section(table: Any, loop: Loop) -> DesignTask:
    """The task of a section. Raises ScenarioError, one line, for whatever is wrong with it."""
    task: DesignTask = read_table(DesignTask, table, "design", over=lambda given, path: _over(given, path, loop))
    for there, missing in (("Q", "R"), ("R", "Q")):
        if getattr(task, there) is not None and getattr(task, missing) is None:
            raise ScenarioError(f"design.{missing} is missing: with design.{there}, a cost needs both")
    return task


def _over(given: Any, path: str, loop: Loop) -> dict[str, Range]:
    table = table_reader(read_as_given, "ranges")(given, path)
    there = {name: (parameter.spec, parameter.shape) for name, parameter in _rangeable_parameters(loop).items()}
    found = read_entries(table, path, there, "nothing that the linear model of this loop depends on")
    return {item.path: item.single("have a range").range() for item in found}


def _rangeable_parameters(loop: Loop) -> dict[str, _Parameter]:
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
            found |= _parameter(block, prefix, "time_constant", "actuator.time_constant")
    if isinstance(loop.controller, Sampled):
        found |= _parameter(loop.controller, "controller.", "delay", "sampling.delay")
    return found


def _parameter(part: Any, prefix: str, name: str, model: str) -> dict[str, _Parameter]:
    return {path: _Parameter(model, spec) for path, spec, _ in parameters(part, prefix) if path == prefix + name}
