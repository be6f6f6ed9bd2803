"""A measured friction curve: the monotone cubic through its knots.

    mu(s) = cubic Hermite between knots, with the slopes of Fritsch and Butland        for s >= 0, odd in s

This is the interpolant of SciPy's PchipInterpolator. It is exact at the knots, has no extrema except at knots, and is
C1.

Source: F. N. Fritsch and J. Butland, A method for constructing local monotone piecewise cubic interpolants, SIAM J.
Sci. Stat. Comput. 5 (1984). The three-point end slopes are those of C. Moler, Numerical Computing with MATLAB, sec.
3.6.
"""

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np

from diffabs.core.arrays import as_rule_array
from diffabs.core.numerics import odd, ratio, searchsorted
from diffabs.core.pytree import param, pytree
from diffabs.core.rules import Rule, increase_rule
from diffabs.core.types import Array, Matrix, Scalar, Vector

KNOTS = (  # slip and friction at the knots of the identified spline
    (0, 0.02108, 0.04215, 0.06323, 0.08431, 0.09696, 0.10539, 0.12039, 0.14539,
     0.17539, 0.19039, 0.20539, 0.23539, 0.28539, 0.40539, 0.60539, 1.0),
    (0, 0.51493, 0.72745, 0.86912, 0.96331, 0.98097, 0.99064, 0.98201, 0.95733,
     0.92939, 0.91484, 0.90622, 0.88005, 0.85317, 0.81806, 0.79436, 0.75761),
)  # fmt: skip


@pytree
class Tabulated:
    """Monotone cubic through (slip, mu); the knots start at (0, 0), increase, and end at slip 1.

    The defaults are the spline identified from Tables 1 and 2 of Aoki and Nakamura, with J = 1.04456 kg m^2. This
    spline reproduces all twenty numbers to the printed digit. The paper does not give its curve, so the true curve is
    unknown.

    >>> from diffabs.parts.roads import Tabulated
    >>> wet = Tabulated(slip=(0.0, 0.1, 0.3, 1.0), mu=(0.0, 0.7, 0.6, 0.5))
    >>> print(f"{wet.friction(0.1):.2f} {wet.friction(0.2):.3f}")
    0.70 0.656
    """

    slip: Vector = param(default=KNOTS[0], unit="1", low=0.0, high=1.0, free=True)
    """Knots, increasing from 0 to 1, shape (n,)."""
    mu: Vector = param(default=KNOTS[1], unit="1", low=0.0, free=True)
    """Friction at the knots, shape (n,)."""

    def friction(self, slip: Scalar, speed: Scalar = 0.0, distance: Scalar = 0.0) -> Scalar:
        """Return mu [1] at a `slip` [1], constant beyond the last knot; `speed` and `distance` have no effect."""
        return self.prepared().friction(slip, speed, distance)

    def prepared(self) -> "PiecewiseCubic":
        """Return the same curve with its coefficients computed once for a whole run.

        Raises:
            ValueError: `slip` and `mu` differ in length, or have fewer than 3 knots.
        """
        x, y = jnp.asarray(self.slip), jnp.asarray(self.mu)
        if x.shape != y.shape or x.ndim != 1 or x.size < 3:
            raise ValueError(f"slip and mu have shapes {x.shape} and {y.shape}; both need one length of at least 3")
        d = slopes(x, y)
        h, m = jnp.diff(x), jnp.diff(y) / jnp.diff(x)
        c2 = (3 * m - 2 * d[:-1] - d[1:]) / h
        c3 = (d[:-1] + d[1:] - 2 * m) / h**2
        return PiecewiseCubic(knots=x, rows=jnp.stack([x[:-1], y[:-1], d[:-1], c2, c3], axis=1))

    def problems(self) -> Iterator[str]:
        """Yield a message if `slip` and `mu` differ in length, or have fewer than 3 knots."""
        x, y = np.shape(self.slip), np.shape(self.mu)
        if x != y or len(x) != 1 or x[0] < 3:
            yield f"slip and mu have shapes {x} and {y}; both need the same length of at least 3"

    def rules(self) -> Iterator[Rule]:
        """Yield the rules that the slips increase and that the knots run from (0, 0) to slip 1."""
        x, y = as_rule_array(self.slip), as_rule_array(self.mu)
        yield increase_rule("slip", self.slip, "is not increasing", "1")
        yield Rule(
            (x[0] == 0) & (y[0] == 0) & (x[-1] == 1),
            "the knots do not run from (0, 0) to slip 1",
            lambda: f"the knots run from ({x[0]:g}, {y[0]:g}) to slip {x[-1]:g}; they must run from (0, 0) to slip 1",
        )


@pytree
class PiecewiseCubic:
    """mu(s) = c0 + z (c1 + z (c2 + z c3)), z = s - x_i, between knots."""

    knots: Vector = param(unit="1")
    """Knots x_i, shape (n,)."""
    rows: Matrix = param(unit="1")
    """Rows (x_i, c0, c1, c2, c3), shape (n - 1, 5)."""

    def friction(self, slip: Scalar, speed: Scalar = 0.0, distance: Scalar = 0.0) -> Scalar:
        """Return mu [1] at a `slip` [1], odd in slip and constant beyond the last knot; `speed` and `distance` have no
        effect.
        """
        del speed, distance
        return odd(self._curve, slip)

    def _curve(self, s: Scalar) -> Scalar:
        i = searchsorted(self.knots[1:-1], s)
        x, c0, c1, c2, c3 = self.rows[i]
        z = jnp.minimum(s, self.knots[-1]) - x
        return c0 + z * (c1 + z * (c2 + z * c3))


def slopes(x: Array, y: Array) -> Array:
    """Return the slopes dy/dx (n,) at n >= 3 knots: inside, the weighted harmonic mean of the two neighbouring secants.

    The slope is 0 where these secants differ in sign. At both ends it is a limited three-point slope. At a local
    extremum the slope stays 0, so the derivative with respect to the knot's value is one-sided.
    """
    h = jnp.diff(x)
    m = jnp.diff(y) / h
    w0, w1 = 2 * h[1:] + h[:-1], h[1:] + 2 * h[:-1]
    product = m[:-1] * m[1:]
    inner = jnp.where(product > 0, ratio((w0 + w1) * product, w0 * m[1:] + w1 * m[:-1]), 0.0)
    first, last = _end_slope(h[0], h[1], m[0], m[1]), _end_slope(h[-1], h[-2], m[-1], m[-2])
    return jnp.concatenate([first[None], inner, last[None]])


def _end_slope(h0: Scalar, h1: Scalar, m0: Scalar, m1: Scalar) -> Array:
    d = ((2 * h0 + h1) * m0 - h0 * m1) / (h0 + h1)
    steep = (jnp.sign(m0) != jnp.sign(m1)) & (jnp.abs(d) > 3 * jnp.abs(m0))
    return jnp.where(jnp.sign(d) != jnp.sign(m0), 0.0, jnp.where(steep, 3 * m0, d))


SPLINE_B = Tabulated()
