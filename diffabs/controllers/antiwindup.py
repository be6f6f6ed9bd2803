"""What an integrator does while the output is at a limit.

Each strategy gives I', the rate of the integral of the error, for a controller whose output is limit(... + gain * I).
"""

import jax.numpy as jnp

from diffabs.core.numerics import ratio
from diffabs.core.pytree import Scalar, param, pytree


@pytree
class NoAntiWindup:
    """I' = e: the integral goes on."""

    def rate(self, error: Scalar, gain: Scalar, raw: Scalar, limited: Scalar) -> Scalar:
        """I'."""
        del gain, raw, limited
        return error


@pytree
class Clamping:
    """I' = e, but 0 while the output is at a limit and gain * e would push it further out (conditional integration)."""

    jumps = True

    def rate(self, error: Scalar, gain: Scalar, raw: Scalar, limited: Scalar) -> Scalar:
        """I'."""
        outward = (raw - limited) * gain * error > 0
        return jnp.where(outward, 0.0, error)


@pytree
class BackCalculation:
    """I' = e + (limited - raw)/(gain * Tt): the excess drains with the tracking time Tt.

    Astrom and Hagglund, PID Controllers, 2nd ed., sec. 3.5.
    """

    tracking_time: Scalar = param(default=0.05, unit="s", above=0.0)

    def rate(self, error: Scalar, gain: Scalar, raw: Scalar, limited: Scalar) -> Scalar:
        """I'; with gain 0 there is nothing to drain."""
        return error + ratio(limited - raw, gain * self.tracking_time)
