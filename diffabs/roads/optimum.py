"""The best slip of a road: where its friction first peaks."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.numerics import clamp, ratio
from diffabs.core.protocols import Road
from diffabs.core.pytree import Scalar

GRID = 1024  # intervals of (0, 1]: resolves the peak of every road with a peak slip above 0.001
BISECTIONS = 50  # 2^-50 of an interval is below the spacing of float64


class Peak(NamedTuple):
    """Best slip [1] and the friction [1] there."""

    slip: Any
    mu: Any


def peak(road: Road, speed: Scalar = 0.0, distance: Scalar = 0.0) -> Peak:
    """Return the first local maximum of mu over slip in (0, 1] of a road; slip 1 where mu only rises (ice).

    speed, distance: of the vehicle [m/s] and along the road [m], at which the curve is looked at

    It is the first maximum that a braking wheel meets, not always the greatest: the rig's curve rises again towards
    lock. Bracketed on a grid, bisected on the slope, and polished by one Newton step s - mu'/mu'' whose derivative is
    that of the implicit function theorem, so slip and mu are differentiable in every parameter of the road.

    >>> from diffabs.roads import DRY_ASPHALT, peak
    >>> slip, mu = peak(DRY_ASPHALT)
    >>> print(f"{mu:.2f} at {slip:.2f}")
    1.17 at 0.17
    """

    def mu(s: Any) -> Any:
        return road.friction(s, speed, distance)

    def slope(s: Any) -> Any:
        return jax.jvp(mu, (s,), (jnp.ones_like(s),))[1]

    grid = jnp.linspace(0.0, 1.0, GRID + 1)
    values = jax.lax.stop_gradient(jax.vmap(mu)(grid))
    falls = values[1:] < values[:-1]
    inside = jnp.any(falls)
    top = jnp.argmax(falls)  # the first fall is after the top grid point

    def halve(_: Any, bracket: tuple[Any, Any]) -> tuple[Any, Any]:
        low, high = bracket
        middle = 0.5 * (low + high)
        rising = slope(middle) > 0
        return jnp.where(rising, middle, low), jnp.where(rising, high, middle)

    bracket = (grid[jnp.maximum(top - 1, 0)], grid[top + 1])
    low, high = jax.lax.fori_loop(0, BISECTIONS, halve, bracket)
    s0 = jax.lax.stop_gradient(0.5 * (low + high))
    curvature = jax.lax.stop_gradient(jax.jvp(slope, (s0,), (jnp.ones_like(s0),))[1])
    near = s0 - ratio(slope(s0), curvature)
    best = jnp.where(inside, clamp(near - ratio(slope(near), curvature), 0.0, 1.0), 1.0)  # each doubles the order
    return Peak(best, mu(best))
