"""Elementary functions whose gradients stay finite where the textbook ones do not."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from diffabs.core.pytree import Scalar

EQUAL_EPS = 1024.0  # precisions: two values of a signal at instants that are one to rounding


def clamp(x: Scalar, low: Scalar, high: Scalar) -> Any:
    """x limited to [low, high]. The slope in x is 1 at a limit and 0 beyond it, where that in the limit is 1.

    Selections, since the tangent of `jnp.clip` divides, and `lax.clamp` refuses to batch an upper limit
    alone (JAX 0.10; of the kind of github.com/jax-ml/jax/issues/5325, whose repair leaves this case out).
    """
    return jnp.where(jnp.less(x, low), low, jnp.where(jnp.greater(x, high), high, x))


def larger(x: Scalar, y: Scalar) -> Any:
    """max(x, y). Equal, the slope is that in x: `jnp.maximum` shares it between both, by a division in its tangent."""
    return jnp.where(jnp.greater_equal(x, y), x, y)


def later_of_larger(x: Scalar, y: Scalar, falls: Any = False) -> Any:
    """max(x, y) of two values one after the other. Where they are equal to rounding, the slope is that of the later
    one, y: the end of a step without a length moves with the event there, its beginning does not. If the signal `falls`
    from x on, it is that of x: a peak at an event that is a rounding before the grid does not stand on the grid."""
    rounding = EQUAL_EPS * jnp.finfo(jnp.result_type(x, y)).eps * jnp.abs(x)
    more = jnp.where(falls, rounding, -rounding)
    return jnp.where(jnp.greater_equal(y, x + more), y, x)


def smaller(x: Scalar, y: Scalar) -> Any:
    """min(x, y), with the slope in x where they are equal."""
    return jnp.where(jnp.less_equal(x, y), x, y)


@jax.custom_jvp
def quotient(x: Scalar, y: Scalar) -> Any:
    """x/y, whose derivatives (dx - (x/y) dy)/y share one 1/y. JAX's own divide three times more."""
    return x / y


@quotient.defjvp
def _quotient_slope(at: Any, moves: Any) -> tuple[Any, Any]:
    inverse = 1.0 / at[1]
    value = at[0] / at[1]
    return value, (moves[0] - value * moves[1]) * inverse


def ratio(numerator: Scalar, denominator: Scalar, otherwise: Scalar = 0.0) -> Any:
    """numerator/denominator, and `otherwise` where the denominator is zero (with zero slope there)."""
    fine = jnp.not_equal(denominator, 0)
    return jnp.where(fine, quotient(numerator, jnp.where(fine, denominator, 1.0)), otherwise)


def power(base: Scalar, exponent: Scalar) -> Any:
    """base ** exponent for base >= 0 and exponent > 1, with slope 0 at base = 0 in both arguments.

    exp(q log x): XLA's own power is three to four times slower on a CPU. By the square of the base, so that a step that
    goes on beyond 0 before it is tried again (`core.comparisons`) finds a number there.
    """
    square = base * base
    fine = jnp.not_equal(square, 0)
    value = jnp.where(fine, jnp.exp(exponent * (0.5 * jnp.log(jnp.where(fine, square, 1.0)))), 0.0)
    return jnp.where(jnp.greater(base, 0), value, 0.0)


@jax.jit
def searchsorted(knots: Any, x: Scalar) -> Any:
    """Return how many of a few increasing knots (n,) are not above x.

    `core.comparisons` recognises a search by this name, which is JAX's. JAX's own looks for NaN among the knots each
    time."""
    return jnp.sum(x >= knots).astype(jnp.int32)


def sign(x: Scalar) -> Any:
    """+1 for x >= 0, else -1: the odd extension of a curve given for x >= 0 keeps the slope of its right side at 0."""
    return jnp.where(jnp.greater_equal(x, 0), 1.0, -1.0)


def odd(curve: Callable[[Any], Any], x: Scalar) -> Any:
    """The odd extension of a curve given for x >= 0. At 0 the slope is that of the curve (|x| would make it 0)."""
    s = sign(x)
    return s * curve(s * x)


def interval_shares(x: Scalar, nodes: Any) -> Any:
    """How much of each interval between nodes (n,), which increase, lies below x, from 0 to 1 (n-1,). A `table` is a
    sum over it: no index to look up, which derivatives would have to scatter to."""
    inside = (x - nodes[:-1]) / jnp.diff(nodes)
    return jnp.where(x >= nodes[1:], 1.0, jnp.where(x < nodes[:-1], 0.0, inside))


def interpolate_shares(risen: Any, values: Any) -> Any:
    """The values (n,) at the nodes: linear between them, constant beyond."""
    return values[0] + jnp.sum(risen * jnp.diff(values))


def axpy(a: Scalar, x: Any, y: Any) -> Any:
    """a x + y on pytrees."""
    return jax.tree.map(lambda x, y: a * x + y, x, y)
