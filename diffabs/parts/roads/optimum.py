"""The best slip of a road: the first maximum of its friction over slip."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.numerics import clamp, ratio
from diffabs.core.protocols import Road
from diffabs.core.types import Any, PyTree, Scalar

GRID = 1024  # intervals of (0, 1]: resolves the peak of every road with a peak slip above 0.001
BISECTIONS = 50  # 2^-50 of an interval is below the resolution of float64


class Peak(NamedTuple):
    """Best slip [1] and the friction coefficient there [1]."""

    slip: Scalar
    mu: Scalar


def peak(road: Road, speed: Scalar = 0.0, distance: Scalar = 0.0) -> Peak:
    """Return the first local maximum of mu over slip in (0, 1], as a pair (slip, mu); slip 1 where mu never falls.

    A braking wheel meets the first maximum first. It is not always the greatest: the rig's curve rises again towards
    lock. A grid of 1024 intervals brackets the maximum, so it misses narrower maxima. Bisection of the slope locates
    it. If mu never falls and is NaN at a slip above 0, slip and mu are NaN.

    Two Newton steps s - mu'/mu'' polish it and carry its derivative by the implicit function theorem. Slip and mu are
    thus differentiable in every parameter of the road. At a kink bisection alone locates the maximum. Its derivative is
    that of the point where both sides cross, each continued beyond the kink. A maximum at more than one slip has the
    derivative NaN.

    >>> from diffabs.parts.roads import DRY_ASPHALT, peak
    >>> slip, mu = peak(DRY_ASPHALT)
    >>> print(f"{mu:.2f} at {slip:.2f}")
    1.17 at 0.17

    Args:
        road: Friction curve.
        speed: Vehicle speed [m/s]; the default is the limit of a slow vehicle.
        distance: Place on the road [m].
    """

    def mu(s: Scalar) -> Any:
        return road.friction(s, speed, distance)

    def slope(s: Scalar) -> Scalar:
        return jax.jvp(mu, (s,), (jnp.ones_like(s),))[1]

    grid = jnp.linspace(0.0, 1.0, GRID + 1)
    values: jax.Array = jax.lax.stop_gradient(jax.vmap(mu)(grid))
    falls = (values[1:] < values[:-1]) & (values[:-1] > 0)  # a fitted curve may dip below 0 next to slip 0
    inside = jnp.any(falls)
    # A comparison with NaN is false, so a curve of NaN seems never to fall. At slip 0 a formula may be 0/0.
    lock = jnp.where(jnp.isnan(values[1:]).any(), jnp.nan, 1.0)
    top = jnp.argmax(falls)  # the first fall is after the top grid point

    def halve(_: object, bracket: tuple[PyTree, PyTree]) -> tuple[PyTree, PyTree]:
        low, high = bracket
        middle = 0.5 * (low + high)
        rising = slope(middle) > 0
        return jnp.where(rising, middle, low), jnp.where(rising, high, middle)

    bracket = (grid[jnp.maximum(top - 1, 0)], grid[top + 1])
    low, high = jax.lax.stop_gradient(jax.lax.fori_loop(0, BISECTIONS, halve, bracket))
    s0 = 0.5 * (low + high)
    curvature = jax.jvp(slope, (s0,), (jnp.ones_like(s0),))[1]
    # Where mu is smooth, only rounding is left of the slope. At a kink a Newton step would leave the bracket.
    smooth = jnp.abs(slope(s0)) < jnp.sqrt(jnp.finfo(s0.dtype).eps) * jnp.abs(curvature)

    def residual(s: Scalar) -> Scalar:
        at_low, at_high = (mu(end + (s - s0)) for end in (low, high))  # s is s0: only derivatives differ from mu(end)
        gap = at_low - at_high
        return jnp.where(smooth, slope(s), gap - jax.lax.stop_gradient(gap))  # bisection alone places a kink

    rate = jax.lax.stop_gradient(jnp.where(smooth, curvature, slope(low) - slope(high)))
    rate = jnp.where(inside, rate, 1.0)
    # The bracket carries no derivative. The first Newton step gives the first derivative of the maximum, and the second
    # step doubles the order of derivatives that are exact.
    near = s0 - _newton_step(residual(s0), rate)
    best = jnp.where(inside, clamp(near - _newton_step(residual(near), rate), 0.0, 1.0), lock)
    return Peak(best, mu(best))


@jax.custom_jvp
def _newton_step(residual: Scalar, rate: Scalar) -> Scalar:
    """Return residual/rate for a constant rate; where it is 0, the step is 0 and its derivative NaN."""
    return ratio(residual, rate)


@_newton_step.defjvp
def _step_slope(at: tuple[Scalar, ...], moves: tuple[Scalar, ...]) -> tuple[PyTree, PyTree]:
    return _newton_step(*at), moves[0] / jnp.where(at[1] == 0, jnp.nan, at[1])
