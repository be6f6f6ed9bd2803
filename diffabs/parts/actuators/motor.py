"""Voltage limit of a motor's supply."""

from diffabs.core.numerics import clamp
from diffabs.core.protocols import Memory, no_flow, no_memory
from diffabs.core.pytree import param, pytree
from diffabs.core.types import Scalar


@pytree
class VoltageLimit:
    """control = clamp(command, -high, high)."""

    high: Scalar = param(default=48.0, unit="V", above=0.0)
    """Upper limit of the control; the lower one is its negative."""

    start = no_memory
    flow = no_flow

    def output(self, t: Scalar, memory: Memory, signal: Scalar) -> Scalar:
        """Return the voltage at the motor [V]."""
        del t, memory
        return clamp(signal, -self.high, self.high)

    def limits(self) -> tuple[Scalar, Scalar]:
        """Return the lower and the upper limit of the control."""
        return -self.high, self.high
