"""A target slip that follows the measured deceleration.

    T a_f' = a - a_f,   target = slips(a_f), linear between nodes and constant beyond them

A car that is braked near the peak of its friction curve decelerates by mu g, so the deceleration says how slippery the
road is, and a table says at which slip such roads have their peak, if they have it in common. No search, no memory but
the filter, which noise needs. A table that rises steeply feeds itself: more slip, more deceleration, more slip.
"""

from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np

from diffabs.core.numerics import interpolate_shares, interval_shares
from diffabs.core.protocols import BrakeOutput, Memory
from diffabs.core.pytree import Scalar, Vector, param, pytree
from diffabs.core.rules import Rule, increase_rule


@pytree
class SlipByDeceleration:
    """target = slips(a_f): slips at increasing decelerations, the deceleration behind a low-pass."""

    decelerations: Vector = param(default=(1.0, 3.0, 6.0, 10.0), unit="m/s^2", free=True)
    slips: Vector = param(default=(0.08, 0.1, 0.13, 0.16), unit="1", above=0.0, high=1.0, free=True)
    time_constant: Scalar = param(default=0.05, unit="s", above=0.0)

    def start(self, signal: BrakeOutput) -> Memory:
        """The filter at the first sample."""
        return Memory(flow=signal.deceleration)

    def flow(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> Scalar:
        """a_f'."""
        del t
        return (signal.deceleration - memory.flow) / self.time_constant

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> Scalar:
        """Target slip [1]."""
        del t, signal
        return self.setpoint(memory)

    def setpoint(self, memory: Memory) -> Any:
        """The target as known now. Raises ValueError for lists of different lengths."""
        nodes, slips = jnp.asarray(self.decelerations), jnp.asarray(self.slips)
        if nodes.shape != slips.shape:
            raise ValueError(f"decelerations and slips have shapes {nodes.shape} and {slips.shape}")
        return interpolate_shares(interval_shares(memory.flow, nodes), slips)

    def problems(self) -> Iterator[str]:
        """Lists of different lengths, or empty ones."""
        nodes, slips = np.shape(self.decelerations), np.shape(self.slips)
        if nodes != slips or len(nodes) != 1 or not nodes[0]:
            yield f"decelerations and slips have shapes {nodes} and {slips}; they need one"

    def rules(self) -> Iterator[Rule]:
        """Decelerations that increase."""
        yield increase_rule("decelerations", self.decelerations, "do not increase", "m/s^2")
