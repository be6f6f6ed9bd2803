"""The reference of a balance: upright."""

from diffabs.core.protocols import BalanceOutput, Memory, no_flow
from diffabs.core.pytree import Scalar, pytree


@pytree
class Upright:
    """target = 0: every angle, every rate."""

    flow = no_flow

    def start(self, signal: BalanceOutput) -> Memory:
        """Zero, of the signal's type."""
        return Memory(held=0.0 * signal.theta)

    def output(self, t: Scalar, memory: Memory, signal: BalanceOutput) -> Scalar:
        """Target angle [rad]."""
        del t, signal
        return memory.held

    def setpoint(self, memory: Memory) -> Scalar:
        """The same."""
        return memory.held
