"""Valve that fills and empties a brake: its command is a rate.

    control' = gain command,   low <= control <= high

An integrator with limits, as in The MathWorks' `sldemo_absbrake`: at a limit, the control waits until the command
points inwards.
"""

from collections.abc import Iterator

import jax.numpy as jnp

from diffabs.core.numerics import clamp, larger, smaller
from diffabs.core.protocols import Memory
from diffabs.core.pytree import param, pytree
from diffabs.core.rules import Rule, order_rule
from diffabs.core.types import Scalar


@pytree
class IntegratingValve:
    """control' = gain command within [low, high], control(0) = low."""

    gain: Scalar = param(default=100.0, unit="1/s", above=0.0)
    """Rate of the control at command 1."""
    low: Scalar = param(default=0.0, unit="control")
    """Lower limit of the control."""
    high: Scalar = param(default=90.0, unit="control")
    """Upper limit of the control."""

    jumps = True

    def start(self, signal: Scalar) -> Memory:
        """Return the memory of an empty brake: control `low`."""
        return Memory(flow=self.low + 0.0 * signal)

    def flow(self, t: Scalar, memory: Memory, signal: Scalar) -> Scalar:
        """Return control', in the control's unit per second: 0 at a limit while the command points outwards."""
        del t
        rate = self.gain * signal
        inwards = jnp.where(memory.flow <= self.low, larger(rate, 0.0), rate)
        return jnp.where(memory.flow >= self.high, smaller(rate, 0.0), inwards)

    def output(self, t: Scalar, memory: Memory, signal: Scalar) -> Scalar:
        """Return the control, for a brake its torque [N m]."""
        del t, signal
        return clamp(memory.flow, self.low, self.high)

    def rules(self) -> Iterator[Rule]:
        """Yield the rule low < high."""
        yield order_rule(("low", self.low), ("high", self.high), "{control}", equal=False)
