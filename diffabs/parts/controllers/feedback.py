"""State feedback with integral action and feed-forward.

    u = clamp(ff + K x, u_min, u_max),   x = (integral of (slip - target), slip - target)

The sign convention is u = +K x, so a stabilising K is negative.

Source: Maeda and Sugiura, eqs. (18), (19), (23): tau1 = tau1* + K x.
"""

from collections.abc import Iterator

import numpy as np

from diffabs.core.numerics import clamp
from diffabs.core.protocols import Memory, Tracking
from diffabs.core.pytree import param, part, pytree
from diffabs.core.rules import Rule, order_rule
from diffabs.core.types import Part, Scalar, Vector
from diffabs.parts.controllers.antiwindup import NoAntiWindup


@pytree
class StateFeedback:
    """u = clamp(ff + k1 x1 + k2 x2, low, high). The default gain is the paper's (section 4)."""

    gain: Vector = param(default=(-11753.0, -48.0), unit="control/signal/s, control/signal")
    """(k1, k2), of the integral and of the slip error, shape (2,)."""
    low: Scalar = param(default=-np.inf, unit="control", below=np.inf, infinite=True)
    """Lower limit of the control."""
    high: Scalar = param(default=np.inf, unit="control", above=-np.inf, infinite=True)
    """Upper limit of the control."""
    antiwindup: Part = part(default=NoAntiWindup)
    """Anti-windup strategy of the integral."""

    def start(self, signal: Tracking) -> Memory:
        """Return the memory x1(0) = 0."""
        return Memory(flow=0.0 * signal.measured[0])

    def flow(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Return x1' = slip - target, in the signal's unit, as modified by the anti-windup strategy."""
        gain, error = self._gain(signal), signal.measured[0] - signal.target
        return self.antiwindup.rate(error, gain[0], *self._torque(gain, memory, signal))

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Return the limited control, for a brake its torque [N m]."""
        return self._torque(self._gain(signal), memory, signal)[1]

    def _gain(self, signal: Tracking) -> Vector:
        del signal
        return self.gain

    def _torque(self, gain: Vector, memory: Memory, signal: Tracking) -> tuple[Scalar, Scalar]:
        error = signal.measured[0] - signal.target
        raw = signal.feedforward + gain[0] * memory.flow + gain[1] * error
        return raw, clamp(raw, self.low, self.high)

    def limits(self) -> tuple[Scalar, Scalar]:
        """Return the lower and the upper limit of the control."""
        return self.low, self.high

    def rules(self) -> Iterator[Rule]:
        """Yield the rule low <= high."""
        yield order_rule(("low", self.low), ("high", self.high), "{control}")
