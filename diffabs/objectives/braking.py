"""What a braking run costs: time, distance, locked wheel, effort of the brake."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.numerics import larger
from diffabs.core.protocols import Ending, Memory, Sample, Segment
from diffabs.core.pytree import Scalar, param, pytree
from diffabs.objectives.tracking import (
    FinalError,
    held_value,
    integral_value,
    keep_memory,
    no_integral,
    start_held,
    start_integral,
)


@pytree
class StopTime:
    """Time to the stop [s]. A run that did not stop gets t + v/a with its last deceleration."""

    unit = "s"
    physical = (0.0, math.inf)

    start, flow, update = FinalError.start, no_integral, keep_memory

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Time of the last sample and what is left."""
        del memory
        return ending.sample.t + ending.time_left


@pytree
class StopDistance:
    """Distance to the stop [m]. A run that did not stop gets x + v^2/(2 a), so that rolling on is never the best."""

    unit = "m"
    physical = (0.0, math.inf)

    start, flow, update = FinalError.start, no_integral, keep_memory

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Distance of the last sample and what is left."""
        del memory
        return ending.sample.output.distance + ending.distance_left


@pytree
class LockedTime:
    """Time [s] during which the slip exceeds `threshold`. A crossing is the root of the cubic of a step."""

    unit = "s"
    failure = 0.0  # a wheel that locks
    physical = (0.0, math.inf)

    threshold: Scalar = param(default=0.99, unit="1", above=0.0, below=1.0)

    start, flow, value = start_held, no_integral, held_value

    def update(self, memory: Memory, segment: Segment) -> Scalar:
        """Add the part of the step above the threshold."""
        slip = segment.output(lambda output: output.slip).minus(self.threshold)
        above, below, root = slip.start > 0, slip.end <= 0, slip.root()
        part = jnp.where(above, jnp.where(below, root, 1.0), jnp.where(below, 0.0, 1.0 - root))
        return memory.held + part * segment.h


@pytree
class Effort:
    """Integral of u^2 dt, u what the actuator delivers: of a torque [N^2 m^2 s]."""

    unit = "control^2 s"
    physical = (0.0, math.inf)

    start, update, value = start_integral, keep_memory, integral_value

    def flow(self, memory: Memory, sample: Sample) -> Scalar:
        """u^2."""
        del memory
        return sample.control**2


class Varied(NamedTuple):
    """What is found so far, the last torque, and the sign of its last change."""

    total: Scalar
    last: Scalar
    way: Scalar


@pytree
class Variation:
    """Total variation of the control, a brake's torque [N m]: |du| added up along the run, jumps included. That is what
    chattering costs."""

    unit = "control"
    physical = (0.0, math.inf)

    flow = no_integral

    def start(self, sample: Sample) -> Memory:
        """From the first torque."""
        return Memory(held=Varied(0.0 * sample.control, sample.control, 0.0 * sample.control))

    def update(self, memory: Memory, segment: Segment) -> Varied:
        """Add the jump before the step, and what the torque does in it: there and back, where it has an extremum."""
        total, last, way = memory.held
        u = segment.sample(lambda sample: sample.control)
        top, bottom = u.greatest(), -u.times(-1.0).greatest()
        # A step without a length, to an event, has no rise yet: which way it moves with the event its rate says.
        up = jnp.where(u.start == u.end, segment.sample_rates()[0].control > 0, u.end > u.start)
        low, high = jnp.where(up, u.start, u.end), jnp.where(up, u.end, u.start)
        beyond = jnp.where(top > high, top - high, 0.0) + jnp.where(bottom < low, low - bottom, 0.0)
        # No jump may be one that a derivative is about to open: part of the change before it, which goes the same way.
        jump, rise = jax.lax.stop_gradient((u.start - last, u.end - u.start))
        way = jnp.where(jump != 0, jnp.sign(jump), way)
        total += way * (u.start - last) + (high - low) + 2.0 * beyond
        return Varied(total, u.end, jnp.where(rise != 0, jnp.sign(rise), way))

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """What was found."""
        del ending
        return memory.held.total


@pytree
class TorqueRate:
    """Greatest |du/dt| of what the actuator delivers, a torque [N m/s], at the instants of the integration. A jump
    counts as jump/step: behind a lag there is none."""

    unit = "control/s"
    physical = (0.0, math.inf)

    start, flow, value = Variation.start, no_integral, Variation.value

    def update(self, memory: Memory, segment: Segment) -> Varied:
        """The jump before the step, and the rates at its ends."""
        greatest, last, way = memory.held
        jump = jnp.abs(segment.start.control - last) / segment.step
        rates = (jnp.abs(rate.control) for rate in segment.sample_rates())
        return Varied(larger(larger(greatest, jump), larger(*rates)), segment.end.control, way)
