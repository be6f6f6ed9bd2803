"""How well a run follows its slip: peak, overshoot, settling, integrals of the error.

The error e = slip - setpoint is against where the reference will settle, not against a filtered target on its way
there."""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from diffabs.core.numerics import clamp, larger, parabola, ratio, sign, smaller
from diffabs.core.protocols import Ending, Memory, Sample
from diffabs.core.pytree import Scalar, Vector, param, pytree

LEAST = 0.01  # slip of which an overshoot is a fraction


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
    return Memory(flow=0.0 * sample.output.slip)


def error(sample: Sample) -> Scalar:
    """slip - setpoint."""
    return sample.output.slip - sample.setpoint


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
    """Integral of |e| dt [s], e = slip - setpoint.

    e is integrated with the plant; |e|, whose kink would cost the method its order and the derivative its smoothness,
    is put together step by step, with the crossings of zero interpolated linearly.
    """

    physical = (0.0, math.inf)

    def start(self, sample: Sample) -> Memory:
        """Zero."""
        zero = 0.0 * sample.output.slip
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
    """Integral of t |e| dt [s^2], by the method of IAE."""

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


@pytree
class MaxSlip:
    """Greatest slip of the run [1]: the vertex of the parabola through the three samples around it, at most 1."""

    physical = (-1.0, 1.0)

    flow = nothing

    def start(self, sample: Sample) -> Memory:
        """The first slip."""
        return Memory(held=Peak(*(sample.output.slip,) * 3))

    def update(self, memory: Memory, before: Sample, sample: Sample, h: Scalar) -> Peak:
        """Look for a vertex at the last sample but one."""
        del before, h
        greatest, last, earlier = memory.held
        slip = sample.output.slip
        turned = (last > earlier) & (last > slip)
        vertex = jnp.where(turned, smaller(parabola(earlier, last, slip)[1], 1.0), slip)
        return Peak(larger(greatest, larger(vertex, slip)), slip, last)

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Greatest slip."""
        del ending
        return memory.held.greatest


@pytree
class Overshoot:
    """max(0, max slip/setpoint - 1), a fraction of the final setpoint [1], or of a slip of 0.01 where that is more: an
    estimator may end at 0. Zero derivative where there is none."""

    physical = (0.0, math.inf)

    flow = nothing
    start = MaxSlip.start
    update = MaxSlip.update

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Overshoot."""
        setpoint = ending.sample.setpoint
        usual = setpoint >= LEAST
        fraction = memory.held.greatest / jnp.where(usual, setpoint, LEAST) - 1
        excess = jnp.where(usual, fraction, (memory.held.greatest - setpoint) / LEAST)
        return jnp.where(excess > 0, excess, 0.0)


@pytree
class SettlingTime:
    """Time [s] after which |slip - setpoint| stays within `band`; the end of the run if it never does.

    The entry is interpolated linearly between samples.
    """

    physical = (0.0, math.inf)

    band: Scalar = param(default=0.01, unit="1", above=0.0)

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
class FinalSlipError:
    """|slip - setpoint| at the end [1]."""

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

    u is the torque that the actuator delivers.
    """

    physical = (0.0, math.inf)

    q: Vector = param(default=(1.0, 1.0), unit="1", low=0.0)
    r: Scalar = param(default=1.0, unit="1", above=0.0)

    update = unchanged

    def start(self, sample: Sample) -> Memory:
        """Zero."""
        return Memory(flow=Quadratic(*(0.0 * sample.output.slip,) * 2))

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
