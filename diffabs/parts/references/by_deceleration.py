"""A target slip that is a function of the measured deceleration.

    T a_f' = a - a_f,   target = slips(a_f), linear between nodes and constant beyond them

A car that brakes near the peak of its friction curve decelerates at mu g, so the deceleration measures the road's
friction. A table gives the slip of the peak for each deceleration, if roads of equal friction share their peak slip.
There is no search, and the only memory is the low-pass filter against noise. A steep table can cause positive feedback:
more slip, more deceleration, more slip.
"""

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np

from diffabs.core.numerics import interpolate_shares, interval_shares
from diffabs.core.protocols import BrakeOutput, Memory
from diffabs.core.pytree import param, pytree
from diffabs.core.rules import Rule, increase_rule
from diffabs.core.types import Scalar, Vector


@pytree
class SlipByDeceleration:
    """target = slips(a_f): a table of slips at increasing decelerations, read at the low-pass filtered deceleration
    a_f.
    """

    decelerations: Vector = param(default=(1.0, 3.0, 6.0, 10.0), unit="m/s^2", free=True)
    """Nodes, increasing."""
    slips: Vector = param(default=(0.08, 0.1, 0.13, 0.16), unit="1", above=0.0, high=1.0, free=True)
    """Targets at the nodes."""
    time_constant: Scalar = param(default=0.05, unit="s", above=0.0)
    """Time constant T of the low-pass filter."""

    def start(self, signal: BrakeOutput) -> Memory:
        """Return the memory with a_f at the measured deceleration."""
        return Memory(flow=signal.deceleration)

    def flow(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> Scalar:
        """Return a_f' [m/s^3]."""
        del t
        return (signal.deceleration - memory.flow) / self.time_constant

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> Scalar:
        """Return the present target slip [1]."""
        del t, signal
        return self.setpoint(memory)

    def setpoint(self, memory: Memory) -> Scalar:
        """Return the present target slip [1], the same as `output`."""
        nodes, slips = jnp.asarray(self.decelerations), jnp.asarray(self.slips)
        return interpolate_shares(interval_shares(memory.flow, nodes), slips)

    def problems(self) -> Iterator[str]:
        """Yield a message if the two lists differ in shape, or are empty."""
        nodes, slips = np.shape(self.decelerations), np.shape(self.slips)
        if nodes != slips or len(nodes) != 1 or not nodes[0]:
            yield f"decelerations and slips have shapes {nodes} and {slips}; they need one"

    def rules(self) -> Iterator[Rule]:
        """Yield the rule that the decelerations increase."""
        yield increase_rule("decelerations", self.decelerations, "do not increase", "m/s^2")
