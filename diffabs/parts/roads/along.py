"""A road whose friction changes along the distance: another road times a cubic spline of the distance.

    mu(s, v, x) = f(x) mu_0(s, v, x),   f(x) = sum_i c_i B(x/d - i),   i = 0 ... n - 1

B is the cubic B-spline on the knots -2 ... 2. It is positive with sum 1, so f lies between the least and the greatest
factor c and is C2. Its slope |f'| is at most the greatest |c_(i+1) - c_i|/d. The first and the last factor continue
before 0 and beyond (n - 1) d.

Source: C. de Boor, A Practical Guide to Splines, ch. IX, XI.
"""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.numerics import clamp
from diffabs.core.protocols import Road
from diffabs.core.pytree import param, part, pytree
from diffabs.core.types import Scalar, Vector
from diffabs.parts.roads.burckhardt import DRY_ASPHALT

FIRST_NODE, LAST = 2, 1  # intervals before 0 and beyond the last factor after which the spline is constant


@pytree
class ScaledAlong:
    """f(x) mu of another road, with f a cubic B-spline along the distance x.

    Factor i belongs to the distance i * `spacing`. The spline smooths them and does not pass through them.

    >>> from diffabs.parts.roads import RIG, ScaledAlong
    >>> road = ScaledAlong(road=RIG, factors=(1.0, 1.0, 1.0, 0.5, 0.5, 0.5), spacing=2.0)
    >>> print(*(f"{road.friction(0.2, 10.0, at) / RIG.friction(0.2):.3f}" for at in (0.0, 5.0, 100.0)))
    1.000 0.750 0.500
    """

    road: Road = part(default=DRY_ASPHALT)
    factors: Vector = param(default=(1.0, 0.9, 1.1, 1.0), unit="1", above=0.0, high=10.0, free=True)
    """Coefficients of the spline f, shape (n,)."""
    spacing: Scalar = param(default=1.0, unit="m", above=0.0)
    """Distance between the centres of two coefficients."""

    def friction(self, slip: Scalar, speed: Scalar, distance: Scalar) -> Scalar:
        """Return mu [1] at a `slip` [1], vehicle `speed` [m/s] and `distance` on the road [m]."""
        return self.factor(distance) * self.road.friction(slip, speed, distance)

    def factor(self, distance: Scalar) -> Scalar:
        """Return f [1] at a `distance` on the road [m]."""
        c = jnp.asarray(self.factors)
        ends = jnp.ones(FIRST_NODE + LAST)
        padded = jnp.concatenate([c[0] * ends, c, c[-1] * ends])
        place = clamp(distance / self.spacing, -1.0 * FIRST_NODE, 1.0 * (c.size - 1 + FIRST_NODE))
        # The spline is C2 across nodes, so the jump of `floor` needs no derivative.
        whole = jax.lax.stop_gradient(jnp.floor(place))
        t = place - whole
        near = jax.lax.dynamic_slice_in_dim(padded, whole.astype(int) + FIRST_NODE, 4)
        a, b = 1 - t, t * t * t
        weights = (a * a * a, 4 + 3 * t * t * (t - 2), 4 + 3 * a * a * (a - 2), b)
        return sum(w * near[i] for i, w in enumerate(weights)) / 6

    def problems(self) -> Iterator[str]:
        """Yield a message if `factors` is not a vector of at least one factor."""
        if np.ndim(self.factors) != 1 or np.size(self.factors) < 1:
            yield f"factors has shape {np.shape(self.factors)}; it needs (n,), n at least 1"
