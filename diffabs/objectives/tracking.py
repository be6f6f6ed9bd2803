"""How well a run follows its setpoint: peak, overshoot, settling, integrals of the error. They read the first signal
that the plant shows, y: a brake's slip, a servo's angle.

The error e = y - setpoint is against where the reference will settle, not against a filtered target on its way
there."""

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.cubic import Cubic
from diffabs.core.numerics import later_of_larger, sign, smaller
from diffabs.core.protocols import Ending, Memory, Sample, Segment
from diffabs.core.pytree import Scalar, Vector, param, pytree

LEAST = 0.01  # of the first signal, of which an overshoot is a fraction


def nothing(self: Any, memory: Memory, sample: Sample) -> Any:
    """`flow` of an objective without an integral."""
    del self, memory, sample
    return ()


def unchanged(self: Any, memory: Memory, segment: Segment) -> Any:
    """`update` of an objective that is only an integral."""
    del self, segment
    return memory.held


def integral(self: Any, memory: Memory, ending: Ending) -> Scalar:
    """`value` of an objective that is only an integral."""
    del self, ending
    return memory.flow


def from_zero(self: Any, sample: Sample) -> Memory:
    """`start` of an objective that is only an integral."""
    del self
    return Memory(flow=0.0 * sample.output[0])


def error(sample: Sample) -> Scalar:
    """The first signal - setpoint."""
    return sample.output[0] - sample.setpoint


def highest(output: Any) -> float:
    """The greatest value that the first signal can have; infinite where the output does not say."""
    return getattr(output, "highest", math.inf)


def _side(sample: Sample) -> Any:
    """-1 below a setpoint of 0, else 1."""
    return jnp.where(sample.setpoint < 0, -1.0, 1.0)


def absolute(cubic: Cubic, integral: Callable[[Any], Any]) -> Any:
    """The integral of |p| over [0, 1], where `integral(x)` is that of p, or of p times something positive, to x."""
    whole = integral(1.0)
    left = integral(cubic.root())
    return jnp.where(cubic.start * cubic.end < 0, jnp.abs(left) + jnp.abs(whole - left), jnp.abs(whole))


def held(self: Any, memory: Memory, ending: Ending) -> Scalar:
    """`value` of an objective that is what it remembers."""
    del self, ending
    return memory.held


def held_from_zero(self: Any, sample: Sample) -> Memory:
    """`start` of an objective that adds up what it sees."""
    del self
    return Memory(held=0.0 * sample.output[0])


@pytree
class IAE:
    """Integral of |e| dt, e = y - setpoint: for a slip [s]. The cubic of e is integrated on either side of its zero."""

    unit = "signal s"
    physical = (0.0, math.inf)

    start, flow, value = held_from_zero, nothing, held

    def update(self, memory: Memory, segment: Segment) -> Scalar:
        """Add |e| over the step."""
        e = segment.error()
        return memory.held + segment.h * absolute(e, e.integral)


@pytree
class ITAE:
    """Integral of t |e| dt, by the method of IAE: for a slip [s^2]."""

    unit = "signal s^2"
    physical = (0.0, math.inf)

    start, flow, value = held_from_zero, nothing, held

    def update(self, memory: Memory, segment: Segment) -> Scalar:
        """Add t |e| over the step."""
        e, t, h = segment.error(), segment.start.t, segment.h
        return memory.held + h * absolute(e, lambda x: t * e.integral(x) + h * e.moment(x))


class Sided(NamedTuple):
    """1, or -1 below a setpoint of 0; and the greatest value on that side."""

    side: Scalar
    greatest: Scalar


@pytree
class MaxSlip:
    """Greatest slip of the run [1], at most 1. Where the greatest of two maxima changes, its derivative jumps."""

    unit = "1"
    physical = (-1.0, 1.0)

    flow, value = nothing, held

    def start(self, sample: Sample) -> Memory:
        """The first slip."""
        return Memory(held=sample.output.slip)

    def update(self, memory: Memory, segment: Segment) -> Scalar:
        """The greatest of the step, from its cubic."""
        slip = segment.output(lambda output: output.slip).greatest()
        return later_of_larger(memory.held, smaller(slip, 1.0))


@pytree
class Overshoot:
    """max(0, max y/setpoint - 1), a fraction of the final setpoint [1], or of 0.01 where that is more: an estimator may
    end at a slip of 0. Where the first setpoint is negative, it is the same of -y. Zero derivative where there is none.
    """

    unit = "1"
    physical = (0.0, math.inf)

    flow = nothing

    def start(self, sample: Sample) -> Memory:
        """The first value, and the side on which it shall not go too far."""
        side = _side(sample)
        return Memory(held=Sided(side, side * sample.output[0]))

    def update(self, memory: Memory, segment: Segment) -> Sided:
        """The greatest of the step, from its cubic."""
        side, greatest = memory.held
        value = segment.output().times(side).greatest()
        return Sided(side, later_of_larger(greatest, smaller(value, highest(segment.end.output))))

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Overshoot."""
        side, greatest = memory.held
        setpoint = side * ending.sample.setpoint
        usual = setpoint >= LEAST
        fraction = greatest / jnp.where(usual, setpoint, LEAST) - 1
        excess = jnp.where(usual, fraction, (greatest - setpoint) / LEAST)
        return jnp.where(excess > 0, excess, 0.0)


@pytree
class SettlingTime:
    """Time [s] after which |y - setpoint| stays within `band`; the end of the run if it never does.

    The entry is the root of the cubic of a step. A visit outside that begins and ends within one step is not seen. The
    time jumps where a lobe just touches the band.
    """

    unit = "s"
    physical = (0.0, math.inf)

    band: Scalar = param(default=0.01, unit="signal", above=0.0)

    flow, value = nothing, held

    def start(self, sample: Sample) -> Memory:
        """Settled from the start."""
        return Memory(held=0.0 * sample.t)

    def update(self, memory: Memory, segment: Segment) -> Scalar:
        """Note the last entry; while outside, the present time."""
        e = segment.error()
        outside = e.times(sign(jax.lax.stop_gradient(e.start))).minus(self.band)
        beyond = jnp.abs(e.end) > self.band
        entered = segment.start.t + segment.h * outside.root()
        return jnp.where(beyond, segment.end.t, jnp.where(outside.start > 0, entered, memory.held))


@pytree
class FinalError:
    """|y - setpoint| at the end."""

    unit = "signal"
    physical = (0.0, math.inf)

    flow, update = nothing, unchanged

    def start(self, sample: Sample) -> Memory:
        """Nothing to remember."""
        del sample
        return Memory()

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Final error."""
        del memory
        return jnp.abs(error(ending.sample))


class Quadratic(NamedTuple):
    """Integral of the error, and of the cost."""

    error: Scalar
    cost: Scalar


@pytree
class QuadraticCost:
    """Integral of q1 x1^2 + q2 x2^2 + r (u - ff)^2 dt, x1 = integral of e, x2 = e: eq. (24) of Maeda and Sugiura with
    eps = 0.

    u is what the actuator delivers.
    """

    unit = ""
    physical = (0.0, math.inf)

    q: Vector = param(default=(1.0, 1.0), unit="1", low=0.0)
    r: Scalar = param(default=1.0, unit="1", above=0.0)

    update = unchanged

    def start(self, sample: Sample) -> Memory:
        """Zero."""
        return Memory(flow=Quadratic(*(0.0 * sample.output[0],) * 2))

    def flow(self, memory: Memory, sample: Sample) -> Quadratic:
        """e, and the integrand."""
        x1, x2, u = memory.flow.error, error(sample), sample.control - sample.feedforward
        return Quadratic(x2, self.q[0] * x1**2 + self.q[1] * x2**2 + self.r * u**2)

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Cost."""
        del ending
        return memory.flow.cost

    def problems(self) -> Iterator[str]:
        """Weights of the wrong length."""
        if np.shape(self.q) != (2,):
            yield f"q has shape {np.shape(self.q)}; it needs (2,): integral and error"
