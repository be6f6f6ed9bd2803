"""What no vehicle can do, watched while it runs: an integration step that is not stable may leave every number finite.

    energy     E(t + h) - E(t) <= work that the control may have done on the vehicle in that step
    braked     distance does not fall, and grows no faster than the speed; friction alone changes the speed

An audit is an objective whose value is at most 1 for a possible run: its unexplained gains of energy, in units of what
is forgiven, a hundredth of the energy of the start. Work is bounded from the control and the speed at both ends of the
step, each at its greatest, and twice that: within the step both may be greater. A brake's torque that is not negative
does none. So legitimate gains (a negative torque that drives the wheel, a motor that rights a vehicle) are no alarm."""

import math
from typing import Any

import jax
import jax.numpy as jnp

from diffabs.protocols import BalanceOutput, BrakeOutput, Ending, Memory, Sample
from diffabs.pytree import Scalar, param, part, pytree

FORGIVEN = 0.01  # of the energy of the start, in the whole run
ROUNDING = 1e-6  # of it in a step, 1e-5 of the distance: single precision
WITHIN = 2.0  # of the work, and of the way, that the ends of a step show
SWING = 4.0  # of the decelerations at both ends: a slip may pass the friction's peak within the step
LITTLE = 10.0  # m/s^2, and 1e-3 of the speed, that are no alarm at all


def _no_flow(self: Any, memory: Memory, sample: Sample) -> Any:
    del self, memory, sample
    return ()


def _driving(before: Any, after: Any) -> Any:
    """The greatest value at either end, 0 where both are negative."""
    return jnp.maximum(jnp.maximum(before, after), 0.0)


def _excess(self: Any, memory: Memory, ending: Ending) -> Scalar:
    """Unexplained gains of energy in units of what is forgiven."""
    del self, ending
    return memory.held[1] / (FORGIVEN * memory.held[0])


@pytree
class BrakeAudit:
    """Of a braked vehicle: its kinetic energy is that of two masses, at the car's speed and at the wheel's rim. `drive`
    is a torque that speeds the wheel up whatever the control; where it is NaN, a negative control is such a torque."""

    car: Scalar = param(unit="kg", above=0.0)
    wheel: Scalar = param(unit="kg", above=0.0)
    radius: Scalar = param(unit="m", above=0.0)
    drive: Scalar = param(default=math.nan, unit="N m")

    flow, value = _no_flow, _excess

    def start(self, sample: Sample) -> Memory:
        """Energy of the start [J], and no gain."""
        energy = self._energy(sample.output)
        return Memory(held=(energy, 0.0 * energy))

    def update(self, memory: Memory, before: Sample, sample: Sample, h: Scalar) -> Any:
        """Add what a step gained without work; infinite for a step that no car makes."""
        first, gained = memory.held
        before, sample = jax.lax.stop_gradient((before, sample))
        a, b = before.output, sample.output
        torque = jnp.where(jnp.isnan(self.drive), _driving(-before.control, -sample.control), self.drive)
        work = WITHIN * h * torque * jnp.maximum(a.wheel_speed, b.wheel_speed) / self.radius
        gain = self._energy(b) - self._energy(a) - work - ROUNDING * first
        return first, gained + jnp.where(_leaps(a, b, h), jnp.inf, jnp.maximum(gain, 0.0))

    def _energy(self, y: BrakeOutput) -> Any:
        return 0.5 * (self.car * y.speed**2 + self.wheel * y.wheel_speed**2)


def _leaps(a: BrakeOutput, b: BrakeOutput, h: Scalar) -> Any:
    """Whether no car goes from a to b in h: backwards, farther than its speed lets it, or with more deceleration than
    friction gives."""
    top, way = jnp.maximum(a.speed, b.speed), b.distance - a.distance
    rounding = 10 * ROUNDING * (1.0 + jnp.abs(b.distance))
    friction = SWING * (jnp.abs(a.deceleration) + jnp.abs(b.deceleration)) + LITTLE
    leap = jnp.abs(b.speed - a.speed) > h * friction + 1e-3 * top
    return leap | (way < -rounding) | (way > WITHIN * h * top + rounding)


@pytree
class BalanceAudit:
    """Of a two-wheeler with a motor at one joint: `plant` has the energy of a state, `scale` its size [J]."""

    plant: Any = part()
    scale: Scalar = param(unit="J", above=0.0)

    flow, value = _no_flow, _excess

    def start(self, sample: Sample) -> Memory:
        """The energy's size [J], and no gain."""
        scale = self.scale + 0.0 * sample.t
        return Memory(held=(scale, 0.0 * scale))

    def update(self, memory: Memory, before: Sample, sample: Sample, h: Scalar) -> Any:
        """Add what a step gained without work: torque and rate of the joint, in the same direction."""
        first, gained = memory.held
        before, sample = jax.lax.stop_gradient((before, sample))
        w0, w1 = before.output.psi_rate, sample.output.psi_rate
        t0, t1 = self.plant.torque(w0, before.control), self.plant.torque(w1, sample.control)
        work = WITHIN * h * (_driving(t0, t1) * _driving(w0, w1) + _driving(-t0, -t1) * _driving(-w0, -w1))
        gain = self._energy(sample.output) - self._energy(before.output) - work - ROUNDING * first
        return first, gained + jnp.maximum(gain, 0.0)

    def _energy(self, y: BalanceOutput) -> Any:
        return self.plant.energy(self.plant.start(y))
