"""The section [design] of a scenario: requirements on a gain, and the ranges over which it is robust.

    Q, R       weights of the integral of x'Qx + u'Ru: a diagonal or a full matrix
    decay      1/s
    damping    of the poles, in [0, 1)
    [design.over]
    "plant.mass" = { low = 5.3, high = 6.2 }              # a path of the loop, as elsewhere in scenarios; in SI
    "initial.speed_kmh" = { low = 5.0, high = 50.0 }      # or in km/h

A path may be one key with dots or nested tables. Only parameters of the loop's linear model can have a range.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from diffabs.core.blocks import Series
from diffabs.core.pytree import ParameterSpec, parameters
from diffabs.core.types import JsonObject, Matrix, Scalar
from diffabs.host.values import (
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
from diffabs.host.values import read_table as read_table
from diffabs.linear.slip_model import SlipModel
from diffabs.loop.closed_loop import Loop
from diffabs.parts.actuators import Lag, RateLimit
from diffabs.parts.controllers import Sampled
from diffabs.scenario.parameter_paths import canonical_path, interval_table, read_entries

ENTRY = ParameterSpec("1")

Range = tuple[float, float]


def _weight(weight: object, path: str) -> Scalar:
    """Return a weight as a number or nested tuples, which can be compared.

    The size is not checked here: only the linear model has the order.
    """
    from diffabs.linear.weights import as_weight_matrix

    if not isinstance(weight, list | int | float) or isinstance(weight, bool):
        raise wrong_kind_error(path, weight, "a number, a diagonal or a matrix")
    if weight == []:
        raise ScenarioError(f"{path} = [] is empty")
    rows = weight if isinstance(weight, list) and any(isinstance(row, list) for row in weight) else ()
    if not all(isinstance(row, list) and len(row) == len(rows) for row in rows):
        raise ScenarioError(
            f"{path} = {format_given(weight)} is not square: {len(rows)} rows need as many numbers each"
        )
    value = _numbers(weight, path)
    try:
        as_weight_matrix(path, value, len(np.atleast_1d(value)), definite=path == "design.R")
    except ValueError as error:
        raise ScenarioError(str(error)) from None
    return value


def _numbers(value: object, path: str) -> Any:
    if not isinstance(value, list):
        return read_number(value, ENTRY, path)
    return tuple(_numbers(item, f"{path}.{i}") for i, item in enumerate(value))


@dataclasses.dataclass(frozen=True)
class DesignTask:
    """The requirements on a gain.

    Attributes:
        Q: Weight of the states: a number, or tuples of a diagonal or of rows; None without a cost.
        R: Weight of the control, in the same form.
        decay: Required decay rate [1/s].
        damping: Required damping of the poles, in [0, 1).
        over: Ranges (low, high), in SI, by path of the loop.
    """

    Q: Matrix = table_field(_weight, None)
    R: Matrix = table_field(_weight, None)
    decay: float = table_field(range_reader(ParameterSpec("1/s", low=0.0)), 0.0)
    damping: float = table_field(range_reader(ParameterSpec("1", low=0.0, high=1.0, open_high=True)), 0.0)
    over: Mapping[str, Range] = dataclasses.field(default_factory=dict)

    def box(self, loop: Loop) -> dict[str, Range]:
        """Return the ranges (low, high) in SI by path of the linear model of `loop`, single values included.

        A speed without a range gets the range from the loop's stop to its start, even if nothing else has a range.
        """
        allowed = _rangeable_parameters(loop)
        return {allowed[path].model: ends for path, ends in self._with_speed(loop).items()}

    def ranges(self, loop: Loop) -> dict[str, Range]:
        """Return the ranges (low, high) in SI by path of `loop`, without ranges of a single value.

        The dictionary is empty if [design.over] is empty. Otherwise the speed of a brake without a range gets the range
        from the loop's stop to its start.
        """
        over = self._with_speed(loop) if self.over and hasattr(loop.plant, "frozen") else self.over
        ranges = {path: ends for path, ends in over.items() if ends[0] < ends[1]}
        paths = {path for path, _, _ in parameters(loop)}
        for path in ranges:
            if path not in paths:
                where = f"design.over.{canonical_path(path)} is a parameter of the linear model, but not of this loop"
                raise ScenarioError(f"{where}: remove it from [design.over]")
        return ranges

    def _with_speed(self, loop: Loop) -> dict[str, Range]:
        over = dict(self.over)
        start, end = getattr(loop.initial, "speed", None), getattr(loop.stop, "speed", None)
        if start is not None and end is not None:
            over.setdefault("initial.speed", (float(end), float(start)))
        return over

    def table(self) -> JsonObject:
        """Return the section as TOML values."""
        over = {path: interval_table(*ends) for path, ends in self.over.items()}
        return {name: value for name, value in (plain_fields(self) | {"over": over}).items() if value is not None}


@dataclasses.dataclass(frozen=True)
class _Parameter:
    """A parameter that can have a range: its path in the linear model, its spec, and its shape."""

    model: str
    spec: ParameterSpec
    shape: tuple[int, ...] = ()


def read_design_section(table: object, loop: Loop) -> DesignTask:
    """Return the task that a section describes."""
    task: DesignTask = read_table(DesignTask, table, "design", over=lambda value, path: _over(value, path, loop))
    for present, missing in (("Q", "R"), ("R", "Q")):
        if getattr(task, present) is not None and getattr(task, missing) is None:
            raise ScenarioError(f"design.{missing} is missing: with design.{present}, a cost needs both")
    return task


def _over(value: object, path: str, loop: Loop) -> dict[str, Range]:
    table = table_reader(read_as_given, "ranges")(value, path)
    allowed = {name: (parameter.spec, parameter.shape) for name, parameter in _rangeable_parameters(loop).items()}
    entries = read_entries(table, path, allowed, "not a parameter of this loop's linear model")
    return {item.path: item.single("have a range").range() for item in entries}


def _rangeable_parameters(loop: Loop) -> dict[str, _Parameter]:
    """Return the parameters that can have a range, by path of the loop.

    A slip loop's linear model is a `SlipModel`, with its own paths. Any other plant keeps the paths of the loop.
    """
    if not hasattr(loop.plant, "frozen"):
        return {path: _Parameter(path, spec, np.shape(x)) for path, spec, x in parameters(loop.plant, "plant.")}
    model = {field.name: field.metadata["spec"] for field in dataclasses.fields(SlipModel) if "spec" in field.metadata}
    rangeable = {
        "initial.speed": _Parameter("speed", model["speed"]),
        "reference.slip": _Parameter("slip", model["slip"]),
    }
    for path, spec, value in parameters(loop.plant, "plant."):
        rangeable[path] = _Parameter(path, spec, np.shape(value))
    actuators = {"actuator.": loop.actuator}
    if isinstance(loop.actuator, Series):
        actuators = {f"actuator.blocks.{i}.": block for i, block in enumerate(loop.actuator.blocks)}
    for prefix, block in actuators.items():
        if isinstance(block, Lag | RateLimit):
            rangeable |= _parameter(block, prefix, "time_constant", "actuator.time_constant")
    if isinstance(loop.controller, Sampled):
        rangeable |= _parameter(loop.controller, "controller.", "delay", "sampling.delay")
    return rangeable


def _parameter(part: object, prefix: str, name: str, model: str) -> dict[str, _Parameter]:
    return {path: _Parameter(model, spec) for path, spec, _ in parameters(part, prefix) if path == prefix + name}
