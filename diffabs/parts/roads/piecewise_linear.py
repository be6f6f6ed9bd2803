"""A friction table with straight lines between its knots.

    mu(s) = mu_i + (s - s_i) (mu_(i+1) - mu_i)/(s_(i+1) - s_i)  for s_i <= s <= s_(i+1),   odd in s

Lookup tables of simulation programs interpolate like this. The slope of the curve jumps at the knots. `Tabulated` is
the smooth curve through the same knots.

The default is the table of anti-lock brake models that follow The MathWorks' `sldemo_absbrake`.
"""

import jax.numpy as jnp

from diffabs.core.pytree import param, pytree
from diffabs.core.types import Scalar, Vector
from diffabs.parts.roads.tabulated import PiecewiseCubic, Tabulated

TABLE = (  # slip from 0 to 1 in steps of 0.05, and friction
    tuple(round(0.05 * i, 2) for i in range(21)),
    (0, 0.4, 0.8, 0.97, 1, 0.98, 0.96, 0.94, 0.92, 0.9, 0.88,
     0.855, 0.83, 0.81, 0.79, 0.77, 0.75, 0.73, 0.72, 0.71, 0.7),
)  # fmt: skip


@pytree
class PiecewiseLinear:
    """Straight lines through (slip, mu); the knots start at (0, 0), increase, and end at slip 1.

    >>> from diffabs.parts.roads import PiecewiseLinear
    >>> wet = PiecewiseLinear(slip=(0.0, 0.1, 0.3, 1.0), mu=(0.0, 0.7, 0.6, 0.5))
    >>> print(f"{wet.friction(0.1):.2f} {wet.friction(0.2):.2f}")
    0.70 0.65
    """

    slip: Vector = param(default=TABLE[0], unit="1", low=0.0, high=1.0, free=True)
    """Knots, increasing from 0 to 1, shape (n,)."""
    mu: Vector = param(default=TABLE[1], unit="1", low=0.0, free=True)
    """Friction at the knots, shape (n,)."""

    problems, rules = Tabulated.problems, Tabulated.rules

    def friction(self, slip: Scalar, speed: Scalar = 0.0, distance: Scalar = 0.0) -> Scalar:
        """Return mu [1] at a `slip` [1], constant beyond the last knot; `speed` and `distance` have no effect."""
        return self.prepared().friction(slip, speed, distance)

    def prepared(self) -> PiecewiseCubic:
        """Return the same curve with its slopes computed once for a whole run.

        Raises:
            ValueError: `slip` and `mu` differ in length, or have fewer than 3 knots.
        """
        x, y = jnp.asarray(self.slip), jnp.asarray(self.mu)
        if x.shape != y.shape or x.ndim != 1 or x.size < 3:
            raise ValueError(f"slip and mu have shapes {x.shape} and {y.shape}; both need one length of at least 3")
        slope = jnp.diff(y) / jnp.diff(x)
        return PiecewiseCubic(knots=x, rows=jnp.stack([x[:-1], y[:-1], slope, 0 * slope, 0 * slope], axis=1))
