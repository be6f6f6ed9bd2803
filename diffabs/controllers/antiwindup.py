"""Anti-windup strategies: the rate of an integrator while the controller's output is at a limit.

Each strategy returns I', the rate of the integral of the error, for a controller with the output limit(... + gain * I).
The error has the controller's own sign: target - signal in a PID, signal - target in a state feedback.
"""

import jax.numpy as jnp

from diffabs.core.numerics import ratio
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
    """Conditional integration: I' = e, but I' = 0 while the output is at a limit and gain * e would push it further
    out.
    """

    jumps = True

    def rate(self, error: Scalar, gain: Scalar, raw: Scalar, limited: Scalar) -> Scalar:
        """Return I', in the unit of `error`: 0 if (raw - limited) * gain * error > 0, else `error`.

        `gain` is the integral's gain, `raw` the output before the limit and `limited` the output after it.
        """
        outward = (raw - limited) * gain * error > 0
        return jnp.where(outward, 0.0, error)


@pytree
class BackCalculation:
    """I' = e + (limited - raw)/(gain * Tt): the excess over the limit decays with the tracking time Tt.

    Attributes:
        tracking_time: Tt [s], > 0.

    Source: Astrom and Hagglund, PID Controllers, 2nd ed., sec. 3.5.
    """

    tracking_time: Scalar = param(default=0.05, unit="s", above=0.0)

    def rate(self, error: Scalar, gain: Scalar, raw: Scalar, limited: Scalar) -> Scalar:
        """Return I' = error + (limited - raw)/(gain * Tt), in the unit of `error`.

        `gain` is the integral's gain, `raw` the output before the limit and `limited` the output after it. If `gain` is
        0, the integral has no effect on the output, so I' = `error`.
        """
        # `ratio` is 0 with zero derivatives where its denominator is 0: a PID without integral action has gain 0.
        return error + ratio(limited - raw, gain * self.tracking_time)
