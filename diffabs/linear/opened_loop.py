"""Any loop, opened at its controller's command and linearised: what margins and Bode plots are about.

    command v --> [delay] --> actuator --> plant --> sensor --> controller --> command u,     L = -du/dv

The loop is taken at rest on its setpoint: everything stands still, and the first signal that the plant shows is the
setpoint. A plant with `frozen` outputs (the speed of a brake) holds them, as in `linearization.tracking`. Blocks are
differentiated as they are, so whatever is smooth there needs no rule of its own: lags, filters of a sensor, a gain
schedule, an observer. A `Sampled` controller makes the loop discrete: everything before it is sampled exactly under a
held input, also behind a delay that is no whole number of periods. Limits do not act at rest, noise and the motion of
the target are disturbances."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from diffabs.actuators import Delay
from diffabs.controllers import Sampled
from diffabs.core.blocks import Direct, Series, offers
from diffabs.core.loop import Loop
from diffabs.core.protocols import Clock, Memory, Tracking
from diffabs.core.pytree import canonical_dtypes
from diffabs.core.tracing import depends_on_signal
from diffabs.linear.linearization import StateSpace, independent_components
from diffabs.linear.operating_point import MAX_REST_RESIDUE, find_root
from diffabs.linear.transfer import WHOLE_PERIOD_TOLERANCE, Transfer
from diffabs.linear.zero_order_hold import discretise_held_input

TARGET_OFFSETS = (0.0, 1e-4, -1e-4, 1e-2, -1e-2)  # of the target, relative, in which directions a limit is left


class OpenLoop(NamedTuple):
    """The two halves of an open loop: `plant`, in continuous time, from the command to all that the controller is
    given, and `controller`, from that to the command; the pure delay between them [s]."""

    plant: Transfer
    controller: Transfer
    delay: float

    @property
    def period(self) -> float | None:
        """Of the controller [s]; None in continuous time."""
        return self.controller.period

    def transfer(self, more: float = 0.0) -> Transfer:
        """The open loop L, from the command to its negative; `more` is added to the delay [s]."""
        delay = self.delay + more
        if self.period is None:
            return _drop_unobserved_states(_series(self.plant, self.controller)._replace(delay=delay))
        whole = int(np.floor(delay / self.period + WHOLE_PERIOD_TOLERANCE))
        rest = max(delay - whole * self.period, 0.0)
        plant = _sample_plant(self.plant, self.period, rest if rest > WHOLE_PERIOD_TOLERANCE * self.period else 0.0)
        return _drop_unobserved_states(_series(plant, self.controller)._replace(delay=whole * self.period))


def open_loop(loop: Loop, target: Any = None) -> OpenLoop:
    """Return a loop, linearised at rest on its setpoint and opened at the controller's command.

    target: another setpoint, in the unit of the first signal; of a reference that finds its target, where it will be
    Raises:
        ValueError: a block that acts at instants (a relay, a controller that computes in every step but is not
            `Sampled`), a plant that does not come to rest at the setpoint, a command that nothing measured acts on.
    """
    rational, delay = _split_off_delays(loop)
    _check_continuous(rational)
    found = jax.device_get(
        _linearize_halves(rational, _start_output_and_setpoint(loop)[1] if target is None else float(target))
    )
    if not found.residue < MAX_REST_RESIDUE:
        raise ValueError(f"plant {type(loop.plant).__name__} does not come to rest at the setpoint: no linear model")
    sampled = loop.controller if isinstance(loop.controller, Sampled) else None
    delay += float(sampled.delay) if sampled else 0.0
    controller = Transfer(*found.controller)._replace(period=float(sampled.period) if sampled else None)
    model = OpenLoop(Transfer(*found.plant), controller, delay)
    if not len(model.transfer().A):
        raise ValueError(
            f"controller {type(loop.controller).__name__}: its command does not follow what is measured at the "
            "setpoint (at a limit, or by steps); there is no linear loop"
        )
    return model


def _split_off_delays(loop: Loop) -> tuple[Loop, float]:
    """The loop without its actuator's pure delays, and their sum [s]: they commute with what is linear."""
    blocks = loop.actuator.blocks if isinstance(loop.actuator, Series) else (loop.actuator,)
    delay = float(sum(block.time for block in blocks if isinstance(block, Delay)))
    left = tuple(block for block in blocks if not isinstance(block, Delay))
    return dataclasses.replace(loop, actuator=Series(blocks=left) if left else Direct()), delay  # pyright: ignore


def _check_continuous(loop: Loop) -> None:
    """Raises ValueError for a block that changes at instants by what it is given."""
    start = loop.start()
    given = {
        "sensor": loop.plant.output(start.plant),
        "actuator": 0.0 * loop.plant.holding(*_start_output_and_setpoint(loop)),
    }
    if not isinstance(loop.controller, Sampled):
        given["controller"] = None
    for name, signal in given.items():
        block = getattr(loop, name)
        if offers(block, "margins") or (offers(block, "tick") and (signal is None or _ticks_use_signal(block, signal))):
            hint = ": put it into a sampled controller" if name == "controller" and not offers(block, "margins") else ""
            raise ValueError(f"{name} {type(block).__name__} acts at instants: it has no linear model{hint}")


def _ticks_use_signal(block: Any, signal: Any) -> bool:
    """Whether a block's ticks look at its signal; noise does not."""
    memory, clock = block.start(signal), Clock(0.0, 1e-3, 1, jax.random.key(0))
    return depends_on_signal(lambda signal: block.tick(clock, memory, signal).held, signal)


class _SurroundingStates(NamedTuple):
    """What is integrated around the controller."""

    plant: Any
    sensor: Any
    actuator: Any


class _LinearHalves(NamedTuple):
    """Matrices (A, B, C, D) of both halves; how far from rest they were taken, relative to the state."""

    plant: Any
    controller: Any
    residue: Any


def _start_output_and_setpoint(loop: Loop) -> tuple[Any, Any]:
    """What the plant shows at the start, and the setpoint."""
    start = loop.start()
    return loop.plant.output(start.plant), loop.reference.setpoint(start.reference)


@jax.jit
def _linearize_halves(loop: Loop, setpoint: Any) -> _LinearHalves:
    loop, setpoint = canonical_dtypes((loop, setpoint))
    around, free, residue = _find_rest(loop, setpoint)
    z, command = free[:-1], free[-1]
    signal, as_signal = ravel_pytree(around.signal(z))
    by_z, b = jax.jacfwd(around.moves, (0, 1))(z, command)
    chart = jax.jacfwd(around.chart)(z)
    n = len(z) - around.held
    a, c = (jnp.linalg.solve(chart.T, m.T).T[:, :n] for m in (by_z, jax.jacfwd(around.signals)(z)))
    plant = (a[:n], b[:n, None], c, jnp.zeros((len(signal), 1), a.dtype))
    return _LinearHalves(plant, _linearize_controller(loop, signal, as_signal, command), residue)


class _Surroundings:
    """Plant, sensor and actuator of a loop as functions of one vector z. Coordinates: the tracked signal, the states
    that neither it nor the frozen outputs depend on, sensor, actuator, and last the `held` frozen outputs."""

    def __init__(self, loop: Loop, setpoint: Any):
        state = loop.start()
        parts = _SurroundingStates(state.plant, state.sensor.flow, state.actuator.flow)
        self.loop, self.setpoint = loop, setpoint
        self.memory = (state.sensor.held, state.actuator.held)
        self.start, self.unravel = ravel_pytree(parts)
        self.frozen: Any = tuple(getattr(loop.plant, "frozen", ()))
        first = loop.plant.shows._fields[0]
        size = ravel_pytree(state.plant)[0].size
        kept = (
            independent_components(loop.plant, state.plant, (first, *self.frozen)) if self.frozen else np.arange(size)
        )
        self.kept, self.size, self.held = kept, size, len(self.frozen)

    def output(self, z: Any) -> Any:
        """What the plant shows."""
        return self.loop.plant.output(self.unravel(z).plant)

    def signal(self, z: Any) -> Tracking:
        """What the controller is given, its target at the setpoint."""
        measured = self.loop.sensor.output(0.0, Memory(self.unravel(z).sensor, self.memory[0]), self.output(z))
        return Tracking(self.setpoint, measured, self.loop.feedforward.input(self.loop.plant, measured, self.setpoint))

    def signals(self, z: Any) -> Any:
        """The same as a vector."""
        return ravel_pytree(self.signal(z))[0]

    def flow(self, z: Any, command: Any) -> Any:
        """dz/dt."""
        x = self.unravel(z)
        actuator = Memory(x.actuator, self.memory[1])
        control = self.loop.actuator.output(0.0, actuator, command)
        rates = _SurroundingStates(
            self.loop.plant.derivative(0.0, x.plant, control),
            self.loop.sensor.flow(0.0, Memory(x.sensor, self.memory[0]), self.output(z)),
            self.loop.actuator.flow(0.0, actuator, command),
        )
        return ravel_pytree(rates)[0]

    def chart(self, z: Any) -> Any:
        """The coordinates."""
        if not self.frozen:
            return z
        y = self.output(z)
        last = jnp.stack([getattr(y, name) for name in self.frozen])
        return jnp.concatenate([y[0][None], z[self.kept], z[self.size :], last])

    def moves(self, z: Any, command: Any) -> Any:
        """The rates of the coordinates."""
        return jax.jvp(self.chart, (z,), (self.flow(z, command),))[1]

    def rest_residual(self, free: Any) -> Any:
        """Zero where all but the frozen outputs stand still, those are where they began, and the first signal is the
        setpoint."""
        z, command = free[:-1], free[-1]
        rates = self.moves(z, command)[: len(z) - self.held]
        where = self.chart(z)[len(z) - self.held :] - self.chart(self.start)[len(z) - self.held :]
        return jnp.concatenate([rates, where, (self.output(z)[0] - self.setpoint)[None]])


def _find_rest(loop: Loop, setpoint: Any) -> tuple[_Surroundings, Any, Any]:
    """The surroundings of the controller, (z, command) at rest, and how far from it they are."""
    around = _Surroundings(loop, setpoint)
    there = around.chart(around.start)
    there = there.at[0].set(around.setpoint) if around.frozen else there
    near = find_root(lambda z: around.chart(z) - there, around.start)  # on the setpoint, the rest as it starts
    guess = loop.plant.holding(around.output(near), around.setpoint)
    free = find_root(around.rest_residual, jnp.append(near, guess))
    return around, free, jnp.max(jnp.abs(around.rest_residual(free))) / (1 + jnp.max(jnp.abs(free)))


def _linearize_controller(loop: Loop, signal: Any, as_signal: Any, command: Any) -> Any:
    """(A, B, C, D) of the controller from its signal to the command, at rest where it commands what holds the plant."""
    controller, memory = loop.controller, loop.start().controller
    sampled = isinstance(controller, Sampled)
    inside, unravel = ravel_pytree(memory.held.inner if sampled else memory)

    def compute(c: Any, s: Any) -> tuple[Any, Any]:
        """The memory after a sample, or its rate; the command."""
        memory, tracking = unravel(c), as_signal(s)
        if not isinstance(controller, Sampled):
            rate = controller.flow(0.0, memory, tracking)
            return ravel_pytree(memory._replace(flow=rate))[0], controller.output(0.0, memory, tracking)
        clock = Clock(0.0, controller.period, 1, None, before=tracking)
        after, output = controller.computed(clock, memory, tracking)
        return ravel_pytree(after)[0], output

    def holding(c: Any, s: Any = signal) -> Any:
        """Zero where the memory is at rest and the command holds the plant."""
        after, output = compute(c, s)
        return jnp.append(after - c if sampled else after, output - command)

    def found(offset: Any) -> Any:
        """Where that is, and what is left of it. The first step has the slopes at a target that is a little off: at the
        setpoint itself the command may begin at a limit."""
        size = jnp.where(signal[0] == 0, 1.0, jnp.abs(signal[0]))
        slopes = jax.jacfwd(holding)(inside, signal.at[0].add(offset * size))
        c = find_root(holding, inside - jnp.linalg.pinv(slopes) @ holding(inside))
        return c, jnp.sum(jnp.abs(holding(c)))

    if inside.size:
        each, left = jax.vmap(found)(jnp.asarray(TARGET_OFFSETS, inside.dtype))
        inside = each[jnp.argmin(jnp.where(jnp.isfinite(left), left, jnp.inf))]
    (f, g), (h, j) = jax.jacfwd(compute, (0, 1))(inside, signal)
    return f, g, h[None], j[None]


def _series(first: Transfer, second: Transfer) -> Transfer:
    """The second system behind the first, which has no direct path; negated, for a loop whose feedback is negative."""
    n, m = len(first.A), len(second.A)
    a = np.block([[first.A, np.zeros((n, m))], [second.B @ first.C, second.A]])
    b = np.concatenate([first.B, np.zeros((m, np.shape(first.B)[1]))])
    c = -np.hstack([second.D @ first.C, second.C])
    return Transfer(a, b, c, np.zeros((len(c), b.shape[1])), second.period)


def _sample_plant(plant: Transfer, period: float, delay: float) -> Transfer:
    """The plant at the instants of a clock, its input held, and changed `delay` after them."""
    n, m = np.shape(plant.B)
    a, b = (np.asarray(x) for x in _discretise_compiled(StateSpace(plant.A, plant.B), period, delay))
    c = np.hstack([plant.C, np.zeros((len(plant.C), m))])
    if not delay:
        a, b, c = a[:n, :n], b[:n], plant.C
    return Transfer(a, b, c, plant.D, period)


_discretise_compiled = jax.jit(discretise_held_input)


def _drop_unobserved_states(system: Transfer) -> Transfer:
    """The system without the states that its output does not depend on, such as an integral whose gain is zero."""
    kept = (system.C != 0).any(axis=0)
    for _ in kept:
        kept = kept | (system.A[kept] != 0).any(axis=0)
    return system._replace(A=system.A[np.ix_(kept, kept)], B=system.B[kept], C=system.C[:, kept])
