"""Actuators without a dead time: limits, lags and rate limit."""

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np

from diffabs.core.numerics import clamp, quotient
from diffabs.core.protocols import Memory, no_flow, no_memory
from diffabs.core.pytree import param, pytree
from diffabs.core.rules import Rule, order_rule
from diffabs.core.types import Scalar


@pytree
class Limits:
    """control = clamp(command, low, high); by default both limits are infinite."""

    low: Scalar = param(default=-np.inf, unit="control", below=np.inf, infinite=True)
    """Lower limit of the control."""
    high: Scalar = param(default=np.inf, unit="control", above=-np.inf, infinite=True)
    """Upper limit of the control."""

    start = no_memory
    flow = no_flow

    def output(self, t: Scalar, memory: Memory, signal: Scalar) -> Scalar:
        """Return the clamped command, for a brake its torque [N m]."""
        del t, memory
        return clamp(signal, self.low, self.high)

    def limits(self) -> tuple[Scalar, Scalar]:
        """Return the lower and the upper limit of the control."""
        return self.low, self.high

    def rules(self) -> Iterator[Rule]:
        """Yield the rule low <= high."""
        yield order_rule(("low", self.low), ("high", self.high), "{control}")


@pytree
class Lag:
    """time_constant control' = command - control, control(0) = 0: a brake that builds up pressure."""

    time_constant: Scalar = param(default=0.01, unit="s", above=0.0)
    """Time constant of the control."""

    def start(self, signal: Scalar) -> Memory:
        """Return the memory of a released brake: control 0."""
        # 0.0 * signal has type and shape of the signal, so a loop carry keeps its type.
        return Memory(flow=0.0 * signal)

    def flow(self, t: Scalar, memory: Memory, signal: Scalar) -> Scalar:
        """Return control', in the control's unit per second."""
        del t
        return quotient(signal - memory.flow, self.time_constant)

    def output(self, t: Scalar, memory: Memory, signal: Scalar) -> Scalar:
        """Return the control, for a brake its torque [N m]."""
        del t, signal
        return memory.flow


@pytree
class AsymmetricLag:
    """T control' = command - control, control(0) = 0, with T = rise where the command is greater, else T = fall.

    A hydraulic brake builds its pressure up slower, or faster, than it releases it.
    """

    rise: Scalar = param(default=0.02, unit="s", above=0.0)
    """Time constant towards a greater command."""
    fall: Scalar = param(default=0.01, unit="s", above=0.0)
    """Time constant towards a smaller command."""

    start = Lag.start
    output = Lag.output

    def flow(self, t: Scalar, memory: Memory, signal: Scalar) -> Scalar:
        """Return control', in the control's unit per second."""
        del t
        excess = signal - memory.flow
        return quotient(excess, jnp.where(excess > 0, self.rise, self.fall))


@pytree
class RateLimit:
    """control' = clamp((command - control)/time_constant, -rate, rate), control(0) = 0.

    This models a servo whose speed saturates. As time_constant goes to 0, the model becomes the ideal rate limiter.
    """

    rate: Scalar = param(default=1000.0, unit="control/s", above=0.0)
    """Greatest |control'|."""
    time_constant: Scalar = param(default=0.002, unit="s", above=0.0)
    """Time constant of the servo below this rate."""

    start = Lag.start
    output = Lag.output

    def flow(self, t: Scalar, memory: Memory, signal: Scalar) -> Scalar:
        """Return control', in the control's unit per second."""
        del t
        return clamp(quotient(signal - memory.flow, self.time_constant), -self.rate, self.rate)
