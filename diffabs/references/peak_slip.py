"""References that find the best slip: the slip at which the measured deceleration was greatest.

Aoki and Nakamura, sec. 4, fig. 5: a running maximum of the deceleration |a|; when it is exceeded, the target becomes
the present slip. Read literally this cannot brake: while friction rises the target equals the slip, the error is zero,
and the car rolls on. `PeakLiteral` shows that. `PeakLatch` is the reading that reproduces the paper's table 2: brake
with the first target until |a| first falls below its maximum, then take the slip at that maximum. `PeakRobust` is the
latch for a noisy accelerometer.

The maximum is an event: where the rate of the deceleration falls through zero, or where the deceleration itself jumps
down, as the noise of a sampled accelerometer does. A step of the integration ends there, and the slip is the slip
there: the run does not depend on the grid, and is differentiable."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.protocols import BrakeOutput, Clock, Memory, no_flow
from diffabs.core.pytree import Scalar, param, pytree

# A later maximum counts only if it exceeds the greatest by this fraction: a controller that holds the best slip keeps
# the deceleration at its maximum to rounding, and comparisons of equal numbers would then decide on derivatives.
SLIP_MARGIN = 1e-6
MIN_DECELERATION = 1e-3  # m/s^2, of a maximum: that of a wheel that still rolls, before the torque comes, is rounding


class PeakMemory(NamedTuple):
    """1 once latched; greatest |a| [m/s^2] and the slip [1] there; target [1]."""

    latched: Scalar
    greatest: Scalar
    slip: Scalar
    target: Scalar


def _size(signal: BrakeOutput) -> Any:
    """|a|, as the paper has it. It matters where the accelerometer has a forward bias: it shows an acceleration before
    the wheel slips, whose size falls before it rises."""
    return jnp.abs(signal.deceleration)


def _fresh_memory(target: Scalar, deceleration: Scalar, slip: Scalar) -> PeakMemory:
    zero = 0.0 * deceleration
    return PeakMemory(zero, zero + MIN_DECELERATION, slip, target + zero)


@pytree
class PeakLiteral:
    """The estimator as printed: whenever |a| exceeds its maximum, target := slip. It does not brake; kept as
    evidence."""

    slip: Scalar = param(default=0.2, unit="1", above=0.0, high=1.0)

    every_step = True  # how little it brakes is the delay of one sample
    flow = no_flow

    def start(self, signal: BrakeOutput) -> Memory:
        """Maximum so far: the first sample."""
        size = _size(signal)
        return Memory(held=_fresh_memory(self.slip, size, signal.slip)._replace(greatest=size))

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> Scalar:
        """Target slip [1]."""
        del t, signal
        return memory.held.target

    def setpoint(self, memory: Memory) -> Scalar:
        """The target as known now."""
        return memory.held.target

    def tick(self, clock: Clock, memory: Memory, signal: BrakeOutput) -> Memory:
        """Follow the slip while |a| rises."""
        m: PeakMemory = memory.held
        size = _size(signal)
        exceeds = clock.ticks()[0] & (size > m.greatest)
        greatest = jnp.where(exceeds, size, m.greatest)
        target = jnp.where(exceeds, signal.slip, m.target)
        return Memory(held=m._replace(greatest=greatest, target=target))


@pytree
class PeakLatch:
    """target = slip until |a| first falls, then the slip at its maximum; a later, greater one moves the target there.

    For an exact accelerometer: noise of 0.05 m/s^2 at 1 kHz latches at once and at the wrong slip. So does a forward
    bias, under which |a| falls through zero before it rises.
    """

    slip: Scalar = param(default=0.2, unit="1", above=0.0, high=1.0)

    flow = no_flow
    output = PeakLiteral.output
    setpoint = PeakLiteral.setpoint

    def start(self, signal: BrakeOutput) -> Memory:
        """No maximum yet."""
        return Memory(held=_fresh_memory(self.slip, _size(signal), signal.slip))

    def margins(self, t: Scalar, memory: Memory, signal: BrakeOutput, rate: Callable[[], BrakeOutput]) -> tuple[Any]:
        """d|a|/dt where |a| is greater than ever, else its size."""
        del t
        m: PeakMemory = memory.held
        return (_falling_rate(_rate(_size, signal, rate()), _size(signal), m),)

    def event(self, t: Scalar, memory: Memory, signal: BrakeOutput, fired: tuple[Any]) -> Memory:
        """Latch at a maximum greater than all before."""
        del t
        m: PeakMemory = _record_peak(memory.held, fired[0], _size(signal), signal.slip)
        latched = jnp.where(fired[0], 1.0, m.latched)
        return Memory(held=m._replace(latched=latched, target=jnp.where(fired[0], signal.slip, m.target)))


class FilterMemory(NamedTuple):
    """Low-passed deceleration [m/s^2] and slip [1]."""

    deceleration: Scalar
    slip: Scalar


@pytree
class PeakRobust:
    """The latch for noisy and biased sensors: deceleration (with its sign: the size of noise has a mean) and slip pass
    the same low-pass (so their delays cancel), nothing happens below `arming`, and the fall must exceed the fraction
    `threshold` of the maximum."""

    slip: Scalar = param(default=0.2, unit="1", above=0.0, high=1.0)
    time_constant: Scalar = param(default=0.02, unit="s", above=0.0)
    threshold: Scalar = param(default=0.03, unit="1", above=0.0, below=1.0)
    arming: Scalar = param(default=3.0, unit="m/s^2", low=0.0, tunable=False)

    output = PeakLiteral.output
    setpoint = PeakLiteral.setpoint

    def start(self, signal: BrakeOutput) -> Memory:
        """Filters at the first sample."""
        flow = FilterMemory(signal.deceleration, signal.slip)
        return Memory(flow, _fresh_memory(self.slip, *flow))

    def flow(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> FilterMemory:
        """First-order low-pass of both signals."""
        del t
        a, s = memory.flow
        return FilterMemory((signal.deceleration - a) / self.time_constant, (signal.slip - s) / self.time_constant)

    def margins(
        self, t: Scalar, memory: Memory, signal: BrakeOutput, rate: Callable[[], BrakeOutput]
    ) -> tuple[Any, Any]:
        """The rate of the filtered deceleration where that is greater than ever, else its size; and, until it has
        latched, how far the filtered deceleration is above the threshold."""
        del rate
        m: PeakMemory = memory.held
        a = memory.flow.deceleration
        level = a - (1 - self.threshold) * m.greatest
        waits = (m.latched < 0.5) & (m.greatest > self.arming)
        moving = self.flow(t, memory, signal).deceleration
        return _falling_rate(moving, a, m), jnp.where(waits, level, jnp.abs(level))

    def event(self, t: Scalar, memory: Memory, signal: BrakeOutput, fired: tuple[Any, Any]) -> Memory:
        """Record the maximum; latch at the threshold below it; follow a later, greater one."""
        del t, signal
        a, s = memory.flow
        m: PeakMemory = _record_peak(memory.held, fired[0], a, s)
        moves = fired[1] | (fired[0] & (m.latched > 0.5))
        latched = jnp.where(fired[1], 1.0, m.latched)
        return Memory(memory.flow, m._replace(latched=latched, target=jnp.where(moves, m.slip, m.target)))


def _rate(size: Callable[[BrakeOutput], Any], signal: BrakeOutput, rate: BrakeOutput) -> Any:
    return jax.jvp(size, (signal,), (rate,))[1]


def _falling_rate(rate: Scalar, deceleration: Scalar, m: PeakMemory) -> Any:
    """The rate where the deceleration is greater than ever, else the size of the rate: a margin that falls through zero
    at a new maximum only."""
    return jnp.where(deceleration > (1 + SLIP_MARGIN) * m.greatest, rate, jnp.abs(rate))


def _record_peak(m: PeakMemory, new: Any, deceleration: Scalar, slip: Scalar) -> PeakMemory:
    return m._replace(greatest=jnp.where(new, deceleration, m.greatest), slip=jnp.where(new, slip, m.slip))
