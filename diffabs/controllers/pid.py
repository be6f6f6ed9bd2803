"""PID control of the plant's first signal, with filtered derivative and limits.

    u = clamp(ff + kp e + kI I + kD wc (e - d), low, high),   I' = e,   d' = wc (e - d),   e = target - signal

P, PI and PD controllers are special cases with gains of zero.

Source: Aoki and Nakamura, eq. (13): C(s) = kp + kI/s + kD s wc/(s + wc). Their u has the opposite sign; here a positive
u brakes.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from diffabs.controllers.antiwindup import NoAntiWindup
from diffabs.core.numerics import clamp
from diffabs.core.protocols import Memory, Tracking
from diffabs.core.pytree import param, part, pytree
from diffabs.core.rules import Rule, order_rule
from diffabs.core.types import Part, Scalar


class PIDMemory(NamedTuple):
    """Continuous memory of the PID.

    Attributes:
        integral: I, integral of the error [signal s].
        filtered: d, filtered error [signal].
    """

    integral: Scalar
    filtered: Scalar


@pytree
class PID:
    """u = clamp(ff + kp e + kI I + kD wc (e - d), low, high); by default both limits are infinite.

    Attributes:
        kp: Proportional gain [control/signal].
        ki: Integral gain kI [control/signal/s].
        kd: Derivative gain kD [control s/signal].
        cutoff: Corner frequency wc of the derivative filter [rad/s].
        low: Lower limit of the control.
        high: Upper limit of the control.
        antiwindup: Anti-windup strategy of the integral.
    """

    kp: Scalar = param(default=3893.0, unit="control/signal", low=0.0)
    ki: Scalar = param(default=0.0, unit="control/signal/s", low=0.0)
    kd: Scalar = param(default=0.0, unit="control s/signal", low=0.0)
    cutoff: Scalar = param(default=55.0, unit="rad/s", above=0.0)
    low: Scalar = param(default=-np.inf, unit="control", below=np.inf, infinite=True)
    high: Scalar = param(default=np.inf, unit="control", above=-np.inf, infinite=True)
    antiwindup: Part = part(default=NoAntiWindup)

    def start(self, signal: Tracking) -> Memory:
        """Return the memory with integral and filter at zero."""
        zero = 0.0 * signal.measured[0]
        return Memory(flow=PIDMemory(zero, zero))

    def flow(self, t: Scalar, memory: Memory, signal: Tracking) -> PIDMemory:
        """Return I' [signal], as modified by the anti-windup strategy, and d' [signal/s]."""
        raw, limited = self._torque(memory, signal)
        error = signal.target - signal.measured[0]
        integral = self.antiwindup.rate(error, self.ki, raw, limited)
        return PIDMemory(integral, self.cutoff * (error - memory.flow.filtered))

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Return the limited control, in the plant's unit."""
        return self._torque(memory, signal)[1]

    def _torque(self, memory: Memory, signal: Tracking) -> tuple[Scalar, Scalar]:
        error = signal.target - signal.measured[0]
        derivative = self.cutoff * (error - memory.flow.filtered)
        raw = signal.feedforward + self.kp * error + self.ki * memory.flow.integral + self.kd * derivative
        return raw, clamp(raw, self.low, self.high)

    def limits(self) -> tuple[Scalar, Scalar]:
        """Return the lower and the upper limit of the control."""
        return self.low, self.high

    def rules(self) -> Iterator[Rule]:
        """Yield the rule low <= high."""
        yield order_rule(("low", self.low), ("high", self.high), "{control}")
