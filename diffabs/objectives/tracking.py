"""How well a run follows its setpoint: peak, overshoot, settling, integrals of the error. They read the first signal
that the plant shows, y: a brake's slip, a servo's angle.

The error e = y - setpoint is against where the reference will settle, not against a filtered target on its way
there."""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from diffabs.core.numerics import clamp, larger, parabola, ratio, sign, smaller
from diffabs.core.protocols import Ending, Memory, Sample
from diffabs.core.pytree import Scalar, Vector, param, pytree

LEAST = 0.01  # of the first signal, of which an overshoot is a fraction


def nothing(self: Any, memory: Memory, sample: Sample) -> Any:
    """`flow` of an objective without an integral."""
    del self, memory, sample
    return ()


def unchanged(self: Any, memory: Memory, before: Sample, sample: Sample, h: Scalar) -> Any:
    """`update` of an objective that is only an integral."""
    del self, before, sample, h
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


class Area(NamedTuple):
    """Integral of the absolute value so far, and of the value itself."""

    total: Scalar
    signed: Scalar


def _area(memory: Memory, a: Scalar, b: Scalar, left: Scalar, right: Scalar, crossing: Scalar) -> Area:
    """Add a step. Where the value changes sign, from a to b, `left` and `right` are its integrals on either side of
    the `crossing` (a fraction of the step) if it were linear; the whole is exact to the order of the method."""
    total, signed = memory.held
    whole = memory.flow - signed
    rest = (whole - left - right) * (crossing * sign(a) + (1 - crossing) * sign(b))
    part = jnp.where(a * b < 0, jnp.abs(left) + jnp.abs(right) + rest, jnp.abs(whole))
    return Area(total + part, memory.flow)


@pytree
class IAE:
    """Integral of |e| dt, e = y - setpoint: for a slip [s].

    e is integrated with the plant; |e|, whose kink would cost the method its order and the derivative its smoothness,
    is put together step by step, with the crossings of zero interpolated linearly.
    """

    unit = "signal s"
    physical = (0.0, math.inf)

    def start(self, sample: Sample) -> Memory:
        """Zero."""
        zero = 0.0 * sample.output[0]
        return Memory(zero, Area(zero, zero))

    def flow(self, memory: Memory, sample: Sample) -> Scalar:
        """e."""
        del memory
        return error(sample)

    def update(self, memory: Memory, before: Sample, sample: Sample, h: Scalar) -> Area:
        """Add |e| over the step."""
        a, b = error(before), error(sample)
        part = clamp(ratio(a, a - b), 0.0, 1.0)
        return _area(memory, a, b, 0.5 * h * part * a, 0.5 * h * (1 - part) * b, part)

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Integral."""
        del ending
        return memory.held.total


@pytree
class ITAE:
    """Integral of t |e| dt, by the method of IAE: for a slip [s^2]."""

    unit = "signal s^2"
    physical = (0.0, math.inf)

    start, value = IAE.start, IAE.value

    def flow(self, memory: Memory, sample: Sample) -> Scalar:
        """t e."""
        del memory
        return sample.t * error(sample)

    def update(self, memory: Memory, before: Sample, sample: Sample, h: Scalar) -> Area:
        """Add t |e| over the step."""
        a, b = error(before), error(sample)
        part = clamp(ratio(a, a - b), 0.0, 1.0)
        head, tail = part * h, (1 - part) * h
        left = a * head * (before.t / 2 + head / 6)
        right = b * tail * ((before.t + head) / 2 + tail / 3)
        return _area(memory, a, b, left, right, part)


class Peak(NamedTuple):
    """Greatest value so far, and the last two samples."""

    greatest: Scalar
    last: Scalar
    earlier: Scalar


class Sided(NamedTuple):
    """1, or -1 below a setpoint of 0; and the peak of the value on that side."""

    side: Scalar
    peak: Peak


def _first(value: Scalar) -> Memory:
    """The greatest of one value."""
    return Memory(held=Peak(value, value, value))


def _peaked(held: Peak, value: Scalar, most: Scalar) -> Peak:
    """Look for a vertex, at most `most`, at the last sample but one."""
    greatest, last, earlier = held
    turned = (last > earlier) & (last > value)
    vertex = jnp.where(turned, smaller(parabola(earlier, last, value)[1], most), value)
    return Peak(larger(greatest, larger(vertex, value)), value, last)


@pytree
class MaxSlip:
    """Greatest slip of the run [1]: the vertex of the parabola through the three samples around it, at most 1."""

    unit = "1"
    physical = (-1.0, 1.0)

    flow = nothing

    def start(self, sample: Sample) -> Memory:
        """The first slip."""
        return _first(sample.output.slip)

    def update(self, memory: Memory, before: Sample, sample: Sample, h: Scalar) -> Peak:
        """Look for a vertex at the last sample but one."""
        del before, h
        return _peaked(memory.held, sample.output.slip, 1.0)

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Greatest slip."""
        del ending
        return memory.held.greatest


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
        return Memory(held=Sided(side, _first(side * sample.output[0]).held))

    def update(self, memory: Memory, before: Sample, sample: Sample, h: Scalar) -> Sided:
        """Look for a vertex at the last sample but one."""
        del before, h
        side, peak = memory.held
        return Sided(side, _peaked(peak, side * sample.output[0], highest(sample.output)))

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Overshoot."""
        side, (greatest, *_) = memory.held
        setpoint = side * ending.sample.setpoint
        usual = setpoint >= LEAST
        fraction = greatest / jnp.where(usual, setpoint, LEAST) - 1
        excess = jnp.where(usual, fraction, (greatest - setpoint) / LEAST)
        return jnp.where(excess > 0, excess, 0.0)


@pytree
class SettlingTime:
    """Time [s] after which |y - setpoint| stays within `band`; the end of the run if it never does.

    The entry is interpolated linearly between samples.
    """

    unit = "s"
    physical = (0.0, math.inf)

    band: Scalar = param(default=0.01, unit="signal", above=0.0)

    flow = nothing

    def start(self, sample: Sample) -> Memory:
        """Settled from the start."""
        return Memory(held=0.0 * sample.t)

    def update(self, memory: Memory, before: Sample, sample: Sample, h: Scalar) -> Scalar:
        """Note the last entry; while outside, the present time."""
        a, b = jnp.abs(error(before)), jnp.abs(error(sample))
        late = clamp(ratio(self.band - b, a - b), 0.0, 1.0)
        return jnp.where(b > self.band, sample.t, jnp.where(a > self.band, sample.t - late * h, memory.held))

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Settling time."""
        del ending
        return memory.held


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
