"""How well a run follows its slip: peak, overshoot, settling, integrals of the error.

The error e = slip - setpoint is against where the reference will settle, not against a filtered target on its way
there."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from diffabs.numerics import clamp, parabola, ratio
from diffabs.protocols import Ending, Memory, Sample
from diffabs.pytree import Scalar, Vector, param, pytree


def nothing(self: Any, memory: Memory, sample: Sample) -> Any:
    """`flow` of an objective without an integral."""
    del self, memory, sample
    return ()


def unchanged(self: Any, memory: Memory, sample: Sample, h: Scalar) -> Any:
    """`update` of an objective that is only an integral."""
    del self, sample, h
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


@pytree
class IAE:
    """Integral of |e| dt [s]. At e = 0 the derivative is taken as 0."""

    start, update, value = from_zero, unchanged, integral

    def flow(self, memory: Memory, sample: Sample) -> Scalar:
        """|e|."""
        del memory
        return jnp.abs(error(sample))


@pytree
class ITAE:
    """Integral of t |e| dt [s^2]."""

    start, update, value = from_zero, unchanged, integral

    def flow(self, memory: Memory, sample: Sample) -> Scalar:
        """t |e|."""
        del memory
        return sample.t * jnp.abs(error(sample))


class Peak(NamedTuple):
    """Greatest value so far, and the last two samples."""

    greatest: Scalar
    last: Scalar
    before: Scalar


@pytree
class MaxSlip:
    """Greatest slip of the run [1]: the vertex of the parabola through the three samples around it, at most 1."""

    flow = nothing

    def start(self, sample: Sample) -> Memory:
        """The first slip."""
        return Memory(held=Peak(*(sample.output.slip,) * 3))

    def update(self, memory: Memory, sample: Sample, h: Scalar) -> Peak:
        """Look for a vertex at the last sample but one."""
        del h
        greatest, last, before = memory.held
        slip = sample.output.slip
        turned = (last > before) & (last > slip)
        vertex = jnp.where(turned, jnp.minimum(parabola(before, last, slip)[1], 1.0), slip)
        return Peak(jnp.maximum(greatest, jnp.maximum(vertex, slip)), slip, last)

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Greatest slip."""
        del ending
        return memory.held.greatest


@pytree
class Overshoot:
    """max(0, max slip/setpoint - 1), a fraction of the final setpoint [1]. Zero derivative where there is none."""

    flow = nothing
    start = MaxSlip.start
    update = MaxSlip.update

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Overshoot."""
        excess = memory.held.greatest / ending.sample.setpoint - 1
        return jnp.where(excess > 0, excess, 0.0)


class Entry(NamedTuple):
    """When |e| last came inside the band [s], and the last |e|."""

    t: Scalar
    distance: Scalar


@pytree
class SettlingTime:
    """Time [s] after which |slip - setpoint| stays within `band`; the end of the run if it never does.

    The entry is interpolated linearly between samples.
    """

    band: Scalar = param(default=0.01, unit="1", above=0.0)

    flow = nothing

    def start(self, sample: Sample) -> Memory:
        """Settled from the start if inside."""
        return Memory(held=Entry(0.0 * sample.t, jnp.abs(error(sample))))

    def update(self, memory: Memory, sample: Sample, h: Scalar) -> Entry:
        """Note the last entry."""
        entered, before = memory.held
        now = jnp.abs(error(sample))
        late = clamp(ratio(self.band - now, before - now), 0.0, 1.0)
        t = jnp.where(now > self.band, sample.t, jnp.where(before > self.band, sample.t - late * h, entered))
        return Entry(t, now)

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Settling time."""
        del ending
        return memory.held.t


@pytree
class FinalSlipError:
    """|slip - setpoint| at the end [1]."""

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
