"""Objectives of a balance: fall, time to rest, and peaks of angles, voltage and torque."""

import math
from collections.abc import Callable, Sequence
from typing import ClassVar

import jax
import jax.numpy as jnp

from diffabs.core.numerics import clamp, larger, later_of_larger, sign
from diffabs.core.protocols import BalanceOutput, Ending, Memory, Sample, Segment
from diffabs.core.pytree import param, pytree
from diffabs.core.types import PyTree, Scalar, Vector
from diffabs.parts.objectives.tracking import FinalValue, HeldValue, Integral, greatest_magnitude

RATE_NAMES = ("theta_rate", "psi_rate", "phi_rate")
ANGLE_NAMES = ("theta", "psi", "phi")


def _norm(output: BalanceOutput, weights: Sequence[float] | Vector = (1.0,) * 6) -> Scalar:
    """Return |x| weighted by `weights`, with slope 0 at x = 0."""
    square = sum(w * getattr(output, name) ** 2 for w, name in zip(weights, ANGLE_NAMES + RATE_NAMES, strict=True))
    # Two selects: the square root has an infinite slope at 0, and 0 * inf in the branch not taken would be NaN.
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


@pytree
class Fell(FinalValue):
    """1 if the run reached its stop, such as `Fallen`, else 0 [1].

    A value of 0 does not prove that the run comes to rest; `diffabs.robust.design.attraction` gives a proof.
    """

    unit = "1"
    failure: ClassVar[float] = 0.0  # a fall
    physical: ClassVar[tuple[float, float]] = (0.0, 1.0)

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Return 1 if the run reached the stop, else 0."""
        del memory
        return jnp.where(ending.stopped, 1.0, 0.0) + 0.0 * ending.sample.t


@pytree
class FinalNorm(FinalValue):
    """sqrt(x'x) at the end of the run [1], x = (theta, psi, phi, theta', psi', phi') in rad and rad/s."""

    unit = "1"
    physical: ClassVar[tuple[float, float]] = (0.0, math.inf)

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Return |x| of the last sample."""
        del memory
        return _norm(ending.sample.output)


@pytree
class PeakLean(HeldValue):
    """Greatest |theta| of the frame [rad]."""

    unit = "rad"
    physical: ClassVar[tuple[float, float]] = (0.0, math.inf)

    start, update = greatest_magnitude(lambda _: "theta")


@pytree
class PeakArmAngle(HeldValue):
    """Greatest |psi| of the arm [rad]."""

    unit = "rad"
    physical: ClassVar[tuple[float, float]] = (0.0, math.inf)

    start, update = greatest_magnitude(lambda _: "psi")


def _greatest_size(size: Callable[[Sample], Scalar]) -> tuple[PyTree, PyTree]:
    """Return start and update of the greatest size(sample).

    The search covers both ends of every step. It covers the inside only of a smooth step, in which no limit is reached.
    Otherwise the cubic may leave the limits.
    """

    def start(self: object, sample: Sample) -> Memory:
        del self
        return Memory(held=size(sample))

    def update(self: object, memory: Memory, segment: Segment) -> Scalar:
        del self
        ends, falls = later_of_larger(size(segment.start), size(segment.end)), False
        if segment.smooth is not False:
            cubic = segment.sample(size)
            ends, falls = jnp.where(segment.smooth, cubic.greatest(), ends), segment.smooth & cubic.falls
        return later_of_larger(memory.held, ends, falls)

    return start, update


@pytree
class PeakVoltage(HeldValue):
    """Greatest |u| at the motor [V]."""

    unit = "V"
    physical: ClassVar[tuple[float, float]] = (0.0, math.inf)

    start, update = _greatest_size(lambda sample: jnp.abs(sample.control))


def motor_torque(sample: Sample) -> Scalar:
    """Return the motor's torque without its friction [N m]; the control is its voltage [V]."""
    y = sample.output
    return y.constant * clamp((sample.control - y.emf) / y.resistance, -y.current_max, y.current_max)


@pytree
class PeakTorque(HeldValue):
    """Greatest absolute torque of the motor, without its friction [N m]."""

    unit = "N m"
    physical: ClassVar[tuple[float, float]] = (0.0, math.inf)

    start, update = _greatest_size(lambda sample: jnp.abs(motor_torque(sample)))


@pytree
class SoftLoss(FinalValue):
    """1/(1 + (radius/|x|)^(1/softness)) of the last state x [1]. Here |x|^2 is the sum of `weight` times x^2.

    x is (theta, psi, phi, theta', psi', phi') in rad and rad/s. The loss is near 0 for a run that comes to rest, near 1
    for one that diverges, and smooth between. Its mean over starts is 1 minus a soft share of the region of attraction;
    see `diffabs.robust.design.attraction`.
    """

    unit = "1"
    physical: ClassVar[tuple[float, float]] = (0.0, 1.0)

    weight: Vector = param(default=(1.0,) * 6, unit="1, s^2", low=0.0)
    """Weights of the squared states, shape (6,)."""
    radius: Scalar = param(default=0.1, unit="1", above=0.0)
    """Size |x| at which the loss is 1/2."""
    softness: Scalar = param(default=0.3, unit="1", above=0.0)
    """Width of the transition; 0 would be a step."""

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Return the loss, a sigmoid of log |x|."""
        del memory
        size = jnp.maximum(_norm(ending.sample.output, self.weight), 1e-12)
        return jax.nn.sigmoid((jnp.log(size) - jnp.log(self.radius)) / self.softness)


@pytree
class RestTime(HeldValue):
    """Time [s] from t = 0 after which theta, psi and phi all stay within +-`band` of upright.

    The value is 0 for a run that never leaves the band, and infinite for one that ends outside.
    """

    unit = "s"
    physical: ClassVar[tuple[float, float]] = (0.0, math.inf)
    unreached: ClassVar[float] = math.inf

    band: Scalar = param(default=0.01, unit="rad", above=0.0)
    """Half width of the band around upright."""

    def start(self, sample: Sample) -> Memory:
        """Return the memory of a run that rests from t = 0."""
        return Memory(held=0.0 * sample.t)

    def update(self, memory: Memory, segment: Segment) -> Scalar:
        """Return the time of the last entry of any angle into the band [s], from roots of the step's cubics."""
        entered = memory.held
        for name in ANGLE_NAMES:
            angle = segment.output(lambda output, name=name: getattr(output, name))
            # Only the sign of the angle matters, so it carries no derivative.
            beyond = angle.times(sign(jax.lax.stop_gradient(angle.start))).minus(self.band)
            entry = segment.start.t + segment.h * beyond.root()
            entered = larger(entered, jnp.where(beyond.start > 0, entry, 0.0))
        return entered

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Return the last entry [s]; infinity if an angle of the last sample is outside."""
        angles = jnp.stack([jnp.abs(getattr(ending.sample.output, name)) for name in ANGLE_NAMES])
        return jnp.where(jnp.all(angles <= self.band), memory.held, self.unreached)


@pytree
class BalanceCost(Integral):
    """Integral of x'diag(q) x + r u^2 dt [rad^2 s], where u is the voltage at the motor [V].

    x is (theta, psi, phi, theta', psi', phi') in rad and rad/s.
    """

    unit = "rad^2 s"
    physical: ClassVar[tuple[float, float]] = (0.0, math.inf)

    q: Vector = param(default=(1.0,) * 6, unit="1, s^2", low=0.0)
    """Weights of the squared states, shape (6,)."""
    r: Scalar = param(default=0.0, unit="rad^2/V^2", low=0.0)
    """Weight of the squared control."""

    def start(self, sample: Sample) -> Memory:
        """Return the memory with integral 0."""
        return Memory(flow=0.0 * sample.t)

    def flow(self, memory: Memory, sample: Sample) -> Scalar:
        """Return the integrand."""
        del memory
        squares = [
            w * getattr(sample.output, name) ** 2 for w, name in zip(self.q, ANGLE_NAMES + RATE_NAMES, strict=True)
        ]
        return sum(squares[1:], squares[0]) + self.r * sample.control**2
