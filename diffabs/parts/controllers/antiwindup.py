"""Anti-windup strategies: the rate of an integrator while the controller's output is at a limit.

Each strategy returns I', the rate of the integral of the error, for a controller with the output limit(... + gain * I).
The error has the controller's own sign: target - signal in a PID, signal - target in a state feedback.
"""

from diffabs.core.numerics import clamp, larger, ratio, smaller
from diffabs.core.pytree import param, pytree
from diffabs.core.types import Scalar


@pytree
class NoAntiWindup:
    """I' = e: the integration continues while the output is at a limit."""

    def rate(self, error: Scalar, gain: Scalar, raw: Scalar, limited: Scalar) -> Scalar:
        """Return I' = `error`, in the error's unit; `gain`, `raw` and `limited` have no effect."""
        del gain, raw, limited
        return error


@pytree
class Clamping:
    """Conditional integration: I' = e, but at a limit I' goes to 0 where gain * e would push the output further out.

        I' = e - (raw - limited)/(gain * Tt), limited to between 0 and e

    The textbook law stops the integral at once, and then chatters along the limit: with the integral the output goes
    beyond it, without the integral it returns. Filippov's equivalent rate lies between 0 and e and keeps the output on
    the limit. This law is continuous and its I' tends to that rate as Tt goes to 0. Metrics differ from those of the
    textbook law by a share of order Tt^2. A sampled controller uses its period instead of a shorter Tt.

    Source: Astrom and Hagglund, PID Controllers, 2nd ed., sec. 3.5 (conditional integration, back-calculation);
        Filippov, Differential Equations with Discontinuous Righthand Sides, sec. 4 (equivalent rate).
    """

    tracking_time: Scalar = param(default=0.01, unit="s", above=0.0)
    """Time constant Tt. A fixed step of a run may be at most 2.78 Tt."""

    def rate(self, error: Scalar, gain: Scalar, raw: Scalar, limited: Scalar) -> Scalar:
        """Return I', in the unit of `error`: between 0 and `error`, and `error` where the output is not limited.

        `gain` is the integral's gain, `raw` the output before the limit and `limited` the output after it.
        """
        excess = ratio(raw - limited, gain * self.tracking_time)
        return error - clamp(excess, smaller(0.0 * error, error), larger(0.0 * error, error))

    def at_period(self, period: Scalar) -> "Clamping":
        """Return the strategy for Euler steps of `period` [s]: shorter tracking times would chatter."""
        return Clamping(tracking_time=larger(self.tracking_time, period))


@pytree
class BackCalculation:
    """I' = e + (limited - raw)/(gain * Tt): the excess over the limit decays with the tracking time Tt.

    Source: Astrom and Hagglund, PID Controllers, 2nd ed., sec. 3.5.
    """

    tracking_time: Scalar = param(default=0.05, unit="s", above=0.0)
    """Time constant Tt."""

    def rate(self, error: Scalar, gain: Scalar, raw: Scalar, limited: Scalar) -> Scalar:
        """Return I' = error + (limited - raw)/(gain * Tt), in the unit of `error`.

        `gain` is the integral's gain, `raw` the output before the limit and `limited` the output after it. If `gain` is
        0, the integral has no effect on the output, so I' = `error`.
        """
        # `ratio` is 0 with zero derivatives where its denominator is 0: a PID without integral action has gain 0.
        return error + ratio(limited - raw, gain * self.tracking_time)
