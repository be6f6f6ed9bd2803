"""Tsitouras' Runge-Kutta step of fifth order, and the error of the cubic through its ends.

    k1 = f(t, x) is known;  ki = f(t + ci h, x + h sum_j aij kj), i = 2 ... 6;  x(t + h) = x + h sum_i bi ki

The local error is O(h^6). On dx/dt = lambda x the step is stable up to |h lambda| = 2.7 at any angle of lambda from 95
to 180 degrees. On the negative axis it is stable up to 3.5.

A cubic represents every signal within a step: the cubic of the values and rates at both ends, with k7 the rate at the
end. Between ends of fifth order its greatest error is h^4 x''''/384, in the middle. There the method has a solution of
its own, of fourth order, that needs no further rate. The difference of the two is h sum_i di ki.

Source: Ch. Tsitouras, Runge-Kutta pairs of order 5(4) satisfying only the first column simplifying assumption, Comput.
Math. Appl. 62 (2011) 770-775 (coefficients and weights of the solution in the middle).
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from diffabs.core.numerics import axpy
from diffabs.core.pytree import Scalar
from diffabs.core.tracing import jvp_nonzero
from diffabs.core.types import PyTree
from diffabs.simulate.drive.checkpoint import rematerialise

X = TypeVar("X")

STAGE_NODES = (0.161, 0.327, 0.9, 0.9800255409045097, 1.0)  # c2 ... c6
STAGE_COEFFICIENTS = (  # a2j ... a6j
    (0.161,),
    (-0.008480655492356989, 0.335480655492357),
    (2.8971530571054935, -6.359448489975075, 4.3622954328695815),
    (5.325864828439257, -11.748883564062828, 7.4955393428898365, -0.09249506636175525),
    (5.86145544294642, -12.92096931784711, 8.159367898576159, -0.071584973281401, -0.028269050394068383),
)
STEP_WEIGHTS = (
    0.09646076681806523,
    0.01,
    0.4798896504144996,
    1.379008574103742,
    -3.290069515436081,
    2.324710524099774,
)  # b
# d: the paper's weights b(1/2) of the solution in the middle, minus b/2 and minus the cubic's 1/8 (k1 - k7).
MIDPOINT_ERROR_WEIGHTS = (
    *(-0.0658180311080639, 0.00635625, 0.15566420535320324, -1.0342564305778064, 2.961220122676205),
    *(-2.1794161163435377, 0.15625),
)


def tsit5_step_with_error(derivative: Callable[[Scalar, X], X], t: Scalar, x: X, rate: X, h: Scalar) -> tuple[X, X]:
    """Return x(t + h), and the contribution of the rates so far to the error of the cubic.

    `midpoint_error` completes the error with the rate at the end of the step.

    Args:
        derivative: Function f(t, x), with the structure of x.
        t: Time at the beginning [s].
        x: State at the beginning, a pytree.
        rate: First rate k1 = f(t, x).
        h: Length of the step [s].
    """
    rates = [rate]
    for place, weights in zip(STAGE_NODES, STAGE_COEFFICIENTS, strict=True):
        rates.append(derivative(t + place * h, axpy(h, _weighted_sum(weights, rates), x)))
    return axpy(h, _weighted_sum(STEP_WEIGHTS, rates), x), _weighted_sum(MIDPOINT_ERROR_WEIGHTS[:-1], rates)


def midpoint_error(so_far: X, last: X, h: Scalar) -> X:
    """Return the difference between the step's own solution and the cubic, in the middle of the step.

    Args:
        so_far: Contribution of the rates k1 to k6.
        last: Rate k7 at the end of the step.
        h: Length of the step [s].
    """
    return jax.tree.map(lambda a, b: h * (a + MIDPOINT_ERROR_WEIGHTS[-1] * b), so_far, last)


def tsit5_step_from(
    derivative: Callable[[Scalar, X, PyTree], X], t: Scalar, x: X, rate: X, h: Scalar, given: PyTree
) -> X:
    """Return x(t + h) after one step of dx/dt = derivative(t, x, given) with a known first rate k1, for the body of a
    scan.

    Derivatives come from a scan over the stages, as in `rk4_step_from`.

    Args:
        derivative: Function f(t, x, given), with the structure of x.
        t: Time at the beginning [s].
        x: State at the beginning, a pytree.
        rate: First rate k1 = f(t, x, given).
        h: Length of the step [s].
        given: Further arguments, a pytree. Every input of the function that is not a real number must come in by it.
    """
    derivative, constants = jax.closure_convert(derivative, t, x, given)
    return _step(derivative, t, x, rate, h, (given, *constants))


def _weighted_sum(weights: Sequence[float], rates: Sequence[X]) -> X:
    def total(*rates: PyTree) -> Any:
        first, *others = (weight * rate for weight, rate in zip(weights, rates, strict=True))
        return sum(others, first)

    return jax.tree.map(total, *rates)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _step(f: Any, t: Scalar, x: Scalar, rate: PyTree, h: Scalar, constants: PyTree) -> Any:
    return tsit5_step_with_error(lambda t, x: f(t, x, *constants), t, x, rate, h)[0]


def _scan(f: Any, t: Scalar, x: Scalar, rate: PyTree, h: Scalar, constants: PyTree) -> Scalar:
    """Return x(t + h) with a scan over the stages, which fills a table of rates."""
    count = len(STEP_WEIGHTS)
    # Rows of equal length, padded with zeros: rates that do not exist yet are zero in the table.
    rows = [[*weights, *(count - len(weights)) * [0.0]] for weights in STAGE_COEFFICIENTS]

    def weigh(weights: PyTree, rates: PyTree) -> Any:
        return jax.tree.map(lambda k: jnp.sum(weights.reshape(-1, *(k.ndim - 1) * [1]) * k, axis=0), rates)

    def stage(rates: PyTree, at: tuple[PyTree, PyTree, PyTree]) -> tuple[PyTree, None]:
        new, place, weights = at
        rate = f(t + place * h, axpy(h, weigh(weights, rates), x), *constants)
        return jax.tree.map(lambda k, one: k.at[new].set(jnp.asarray(one, k.dtype)), rates, rate), None

    def table(rate: PyTree) -> Any:
        rate = jnp.asarray(rate)
        return jnp.zeros((count, *rate.shape), rate.dtype).at[0].set(rate)

    dtype = jnp.result_type(h)
    rounds = (jnp.arange(1, count), jnp.asarray(STAGE_NODES, dtype), jnp.asarray(rows, dtype))
    # Reverse mode keeps only the table of rates, and computes the stages again.
    rates = jax.lax.scan(rematerialise(stage), jax.tree.map(table, rate), rounds)[0]
    return axpy(h, weigh(jnp.asarray(STEP_WEIGHTS, dtype), rates), x)


def _rule(f: Any, primals: PyTree, tangents: PyTree) -> tuple[PyTree, PyTree]:
    return jvp_nonzero(lambda *step: _scan(f, *step), primals, tangents)


_step.defjvp(_rule, symbolic_zeros=True)
