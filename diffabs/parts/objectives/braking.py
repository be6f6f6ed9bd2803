"""Objectives of a braking run: time, distance, locked wheel, effort of the brake."""

import math
from collections.abc import Callable, Iterator
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.numerics import larger, quotient
from diffabs.core.protocols import Ending, Memory, Sample, Segment
from diffabs.core.pytree import param, pytree
from diffabs.core.rules import Rule, order_rule
from diffabs.core.types import PyTree, Scalar
from diffabs.parts.objectives.tracking import FinalValue, HeldValue, Integral


@pytree
class StopTime(FinalValue):
    """Time to the stop [s]: the time of the last sample, plus the time that the loop's stop extrapolates.

    `Standstill` extrapolates to rest, v/a. A run that does not stop is extrapolated, too, with its last deceleration a
    of at least 0.001 m/s^2. `NoStop` adds nothing.
    """

    unit = "s"
    physical: ClassVar[tuple[float, float]] = (0.0, math.inf)

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Return the time of the last sample plus the remaining time [s]."""
        del memory
        return ending.sample.t + ending.time_left


@pytree
class StopDistance(FinalValue):
    """Distance to the stop [m]: the distance of the last sample, plus the distance that the loop's stop extrapolates.

    `Standstill` extrapolates to rest, v^2/(2 a). A run that does not stop is extrapolated, too, with its last
    deceleration a of at least 0.001 m/s^2. So rolling on is never optimal. `NoStop` adds nothing.
    """

    unit = "m"
    physical: ClassVar[tuple[float, float]] = (0.0, math.inf)

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Return the distance of the last sample plus the remaining distance [m]."""
        del memory
        return ending.sample.output.distance + ending.distance_left


@pytree
class LockedTime(HeldValue):
    """Time [s] during which the slip exceeds `threshold`; 0 if the wheel never locks.

    A root of the step's cubic locates each crossing.
    """

    unit = "s"
    failure: ClassVar[float] = 0.0  # a wheel that locks
    physical: ClassVar[tuple[float, float]] = (0.0, math.inf)

    threshold: Scalar = param(default=0.99, unit="1", above=0.0, below=1.0)
    """Slip from which on the wheel counts as locked."""

    def update(self, memory: Memory, segment: Segment) -> Scalar:
        """Return the sum with the part of the step above the threshold [s]."""
        return memory.held + _time_above(segment, lambda output: output.slip, self.threshold)


@pytree
class TimeBetweenSpeeds(HeldValue):
    """Time [s] that the vehicle takes from the speed `fast` to the speed `slow`."""

    unit = "s"
    physical: ClassVar[tuple[float, float]] = (0.0, math.inf)

    fast: Scalar = param(default=45 / 3.6, unit="m/s", above=0.0)
    """Speed at which the time begins."""
    slow: Scalar = param(default=15 / 3.6, unit="m/s", low=0.0)
    """Speed at which it ends, < fast."""

    def update(self, memory: Memory, segment: Segment) -> Scalar:
        """Return the sum with the part of the step between both speeds [s]."""
        slower, faster = (_time_above(segment, lambda output: output.speed, v) for v in (self.slow, self.fast))
        return memory.held + slower - faster

    def rules(self) -> Iterator[Rule]:
        """Yield the rule slow < fast."""
        yield order_rule(("slow", self.slow), ("fast", self.fast), "m/s", equal=False)


class Rise(NamedTuple):
    """Memory of `RiseTime`.

    Attributes:
        time: Time since the place [s], up to the rise.
        risen: 1 once the deceleration has risen, else 0.
    """

    time: Scalar
    risen: Scalar


@pytree
class RiseTime(HeldValue):
    """Time [s] from a place of the road until the deceleration reaches a value; infinite if it does not."""

    unit = "s"
    unreached: ClassVar[float] = math.inf
    physical: ClassVar[tuple[float, float]] = (0.0, math.inf)

    place: Scalar = param(default=10.0, unit="m", low=0.0)
    """Distance at which the time begins."""
    deceleration: Scalar = param(default=5.0, unit="m/s^2", above=0.0)
    """Deceleration that ends it."""

    def start(self, sample: Sample) -> Memory:
        """Return the memory with time 0."""
        zero = 0.0 * sample.output.deceleration
        return Memory(held=Rise(zero, zero))

    def update(self, memory: Memory, segment: Segment) -> Rise:
        """Return the time with the part of the step beyond the place and before the rise [s]."""
        way = segment.output(lambda output: output.distance).minus(self.place)
        begin = jnp.where(way.start > 0, 0.0, jnp.where(way.end > 0, way.root(), 1.0))
        rise = segment.output(lambda output: output.deceleration).minus(self.deceleration)
        end = jnp.where(rise.start >= 0, 0.0, jnp.where(rise.end >= 0, rise.root(), 1.0))
        open_ = memory.held.risen < 0.5
        time = memory.held.time + jnp.where(open_, larger(end - begin, 0.0), 0.0) * segment.h
        reached = (way.end > 0) & ((rise.end >= 0) | ((rise.start >= 0) & (way.start > 0)))
        return Rise(time, jnp.where(reached, 1.0, memory.held.risen))

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Return the time, or infinity."""
        del ending
        return jnp.where(memory.held.risen > 0.5, memory.held.time, jnp.inf)


def _time_above(segment: Segment, read: Callable[[PyTree], Scalar], threshold: Scalar) -> Scalar:
    """Return the part of a step with `read`(output) at or above a threshold [s]."""
    excess = segment.output(read).minus(threshold)
    # A crossing at the end of a step belongs to the next one, which begins at a root: there it has a derivative.
    above, below, root = excess.start >= 0, excess.end < 0, excess.root()
    return segment.h * jnp.where(above, jnp.where(below, root, 1.0), jnp.where(below, 0.0, 1.0 - root))


@pytree
class Effort(Integral):
    """Integral of u^2 dt, where u is the actuator's output, in the square of its unit times s; for a torque [N^2 m^2
    s].
    """

    unit = "control^2 s"
    physical: ClassVar[tuple[float, float]] = (0.0, math.inf)

    def flow(self, memory: Memory, sample: Sample) -> Scalar:
        """Return u^2."""
        del memory
        return sample.control**2


@pytree
class BrakeWork(Integral):
    """Work of a brake on its wheel [J]: the integral of torque and rim speed over the radius.

    With `InChannel` it is the work of one wheel or axle of a car.
    """

    unit = "J"
    physical: ClassVar[tuple[float, float]] = (-math.inf, math.inf)

    radius: Scalar = param(default=0.344, unit="m", above=0.0)
    """Radius of the wheel."""

    def flow(self, memory: Memory, sample: Sample) -> Scalar:
        """Return the power of the brake [W]."""
        del memory
        return quotient(sample.control * sample.output.wheel_speed, self.radius)


class Varied(NamedTuple):
    """Memory of `Variation` and of `TorqueRate`.

    Attributes:
        total: Total variation, or greatest rate, up to the end of the last step.
        last: Control at the end of the last step.
        way: Sign of the control's last change.
    """

    total: Scalar
    last: Scalar
    way: Scalar


@pytree
class Variation(HeldValue):
    """Total variation of the control, a brake's torque [N m]: the integral of |du| along the run, with jumps. It
    measures chattering.
    """

    unit = "control"
    physical: ClassVar[tuple[float, float]] = (0.0, math.inf)
    counts_kinks = True

    def start(self, sample: Sample) -> Memory:
        """Return the memory with the first control and variation 0."""
        return Memory(held=Varied(0.0 * sample.control, sample.control, 0.0 * sample.control))

    def update(self, memory: Memory, segment: Segment) -> Varied:
        """Return the sum with the jump before the step and the variation inside it, with both sides of an extremum."""
        total, last, way = memory.held
        u = segment.sample(lambda sample: sample.control)
        top, bottom = u.greatest(), -u.times(-1.0).greatest()
        # A step of zero length, before an event, has no rise: the sign of the rate gives the direction in which its end
        # moves with the event.
        up = jnp.where(u.start == u.end, segment.sample_rates()[0].control > 0, u.end > u.start)
        low, high = jnp.where(up, u.start, u.end), jnp.where(up, u.end, u.start)
        beyond = jnp.where(top > high, top - high, 0.0) + jnp.where(bottom < low, low - bottom, 0.0)
        # A jump of 0 still has a tangent when the step's two values move apart. It then belongs to the change before it
        # and takes the sign of this change.
        jump, rise = jax.lax.stop_gradient((u.start - last, u.end - u.start))
        way = jnp.where(jump != 0, jnp.sign(jump), way)
        total += way * (u.start - last) + (high - low) + 2.0 * beyond
        return Varied(total, u.end, jnp.where(rise != 0, jnp.sign(rise), way))

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Return the total variation."""
        del ending
        return memory.held.total


@pytree
class TorqueRate(HeldValue):
    """Greatest |du/dt| of the actuator's output u at the instants of the integration, for a torque [N m/s].

    A jump counts as its height divided by the grid's step, so it depends on the step. An actuator with a lag has no
    jumps.
    """

    unit = "control/s"
    physical: ClassVar[tuple[float, float]] = (0.0, math.inf)

    start, value = Variation.start, Variation.value

    def update(self, memory: Memory, segment: Segment) -> Varied:
        """Return the greatest rate up to the step's end, from the jump before the step and the rates at its ends."""
        greatest, last, way = memory.held
        jump = jnp.abs(segment.start.control - last) / segment.step
        rates = (jnp.abs(rate.control) for rate in segment.sample_rates())
        return Varied(larger(larger(greatest, jump), larger(*rates)), segment.end.control, way)
