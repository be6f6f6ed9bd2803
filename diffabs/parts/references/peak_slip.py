"""References that find the best slip: the slip of the greatest measured deceleration.

Aoki and Nakamura, sec. 4, fig. 5, keep a running maximum of the deceleration |a|. When |a| exceeds it, the target
becomes the present slip. Read literally, this rule cannot brake. While friction rises, the target equals the slip, the
error is zero, and the car rolls on. `PeakLiteral` shows this.

`PeakLatch` is the reading that reproduces the paper's table 2: brake with the first target until |a| first falls below
its maximum. Then take the slip at this maximum. `PeakRobust` is the latch for a noisy accelerometer.

The maximum is an event. It occurs where the rate of the deceleration falls through zero, or where the deceleration
itself jumps down. The noise of a sampled accelerometer causes such jumps. A step of the integration ends at the event,
and the slip is the slip there. The run therefore does not depend on the grid and is differentiable.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.protocols import BrakeOutput, Clock, Memory, no_flow
from diffabs.core.pytree import param, pytree
from diffabs.core.types import Bool, PyTree, Scalar

# A later maximum counts only if it exceeds the greatest by this fraction. A controller that holds the best slip keeps
# the deceleration equal to its maximum up to rounding; comparisons of equal numbers would then decide the derivatives.
SLIP_MARGIN = 1e-6
MIN_DECELERATION = 1e-3  # m/s^2, least maximum: a smaller deceleration of a free wheel is rounding


class PeakMemory(NamedTuple):
    """Memory of the running maximum.

    Attributes:
        latched: In `PeakRobust`, 1 once latched, else 0.
        greatest: Greatest |a| so far; in `PeakRobust`, of the signed filtered deceleration [m/s^2].
        slip: Slip at this maximum [1]; in `PeakLiteral`, the first slip.
        target: Target slip [1].
    """

    latched: Scalar
    greatest: Scalar
    slip: Scalar
    target: Scalar


def _size(signal: BrakeOutput) -> Scalar:
    """Return |a|, as in the paper.

    The absolute value matters for an accelerometer with a forward bias. Such a sensor shows an acceleration before the
    wheel slips, and |a| falls before it rises.
    """
    return jnp.abs(signal.deceleration)


def _fresh_memory(target: Scalar, deceleration: Scalar, slip: Scalar) -> PeakMemory:
    zero = 0.0 * deceleration
    return PeakMemory(zero, zero + MIN_DECELERATION, slip, target + zero)


@pytree
class PeakLiteral:
    """The paper's estimator as printed: whenever |a| exceeds its maximum, target := slip. It does not brake."""

    slip: Scalar = param(default=0.2, unit="1", above=0.0, high=1.0)
    """Target until |a| exceeds its first sample."""

    every_step = True  # ticks in every step: its braking comes only from the delay of one sample
    flow = no_flow

    def start(self, signal: BrakeOutput) -> Memory:
        """Return the memory with `slip` as the target and the first |a| as the maximum."""
        size = _size(signal)
        return Memory(held=_fresh_memory(self.slip, size, signal.slip)._replace(greatest=size))

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> Scalar:
        """Return the present target slip [1]."""
        del t, signal
        return memory.held.target

    def setpoint(self, memory: Memory) -> Scalar:
        """Return the present target slip [1]."""
        return memory.held.target

    def tick(self, clock: Clock, memory: Memory, signal: BrakeOutput) -> Memory:
        """Return the memory with the present slip as target if |a| exceeds its maximum."""
        m: PeakMemory = memory.held
        size = _size(signal)
        exceeds = clock.ticks()[0] & (size > m.greatest)
        greatest = jnp.where(exceeds, size, m.greatest)
        target = jnp.where(exceeds, signal.slip, m.target)
        return Memory(held=m._replace(greatest=greatest, target=target))


@pytree
class PeakLatch:
    """target = slip until |a| first falls, then the slip at the maximum of |a|; a later, greater maximum moves the
    target.

    It needs an exact accelerometer. Noise of 0.05 m/s^2 at 1 kHz latches at once and at the wrong slip. A forward bias
    does the same, because |a| falls through zero before it rises.
    """

    slip: Scalar = param(default=0.2, unit="1", above=0.0, high=1.0)
    """Target before the latch."""

    flow = no_flow
    output = PeakLiteral.output
    setpoint = PeakLiteral.setpoint

    def start(self, signal: BrakeOutput) -> Memory:
        """Return the memory with `slip` as the target and no maximum yet."""
        return Memory(held=_fresh_memory(self.slip, _size(signal), signal.slip))

    def margins(self, t: Scalar, memory: Memory, signal: BrakeOutput, rate: Callable[[], BrakeOutput]) -> tuple[PyTree]:
        """Return d|a|/dt [m/s^3] where |a| exceeds its maximum so far, else |d|a|/dt|.

        So the margin falls through zero only at a new maximum.
        """
        del t
        m: PeakMemory = memory.held
        return (_falling_rate(jax.jvp(_size, (signal,), (rate(),))[1], _size(signal), m),)

    def event(self, t: Scalar, memory: Memory, signal: BrakeOutput, fired: tuple[PyTree]) -> Memory:
        """Return the memory after the event: if it has fired, target and maximum are the present slip and |a|."""
        del t
        m: PeakMemory = _record_peak(memory.held, fired[0], _size(signal), signal.slip)
        return Memory(held=m._replace(target=jnp.where(fired[0], signal.slip, m.target)))


class FilterMemory(NamedTuple):
    """Low-pass filtered deceleration [m/s^2] and slip [1]."""

    deceleration: Scalar
    slip: Scalar


@pytree
class PeakRobust:
    """The latch for noisy and biased sensors: it filters the signals and latches after a fall by the fraction
    `threshold` of the maximum.

    Deceleration and slip pass the same low-pass filter, so their delays cancel. The deceleration keeps its sign,
    because the absolute value of noise has a nonzero mean. A maximum of at most `arming` does not latch.
    """

    slip: Scalar = param(default=0.2, unit="1", above=0.0, high=1.0)
    """Target before the latch."""
    time_constant: Scalar = param(default=0.02, unit="s", above=0.0)
    """Time constant of both low-pass filters."""
    threshold: Scalar = param(default=0.03, unit="1", above=0.0, below=1.0)
    """Fraction of the maximum by which the deceleration must fall."""
    arming: Scalar = param(default=3.0, unit="m/s^2", low=0.0, tunable=False)
    """Bound that the maximum must exceed for a latch."""

    output = PeakLiteral.output
    setpoint = PeakLiteral.setpoint

    def start(self, signal: BrakeOutput) -> Memory:
        """Return the memory with both filters at the first sample."""
        flow = FilterMemory(signal.deceleration, signal.slip)
        return Memory(flow, _fresh_memory(self.slip, *flow))

    def flow(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> FilterMemory:
        """Return the rates of both low-pass filters."""
        del t
        a, s = memory.flow
        return FilterMemory((signal.deceleration - a) / self.time_constant, (signal.slip - s) / self.time_constant)

    def margins(
        self, t: Scalar, memory: Memory, signal: BrakeOutput, rate: Callable[[], BrakeOutput]
    ) -> tuple[PyTree, PyTree]:
        """Return two margins: of a new maximum [m/s^3], and of the fall that latches [m/s^2].

        The first is the filtered deceleration's rate where it exceeds its maximum, else the absolute value of the rate.
        The second is the filtered deceleration minus (1 - threshold) times its maximum. After the latch, or while the
        maximum is at most `arming`, the second is an absolute value, so it causes no event.
        """
        del rate
        m: PeakMemory = memory.held
        a = memory.flow.deceleration
        level = a - (1 - self.threshold) * m.greatest
        waits = (m.latched < 0.5) & (m.greatest > self.arming)
        moving = self.flow(t, memory, signal).deceleration
        return _falling_rate(moving, a, m), jnp.where(waits, level, jnp.abs(level))

    def event(self, t: Scalar, memory: Memory, signal: BrakeOutput, fired: tuple[PyTree, PyTree]) -> Memory:
        """Return the memory after the events in `fired`: a new maximum, a latch, or both.

        A latch sets the target to the slip at the maximum. Once latched, a new maximum moves the target.
        """
        del t, signal
        a, s = memory.flow
        m: PeakMemory = _record_peak(memory.held, fired[0], a, s)
        moves = fired[1] | (fired[0] & (m.latched > 0.5))
        latched = jnp.where(fired[1], 1.0, m.latched)
        return Memory(memory.flow, m._replace(latched=latched, target=jnp.where(moves, m.slip, m.target)))


def _falling_rate(rate: Scalar, deceleration: Scalar, m: PeakMemory) -> Scalar:
    """Return the rate where the deceleration exceeds its maximum, else its absolute value.

    This margin falls through zero only at a new maximum.
    """
    return jnp.where(deceleration > (1 + SLIP_MARGIN) * m.greatest, rate, jnp.abs(rate))


def _record_peak(m: PeakMemory, new: Bool, deceleration: Scalar, slip: Scalar) -> PeakMemory:
    return m._replace(greatest=jnp.where(new, deceleration, m.greatest), slip=jnp.where(new, slip, m.slip))
