"""A reference that the brake can follow: it asks for no more than the torque's limits leave.

    target+ = target + min[(1 - exp(-h v0/(T v))) (slip - target),  h rate v0/v]          every period h

The slip of a braked wheel answers to torque with a rate that goes with 1/v, r tau/(J v): a target that is slow in
proportion to the speed needs the same torque at every speed, and with `rate`, its greatest rate at the speed v0, no
more than the limits have. Towards the end it settles with the time constant T v/v0. From the measured slip; at the
first instant it has made its first step.
"""

from collections.abc import Iterator

import jax.numpy as jnp

from diffabs.core.numerics import smaller
from diffabs.core.protocols import BrakeOutput, Clock, Memory, no_flow
from diffabs.core.pytree import Scalar, param, pytree
from diffabs.core.rules import Rule
from diffabs.core.timing import whole_steps


@pytree
class LimitedSlip:
    """A target that rises at `rate` v0/v at most, and settles with the time constant T v/v0."""

    slip: Scalar = param(default=0.2, unit="1", above=0.0, high=1.0)
    rate: Scalar = param(default=4.0, unit="1/s", above=0.0)
    time_constant: Scalar = param(default=0.02, unit="s", above=0.0)
    reference_speed: Scalar = param(default=50 / 3.6, unit="m/s", above=0.0)
    period: Scalar = param(default=1e-3, unit="s", above=0.0, tunable=False)
    floor: Scalar = param(default=0.05, unit="m/s", above=0.0)

    flow = no_flow

    def start(self, signal: BrakeOutput) -> Memory:
        """The measured slip."""
        return Memory(held=signal.slip)

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> Scalar:
        """Target slip [1]."""
        del t, signal
        return memory.held

    def setpoint(self, memory: Memory) -> Scalar:
        """Where the target settles."""
        del memory
        return self.slip

    def tick(self, clock: Clock, memory: Memory, signal: BrakeOutput) -> Memory:
        """One step of the target at the instants of the period."""
        now, _ = clock.ticks(self.period)
        h = self.period * self.reference_speed / jnp.maximum(signal.speed, self.floor)
        left = self.slip - memory.held
        step = smaller(-jnp.expm1(-h / self.time_constant) * left, h * self.rate)
        return Memory(held=jnp.where(now, memory.held + step, memory.held))

    def grid_rules(self, step: float) -> Iterator[Rule]:
        """The period is on the integration grid."""
        yield whole_steps("period", self.period, step)
