"""Actuators that are a gain or a differential equation: limits, lag, rate limit."""

from collections.abc import Iterator

import numpy as np

from diffabs.core.numerics import clamp, quotient
from diffabs.core.protocols import Memory, no_flow, no_memory
from diffabs.core.pytree import Scalar, param, pytree
from diffabs.core.rules import Rule, order_rule


@pytree
class Limits:
    """control = clamp(command, low, high), without limits by default."""

    low: Scalar = param(default=-np.inf, unit="control", infinite=True)
    high: Scalar = param(default=np.inf, unit="control", infinite=True)

    start = no_memory
    flow = no_flow

    def output(self, t: Scalar, memory: Memory, signal: Scalar) -> Scalar:
        """Control: a brake's torque [N m]."""
        del t, memory
        return clamp(signal, self.low, self.high)

    def limits(self) -> tuple[Scalar, Scalar]:
        """Between which the control stays."""
        return self.low, self.high

    def rules(self) -> Iterator[Rule]:
        """Limits that do not exclude each other."""
        yield order_rule(("low", self.low), ("high", self.high), "{control}")


@pytree
class Lag:
    """time_constant control' = command - control, control(0) = 0: a brake that has to build up pressure."""

    time_constant: Scalar = param(default=0.01, unit="s", above=0.0)

    def start(self, signal: Scalar) -> Memory:
        """Brake released."""
        return Memory(flow=0.0 * signal)

    def flow(self, t: Scalar, memory: Memory, signal: Scalar) -> Scalar:
        """control'."""
        del t
        return quotient(signal - memory.flow, self.time_constant)

    def output(self, t: Scalar, memory: Memory, signal: Scalar) -> Scalar:
        """Control: a brake's torque [N m]."""
        del t, signal
        return memory.flow


@pytree
class RateLimit:
    """control' = clamp((command - control)/time_constant, -rate, rate), control(0) = 0.

    A servo whose speed saturates; the ideal rate limiter is the limit of a small time constant.
    """

    rate: Scalar = param(default=1000.0, unit="control/s", above=0.0)
    time_constant: Scalar = param(default=0.002, unit="s", above=0.0)

    start = Lag.start
    output = Lag.output

    def flow(self, t: Scalar, memory: Memory, signal: Scalar) -> Scalar:
        """control'."""
        del t
        return clamp(quotient(signal - memory.flow, self.time_constant), -self.rate, self.rate)
