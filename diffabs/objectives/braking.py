"""What a braking run costs: time, distance, locked wheel, effort of the brake."""

import math
from typing import NamedTuple

import jax.numpy as jnp

from diffabs.core.numerics import ratio
from diffabs.core.protocols import Ending, Memory, Sample
from diffabs.core.pytree import Scalar, param, pytree
from diffabs.objectives.tracking import FinalError, from_zero, integral, nothing, unchanged


@pytree
class StopTime:
    """Time to the stop [s]. A run that did not stop gets t + v/a with its last deceleration."""

    unit = "s"
    physical = (0.0, math.inf)

    start, flow, update = FinalError.start, nothing, unchanged

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Time of the last sample and what is left."""
        del memory
        return ending.sample.t + ending.time_left


@pytree
class StopDistance:
    """Distance to the stop [m]. A run that did not stop gets x + v^2/(2 a), so that rolling on is never the best."""

    unit = "m"
    physical = (0.0, math.inf)

    start, flow, update = FinalError.start, nothing, unchanged

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Distance of the last sample and what is left."""
        del memory
        return ending.sample.output.distance + ending.distance_left


@pytree
class LockedTime:
    """Time [s] during which the slip exceeds `threshold`. Crossings are interpolated linearly inside a step."""

    unit = "s"
    failure = 0.0  # a wheel that locks
    physical = (0.0, math.inf)

    threshold: Scalar = param(default=0.99, unit="1", above=0.0, below=1.0)

    flow = nothing

    def start(self, sample: Sample) -> Memory:
        """Zero."""
        return Memory(held=0.0 * sample.t)

    def update(self, memory: Memory, before: Sample, sample: Sample, h: Scalar) -> Scalar:
        """Add the part of the step above the threshold."""
        a, b = before.output.slip - self.threshold, sample.output.slip - self.threshold
        crossing = ratio(jnp.maximum(a, b), jnp.abs(a - b))
        part = jnp.where((a > 0) & (b > 0), 1.0, jnp.where((a > 0) | (b > 0), crossing, 0.0))
        return memory.held + part * h

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Locked time."""
        del ending
        return memory.held


@pytree
class Effort:
    """Integral of u^2 dt [N^2 m^2 s], u the torque that the actuator delivers."""

    unit = "control^2 s"
    physical = (0.0, math.inf)

    start, update, value = from_zero, unchanged, integral

    def flow(self, memory: Memory, sample: Sample) -> Scalar:
        """u^2."""
        del memory
        return sample.control**2


class Varied(NamedTuple):
    """Variation so far, and the last torque."""

    total: Scalar
    last: Scalar


@pytree
class Variation:
    """Total variation of the torque, sum of |u_(k+1) - u_k| [N m]: what chattering costs."""

    unit = "control"
    physical = (0.0, math.inf)

    flow = nothing

    def start(self, sample: Sample) -> Memory:
        """From the first torque."""
        return Memory(held=Varied(0.0 * sample.control, sample.control))

    def update(self, memory: Memory, before: Sample, sample: Sample, h: Scalar) -> Varied:
        """Add the change since the last sample, jumps between steps included."""
        del before, h
        total, last = memory.held
        return Varied(total + jnp.abs(sample.control - last), sample.control)

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Variation."""
        del ending
        return memory.held.total


class Rate(NamedTuple):
    """Greatest rate so far, the last torque, and the length of the longest step."""

    greatest: Scalar
    last: Scalar
    step: Scalar


@pytree
class TorqueRate:
    """Greatest |du/dt| [N m/s] of the torque that the actuator delivers, as a difference quotient over a step.

    A shorter last step, which lands on the end of the run, does not count. Behind a lag the rate is finite; of a
    controller's own jumps the quotient says no more than jump/step.
    """

    unit = "control/s"
    physical = (0.0, math.inf)

    flow = nothing

    def start(self, sample: Sample) -> Memory:
        """From the first torque."""
        zero = 0.0 * sample.control
        return Memory(held=Rate(zero, sample.control, zero))

    def update(self, memory: Memory, before: Sample, sample: Sample, h: Scalar) -> Rate:
        """Look at the step."""
        del before
        greatest, last, step = memory.held
        whole = jnp.greater(h, 0.5 * step)
        rate = jnp.where(whole, jnp.abs(sample.control - last) / jnp.where(whole, h, 1.0), 0.0)
        return Rate(jnp.maximum(greatest, rate), sample.control, jnp.maximum(step, h))

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Greatest rate."""
        del ending
        return memory.held.greatest
