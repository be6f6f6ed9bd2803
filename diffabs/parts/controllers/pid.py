"""PID control of the plant's first signal, with filtered derivative and limits.

    u = clamp(ff + kp (b r - y) + kI I + kD wc (c r - y - d), low, high)
    I' = r - y,   d' = wc (c r - y - d)                                     r: target, y: signal

P, PI and PD controllers are special cases with gains of zero. Negative gains are reverse action, for a signal that a
positive control lowers: cooling, for example. The set-point weights b and c change the response to the target only;
that to disturbances and the margins of the loop stay. With b = 0 and c = 0 the target acts through the integral alone.

Sources: Aoki and Nakamura, eq. (13), for b = c = 1: C(s) = kp + kI/s + kD s wc/(s + wc). Their u has the opposite
sign; here a positive u brakes. Astrom and Hagglund, PID Controllers, 2nd ed., sec. 3.4, for b and c.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from diffabs.core.numerics import clamp
from diffabs.core.protocols import Memory, Tracking
from diffabs.core.pytree import param, part, pytree
from diffabs.core.rules import Rule, order_rule
from diffabs.core.types import Part, Scalar
from diffabs.parts.controllers.antiwindup import NoAntiWindup


class PIDMemory(NamedTuple):
    """Continuous memory of the PID.

    Attributes:
        integral: I, integral of the error [signal s].
        filtered: d, filtered error c r - y [signal].
    """

    integral: Scalar
    filtered: Scalar


@pytree
class PID:
    """u = clamp(ff + kp (b r - y) + kI I + kD wc (c r - y - d), low, high), with any sign of the gains.

    See also:
        `controllers.Clamping`, `controllers.BackCalculation`: Anti-windup strategies.
        `controllers.Cascade`: An outer and an inner controller.
        `controllers.StateFeedback`: u = K x.
        `tune.tune`: Gains by gradients.

    Notes:
        With the target r, the plant's first signal y and the feedforward ff

            u = clamp(ff + kp (b r - y) + kI I + kD wc (c r - y - d), low, high)
            I' = r - y,   d' = wc (c r - y - d)

        so the derivative part is kD s wc/(s + wc). The set-point weights b and c change the response to the target
        only; that to disturbances and the margins of the loop stay. Sources: Aoki and Nakamura, eq. (13), without
        weights; K. J. Astrom and T. Hagglund, PID Controllers: Theory, Design, and Tuning, 2nd ed., 1995, sec. 3.4, for
        the weights.

    Examples:
        >>> from diffabs.parts.controllers import PID
        >>> from diffabs.core.protocols import Tracking
        >>> pid = PID(kp=100.0, ki=20.0, low=0.0, high=30.0)
        >>> signal = Tracking(target=0.2, measured=(0.05,), feedforward=10.0)
        >>> print(f"{pid.output(0.0, pid.start(signal), signal):.1f}")  # 10 + 100 (0.2 - 0.05)
        25.0

        A greater error meets the upper limit:

        >>> signal = Tracking(target=0.9, measured=(0.05,), feedforward=10.0)
        >>> print(f"{pid.output(0.0, pid.start(signal), signal):.1f}")
        30.0
    """

    kp: Scalar = param(default=3893.0, unit="control/signal")
    """Proportional gain. Negative gains are reverse action."""
    ki: Scalar = param(default=0.0, unit="control/signal/s")
    """Integral gain kI."""
    kd: Scalar = param(default=0.0, unit="control s/signal")
    """Derivative gain kD."""
    b: Scalar = param(default=1.0, unit="1", low=0.0)
    """Set-point weight of the proportional part."""
    c: Scalar = param(default=1.0, unit="1", low=0.0)
    """Set-point weight of the derivative part."""
    cutoff: Scalar = param(default=55.0, unit="rad/s", above=0.0)
    """Corner frequency wc of the derivative's low-pass filter."""
    low: Scalar = param(default=-np.inf, unit="control", below=np.inf, infinite=True)
    """Lower limit of the control."""
    high: Scalar = param(default=np.inf, unit="control", above=-np.inf, infinite=True)
    """Upper limit of the control."""
    antiwindup: Part = part(default=NoAntiWindup)
    """Anti-windup strategy of the integral."""

    def start(self, signal: Tracking) -> Memory:
        """Return the memory with integral and filter at zero."""
        zero = 0.0 * signal.measured[0]
        return Memory(flow=PIDMemory(zero, zero))

    def flow(self, t: Scalar, memory: Memory, signal: Tracking) -> PIDMemory:
        """Return I' [signal], as modified by the anti-windup strategy, and d' [signal/s]."""
        raw, limited = self._torque(memory, signal)
        integral = self.antiwindup.rate(signal.target - signal.measured[0], self.ki, raw, limited)
        return PIDMemory(integral, self._filter_rate(memory, signal))

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Return the limited control, in the plant's unit."""
        return self._torque(memory, signal)[1]

    def _torque(self, memory: Memory, signal: Tracking) -> tuple[Scalar, Scalar]:
        proportional = self.kp * (self.b * signal.target - signal.measured[0])
        derivative = self.kd * self._filter_rate(memory, signal)
        raw = signal.feedforward + proportional + self.ki * memory.flow.integral + derivative
        return raw, clamp(raw, self.low, self.high)

    def _filter_rate(self, memory: Memory, signal: Tracking) -> Scalar:
        """Return d' [signal/s]."""
        return self.cutoff * (self.c * signal.target - signal.measured[0] - memory.flow.filtered)

    def limits(self) -> tuple[Scalar, Scalar]:
        """Return the lower and the upper limit of the control."""
        return self.low, self.high

    def rules(self) -> Iterator[Rule]:
        """Yield the rule low <= high."""
        yield order_rule(("low", self.low), ("high", self.high), "{control}")

    def cautions(self) -> Iterator[str]:
        """Yield a line if the gains have different signs."""
        gains = {name: float(getattr(self, name)) for name in ("kp", "ki", "kd")}
        if min(gains.values()) < 0 < max(gains.values()):
            listing = ", ".join(f"{name} = {gain:g}" for name, gain in gains.items())
            yield f"{listing} have different signs: reverse action needs the same sign in all gains"
