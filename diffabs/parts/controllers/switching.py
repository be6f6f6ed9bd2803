"""Controllers without a plant model: constant torque, relay with hysteresis, sliding mode."""

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np

from diffabs.core.numerics import clamp
from diffabs.core.protocols import Memory, Tracking, no_flow, no_memory
from diffabs.core.pytree import param, pytree
from diffabs.core.rules import Rule, order_rule
from diffabs.core.types import PyTree, Scalar


@pytree
class ConstantTorque:
    """u = torque, regardless of the target: a driver who brakes fully, without anti-lock control."""

    torque: Scalar = param(default=90.0, unit="control")
    """Constant control."""

    start = no_memory
    flow = no_flow

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Return the control, for a brake its torque [N m]."""
        del t, memory, signal
        return self.torque


@pytree
class Relay:
    """high until slip > target + band, then low until slip < target - band.

    An event locates each switch where the slip crosses the edge of the band, also between grid instants. The memory is
    1 while the brake is applied, else 0.
    """

    band: Scalar = param(default=0.02, unit="signal", above=0.0, below=1.0)
    """Half width of the hysteresis."""
    low: Scalar = param(default=0.0, unit="control")
    """Lower limit of the control, that of a released brake."""
    high: Scalar = param(default=90.0, unit="control")
    """Upper limit of the control, that of an applied brake."""

    flow = no_flow

    def start(self, signal: Tracking) -> Memory:
        """Return 1 (brake applied) if the slip is below the target, else 0."""
        excess = signal.measured[0] - signal.target
        return Memory(held=jnp.where(excess < 0, 1.0, 0.0) + 0.0 * excess)

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Return the control, for a brake its torque [N m]."""
        del t, signal
        return self.low + memory.held * (self.high - self.low)

    def margins(self, t: Scalar, memory: Memory, signal: Tracking, rate: object) -> tuple[PyTree]:
        """Return the signed distance to the switching edge, in the signal's unit: positive before the edge, negative
        beyond.

        The edge is target + band while the brake is applied, else target - band.
        """
        del t, rate
        excess = signal.measured[0] - signal.target
        return (self.band + jnp.where(memory.held > 0.5, -excess, excess),)

    def event(self, t: Scalar, memory: Memory, signal: Tracking, fired: tuple[PyTree]) -> Memory:
        """Return the memory with the brake toggled if the event has fired."""
        del t, signal
        return Memory(held=jnp.where(fired[0], 1.0 - memory.held, memory.held))

    def rules(self) -> Iterator[Rule]:
        """Yield the rule low < high."""
        yield order_rule(("low", self.low), ("high", self.high), "{control}", equal=False)


@pytree
class SlidingMode:
    """u = clamp(ff + gain sat((target - signal)/boundary), low, high), sat(z) = clamp(z, -1, 1).

    First-order sliding mode with a boundary layer. By default both limits are infinite.

    Source: Slotine and Li, Applied Nonlinear Control, sec. 7.2.
    """

    gain: Scalar = param(default=90.0, unit="control", low=0.0)
    """Greatest distance of the control from the feed-forward."""
    boundary: Scalar = param(default=0.02, unit="signal", above=0.0)
    """Half width of the boundary layer."""
    low: Scalar = param(default=-np.inf, unit="control", below=np.inf, infinite=True)
    """Lower limit of the control."""
    high: Scalar = param(default=np.inf, unit="control", above=-np.inf, infinite=True)
    """Upper limit of the control."""

    start = no_memory
    flow = no_flow

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Return the limited control, for a brake its torque [N m]."""
        del t, memory
        inside = clamp((signal.target - signal.measured[0]) / self.boundary, -1.0, 1.0)
        return clamp(signal.feedforward + self.gain * inside, self.low, self.high)

    def limits(self) -> tuple[Scalar, Scalar]:
        """Return the lower and the upper limit of the control."""
        return self.low, self.high

    def rules(self) -> Iterator[Rule]:
        """Yield the rule low <= high."""
        yield order_rule(("low", self.low), ("high", self.high), "{control}")
