"""Explicit Runge-Kutta steps on any pytree, from a table of coefficients.

    k1 = f(t, x) is known;  ki = f(t + ci h, x + h sum_j aij kj);  x(t + h) = x + h sum_i bi ki

`RK4` is the classical method of fourth order. On dx/dt = lambda x it is stable where
|1 + z + z^2/2 + z^3/6 + z^4/24| <= 1, z = h lambda.

`TSIT5` is Tsitouras' method of fifth order. It is stable up to |h lambda| = 2.7 at any angle of lambda from 95 to 180
degrees. On the negative axis it is stable up to 3.5. A cubic represents every signal within a step. It has the values
and rates at both ends; k7 is the rate at the end. Between ends of fifth order its greatest error is h^4 x''''/384, in
the middle. There the method has a solution of its own, of fourth order, that needs no further rate. The difference of
the two is h sum_i di ki.

Source: Ch. Tsitouras, Runge-Kutta pairs of order 5(4) satisfying only the first column simplifying assumption, Comput.
Math. Appl. 62 (2011) 770-775 (coefficients and weights of the solution in the middle).
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from diffabs.core.lanes import rematerialise
from diffabs.core.numerics import axpy
from diffabs.core.tracing import jvp_nonzero
from diffabs.core.types import Array, PyTree, Scalar

X = TypeVar("X")


class Tableau(NamedTuple):
    """Coefficients of an explicit Runge-Kutta method.

    Attributes:
        nodes: Places of the stages 2, 3, ... in the step, ci.
        stages: Weights aij of the rates before each of these stages.
        weights: Weights bi of all rates in the step.
        midpoint: Weights di of the error in the middle of the step, the last one for the rate at the end; () without
            an estimate.
    """

    nodes: tuple[float, ...]
    stages: tuple[tuple[float, ...], ...]
    weights: tuple[float, ...]
    midpoint: tuple[float, ...] = ()


RK4 = Tableau((0.5, 0.5, 1.0), ((0.5,), (0.0, 0.5), (0.0, 0.0, 1.0)), (1 / 6, 1 / 3, 1 / 3, 1 / 6))
TSIT5 = Tableau(
    nodes=(0.161, 0.327, 0.9, 0.9800255409045097, 1.0),
    stages=(
        (0.161,),
        (-0.008480655492356989, 0.335480655492357),
        (2.8971530571054935, -6.359448489975075, 4.3622954328695815),
        (5.325864828439257, -11.748883564062828, 7.4955393428898365, -0.09249506636175525),
        (5.86145544294642, -12.92096931784711, 8.159367898576159, -0.071584973281401, -0.028269050394068383),
    ),
    weights=(
        *(0.09646076681806523, 0.01, 0.4798896504144996),
        *(1.379008574103742, -3.290069515436081, 2.324710524099774),
    ),
    # The paper's weights b(1/2) of the solution in the middle, minus b/2 and minus the cubic's 1/8 (k1 - k7).
    midpoint=(
        *(-0.0658180311080639, 0.00635625, 0.15566420535320324, -1.0342564305778064, 2.961220122676205),
        *(-2.1794161163435377, 0.15625),
    ),
)


def rk4_step(derivative: Callable[[Scalar, X], X], t: Scalar, x: X, h: Scalar) -> X:
    """Return x(t + h) after one step of dx/dt = derivative(t, x) by `RK4`, with a local error O(h^5)."""
    return _unrolled_step(RK4, derivative, t, x, derivative(t, x), h)[0]


def runge_kutta_step(
    tableau: Tableau,
    derivative: Callable[[Scalar, X, PyTree], X],
    t: Scalar,
    x: X,
    rate: X,
    h: Scalar,
    arguments: object = (),
) -> tuple[X, X]:
    """Return x(t + h) after one step of dx/dt = derivative(t, x, arguments), and the rates' shares in its error.

    `rate` is k1, and `midpoint_error` completes the error by the rate at the end. Derivatives of the result are those
    of the same step. Every input of the function that is not a real number must come in by `arguments`.
    """
    # `custom_jvp` needs every differentiable input as an argument, also those in the closure of `derivative`.
    derivative, constants = jax.closure_convert(derivative, t, x, arguments)
    return _step(tableau, derivative, t, x, rate, h, (arguments, *constants))


def midpoint_error(tableau: Tableau, shares: X, last: X, h: Scalar) -> X:
    """Return the step's own solution minus the cubic in the middle of the step, from the shares and the last rate."""
    return jax.tree.map(lambda a, b: h * (a + tableau.midpoint[-1] * b), shares, last)


def runge_kutta_scan(
    tableau: Tableau, derivative: Callable[[Scalar, X], X], t: Scalar, x: X, rate: X, h: Scalar
) -> tuple[X, X]:
    """Return the results of `runge_kutta_step` by a scan over the stages: a short program for a costly rate."""
    return _scanned_step(tableau, derivative, t, x, rate, h, ())


# XLA fuses across everything but a loop. With unrolled stages it would compute the tangents of the first stage again in
# each later one: a gradient would take two to three times as long. For values alone the scan does not pay.
@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _step(tableau: Tableau, f: Callable, t: Scalar, x: X, rate: X, h: Scalar, constants: PyTree) -> tuple[X, X]:
    return _unrolled_step(tableau, lambda t, x: f(t, x, *constants), t, x, rate, h)


def _rule(tableau: Tableau, f: Callable, primals: object, tangents: object) -> tuple[PyTree, PyTree]:
    return jvp_nonzero(lambda *step: _scanned_step(tableau, f, *step), primals, tangents)


_step.defjvp(_rule, symbolic_zeros=True)


def _unrolled_step(tableau: Tableau, f: Callable, t: Scalar, x: X, rate: X, h: Scalar) -> tuple[X, X]:
    """Return the results of `runge_kutta_step` with the stages written out."""
    rates = [rate]
    for place, weights in zip(tableau.nodes, tableau.stages, strict=True):
        rates.append(f(t + place * h, axpy(h, _weighted_sum(weights, rates), x)))
    return axpy(h, _weighted_sum(tableau.weights, rates), x), _error_shares(tableau, rates)


def _scanned_step(tableau: Tableau, f: Callable, t: Scalar, x: X, rate: X, h: Scalar, constants: PyTree) -> tuple[X, X]:
    """Return the results of `runge_kutta_step` with a scan over the stages, which fills a table of rates."""
    count, dtype = len(tableau.weights), jnp.result_type(h)
    # Rows of equal length, padded with zeros: rates that do not exist yet are zero in the table.
    rows = [[*weights, *(count - len(weights)) * [0.0]] for weights in tableau.stages]

    def weigh(weights: Array, rates: PyTree) -> PyTree:
        return jax.tree.map(lambda k: jnp.sum(weights.reshape(-1, *(k.ndim - 1) * [1]) * k, axis=0), rates)

    def stage(rates: PyTree, at: tuple[PyTree, PyTree, PyTree]) -> tuple[PyTree, None]:
        new, place, weights = at
        rate = f(t + place * h, axpy(h, weigh(weights, rates), x), *constants)
        return jax.tree.map(lambda k, x: k.at[new].set(jnp.asarray(x, k.dtype)), rates, rate), None

    def begin_table(rate: Scalar) -> Array:
        rate = jnp.asarray(rate)
        return jnp.zeros((count, *rate.shape), rate.dtype).at[0].set(rate)

    rounds = (jnp.arange(1, count), jnp.asarray(tableau.nodes, dtype), jnp.asarray(rows, dtype))
    # Reverse mode keeps only the table of rates, and computes the stages again.
    rates = jax.lax.scan(rematerialise(stage), jax.tree.map(begin_table, rate), rounds)[0]
    each = [jax.tree.map(lambda k, i=i: k[i], rates) for i in range(count)]
    return axpy(h, weigh(jnp.asarray(tableau.weights, dtype), rates), x), _error_shares(tableau, each)


def _error_shares(tableau: Tableau, rates: Sequence[X]) -> X:
    """Return the weighted sum of the rates in the error at the middle of the step; zeros without an estimate."""
    return _weighted_sum(tableau.midpoint[:-1] or (0.0,), rates[: len(tableau.midpoint[:-1]) or 1])


def _weighted_sum(weights: Sequence[float], rates: Sequence[X]) -> X:
    def total(*rates: Array) -> Array:
        terms = [weight * rate for weight, rate in zip(weights, rates, strict=True) if weight]
        return sum(terms[1:], terms[0]) if terms else 0.0 * rates[0]

    return jax.tree.map(total, *rates)
