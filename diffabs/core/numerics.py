"""Elementary functions whose gradients stay finite where the textbook formulas fail."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.types import Array, Bool, Numbers, PyTree, Scalar, Vector

T = TypeVar("T")

EQUAL_EPS = 1024.0  # in units of eps: difference of a signal between instants that are equal to rounding


def clamp(x: Scalar, low: Scalar, high: Scalar) -> Scalar:
    """Return x limited to [low, high]; its slope in x is 1 at a limit and 0 beyond it, and in a limit 1 beyond that.

    Selections, since the tangent of `jnp.clip` divides, and `lax.clamp` of JAX 0.10 refuses to batch an upper limit
    alone (similar to github.com/jax-ml/jax/issues/5325, whose repair leaves this case out).
    """
    return jnp.where(jnp.less(x, low), low, jnp.where(jnp.greater(x, high), high, x))


def larger(x: Scalar, y: Scalar) -> Scalar:
    """Return max(x, y); where both are equal, its derivative is that of x.

    `jnp.maximum` shares the derivative between both, by a division in its tangent.
    """
    return jnp.where(jnp.greater_equal(x, y), x, y)


def later_of_larger(x: Scalar, y: Scalar, falls: Bool = False) -> Array:
    """Return max(x, y) of two successive values of a signal; where both are equal to rounding, it moves as y.

    At the end of a step of zero length, y moves with the event there, and x does not. If the signal falls at x, the
    result moves as x instead. So a peak at an event just before a grid instant does not move with the grid.
    """
    rounding = EQUAL_EPS * jnp.finfo(jnp.result_type(x, y)).eps * jnp.abs(x)
    more = jnp.where(falls, rounding, -rounding)
    moving = jnp.where(jnp.greater_equal(y, x + more), y, x)
    # The value is the larger one also within the rounding: a maximum of many values would follow a slow decline.
    short = jnp.where(jnp.greater(y, x), y, x) - moving
    return moving + jax.lax.stop_gradient(jnp.where(jnp.greater(short, 0), short, 0.0))


def smaller(x: Scalar, y: Scalar) -> Scalar:
    """Return min(x, y); where both are equal, its derivative is that of x."""
    return jnp.where(jnp.less_equal(x, y), x, y)


def invalidate(tree: object, invalid: Bool, inputs: object) -> PyTree:
    """Return a pytree of real numbers; where they are invalid, they and their derivatives by every input are NaN.

    A selection (`jnp.where`) alone would give an invalid number the derivative zero. `inputs` is a pytree of everything
    that the result may depend on; only its floating-point leaves count.
    """
    factor = jnp.where(invalid, jnp.nan, 1.0)
    numbers = jax.tree.map(jnp.asarray, tree)
    return void_derivatives(jax.tree.map(lambda x: factor.astype(x.dtype) * x, numbers), invalid, inputs)


def void_derivatives(tree: object, void: Bool, inputs: object) -> PyTree:
    """Return a pytree of valid numbers whose derivatives by every input (`invalidate`) are NaN if `void`.

    In reverse mode one such number makes the whole derivative NaN.
    """
    real = jnp.result_type(float)
    leaves = [leaf for leaf in map(jnp.asarray, jax.tree.leaves(inputs)) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    # Zero, with the sum of all tangents as its derivative: one number for all results, since a run has many inputs.
    total = sum((jnp.sum(_vanish(leaf.astype(real))) for leaf in leaves), jnp.zeros((), real))
    slope = jnp.where(void, jnp.nan, jnp.zeros((), real))

    def each(x: Scalar) -> Scalar:
        x = jnp.asarray(x)
        if not jnp.issubdtype(x.dtype, jnp.floating):
            return x
        # Under `vmap` a number must be batched like its derivative, which the rule alone would not ensure.
        return _add_slope(jnp.where(void | (total > 0), x, x), slope, total)

    return jax.tree.map(each, tree)


@jax.custom_jvp
def _vanish(x: Scalar) -> Scalar:
    """Return zeros that have the derivative of x, also where x is infinite or NaN."""
    return jnp.zeros_like(x)


_vanish.defjvp(lambda at, moves: (_vanish(*at), moves[0]))


@jax.custom_jvp
def _add_slope(x: Scalar, slope: Scalar, total: Scalar) -> Scalar:
    """Return x; its derivative is increased by `slope` times that of `total`."""
    del slope, total
    return x


@_add_slope.defjvp
def _slope_rule(at: tuple[Array, ...], moves: PyTree) -> tuple[PyTree, PyTree]:
    x, slope, _ = at
    return x, moves[0] + (slope * moves[2]).astype(x.dtype)


@jax.custom_jvp
def quotient(x: Scalar, y: Scalar) -> Scalar:
    """Return x/y; its derivatives (dx - (x/y) dy)/y share one 1/y. JAX's own derivatives divide three more times."""
    return x / y


@quotient.defjvp
def _quotient_slope(at: tuple[Numbers, ...], moves: tuple[Numbers, ...]) -> tuple[PyTree, PyTree]:
    inverse = 1.0 / at[1]
    value = at[0] / at[1]
    return value, (moves[0] - value * moves[1]) * inverse


def ratio(numerator: Scalar, denominator: Scalar, otherwise: Scalar = 0.0) -> Scalar:
    """Return numerator/denominator, or `otherwise` with zero slope where the denominator is zero."""
    # The inner `where` replaces a zero denominator: 0 times the infinite derivative of 1/0 would be NaN.
    nonzero = jnp.not_equal(denominator, 0)
    return jnp.where(nonzero, quotient(numerator, jnp.where(nonzero, denominator, 1.0)), otherwise)


def power(base: Scalar, exponent: Scalar) -> Scalar:
    """Return base ** exponent for exponent > 1, or 0 with zero slopes for base <= 0.

    The formula is exp(q/2 log(base^2)). XLA's own power takes three to four times as long on a CPU. The square keeps
    the number finite in a trial step that passes base = 0 with frozen comparisons.
    """
    square = base * base
    nonzero = jnp.not_equal(square, 0)
    value = jnp.where(nonzero, jnp.exp(exponent * (0.5 * jnp.log(jnp.where(nonzero, square, 1.0)))), 0.0)
    return jnp.where(jnp.greater(base, 0), value, 0.0)


@jax.jit
def searchsorted(knots: Scalar, x: Scalar) -> Scalar:
    """Return the number of knots (n,) that are not above x, for a few increasing knots.

    `simulate.step.comparisons` recognises the search by this name, which JAX uses, too. JAX's own search looks for NaN
    among the knots in each call.
    """
    return jnp.sum(x >= knots).astype(jnp.int32)


def sign(x: Scalar) -> Scalar:
    """Return +1 for x >= 0, else -1; with it, the odd extension of a curve keeps its right-hand slope at 0."""
    return jnp.where(jnp.greater_equal(x, 0), 1.0, -1.0)


def odd(curve: Callable[[PyTree], PyTree], x: Scalar) -> Scalar:
    """Return the odd extension of a curve for x >= 0, with the curve's slope at 0 (|x| would give slope 0)."""
    s = sign(x)
    return s * curve(s * x)


def interval_shares(x: Scalar, nodes: Vector) -> Scalar:
    """Return the share of each interval between increasing nodes (n,) that lies below x, from 0 to 1, shape (n - 1,).

    `interpolate_shares` sums over the shares. It looks up no index, so its derivatives need no scatter.
    """
    inside = (x - nodes[:-1]) / jnp.diff(nodes)
    return jnp.where(x >= nodes[1:], 1.0, jnp.where(x < nodes[:-1], 0.0, inside))


def interpolate_shares(risen: Scalar, values: Vector) -> Scalar:
    """Return the piecewise linear interpolant of values (n,) at the nodes of `interval_shares`, constant beyond."""
    return values[0] + jnp.sum(risen * jnp.diff(values))


def axpy(a: Scalar, x: T, y: T) -> T:
    """Return a x + y on pytrees."""
    return jax.tree.map(lambda x, y: a * x + y, x, y)


def spectral_bound(matrices: np.ndarray, *, discrete: bool = False) -> np.ndarray:
    """Return the largest real part of the eigenvalues of matrices (..., n, n), or if `discrete` the largest modulus."""
    modes = np.linalg.eigvals(matrices)
    return (np.abs(modes) if discrete else np.real(modes)).max(axis=-1)
