"""A plant as C99: its start, a Runge-Kutta step and its outputs, with every parameter as a variable.

The text comes from the functions that the simulation calls, traced as for a controller (`lowered`).
"""

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.compiler.emit.c99_words import Words
from diffabs.compiler.ir import Node, UpdateLevel, is_real, live_nodes
from diffabs.compiler.lower.labels import Labelled
from diffabs.compiler.lower.rules import Unsupported
from diffabs.core.protocols import Plant
from diffabs.core.pytree import ParameterSpec, canonical_dtypes, parameters, prepare_parts
from diffabs.core.types import PyTree, Scalar
from diffabs.core.units import control_units, unit_at
from diffabs.engine.step.runge_kutta import rk4_step
from diffabs.loop.closed_loop import Loop
from diffabs.output.export.device import NotExported, check_numbers
from diffabs.output.export.lowered import fill_shapes, number_leaves, trace_outputs


class FmuVariable(NamedTuple):
    """A variable of the FMU.

    Attributes:
        name: Name; a parameter has its path, such as plant.mass.
        role: "output", "input" (the control) or "parameter".
        value: Default value.
        unit: Unit, "1" or empty for a pure number.
        low, high: Least and greatest value that may be set.
    """

    name: str
    role: str
    value: float
    unit: str
    low: float = -sys.float_info.max
    high: float = sys.float_info.max


class PlantSource(NamedTuple):
    """A plant as C, without a definition of the struct `model` that the functions take.

    Attributes:
        text: C functions `plant_start(m)`, `plant_step(m, t, h)` and `plant_show(m)` of a pointer `m` to a struct with
            the arrays `v` (variables, in their order) and `x` (states). They set `x` at the start, advance `x` from t
            by h seconds, and store the outputs in `v`.
        variables: Variables of the FMU: outputs, control, parameters.
        states: Number of states.
    """

    text: str
    variables: tuple[FmuVariable, ...]
    states: int


def plant_source(loop: Loop) -> PlantSource:
    """Return the plant of a loop as C, with the loop's initial condition as its default start."""
    check_numbers(loop.plant, "plant.")
    check_numbers(loop.initial, "initial.")
    with jax.enable_x64(True):
        typed = jax.tree.map(lambda x: jnp.asarray(x, float), canonical_dtypes((loop.plant, loop.initial)))
        variables = _variables(loop)
        try:
            written = _Written(typed, variables)
            text = "\n".join(written.parts())
        except Unsupported as error:
            raise NotExported(f"{error.primitive} has no translation to C: {error.reason}") from None
    return PlantSource(f"{text}\n", variables, written.states)


def _variables(loop: Loop) -> tuple[FmuVariable, ...]:
    """Return the variables: outputs, controls, then each number of the parameters of plant and start."""
    plant = loop.plant
    variables = [FmuVariable(name, "output", 0.0, plant.shows.units[name]) for name in plant.shows._fields]
    variables += [FmuVariable(name, "input", 0.0, unit) for name, unit in control_units(plant).items()]
    for where, part in (("plant", plant), ("initial", loop.initial)):
        for path, spec, value in parameters(part):
            numbers = np.asarray(value, float)
            for k, at in enumerate(np.ndindex(numbers.shape)):
                unit = unit_at(spec.unit, k, numbers.size)
                name = ".".join([where, path, *map(str, at)])
                variables.append(FmuVariable(name, "parameter", float(numbers[at]), unit, *_limits(spec)))
    return tuple(variables)


def _limits(spec: ParameterSpec) -> tuple[float, float]:
    """Return the least and greatest double of a range.

    An open end gives the next double inside; next to 0 that is the least normal number, not a subnormal one.
    """
    low, high = spec.low, spec.high
    if spec.open_low:
        low = sys.float_info.min if low == 0 else math.nextafter(low, math.inf)
    if spec.open_high:
        high = -sys.float_info.min if high == 0 else math.nextafter(high, -math.inf)
    largest = math.inf if spec.infinite else sys.float_info.max
    return max(low, -largest), min(high, largest)


class _Written:
    """A writer of the plant's functions."""

    def __init__(self, typed: tuple[PyTree, PyTree], variables: Sequence[FmuVariable]):
        self.places = {variable.name: k for k, variable in enumerate(variables)}
        self.words = Words("double", self._place)
        graph = Labelled()
        plant, initial = typed
        inputs = [
            number
            for where, part in (("plant", plant), ("initial", initial))
            for number in fill_shapes(
                part, number_leaves(part, graph, "v", lambda path, where=where: f"{where}.{path}")
            )
        ]
        # The first leaves are the plant's. The start's parameters matter only in `plant_start`.
        plant_inputs = inputs[: len(jax.tree.leaves(plant))]
        state = jax.eval_shape(lambda both: prepare_parts(both[0]).start(both[1]), typed)
        held = fill_shapes(state, number_leaves(state, graph, "x", str))
        if any(not is_real(leaf.dtype) for leaf in jax.tree.leaves(state)):
            raise NotExported(f"plant {type(plant).__name__} has a state that is no real number")
        self.order = {node.attr[1]: k for k, node in enumerate(node for array in held for node in array.flat)}
        self.states = len(self.order)
        scalar = jax.ShapeDtypeStruct((), np.float64)
        names = control_units(plant)
        *controls, time, length = (
            np.full((), graph.input(np.float64, UpdateLevel.UNIFORM, place), object)
            for place in (*(("v", name) for name in names), ("", "t"), ("", "h"))
        )
        control = plant.controls(*(scalar for _ in names)) if hasattr(plant, "controls") else scalar
        self.begun = trace_outputs(graph, lambda both: prepare_parts(both[0]).start(both[1]), typed, inputs)
        moving, shown = (plant, state, control, scalar, scalar), (plant, state)
        self.moved = trace_outputs(
            graph, lambda all: _advance_state(*all), moving, [*plant_inputs, *held, *controls, time, length]
        )
        self.shown = trace_outputs(
            graph, lambda both: prepare_parts(both[0]).output(both[1]), shown, [*plant_inputs, *held]
        )

    def _place(self, where: str, path: str) -> str:
        """Return the C expression of an input of the graph."""
        return f"m->v[{self.places[path]}]" if where == "v" else f"m->x[{self.order[path]}]" if where == "x" else path

    def parts(self) -> Iterator[str]:
        """Yield the functions of the text."""
        yield from self._function("plant_start(model *m)", "x", dict(enumerate(self.begun)))
        yield from self._function("plant_step(model *m, double t, double h)", "x", dict(enumerate(self.moved)), "th")
        yield from self._function("plant_show(model *m)", "v", dict(enumerate(self.shown)))

    def _function(self, head: str, array: str, results: Mapping[int, Node], unused: str = "") -> Iterator[str]:
        """Yield a function that computes `results` and stores them in an array of the model."""
        yield f"static void {head}\n{{"
        yield from (f"  (void){name};" for name in unused)
        yield from self.words.operations(live_nodes(list(results.values())), "  ")
        names = {k: f"n{k}_" for k in results}  # no variable is called n, a number and _
        yield from (f"  const double {names[k]} = {self.words.name(node)};" for k, node in results.items())
        # Store last: a result may read the old value of another one.
        yield from (f"  m->{array}[{k}] = {name};" for k, name in names.items())
        yield "}\n"


def _advance_state(plant: Plant, state: PyTree, control: PyTree, t: Scalar, h: Scalar) -> PyTree:
    """Return the state after a step with constant control, as `FixedStep` computes it."""
    plant = prepare_parts(plant)
    return plant.project(rk4_step(lambda t, x: plant.derivative(t, x, control), t, state, h))
