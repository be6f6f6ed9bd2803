"""A reference that stays within the brake's torque limits.

    target+ = target + min[(1 - exp(-h v0/(T v))) (slip - target),  h rate v0/v]          every period h

The slip rate of a braked wheel under torque is proportional to 1/v: r tau/(J v). A target with a rate proportional to
1/v therefore needs the same torque at every speed. `rate`, the greatest rate at the speed v0, keeps this torque within
the limits. It limits a rising target, not a falling one. Near its final value the target settles with the time
constant T v/v0. The target starts at the measured slip. At t = 0 it has already made its first step.
"""

import jax.numpy as jnp

from diffabs.core.numerics import smaller
from diffabs.core.protocols import BrakeOutput, Clock, Memory, no_flow
from diffabs.core.pytree import param, pytree
from diffabs.core.rules import period_on_grid
from diffabs.core.types import Scalar


@pytree
class LimitedSlip:
    """A target that rises at most at `rate` v0/v and settles with the time constant T v/v0."""

    slip: Scalar = param(default=0.2, unit="1", above=0.0, high=1.0)
    """Final target."""
    rate: Scalar = param(default=4.0, unit="1/s", above=0.0)
    """Greatest rate of the target at v0."""
    time_constant: Scalar = param(default=0.02, unit="s", above=0.0)
    """Time constant T of the low-pass filter."""
    reference_speed: Scalar = param(default=50 / 3.6, unit="m/s", above=0.0)
    """Speed v0 at which gains and rates have their stated values."""
    period: Scalar = param(default=1e-3, unit="s", above=0.0, tunable=False)
    """Period of the samples h."""
    floor: Scalar = param(default=0.05, unit="m/s", above=0.0)
    """Least speed in the denominator of the step."""

    flow = no_flow
    grid_rules = period_on_grid

    def start(self, signal: BrakeOutput) -> Memory:
        """Return the memory with the measured slip."""
        return Memory(held=signal.slip)

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> Scalar:
        """Return the present target slip [1]."""
        del t, signal
        return memory.held

    def setpoint(self, memory: Memory) -> Scalar:
        """Return the final target slip [1]."""
        del memory
        return self.slip

    def tick(self, clock: Clock, memory: Memory, signal: BrakeOutput) -> Memory:
        """Return the memory after one step of the target if a period begins, else the old memory."""
        now, _ = clock.ticks(self.period)
        # h is the period scaled by v0/v: in this time the target behaves equally at every speed.
        h = self.period * self.reference_speed / jnp.maximum(signal.speed, self.floor)
        distance = self.slip - memory.held
        step = smaller(-jnp.expm1(-h / self.time_constant) * distance, h * self.rate)
        return Memory(held=jnp.where(now, memory.held + step, memory.held))
