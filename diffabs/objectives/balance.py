"""What is measured of a balance: whether it fell, how soon it rests, what the arm and the motor had to do."""

import math
from typing import Any

import jax
import jax.numpy as jnp

from diffabs.core.numerics import clamp, larger, later_of_larger, sign
from diffabs.core.protocols import BalanceOutput, Ending, Memory, Sample, Segment
from diffabs.core.pytree import Scalar, Vector, param, pytree
from diffabs.objectives.tracking import FinalError, held_value, integral_value, keep_memory, no_integral

RATE_NAMES = ("theta_rate", "psi_rate", "phi_rate")
ANGLE_NAMES = ("theta", "psi", "phi")


def _norm(output: BalanceOutput, weights: Vector = (1.0,) * 6) -> Any:
    """|x|, with a finite slope at 0."""
    square = sum(w * getattr(output, name) ** 2 for w, name in zip(weights, ANGLE_NAMES + RATE_NAMES, strict=True))
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


@pytree
class Fell:
    """1 if the run ended before its time, by a fall; else 0 [1], which does not say that it comes to rest: `attraction`
    tells when that is sure."""

    unit = "1"
    failure = 0.0  # a fall
    physical = (0.0, 1.0)

    start, flow, update = FinalError.start, no_integral, keep_memory

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Whether the stop was reached."""
        del memory
        return jnp.where(ending.stopped, 1.0, 0.0) + 0.0 * ending.sample.t


@pytree
class FinalNorm:
    """sqrt(x'x) at the end [1], x = (theta, psi, phi, theta', psi', phi') in rad and rad/s."""

    unit = "1"
    physical = (0.0, math.inf)

    start, flow, update = Fell.start, no_integral, keep_memory

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Of the last sample."""
        del memory
        return _norm(ending.sample.output)


def _greatest_angle(name: str) -> tuple[Any, Any, Any, Any]:
    """start, flow, update and value of the greatest |angle|, from the cubic of every step."""

    def start(self: Any, sample: Sample) -> Memory:
        """The first."""
        del self
        return Memory(held=jnp.abs(getattr(sample.output, name)))

    def update(self: Any, memory: Memory, segment: Segment) -> Scalar:
        """The greatest so far."""
        del self
        angle = segment.output(lambda output: getattr(output, name))
        falls = jnp.where(angle.start >= 0, angle.falls, angle.times(-1.0).falls)
        return later_of_larger(memory.held, larger(angle.greatest(), angle.times(-1.0).greatest()), falls)

    return start, no_integral, update, held_value


@pytree
class PeakLean:
    """Greatest |theta| of the frame [rad]."""

    unit = "rad"
    physical = (0.0, math.inf)

    start, flow, update, value = _greatest_angle("theta")


@pytree
class PeakArmAngle:
    """Greatest |psi| of the arm [rad]."""

    unit = "rad"
    physical = (0.0, math.inf)

    start, flow, update, value = _greatest_angle("psi")


def _greatest_size(size: Any) -> tuple[Any, Any, Any, Any]:
    """start, flow, update and value of the greatest size(sample): at either end of every step, and between where the
    step would end on a limit. Where it would not, a cubic leaves limits."""

    def start(self: Any, sample: Sample) -> Memory:
        """The first."""
        del self
        return Memory(held=size(sample))

    def update(self: Any, memory: Memory, segment: Segment) -> Scalar:
        """The greater of what was, and of the greatest of the step."""
        del self
        ends, falls = later_of_larger(size(segment.start), size(segment.end)), False
        if segment.smooth is not False:
            cubic = segment.sample(size)
            ends, falls = jnp.where(segment.smooth, cubic.greatest(), ends), segment.smooth & cubic.falls
        return later_of_larger(memory.held, ends, falls)

    return start, no_integral, update, held_value


@pytree
class PeakVoltage:
    """Greatest |u| that the motor gets [V]."""

    unit = "V"
    physical = (0.0, math.inf)

    start, flow, update, value = _greatest_size(lambda sample: jnp.abs(sample.control))


def motor_torque(sample: Sample) -> Any:
    """What the motor gives [N m], without its friction."""
    y = sample.output
    return y.constant * clamp((sample.control - y.emf) / y.resistance, -y.current_max, y.current_max)


@pytree
class PeakTorque:
    """Greatest torque of the motor [N m], in absolute value and without its friction."""

    unit = "N m"
    physical = (0.0, math.inf)

    start, flow, update, value = _greatest_size(lambda sample: jnp.abs(motor_torque(sample)))


@pytree
class SoftLoss:
    """1/(1 + (radius/|x|)^(1/softness)) of the last state [1], |x|^2 = sum of weight x^2 in rad and rad/s: near 0 for a
    run that comes to rest, near 1 for one that runs away, and smooth between. Its mean over starts is one minus a soft
    share of the region of attraction; see `diffabs.design.attraction`."""

    unit = "1"
    physical = (0.0, 1.0)

    weight: Vector = param(default=(1.0,) * 6, unit="1, s^2", low=0.0)
    radius: Scalar = param(default=0.1, unit="1", above=0.0)
    softness: Scalar = param(default=0.3, unit="1", above=0.0)

    start, flow, update = Fell.start, no_integral, keep_memory

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """A sigmoid of log |x|."""
        del memory
        size = jnp.maximum(_norm(ending.sample.output, self.weight), 1e-12)
        return jax.nn.sigmoid((jnp.log(size) - jnp.log(self.radius)) / self.softness)


@pytree
class RestTime:
    """Since when every angle has stayed within `band` of upright [s]; infinite for a run that ends outside of it."""

    unit = "s"
    physical = (0.0, math.inf)
    unreached = math.inf  # the value of a run that does not come to rest

    band: Scalar = param(default=0.01, unit="rad", above=0.0)

    flow = no_integral

    def start(self, sample: Sample) -> Memory:
        """At rest from the start."""
        return Memory(held=0.0 * sample.t)

    def update(self, memory: Memory, segment: Segment) -> Scalar:
        """The last of the angles' entries into the band, roots of the cubics of the step."""
        entered = memory.held
        for name in ANGLE_NAMES:
            angle = segment.output(lambda output, name=name: getattr(output, name))
            beyond = angle.times(sign(jax.lax.stop_gradient(angle.start))).minus(self.band)
            entry = segment.start.t + segment.h * beyond.root()
            entered = larger(entered, jnp.where(beyond.start > 0, entry, 0.0))
        return entered

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """The last entry; infinite if an angle of the last sample is outside."""
        angles = jnp.stack([jnp.abs(getattr(ending.sample.output, name)) for name in ANGLE_NAMES])
        return jnp.where(jnp.all(angles <= self.band), memory.held, self.unreached)


@pytree
class BalanceCost:
    """Integral of x'diag(q) x + r u^2 dt [rad^2 s], u the voltage that the motor gets [V]."""

    unit = "rad^2 s"
    physical = (0.0, math.inf)

    q: Vector = param(default=(1.0,) * 6, unit="1, s^2", low=0.0)
    r: Scalar = param(default=0.0, unit="rad^2/V^2", low=0.0)

    update, value = keep_memory, integral_value

    def start(self, sample: Sample) -> Memory:
        """Zero."""
        return Memory(flow=0.0 * sample.t)

    def flow(self, memory: Memory, sample: Sample) -> Scalar:
        """The integrand."""
        del memory
        squares = [
            w * getattr(sample.output, name) ** 2 for w, name in zip(self.q, ANGLE_NAMES + RATE_NAMES, strict=True)
        ]
        return sum(squares[1:], squares[0]) + self.r * sample.control**2
