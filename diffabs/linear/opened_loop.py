"""The open loop of any control loop, cut at the controller's command and linearised, for margins and Bode plots.

    command v --> [delay] --> actuator --> plant --> sensor --> controller --> command u,     L = -du/dv

The loop is at rest on its setpoint: everything stands still, and the plant's first signal is the setpoint. A plant with
`frozen` outputs (the speed of a brake) holds them, as in `linearization.tracking_dynamics`. Blocks are differentiated
directly, so a smooth block needs no rule of its own: lags, sensor filters, a gain schedule, an observer.

A plant with several controls makes L a matrix, with a row and a column for each channel.

A `Sampled` controller makes the loop discrete. The other parts are then sampled exactly under a held input, also with a
delay that is not a whole number of periods. Limits do not act at rest; noise and the motion of the target are
disturbances.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from diffabs.core.blocks import Direct, Series, offers
from diffabs.core.channels import control_names, has_channels, outputs_like
from diffabs.core.jax_flags import default_flags
from diffabs.core.protocols import Clock, Memory, Tracking
from diffabs.core.pytree import canonical_dtypes, parts
from diffabs.core.tracing import depends_on_signal
from diffabs.core.types import Array, Bool, Part, PyTree, Scalar
from diffabs.core.validity import check_part
from diffabs.linear.linearization import (
    check_kink,
    coordinate_moves,
    independent_components,
    is_kinked,
    nan_at_kink,
)
from diffabs.linear.operating_point import MAX_REST_RESIDUE, find_root
from diffabs.linear.transfer import WHOLE_PERIOD_TOLERANCE, Transfer, check_transfer
from diffabs.linear.zero_order_hold import hold_input
from diffabs.loop.closed_loop import Loop
from diffabs.parts.actuators import Delay
from diffabs.parts.controllers import Sampled

# Relative offsets of the target for the first Newton step of a controller, in the directions that leave a limit.
TARGET_OFFSETS = (0.0, 1e-4, -1e-4, 1e-2, -1e-2)


class OpenLoop(NamedTuple):
    """The two halves of an open loop, and the pure delay between them.

    Attributes:
        plant: System in continuous time from the command to all inputs of the controller.
        controller: System from these inputs to the command.
        delay: Pure delay [s], of each channel.
        channels: Names of the controls; empty for a plant with one control.
    """

    plant: Transfer
    controller: Transfer
    delay: float
    channels: tuple[str, ...] = ()

    @property
    def period(self) -> float | None:
        """Sampling period of the controller [s]; None in continuous time."""
        return self.controller.period

    def transfer(self, more: float = 0.0) -> Transfer:
        """Return the open loop L from the command to minus the controller's command, so the feedback is negative.

        With a sampled controller L is discrete. States that do not influence its output are left out.

        Args:
            more: Added delay [s]; the sum with the loop's own delay is at least 0.

        Raises:
            ValueError: The whole delay is negative, or a half has a field that `check_transfer` refuses.
        """
        delay = self.delay + more
        if not 0 <= delay < np.inf:
            raise ValueError(f"delay = {delay:g} s is outside [0, inf) s")
        _check_halves(self)
        if self.period is None:
            return drop_unobserved_states(in_series(self.plant, self.controller)._replace(delay=delay))
        # Whole periods become shifts in `Transfer`. The rest of the delay is sampled exactly.
        whole, remainder = split_delay(delay, self.period)
        plant = sample_plant(self.plant, self.period, remainder)
        return drop_unobserved_states(in_series(plant, self.controller)._replace(delay=whole * self.period))

    def respond_to_state(self, w: np.ndarray) -> np.ndarray:
        """Return the response (k, n) from a change of the plant's state to minus the command, if it is sampled."""
        plant = sample_plant(self.plant, float(self.period or 0.0), 0.0)
        a, c = plant.A, plant.C
        states = Transfer(a, np.eye(len(a)), c, np.zeros((len(c), len(a))), self.period).rational_response(w)
        return -(self.controller.rational_response(w) @ states)[:, 0]


def _check_halves(loop: OpenLoop) -> None:
    plant, controller = check_transfer(loop.plant), check_transfer(loop.controller)
    if plant.period is not None:
        raise ValueError(f"plant: period = {plant.period:g} s; the plant is in continuous time: None")
    if plant.D.any():
        raise ValueError(f"plant: D = {plant.D[plant.D != 0][0]:g} is outside [0, 0]: no direct path is allowed")
    for name, half in (("plant", plant), ("controller", controller)):
        if half.delay:
            raise ValueError(f"{name}: delay = {half.delay:g} s is outside [0, 0] s: give the delay to the OpenLoop")
    if len(plant.C) != controller.B.shape[1]:
        raise ValueError(f"controller: B has {controller.B.shape[1]} columns; the plant has {len(plant.C)} outputs")


@default_flags()
def open_loop(loop: Loop, target: Scalar | None = None) -> OpenLoop:
    """Return a loop, linearised at rest on its setpoint and opened at the controller's command.

    Args:
        loop: Loop to open.
        target: Setpoint in the unit of the first signal; None takes the setpoint of the loop's reference. A reference
            that searches for its target has no setpoint yet: give the value that it will find. A loop with several
            targets has them in its reference.

    Raises:
        ValueError: A part has a parameter that `check` refuses, or the target is not finite, or there are several
            targets and `target` is not None. A block acts at instants
            (a relay, a controller that computes in every step but is not `Sampled`); or the plant does not come to rest
            at the setpoint; or a slope jumps there, at a kink; or the command does not respond to a measured signal
            there, for example at a limit. In single precision a kink is not noticed.
    """
    return _open(loop, target, plant=True)


def linear_controller(loop: Loop, target: Scalar | None = None) -> Transfer:
    """Return the controller of `open_loop`; the parts around it may be at a kink."""
    return _open(loop, target, plant=False).controller


@default_flags()
def rest_point(loop: Loop, target: Scalar | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where `open_loop` linearises: states of plant, sensor and actuator, command, and controller's memory."""
    open_loop(loop, target)  # refuses a loop without a linear model
    undelayed = split_off_delays(loop)[0]
    setpoint = _start_output_and_setpoint(undelayed)[1] if target is None else float(target)
    return jax.device_get(_linearize_halves(undelayed, setpoint).point)


def open_traced(loop: Loop, target: Scalar | None = None) -> OpenLoop:
    """Return the open loop with JAX arrays, for a loop whose parameters may be tracers.

    Its entries are NaN where `open_loop` raises an error for a value: at a kink, and without rest at the setpoint.

    Raises:
        ValueError: A block acts at instants and is not `Sampled`.
    """
    rational, delay = split_off_delays(loop)
    _check_continuous(rational)
    linear = _linearize_halves(rational, _start_output_and_setpoint(loop)[1] if target is None else target)
    linear = nan_at_kink(linear, linear.kinked[0] | linear.kinked[1] | ~(linear.residue < MAX_REST_RESIDUE))
    return _join(loop, linear, delay)


def tracked_columns(loop: Loop) -> list[int]:
    """Return the columns of the controller's inputs that are measurements of the tracked signals."""
    output, setpoint = jax.eval_shape(_start_output_and_setpoint, loop)
    tracked = setpoint._fields if has_channels(setpoint) else loop.plant.shows._fields[:1]
    return [len(jax.tree.leaves(setpoint)) + output._fields.index(name) for name in tracked]


def _open(loop: Loop, target: Scalar | None, *, plant: bool) -> OpenLoop:
    """Return the open loop. `plant`: whether the parts around the controller must be smooth, too."""
    check_part(loop)
    if target is not None and not np.isfinite(target):
        raise ValueError(f"target = {float(target):g} is outside (-inf, inf), in the unit of the first signal")
    rational, delay = split_off_delays(loop)
    _check_continuous(rational)
    setpoint = _start_output_and_setpoint(loop)[1]
    if target is not None and has_channels(setpoint):
        names = ", ".join(setpoint._fields)
        raise ValueError(f"target = {float(target):g}: the loop has several targets, {names}: set its reference")
    linear = jax.device_get(_linearize_halves(rational, setpoint if target is None else float(target)))
    if not linear.residue < MAX_REST_RESIDUE:
        raise ValueError(f"plant {type(loop.plant).__name__} does not come to rest at the setpoint: no linear model")
    halves = (("sensor", "plant", "actuator"), plant and linear.kinked[0]), (("controller",), linear.kinked[1])
    for names, kinked in halves:
        parts = ", ".join(f"{name} {type(getattr(loop, name)).__name__}" for name in names)
        check_kink(f"{parts} at the setpoint", kinked)
    model = _join(loop, linear, delay)
    period = None if model.period is None else float(model.period)
    model = model._replace(controller=model.controller._replace(period=period), delay=float(model.delay))
    if not len(model.transfer().A):
        raise ValueError(
            f"controller {type(loop.controller).__name__}: its command does not follow what is measured at the "
            "setpoint (at a limit, or by steps); there is no linear loop"
        )
    return model


def _join(loop: Loop, linear: "_LinearHalves", delay: Scalar) -> OpenLoop:
    """Return the halves as an open loop with the delays of actuator and computer."""
    sampled = loop.controller if isinstance(loop.controller, Sampled) else None
    controller = Transfer(*linear.controller)._replace(period=sampled.period if sampled else None)
    delay = delay + (sampled.delay if sampled else 0.0)
    return OpenLoop(Transfer(*linear.plant), controller, delay, control_names(loop.plant))  # pyright: ignore[reportArgumentType]


def split_off_delays(loop: Loop) -> tuple[Loop, Scalar]:
    """Return the loop without its actuator's pure delays, and the sum of these delays [s]."""
    # A pure delay commutes with linear blocks, so its place in the series does not matter.
    blocks = loop.actuator.blocks if isinstance(loop.actuator, Series) else (loop.actuator,)
    delay = sum((block.time for block in blocks if isinstance(block, Delay)), 0.0)
    undelayed = tuple(block for block in blocks if not isinstance(block, Delay))
    if any(map(_has_delay, undelayed)):
        name = type(loop.actuator).__name__
        raise ValueError(f"actuator {name} delays some controls: a linear loop has one delay, a Delay of all controls")
    return dataclasses.replace(loop, actuator=Series(blocks=undelayed) if undelayed else Direct()), delay  # pyright: ignore


def _has_delay(block: Part) -> bool:
    return isinstance(block, Delay) or any(map(_has_delay, parts(block)))


def _check_continuous(loop: Loop) -> None:
    """Raise ValueError for a block whose memory jumps at instants in dependence on its signal."""
    start = loop.start()
    signals = {
        "sensor": loop.plant.output(start.plant),
        "actuator": jax.tree.map(lambda u: 0.0 * u, loop.plant.holding(*_start_output_and_setpoint(loop))),
    }
    if not isinstance(loop.controller, Sampled):
        signals["controller"] = None
    for name, signal in signals.items():
        block = getattr(loop, name)
        if offers(block, "margins") or (offers(block, "tick") and (signal is None or _ticks_use_signal(block, signal))):
            hint = ": put it into a sampled controller" if name == "controller" and not offers(block, "margins") else ""
            raise ValueError(f"{name} {type(block).__name__} acts at instants: it has no linear model{hint}")


def _ticks_use_signal(block: Part, signal: PyTree) -> bool:
    """Return whether a block's ticks depend on its signal. Ticks that only draw noise do not."""
    memory, clock = block.start(signal), Clock(0.0, 1e-3, 1, jax.random.key(0))
    return depends_on_signal(lambda signal: block.tick(clock, memory, signal).held, signal)


class _SurroundingStates(NamedTuple):
    """Integrated states of the parts around the controller."""

    plant: Part
    sensor: Part
    actuator: Part


class _LinearHalves(NamedTuple):
    """Matrices (A, B, C, D) of both halves, their distance from rest, relative to the state, whether each half is at a
    kink, and the point: states around the controller, command, and the controller's memory.
    """

    plant: Part
    controller: Part
    residue: Scalar
    kinked: tuple[Bool, Bool]
    point: tuple[Array, Array, Array]


def _start_output_and_setpoint(loop: Loop) -> tuple[PyTree, PyTree]:
    start = loop.start()
    return loop.plant.output(start.plant), loop.reference.setpoint(start.reference)


@jax.jit
def _linearize_halves(loop: Loop, setpoint: Scalar) -> _LinearHalves:
    loop, setpoint = canonical_dtypes((loop, setpoint))
    around = _Surroundings(loop, setpoint)
    target = around.chart(around.start)
    target = target.at[: len(around.tracked)].set(ravel_pytree(around.setpoint)[0]) if around.frozen else target
    # Newton's method starts on the setpoint, with the other coordinates at their start.
    near = find_root(lambda z: around.chart(z) - target, around.start)
    guess = ravel_pytree(loop.plant.holding(around.output(near), around.setpoint))[0]
    free = find_root(around.rest_residual, jnp.append(near, guess))
    residue = jnp.max(jnp.abs(around.rest_residual(free))) / (1 + jnp.max(jnp.abs(free)))
    z, command = free[: len(near)], free[len(near) :]
    signal, as_signal = ravel_pytree(around.signal(z))
    by_z, b = jax.jacfwd(around.moves, (0, 1))(z, command)
    chart = jax.jacfwd(around.chart)(z)
    # M DF^-1 are the derivatives with respect to the coordinates; the frozen outputs are the last and are cut off.
    n = len(z) - around.held
    a, c = (jnp.linalg.solve(chart.T, m.T).T[:, :n] for m in (by_z, jax.jacfwd(around.signals)(z)))
    plant = (a[:n], b[:n], c, jnp.zeros((len(signal), len(command)), a.dtype))
    steps = coordinate_moves(chart, around.chart(z))[:n]
    bent = is_kinked(lambda z, v: jnp.concatenate([around.moves(z, v)[:n], around.signals(z)]), steps, z, command)
    controller, compute, inside = _linearize_controller(loop, signal, as_signal, command)
    moves = jax.vmap(lambda step: jax.jvp(around.signals, (z,), (step,))[1])(steps)
    bends = (bent, is_kinked(compute, moves, signal, inside))
    return _LinearHalves(plant, controller, residue, bends, (z, command, inside))


class _Surroundings:
    """Plant, sensor and actuator of a loop as functions of one vector z, and of the commands v as a vector.

    The coordinates begin with the tracked signals, and the states on which neither they nor the frozen outputs depend.
    Then follow the states of sensor and actuator, and the `held` frozen outputs.
    """

    def __init__(self, loop: Loop, setpoint: PyTree):
        state = loop.start()
        parts = _SurroundingStates(state.plant, state.sensor.flow, state.actuator.flow)
        self.loop, self.setpoint = loop, setpoint
        self.memory = (state.sensor.held, state.actuator.held)
        self.start, self.unravel = ravel_pytree(parts)
        self.frozen: Any = tuple(getattr(loop.plant, "frozen", ()))
        self.tracked = setpoint._fields if has_channels(setpoint) else loop.plant.shows._fields[:1]
        self.as_control = ravel_pytree(loop.plant.holding(self.output(self.start), setpoint))[1]
        size = ravel_pytree(state.plant)[0].size
        remaining = (
            independent_components(loop.plant, state.plant, (*self.tracked, *self.frozen))
            if self.frozen
            else np.arange(size)
        )
        self.remaining, self.size, self.held = remaining, size, len(self.frozen)

    def output(self, z: Array) -> PyTree:
        return self.loop.plant.output(self.unravel(z).plant)

    def signal(self, z: Array) -> Tracking:
        measured = self.loop.sensor.output(0.0, Memory(self.unravel(z).sensor, self.memory[0]), self.output(z))
        return Tracking(self.setpoint, measured, self.loop.feedforward.input(self.loop.plant, measured, self.setpoint))

    def signals(self, z: Array) -> Array:
        return ravel_pytree(self.signal(z))[0]

    def flow(self, z: Array, v: Array) -> Array:
        x, command = self.unravel(z), self.as_control(v)
        actuator = Memory(x.actuator, self.memory[1])
        control = self.loop.actuator.output(0.0, actuator, command)
        rates = _SurroundingStates(
            self.loop.plant.derivative(0.0, x.plant, control),
            self.loop.sensor.flow(0.0, Memory(x.sensor, self.memory[0]), self.output(z)),
            self.loop.actuator.flow(0.0, actuator, command),
        )
        return ravel_pytree(rates)[0]

    def chart(self, z: Array) -> Array:
        """Return the coordinates."""
        if not self.frozen:
            return z
        y = self.output(z)
        first, last = (jnp.stack([getattr(y, name) for name in names]) for names in (self.tracked, self.frozen))
        return jnp.concatenate([first, z[self.remaining], z[self.size :], last])

    def moves(self, z: Array, v: Array) -> Array:
        return jax.jvp(self.chart, (z,), (self.flow(z, v),))[1]

    def rest_residual(self, free: PyTree) -> Array:
        """Return a vector that is zero at rest.

        It contains the rates of all coordinates except the frozen outputs, and the change of the frozen outputs since
        the start. The last entries are the tracked signals minus their setpoints.
        """
        n = len(self.start)
        z, v = free[:n], free[n:]
        rates = self.moves(z, v)[: len(z) - self.held]
        where = self.chart(z)[len(z) - self.held :] - self.chart(self.start)[len(z) - self.held :]
        return jnp.concatenate([rates, where, tracking_errors(self.output(z), self.setpoint)])


def controller_function(
    loop: Loop, as_signal: Callable[[Array], Tracking]
) -> tuple[Array, Callable[[Array, Array], tuple[Array, Array]]]:
    """Return the controller's memory c at the start, and a function of c and the signal s.

    It returns the memory after a sample, or its rate in continuous time; and the command.
    """
    controller, memory = loop.controller, loop.start().controller
    sampled = isinstance(controller, Sampled)
    inside, unravel = ravel_pytree(memory.held.inner if sampled else memory)

    def compute(c: Array, s: Array) -> tuple[Array, Array]:
        memory, tracking = unravel(c), as_signal(s)
        if not isinstance(controller, Sampled):
            rate = controller.flow(0.0, memory, tracking)
            return ravel_pytree(memory._replace(flow=rate))[0], _flatten(controller.output(0.0, memory, tracking))
        clock = Clock(0.0, controller.period, 1, None, before=tracking)
        after, output = controller.compute_sample(clock, memory, tracking)
        return ravel_pytree(after)[0], _flatten(output)

    return inside, compute


def _linearize_controller(
    loop: Loop, signal: Array, as_signal: Callable[[Array], Tracking], command: Array
) -> tuple[tuple[Array, Array, Array, Array], Callable[[Array, Array], Array], Array]:
    """Return the controller at rest with the command that holds the plant: (A, B, C, D), a function, and its memory.

    The system is from its signal to its command. The function maps (signal, memory) to (rate or next memory, command).
    """
    sampled = isinstance(loop.controller, Sampled)
    inside, compute = controller_function(loop, as_signal)
    targets = len(jax.tree.leaves(as_signal(signal).target))

    def rest_residual(c: Array, s: Array = signal) -> Array:
        """Return a vector that is zero where the memory is at rest and the command holds the plant."""
        after, output = compute(c, s)
        return jnp.append(after - c if sampled else after, output - command)

    def find_rest(offset: Scalar) -> tuple[Array, Array]:
        """Return the memory at rest and the size of the residual; `offset` moves the target for the first step."""
        # At the setpoint itself the command may be at the edge of a limit, where its slope is zero. The first step
        # therefore uses the slopes at a nearby target.
        size = jnp.where(signal[:targets] == 0, 1.0, jnp.abs(signal[:targets]))
        slopes = jax.jacfwd(rest_residual)(inside, signal.at[:targets].add(offset * size))
        c = find_root(rest_residual, inside - jnp.linalg.pinv(slopes) @ rest_residual(inside))
        return c, jnp.sum(jnp.abs(rest_residual(c)))

    if inside.size:
        candidates, residuals = jax.vmap(find_rest)(jnp.asarray(TARGET_OFFSETS, inside.dtype))
        # The offset with the smallest finite residual.
        inside = candidates[jnp.argmin(jnp.where(jnp.isfinite(residuals), residuals, jnp.inf))]
    (f, g), (h, j) = jax.jacfwd(compute, (0, 1))(inside, signal)
    return (f, g, h, j), lambda s, c: jnp.append(*compute(c, s)), inside


def tracking_errors(output: PyTree, setpoint: PyTree) -> Array:
    """Return the tracked outputs minus their setpoints, as a vector."""
    return _flatten(outputs_like(output, setpoint)) - _flatten(setpoint)


def _flatten(signal: PyTree) -> Array:
    return ravel_pytree(signal)[0]


def in_series(first: Transfer, second: Transfer) -> Transfer:
    """Return minus the second system behind the first (negative feedback); the first has no direct path."""
    n, m = len(first.A), len(second.A)
    a = np.block([[first.A, np.zeros((n, m))], [second.B @ first.C, second.A]])
    b = np.concatenate([first.B, np.zeros((m, np.shape(first.B)[1]))])
    c = -np.hstack([second.D @ first.C, second.C])
    return Transfer(a, b, c, np.zeros((len(c), b.shape[1])), second.period)


def sample_plant(plant: Transfer, period: float, delay: float) -> Transfer:
    """Return the sampled plant for an input that is held and changes `delay`, 0 to `period`, after each instant.

    The plant has no direct path.
    """
    n, m = np.shape(plant.B)
    (a, _, after), (whole, late, early) = hold_input(plant.A, plant.B, np.array([period, delay, period - delay]))
    if not delay:
        return Transfer(a, whole, plant.C, plant.D, period)
    # The state is followed by the input before the instant, which acts until `delay`.
    a = np.block([[a, after @ late], [np.zeros((m, n + m))]])
    b = np.concatenate([early, np.eye(m)])
    return Transfer(a, b, np.hstack([plant.C, np.zeros((len(plant.C), m))]), plant.D, period)


def split_delay(delay: float, period: float) -> tuple[int, float]:
    """Return a delay [s] as whole periods, and the rest [s]; a rest of a rounding is 0."""
    whole = int(np.floor(delay / period + WHOLE_PERIOD_TOLERANCE))
    rest = max(delay - whole * period, 0.0)
    return whole, rest if rest > WHOLE_PERIOD_TOLERANCE * period else 0.0


def drop_unobserved_states(system: Transfer) -> Transfer:
    """Return a system without the states that do not influence its output."""
    observed = (system.C != 0).any(axis=0)
    # Each pass adds the states that influence an observed one; as many passes as states reach all of them.
    for _ in observed:
        observed = observed | (system.A[observed] != 0).any(axis=0)
    return system._replace(A=system.A[np.ix_(observed, observed)], B=system.B[observed], C=system.C[:, observed])
