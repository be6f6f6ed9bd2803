"""The reference of a balance: the upright position."""

from diffabs.core.protocols import BalanceOutput, Memory, no_flow
from diffabs.core.pytree import pytree
from diffabs.core.types import Scalar


@pytree
class Upright:
    """target = 0: the angle theta in the upright position."""

    flow = no_flow

    def start(self, signal: BalanceOutput) -> Memory:
        """Return the memory with the target 0, in the type of the signal."""
        return Memory(held=0.0 * signal.theta)

    def output(self, t: Scalar, memory: Memory, signal: BalanceOutput) -> Scalar:
        """Return the target angle 0 [rad]."""
        del t, signal
        return memory.held

    def setpoint(self, memory: Memory) -> Scalar:
        """Return the target angle 0 [rad]."""
        return memory.held
