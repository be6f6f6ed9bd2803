"""Stops of a run, and the time and distance that remain after the last sample."""

import math

import jax.numpy as jnp

from diffabs.core.protocols import BalanceOutput, BrakeOutput, Sample
from diffabs.core.pytree import param, pytree
from diffabs.core.types import Bool, PyTree, Scalar

LEAST_DECELERATION = 1e-3  # m/s^2; a car that only rolls gets a finite, very long stopping distance
EXTRAPOLATED = (
    f"stop_time and stop_distance are extrapolated with the last deceleration, at least {LEAST_DECELERATION:g} m/s^2"
)


@pytree
class SpeedReached:
    """The run ends when the vehicle falls to `speed`. A run that does not reach it in time continues, by extrapolation,
    at its last deceleration.
    """

    speed: Scalar = param(default=5 / 3.6, unit="m/s", above=0.0)
    """Speed of the vehicle at the end of the run."""

    success = True
    otherwise = EXTRAPOLATED

    def margin(self, output: BrakeOutput) -> Scalar:
        """Return the speed above the stop's speed [m/s]."""
        return output.speed - self.speed

    def remainder(self, sample: Sample, stopped: Bool) -> tuple[Scalar, Scalar]:
        """Return 0 and 0 after a stop, else (v - v_end)/a [s] and (v^2 - v_end^2)/(2 a) [m].

        a is the last deceleration, at least 0.001 m/s^2.
        """
        time, distance = _rest_of_braking(sample, self.speed, False)
        return jnp.where(stopped, 0.0, time), jnp.where(stopped, 0.0, distance)


@pytree
class Standstill:
    """The run ends when the vehicle falls to a small `speed`. The rest to standstill is extrapolated: v/a [s] and
    v^2/(2 a) [m].

    Slip is stiff near standstill (its rate is proportional to 1/v), so the last centimetres are not integrated. The
    result does not depend on `speed` between 0.01 and 1 m/s.
    """

    speed: Scalar = param(default=0.05, unit="m/s", above=0.0)
    """Speed of the vehicle at the end of the run."""

    success = True
    otherwise = EXTRAPOLATED
    margin = SpeedReached.margin

    def remainder(self, sample: Sample, stopped: Bool) -> tuple[Scalar, Scalar]:
        """Return v/a [s] and v^2/(2 a) [m], with the last deceleration a, at least 0.001 m/s^2.

        After a stop a is also at least half the mean deceleration of the run, because slip may chatter at the end.
        """
        return _rest_of_braking(sample, 0.0, stopped)


@pytree
class Fallen:
    """The run of a two-wheeler ends where its frame leans by `angle`; pi/2 is the ground."""

    angle: Scalar = param(default=math.pi / 2, unit="rad", above=0.0, high=math.pi)
    """Lean of the frame at the end of the run; pi/2 is the ground."""

    success = False
    otherwise = "FELL: the frame reached the stop's angle"

    def margin(self, output: BalanceOutput) -> Scalar:
        """Return angle^2 - theta^2 [rad^2]; the run ends when it falls below zero."""
        return self.angle**2 - output.theta**2

    def remainder(self, sample: Sample, stopped: Bool) -> tuple[Scalar, Scalar]:
        """Return 0 s and 0 m."""
        del stopped
        return 0.0 * sample.t, 0.0 * sample.t


@pytree
class NoStop:
    """No stop: the run lasts for the whole duration of the solver."""

    success = False
    remainder = Fallen.remainder

    def margin(self, output: PyTree) -> Scalar:
        """Return 1 for every output, so the run never stops."""
        return 1.0 + 0.0 * output[0]


def _rest_of_braking(sample: Sample, end: Scalar, stopped: Bool) -> tuple[PyTree, PyTree]:
    """Return time [s] and distance [m] to the speed `end` at the last deceleration.

    For a run that stopped, the deceleration is at least half its mean. Slip may chatter at the very end, and the last
    instant is then not representative.
    """
    output, t = sample.output, jnp.maximum(sample.t, 1e-9)
    mean = 2 * (output.distance / t - output.speed) / t
    a = jnp.where(stopped, jnp.maximum(output.deceleration, 0.5 * mean), output.deceleration)
    a = jnp.maximum(a, LEAST_DECELERATION)
    return (output.speed - end) / a, (output.speed**2 - end**2) / (2 * a)
