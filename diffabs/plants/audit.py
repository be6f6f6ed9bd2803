"""What no vehicle can do, watched while it runs: an integration step that is not stable may leave every number finite.

    energy     E(t + h) - E(t) <= work that the control may have done on the vehicle in that step; of a balance in all
    braked     distance does not fall, and grows no faster than the speed; friction alone changes the speed

An audit is an objective whose value is at most 1 for a possible run: its unexplained gains of energy, in units of what
is forgiven, a hundredth of the energy of the start. Work is bounded from the control and the speed at both ends of the
step, each at its greatest, and twice that: within the step both may be greater. A brake's torque that is not negative
does none. So legitimate gains (a negative torque that drives the wheel, a motor that rights a vehicle) are no alarm."""

from typing import Any

import jax
import jax.numpy as jnp

from diffabs.core.protocols import BalanceOutput, BrakeOutput, Ending, Memory, Sample, Segment
from diffabs.core.pytree import Scalar, param, part, pytree, static
from diffabs.objectives.tracking import no_integral

FORGIVEN = 0.01  # of the energy of the start, in the whole run
SPEED_ROUNDING = 1e-6  # of it in a step, 1e-5 of the distance: single precision
MAX_STEP_RATIO = 2.0  # of the work, and of the way, that the ends of a step show
SWING = 4.0  # of the decelerations at both ends: a slip may pass the friction's peak within the step
MIN_STEP_ENERGY = 10.0  # m/s^2, and 1e-3 of the speed, that are no alarm at all


def _driving_power(before: Any, after: Any) -> Any:
    """The greatest value at either end, 0 where both are negative."""
    return jnp.maximum(jnp.maximum(before, after), 0.0)


def _zero(self: Any, sample: Sample) -> Memory:
    """No gain yet."""
    del self
    return Memory(held=0.0 * sample.t)


def _excess(self: Any, memory: Memory, ending: Ending) -> Scalar:
    """Unexplained gains of energy in units of what is forgiven."""
    del ending
    return memory.held / (FORGIVEN * self.scale)


@pytree
class BrakeAudit:
    """Of a braked vehicle: its kinetic energy is that of two masses, at the car's speed and at the wheel's rim, and of
    `scale` [J] at the start. A negative control speeds the wheel up, unless it is a brake's command (`commanded`)."""

    car: Scalar = param(unit="kg", above=0.0)
    wheel: Scalar = param(unit="kg", above=0.0)
    radius: Scalar = param(unit="m", above=0.0)
    scale: Scalar = param(unit="J", above=0.0)
    commanded: bool = static(default=False)

    start, flow, value = _zero, no_integral, _excess

    def update(self, memory: Memory, segment: Segment) -> Any:
        """Add what a step gained without work; infinite for a step that no car makes."""
        before, sample, h = jax.lax.stop_gradient((segment.start, segment.end, segment.h))
        a, b = before.output, sample.output
        drive = 0.0 if self.commanded else _driving_power(-before.control, -sample.control)
        work = MAX_STEP_RATIO * h * drive * jnp.maximum(a.wheel_speed, b.wheel_speed) / self.radius
        gain = 0.5 * (self.car * (b.speed**2 - a.speed**2) + self.wheel * (b.wheel_speed**2 - a.wheel_speed**2)) - work
        return memory.held + jnp.where(_leaps(a, b, h), jnp.inf, jnp.maximum(gain - SPEED_ROUNDING * self.scale, 0.0))


def _leaps(a: BrakeOutput, b: BrakeOutput, h: Scalar) -> Any:
    """Whether no car goes from a to b in h: backwards, farther than its speed lets it, or with more deceleration than
    friction gives."""
    top = jnp.maximum(a.speed, b.speed)
    way = 0.5 * MAX_STEP_RATIO * h * top  # give or take as much
    far = jnp.abs(b.distance - a.distance - way) > way + 10 * SPEED_ROUNDING * (1.0 + jnp.abs(b.distance))
    friction = SWING * (jnp.abs(a.deceleration) + jnp.abs(b.deceleration)) + MIN_STEP_ENERGY
    return far | (jnp.abs(b.speed - a.speed) > h * friction + 1e-3 * top)


@pytree
class BalanceAudit:
    """Of a two-wheeler with a motor at one joint, whose torque and energy `plant` has: the energy at the end is at most
    the `first`, of the size `scale`, and the motor's work. In between it would cost five cosines a step."""

    plant: Any = part()
    first: Scalar = param(unit="J")
    scale: Scalar = param(unit="J", above=0.0)

    start, flow = _zero, no_integral

    def update(self, memory: Memory, segment: Segment) -> Any:
        """Add the work that the motor may have done: of torques and rates in the same direction."""
        before, sample, h = jax.lax.stop_gradient((segment.start, segment.end, segment.h))
        w0, w1 = before.output.psi_rate, sample.output.psi_rate
        t0, t1 = self.plant.torque(w0, before.control), self.plant.torque(w1, sample.control)
        return memory.held + MAX_STEP_RATIO * h * (
            _driving_power(t0, t1) * _driving_power(w0, w1) + _driving_power(-t0, -t1) * _driving_power(-w0, -w1)
        )

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Unexplained gain of energy in units of what is forgiven."""
        y: BalanceOutput = ending.sample.output
        gain = self.plant.energy(self.plant.start(y)) - self.first - memory.held
        return gain / (FORGIVEN * self.scale)
