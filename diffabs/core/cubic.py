"""The cubic Hermite interpolant from values and rates at both ends of a step: values, roots, extrema, integrals.

    p(x) = a + c1 x + c2 x^2 + c3 x^3,   x = (t - t0)/h in [0, 1]
    c1 = h a',  c2 = 3 (b - a) - h (2 a' + b'),  c3 = 2 (a - b) + h (a' + b')

It differs from a smooth function by O(h^4).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.numerics import clamp, later_of_larger
from diffabs.core.types import Array, Bool, PyTree, Scalar

NEWTON_ITERATIONS = 4  # from the secant's root, before the last: in a long step the cubic is far from a line


class Cubic(NamedTuple):
    """The cubic p on [0, 1], given by its values at both ends and dp/dx there: the rate times the step length."""

    start: Scalar
    end: Scalar
    start_slope: Scalar
    end_slope: Scalar

    def __call__(self, x: Scalar) -> Scalar:
        """Return p(x)."""
        c1, c2, c3 = self.coefficients()
        return self.start + x * (c1 + x * (c2 + x * c3))

    def slope(self, x: Scalar) -> Scalar:
        """Return dp/dx at `x`."""
        c1, c2, c3 = self.coefficients()
        return c1 + x * (2.0 * c2 + x * 3.0 * c3)

    def minus(self, level: Scalar) -> "Cubic":
        """Return the cubic p - `level`."""
        return self._replace(start=self.start - level, end=self.end - level)

    def times(self, factor: Scalar) -> "Cubic":
        """Return the cubic `factor` p."""
        return Cubic(*(factor * x for x in self))

    def integral(self, x: Scalar) -> Scalar:
        """Return the integral of p from 0 to `x`; times the step length, it is an integral over time."""
        c1, c2, c3 = self.coefficients()
        return x * (self.start + x * (c1 / 2.0 + x * (c2 / 3.0 + x * c3 / 4.0)))

    def moment(self, x: Scalar) -> Scalar:
        """Return the integral of x p(x) from 0 to `x`; times the squared step length, it is an integral over time."""
        c1, c2, c3 = self.coefficients()
        return x * x * (self.start / 2.0 + x * (c1 / 3.0 + x * (c2 / 4.0 + x * c3 / 5.0)))

    @jax.jit  # a step has many roots: they are traced and differentiated once
    def root(self) -> Scalar:
        """Return the x in [0, 1] at which p changes sign.

        It is 0 if p is zero at the start, and 1 if both ends have the same sign. The derivative of x follows from the
        implicit function theorem.
        """
        # The iterations run without derivatives; `_refine_zero` adds the derivative of the root once at the end.
        # The barrier keeps XLA from fusing them with what computes the cubic. LLVM's loop vectorizer in JAX 0.11 and
        # 0.12 takes minutes for such a loop on a processor.
        still = jax.lax.optimization_barrier(jax.lax.stop_gradient(self))
        spread = still.start - still.end
        x = clamp(still.start / jnp.where(spread == 0, 1.0, spread), 0.0, 1.0)
        low, high = jnp.zeros_like(x), jnp.ones_like(x)
        # Safeguarded Newton iterations: a step that leaves the bracket is replaced by bisection. The accuracy matters
        # for derivatives, too: an error of the root is an error of the same size in a derivative by the root.
        for _ in range(NEWTON_ITERATIONS):
            value = still(x)
            before = (value < 0) == (still.start < 0)
            low, high = jnp.where(before, x, low), jnp.where(before, high, x)
            newton = x - _quotient(value, still.slope(x))
            x = jnp.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
        x = clamp(x - _quotient(self(x), still.slope(x)), low, high)
        x = _refine_zero(x, self, still.slope(jax.lax.stop_gradient(x)))
        changes = ((still.start < 0) != (still.end < 0)) | (still.start == 0)
        return jnp.where(changes, x, 1.0)

    @jax.jit
    def greatest(self) -> Scalar:
        """Return the greatest value of p in [0, 1], if p rises at the start and falls at the end; else the greater end.

        Another maximum is an artefact of a step that ends beyond a bend of the quantity, such as the end of a limit.
        The derivative of the result is that of p at the place of the maximum. A Newton step moves that place, which
        changes the value in second order.
        """
        c1, c2, c3 = jax.lax.stop_gradient(self.coefficients())
        inside = (self.start_slope > 0) & (self.end_slope < 0)
        square = c2 * c2 - 3.0 * c1 * c3
        # Root of p' = c1 + 2 c2 x + 3 c3 x^2 as c1/(sqrt(c2^2 - 3 c1 c3) - c2), which has no cancellation for c2 < 0.
        # The inner `where` keeps the root's argument positive, since 0 times an infinite gradient is NaN.
        bend = jnp.sqrt(jnp.where(inside & (square > 0), square, 1.0)) - c2
        x = clamp(_quotient(c1, bend), 0.0, 1.0)
        x = _refine_zero(x, self.slope, jnp.where(inside, 2.0 * c2 + 6.0 * c3 * x, 0.0))
        ends = later_of_larger(self.start, self.end, self.falls)
        top = self(x)
        return jnp.where(inside & (top > ends), top, ends)

    @property
    def falls(self) -> Bool:
        """Whether p falls at the start."""
        return jax.lax.stop_gradient(self.start_slope) < 0

    def coefficients(self) -> tuple[PyTree, PyTree, PyTree]:
        """Return c1, c2 and c3 of p(x) = start + c1 x + c2 x^2 + c3 x^3."""
        rise = self.end - self.start
        c2 = 3.0 * rise - 2.0 * self.start_slope - self.end_slope
        return self.start_slope, c2, self.start_slope + self.end_slope - 2.0 * rise


class HermiteStep(NamedTuple):
    """A quantity over a step without jumps: the cubic through its values and rates at both ends.

    Attributes:
        start: Time [s] at the start of the step.
        end: Time [s] at the end of the step.
        values: The quantity, a pytree, at both ends: after the changes at the start, before the changes at the end.
        rates: Time derivatives of the quantity at both ends, per second.
    """

    start: Array
    end: Array
    values: tuple[PyTree, PyTree]
    rates: tuple[PyTree, PyTree]

    def at(self, t: Scalar) -> PyTree:
        """Return the quantity at a time `t` [s] within the step."""
        h = self.end - self.start
        x = clamp((t - self.start) / jnp.where(h > 0, h, 1.0), 0.0, 1.0)
        return jax.tree.map(lambda a, b, p, q: Cubic(a, b, h * p, h * q)(x), *self.values, *self.rates)


def _refine_zero(x: Scalar, function: Callable[[PyTree], PyTree], slope: Scalar) -> Scalar:
    """Return x unchanged in value, with the derivatives of the zero of `function` near x.

    They are the derivatives of a Newton step, and their order is twice the order of x.
    """
    # `remainder - stop_gradient(remainder)` is 0 in value and has the derivative of `remainder`.
    remainder = function(x)
    return x - _quotient(remainder - jax.lax.stop_gradient(remainder), slope)


def _quotient(x: Scalar, y: Scalar) -> Scalar:
    """Return x/y without a derivative in y, and 0 where y is 0."""
    y = jax.lax.stop_gradient(y)
    return jnp.where(y == 0, 0.0, x / jnp.where(y == 0, 1.0, y))
