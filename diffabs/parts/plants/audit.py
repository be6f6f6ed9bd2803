"""Energy audits of a run: they detect an unstable integration whose numbers all stay finite.

    energy     E(t + h) - E(t) <= work that the control may have done on the vehicle in that step (balance: in the run)
    braked     distance does not fall, and grows no faster than the speed; friction alone changes the speed

An audit is an objective with a value of at most 1 for a physically possible run. The value is the unexplained gain of
energy divided by the tolerance, 1 % of the energy scale at the start.

The bound on a step's work is twice its length times the greatest control and the greatest speed at its ends. Both may
be greater inside the step. A nonnegative brake torque does no work on the vehicle. The bound thus covers legitimate
gains: a negative torque that drives the wheel, or a motor that rights a two-wheeler.
"""

import jax
import jax.numpy as jnp

from diffabs.core.protocols import BalanceOutput, BrakeOutput, Ending, Memory, Sample, Segment
from diffabs.core.pytree import param, part, pytree, static
from diffabs.core.types import Part, Scalar
from diffabs.parts.objectives.tracking import HeldValue

FORGIVEN = 0.01  # tolerance for a whole run, as a fraction of the energy scale
SPEED_ROUNDING = 1e-6  # single precision: fraction of the energy scale in one step; ten times as much of the distance
MAX_STEP_RATIO = 2.0  # factor on the work and the distance that the ends of a step give
SWING = 4.0  # factor on the decelerations at both ends: the slip may pass the friction's peak inside the step
MIN_STEP_ENERGY = 10.0  # m/s^2, deceleration that is always accepted, as is 1e-3 of the speed


def _driving_power(before: Scalar, after: Scalar) -> Scalar:
    """Return the greater of both values, and 0 where both are negative."""
    return jnp.maximum(jnp.maximum(before, after), 0.0)


class _Audit(HeldValue):
    """Base of audits, which sum energies."""

    scale: Scalar

    def start(self, sample: Sample) -> Memory:
        """Return the memory with no gain of energy."""
        return Memory(held=0.0 * sample.t)

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Return the unexplained gain of energy relative to the tolerance [1]; above 1 the run is not physical."""
        del ending
        return memory.held / (FORGIVEN * self.scale)


@pytree
class BrakeAudit(_Audit):
    """Audit of a braked vehicle, whose kinetic energy is that of two masses: one at the car's speed and one at the
    wheel's rim.
    """

    car: Scalar = param(unit="kg", above=0.0)
    """Mass at the car's speed."""
    wheel: Scalar = param(unit="kg", above=0.0)
    """Mass at the speed of the wheel's rim."""
    radius: Scalar = param(unit="m", above=0.0)
    """Radius r of the wheel."""
    scale: Scalar = param(unit="J", above=0.0)
    """Energy scale of the tolerance: that at the start."""
    commanded: bool = static(default=False)
    """True if the control is the command of a brake. Otherwise the control is a torque, and a negative one speeds the
    wheel up.
    """

    def update(self, memory: Memory, segment: Segment) -> Scalar:
        """Return the sum of the steps' unexplained gains of energy [J], this step included.

        Only the gain beyond the work of a driving torque and beyond rounding counts. The sum is infinite after a step
        that no car can make.
        """
        # An audit decides on validity only, so it needs no derivatives.
        before, sample, h = jax.lax.stop_gradient((segment.start, segment.end, segment.h))
        a, b = before.output, sample.output
        drive = 0.0 if self.commanded else _driving_power(-before.control, -sample.control)
        work = MAX_STEP_RATIO * h * drive * jnp.maximum(a.wheel_speed, b.wheel_speed) / self.radius
        gain = 0.5 * (self.car * (b.speed**2 - a.speed**2) + self.wheel * (b.wheel_speed**2 - a.wheel_speed**2)) - work
        return memory.held + jnp.where(_leaps(a, b, h), jnp.inf, jnp.maximum(gain - SPEED_ROUNDING * self.scale, 0.0))


def _leaps(a: BrakeOutput, b: BrakeOutput, h: Scalar) -> Scalar:
    """Return whether no car can go from a to b in the time h.

    Three conditions are impossible: to move backwards, to move farther than the speed allows, or to decelerate more
    than friction allows.
    """
    top = jnp.maximum(a.speed, b.speed)
    way = 0.5 * MAX_STEP_RATIO * h * top  # the accepted interval is way - way to way + way
    far = jnp.abs(b.distance - a.distance - way) > way + 10 * SPEED_ROUNDING * (1.0 + jnp.abs(b.distance))
    friction = SWING * (jnp.abs(a.deceleration) + jnp.abs(b.deceleration)) + MIN_STEP_ENERGY
    return far | (jnp.abs(b.speed - a.speed) > h * friction + 1e-3 * top)


@pytree
class BalanceAudit(_Audit):
    """Audit of a two-wheeler with a motor at one joint: the energy at the end is at most `first` plus the motor's work.

    The audit evaluates the energy only at the end of the run, because every evaluation costs five cosines.
    """

    plant: Part = part()
    """Plant with `torque` and `energy`."""
    first: Scalar = param(unit="J")
    """Energy at the start."""
    scale: Scalar = param(unit="J", above=0.0)
    """Energy scale of the tolerance."""

    def update(self, memory: Memory, segment: Segment) -> Scalar:
        """Return the sum of the work [J] that the motor may have done, this step included.

        Only torques and rates of the same sign do work on the vehicle.
        """
        before, sample, h = jax.lax.stop_gradient((segment.start, segment.end, segment.h))
        w0, w1 = before.output.psi_rate, sample.output.psi_rate
        t0, t1 = self.plant.torque(w0, before.control), self.plant.torque(w1, sample.control)
        return memory.held + MAX_STEP_RATIO * h * (
            _driving_power(t0, t1) * _driving_power(w0, w1) + _driving_power(-t0, -t1) * _driving_power(-w0, -w1)
        )

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Return the unexplained gain of energy relative to the tolerance [1]; above 1 the run is not physical."""
        y: BalanceOutput = ending.sample.output
        gain = self.plant.energy(self.plant.start(y)) - self.first - memory.held
        return gain / (FORGIVEN * self.scale)
