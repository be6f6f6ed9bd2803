"""References with a known target: a constant for the plant's first signal, or a slip, fixed or filtered."""

from diffabs.core.protocols import BrakeOutput, Memory, no_flow, no_memory
from diffabs.core.pytree import param, pytree
from diffabs.core.types import Scalar


@pytree
class Setpoint:
    """target = value, for the first signal of the plant's output."""

    value: Scalar = param(default=1.0, unit="signal")
    """Target."""

    start = no_memory
    flow = no_flow

    def output(self, t: Scalar, memory: Memory, signal: object) -> Scalar:
        """Return the target, in the unit of that signal."""
        del t, memory, signal
        return self.value

    def setpoint(self, memory: Memory) -> Scalar:
        """Return the target, in the unit of that signal."""
        del memory
        return self.value


@pytree
class FixedSlip:
    """target = slip."""

    slip: Scalar = param(default=0.2, unit="1", above=0.0, high=1.0)
    """Target."""

    start = no_memory
    flow = no_flow

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> Scalar:
        """Return the target slip [1]."""
        del t, memory, signal
        return self.slip

    def setpoint(self, memory: Memory) -> Scalar:
        """Return the target slip [1]."""
        del memory
        return self.slip


@pytree
class FilteredSlip:
    """time_constant target' = slip - target, from the measured slip at the start.

    From slip 0 this is slip (1 - exp(-t/T)), which the loop can follow without overshoot.
    """

    slip: Scalar = param(default=0.2, unit="1", above=0.0, high=1.0)
    """Final target."""
    time_constant: Scalar = param(default=0.035, unit="s", above=0.0)
    """Time constant T of the low-pass filter."""

    def start(self, signal: BrakeOutput) -> Memory:
        """Return the memory with the measured slip."""
        return Memory(flow=signal.slip)

    def flow(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> Scalar:
        """Return target' [1/s]."""
        del t, signal
        return (self.slip - memory.flow) / self.time_constant

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> Scalar:
        """Return the present target slip [1]."""
        del t, signal
        return memory.flow

    def setpoint(self, memory: Memory) -> Scalar:
        """Return the final target slip, `slip` [1]."""
        del memory
        return self.slip
