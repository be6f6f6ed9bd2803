"""PID control of the plant's first signal, with filtered derivative and limits.

P, PI and PD controllers are special cases with gains of zero. Negative gains are reverse action, for a signal that a
positive command lowers: cooling, for example. With b = 0 and c = 0 the target acts through the integral alone.

The u of Aoki and Nakamura has the opposite sign; here a positive u brakes.
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
    """A PID controller with feed-forward, set-point weights, filtered derivative and limits, and gains of either sign.

    See also:
        `controllers.Clamping`, `controllers.BackCalculation`: Anti-windup strategies.
        `controllers.Cascade`: An outer and an inner controller.
        `controllers.StateFeedback`: u = K x.
        `tune.tune`: Gains by gradients.

    Notes:
        With the target r, the plant's first signal y and the feedforward ff

            u = clamp(ff + kp (b r - y) + kI I + kD wc (c r - y - d), low, high)
            I' = r - y,   d' = wc (c r - y - d)

        so the derivative part is kD s wc/(s + wc). At a limit, an anti-windup strategy changes I'. The set-point
        weights b and c change only the response to the target. They change neither the response to disturbances nor the
        margins of the loop. I and d start at zero, so the command begins with the derivative part kD wc (c r - y).

        The defaults of kp and wc belong to the quarter car of the first source (scenario `slip-estimator`). Sources: T.
        Aoki and Y. Nakamura, Anti-lock Brake System based on the Maximum Sliding Frictional Force, eq. (13), without
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
    """Lower limit of the command."""
    high: Scalar = param(default=np.inf, unit="control", above=-np.inf, infinite=True)
    """Upper limit of the command."""
    antiwindup: Part = part(default=NoAntiWindup)
    """Anti-windup strategy of the integral."""

    def start(self, signal: Tracking) -> Memory:
        zero = 0.0 * signal.measured[0]
        return Memory(flow=PIDMemory(zero, zero))

    def flow(self, t: Scalar, memory: Memory, signal: Tracking) -> PIDMemory:
        """Return I' [signal], as changed by the anti-windup strategy, and d' [signal/s]."""
        raw, limited = self._commands(memory, signal)
        integral = self.antiwindup.rate(signal.target - signal.measured[0], self.ki, raw, limited)
        return PIDMemory(integral, self._filter_rate(memory, signal))

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Return the limited command, in the unit of the plant's control."""
        return self._commands(memory, signal)[1]

    def _commands(self, memory: Memory, signal: Tracking) -> tuple[Scalar, Scalar]:
        """Return the command before and after the limits."""
        proportional = self.kp * (self.b * signal.target - signal.measured[0])
        derivative = self.kd * self._filter_rate(memory, signal)
        raw = signal.feedforward + proportional + self.ki * memory.flow.integral + derivative
        return raw, clamp(raw, self.low, self.high)

    def _filter_rate(self, memory: Memory, signal: Tracking) -> Scalar:
        """Return d' [signal/s]."""
        return self.cutoff * (self.c * signal.target - signal.measured[0] - memory.flow.filtered)

    def limits(self) -> tuple[Scalar, Scalar]:
        return self.low, self.high

    def rules(self) -> Iterator[Rule]:
        yield order_rule(("low", self.low), ("high", self.high), "{control}")

    def cautions(self) -> Iterator[str]:
        """Yield a line if the gains have different signs."""
        gains = {name: float(getattr(self, name)) for name in ("kp", "ki", "kd")}
        if min(gains.values()) < 0 < max(gains.values()):
            listing = ", ".join(f"{name} = {gain:g}" for name, gain in gains.items())
            yield f"{listing} have different signs: reverse action needs the same sign in all gains"
