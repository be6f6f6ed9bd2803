"""The computer's part of a loop: the calculation from measurements to commands that runs once a period.

    memory, measured --> target, feed-forward, controller --> memory, commands

The functions are the loop's own code, traced: reference, feed-forward and the controller within `Sampled`
(`Sampled.compute_guarded`). The parameters of these three remain variables. Those of the plant, period and delay become
constants. A target that moves by itself, such as a filtered one, is advanced by the Runge-Kutta steps of the
simulation. Sensors and actuators belong to the machine, not to the computer.
"""

import dataclasses
from collections.abc import Callable, Iterator
from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from diffabs.core.blocks import offers
from diffabs.core.channels import has_channels, outputs_like
from diffabs.core.protocols import Clock, Feedforward, Memory, Tracking
from diffabs.core.pytree import ParameterSpec, arrays, parameters, prepare_parts
from diffabs.core.tracing import depends_on_signal, leaf_dependence
from diffabs.core.types import Part, PyTree, Scalar
from diffabs.core.units import control_units, unit_at
from diffabs.core.validity import find_problems
from diffabs.engine.step.runge_kutta import rk4_step
from diffabs.loop.closed_loop import Loop
from diffabs.parts.controllers import Sampled, SampledOnGrid
from diffabs.parts.controllers.sampled import replace_nan

MAX_STEPS_PER_SAMPLE = 64  # simulation steps in a period, for a target that moves by itself


class NotExported(ValueError):
    """An error: a loop cannot be exported. The message gives the reason in one line."""


class Input(NamedTuple):
    """The input of one period.

    Attributes:
        measured: Measured outputs, a tuple such as `BrakeOutput`.
        target: Target, a number or a channel for each output with a target, if it comes from outside; else empty.
    """

    measured: PyTree
    target: Any = ()


class State(NamedTuple):
    """The memory of the computer.

    Attributes:
        controller: Memory of the controller.
        samples: Number of samples so far (int64).
        command: Last command, a number or a channel for each control.
        reference: Memory of the reference, empty if the target comes from outside.
    """

    controller: Memory
    samples: PyTree
    command: PyTree
    reference: Memory


class Parts(NamedTuple):
    """The parts with variable parameters; the reference is empty if the target comes from outside."""

    controller: Part
    feedforward: Feedforward
    reference: Part = ()


class DeviceParameter(NamedTuple):
    """A parameter of a part.

    Attributes:
        path: Path in the loop, such as controller.controller.kp.
        value: Value, of the parameter's shape.
        spec: Unit and range.
    """

    path: str
    value: np.ndarray
    spec: ParameterSpec

    def __str__(self) -> str:
        """Return one line for the head of a file: path, value and unit."""
        # Nine digits if they identify the value, else all seventeen.
        values = " ".join(f"{x:.17g}" if float(f"{x:.9g}") != x else f"{x:.9g}" for x in self.value.flat)
        return f"{self.path} = {values}{'' if self.spec.unit in ('', '1') else f' {self.spec.unit}'}"

    def name_entries(self) -> Iterator[tuple[str, str]]:
        """Yield, for each number of the value, its name in `Lowered.numbers` and a description (unit and range)."""
        # Twice: the controller stands within `Sampled`, which itself is the loop's controller.
        path = self.path.removeprefix("controller.").removeprefix("controller.")
        spec = dataclasses.replace(self.spec, unit="1")
        for k, at in enumerate(np.ndindex(self.value.shape)):
            unit = unit_at(self.spec.unit, k, self.value.size)
            yield ".".join([path, *map(str, at)]), f"[{unit}] in {spec.interval()}"


@dataclasses.dataclass(frozen=True)
class ComputerProgram:
    """The computer's part of a loop as functions to trace.

    A program calls `start` once before the first sample. At each sample it calls `step` once, and then `move` `moves`
    times. The shapes are `jax.ShapeDtypeStruct`s, whose real numbers have the type `dtype`.

    Attributes:
        start: start(parts, input) -> state before the first sample.
        step: step(parts, state, input) -> (controller's memory, samples, command, held). `held` is true if the sample
            cannot be used. The controller's memory and the command then stay, but `samples` counts it and `move`
            advances the reference.
        move: move(parts, state, i) -> reference's memory after the i-th simulation step, for i = 0, 1, ..., moves - 1.
        moves: Number of calls of `move` after each sample; 0 for a reference without continuous memory.
        units: Units of the inputs by name.
        input: Shapes of the input.
        state: Shapes of the state.
        parts: Parts with the initial values of their parameters.
        dtype: Type of the real numbers.
        period: Sampling period [s].
        delay: Computing delay [s].
        commands: Unit of each command by its name in `Lowered.state`: command, or command.pump_1.
        numbers: All parameters; those of the plant only if the feed-forward depends on them.
    """

    start: Callable[[Parts, Input], State]
    step: Callable[[Parts, State, Input], tuple[Memory, PyTree, PyTree, PyTree]]
    move: Callable[[Parts, State, PyTree], Memory]
    moves: int
    units: dict[str, str]
    input: Input
    state: State
    parts: Parts
    dtype: np.dtype
    period: float
    delay: float
    commands: dict[str, str]
    numbers: tuple[DeviceParameter, ...]


def computer_program(
    loop: Loop, *, step: float | None = None, dtype: DTypeLike = np.float64, given_target: bool = False
) -> ComputerProgram:
    """Return the computer's part of a loop whose controller is `Sampled` or `SampledOnGrid`.

    Args:
        loop: Closed loop.
        step: Step of the simulation [s], by which a target that moves by itself is advanced; None for the period.
            The number of steps in a period is rounded to a whole number.
        dtype: Type of the real numbers, np.float32 or np.float64.
        given_target: True makes the target an input and leaves the reference out.

    Raises:
        ValueError: The step is not positive and finite, or the type is neither float32 nor float64.
        NotExported: A parameter is no number or has a wrong value or shape, the controller runs in continuous time,
            or a target that moves by itself needs more than MAX_STEPS_PER_SAMPLE steps in a period. Without
            `given_target`, also a reference that follows measurements, ticks or has events.
    """
    if step is not None and not 0 < step < np.inf:
        raise ValueError(f"step = {step:g} s: a positive and finite number is needed")
    if np.dtype(dtype) not in (np.float32, np.float64):
        raise ValueError(f"dtype = {np.dtype(dtype)}: float32 or float64 is needed")
    check_numbers(loop)
    loop = with_sampled_controller(loop)
    controller: Part = loop.controller
    with jax.enable_x64(True):
        typed: Loop = jax.tree.map(lambda x: jnp.asarray(x, dtype), arrays(loop))
        computer: Any = typed.controller
        parts = Parts(computer.controller, typed.feedforward, () if given_target else typed.reference)
        # `parts` holds the raw parameters: derived values are traced from them, so they follow a changed parameter.
        typed = prepare_parts(typed)
        shapes = jax.eval_shape(lambda: _start_input(typed, given_target))
        if not given_target:
            _check_reference(typed, _start_input(typed, False).measured)
        period = float(controller.period)
        count = max(round(period / step) if step else 1, 1)
        work = _Work(typed, count, given_target, shapes)
        state = jax.eval_shape(work.start, parts, shapes)
        moves = count if jax.tree.leaves(state.reference.flow) else 0
        if moves > MAX_STEPS_PER_SAMPLE:
            raise NotExported(
                f"the period of {period:g} s is {moves} steps of the solver, more than {MAX_STEPS_PER_SAMPLE}: choose a"
                f" solver.step of at least {period / MAX_STEPS_PER_SAMPLE:g} s"
            )
    units = dict(loop.plant.shows.units)
    if given_target:
        names = getattr(shapes.target, "_fields", ())
        units |= {f"target.{name}": units[name] for name in names} or {"target": units[loop.plant.shows._fields[0]]}
    controls = control_units(loop.plant)
    commands = {f"command.{name}" if has_channels(state.command) else "command": controls[name] for name in controls}
    return ComputerProgram(
        work.start, work.step, work.move, moves, units, shapes, state, parts, np.dtype(dtype), period,
        float(controller.delay), commands, tuple(_numbers(loop, typed, given_target)),
    )  # fmt: skip


def _numbers(loop: Loop, typed: Loop, given_target: bool) -> Iterator[DeviceParameter]:
    """Yield the parameters that the computer's calculation depends on."""

    def ahead(plant: object) -> Scalar:
        return typed.feedforward.input(plant, measured, target)

    families = ["controller", "feedforward", *(() if given_target else ("reference",))]
    with jax.enable_x64(True):
        shapes = jax.eval_shape(lambda: _start_input(typed, True))
        measured, target = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        families += ["plant"] if depends_on_signal(ahead, typed.plant) else []
    for path, spec, value in parameters(loop):
        if path.partition(".")[0] in families:
            yield DeviceParameter(path, np.asarray(value, float), spec)


def check_numbers(part: object, prefix: str = "") -> None:
    """Check the parameters of a part before their names and values become code."""
    if lines := list(find_problems(part, prefix)):
        raise NotExported("; ".join(lines))


def with_sampled_controller(loop: Loop) -> Loop:
    """Return the loop with a `Sampled` controller; a `SampledOnGrid` becomes the `Sampled` with the same times."""
    controller: Part = loop.controller
    if isinstance(controller, SampledOnGrid):
        inner, period = controller.controller, controller.sampling_period
        controller = Sampled(controller=inner, period=period, delay=controller.delay)
    if not isinstance(controller, Sampled):
        name = type(controller).__name__
        raise NotExported(f"controller {name} runs in continuous time: give the period at which a computer samples it")
    return dataclasses.replace(loop, controller=controller)


def _start_input(loop: Loop, given_target: bool) -> Input:
    """Return the input at the loop's start, whose target is what is measured."""
    state = loop.start()
    measured = loop.sensor.output(0.0, state.sensor, loop.plant.output(state.plant))
    setpoint = loop.reference.setpoint(loop.reference.start(measured))
    return Input(measured, outputs_like(measured, setpoint) if given_target else ())


def _check_reference(loop: Loop, measured: object) -> None:
    """Raise NotExported for a target that depends on measurements between samples, ticks, or has events."""
    reference, name = loop.reference, type(loop.reference).__name__
    memory = reference.start(measured)
    moves = depends_on_signal(lambda y: (reference.flow(0.0, memory, y), reference.output(0.0, memory, y)), measured)
    if offers(reference, "tick", "margins") or moves:
        raise NotExported(f"reference {name} follows what is measured between samples: give the target from outside")


class _Work:
    """The computer's calculation for a loop whose real numbers have one type."""

    def __init__(self, loop: Loop, count: int, given_target: bool, inputs: Input):
        self.loop, self.count, self.given_target, self.inputs = loop, count, given_target, inputs
        assert isinstance(loop.controller, Sampled)
        self.sampled = loop.controller

    def start(self, parts: Parts, inputs: Input) -> State:
        """Return the memory at the first sample."""
        loop, inputs = self._with(parts), replace_nan(inputs)
        reference = Memory() if self.given_target else loop.reference.start(inputs.measured)
        tracking, _ = self._track(loop, reference, inputs, 0.0)
        zero = jax.tree.map(jnp.zeros_like, tracking.feedforward)
        return State(loop.controller.controller.start(tracking), jnp.zeros((), jnp.int64), zero, reference)

    def step(self, parts: Parts, state: State, inputs: Input) -> tuple[Memory, PyTree, PyTree, PyTree]:
        """Return the controller's memory after a sample, the number of samples, the command, and the truth `held`."""
        loop, t = self._with(parts), self._time(state)
        tracking, lost = self._track(loop, state.reference, inputs, t)
        clock = Clock(t, loop.controller.period, state.samples, None, before=tracking)
        inner, command, held = loop.controller.compute_guarded(clock, state.controller, state.command, tracking, lost)
        return inner, state.samples + 1, command, held

    def move(self, parts: Parts, state: State, i: Scalar) -> Memory:
        """Return the reference's memory after the i-th simulation step in a period."""
        loop = self._with(parts)
        h, memory = loop.controller.period / self.count, state.reference
        # `_check_reference` has shown that the reference ignores measurements, so zeros stand for them.
        zero = jax.tree.map(jnp.zeros_like, self.inputs.measured)

        def rate(t: Scalar, x: Scalar) -> Any:
            return loop.reference.flow(t, memory._replace(flow=x), zero)

        return memory._replace(flow=rk4_step(rate, self._time(state) + i * h, memory.flow, h))

    def _with(self, parts: Parts) -> PyTree:
        """Return the loop with these parts in it."""
        controller = dataclasses.replace(self.sampled, controller=prepare_parts(parts.controller))
        loop = dataclasses.replace(self.loop, controller=controller, feedforward=prepare_parts(parts.feedforward))
        return loop if self.given_target else dataclasses.replace(loop, reference=prepare_parts(parts.reference))

    def _time(self, state: State) -> Scalar:
        """Return the time of the sample [s]."""
        period = self.sampled.period
        return state.samples.astype(jnp.result_type(period)) * period

    def _track(self, loop: Loop, reference: Memory, inputs: Input, t: Scalar) -> tuple[Tracking, PyTree]:
        """Return the controller's input, and whether a NaN enters the feed-forward."""
        measured = replace_nan(inputs.measured)
        if self.given_target:
            target, setpoint = inputs.target, replace_nan(inputs.target)
        else:
            target = loop.reference.output(t, reference, measured)
            setpoint = loop.reference.setpoint(reference)

        def ahead(measured: object) -> Scalar:
            return loop.feedforward.input(loop.plant, measured, setpoint)

        # Only measurements that the feed-forward depends on can spoil it. The controller checks the others itself.
        followed = zip(jax.tree.leaves(inputs.measured), leaf_dependence(ahead, measured), strict=True)
        lost = reduce(jnp.logical_or, [jnp.isnan(x) for x, on in followed if on], False)
        return Tracking(target, inputs.measured, ahead(measured)), lost
