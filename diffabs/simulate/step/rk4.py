"""The classical fourth-order Runge-Kutta step on any pytree: unrolled stages for values, a scan over stages for
derivatives.
"""

from collections.abc import Callable
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


STAGES = ((0.5, 2.0), (0.5, 2.0), (1.0, 1.0))  # stages 2 to 4: place in the step, six times the weight


def rk4_step(derivative: Callable[[Scalar, X], X], t: Scalar, x: X, h: Scalar) -> X:
    """Return x(t + h) after one step of dx/dt = derivative(t, x).

        k1 = f(t, x), k2 = f(t + h/2, x + h/2 k1), k3 = f(t + h/2, x + h/2 k2), k4 = f(t + h, x + h k3)
        x(t + h) = x + h/6 (k1 + 2 k2 + 2 k3 + k4)

    Local error O(h^5). On dx/dt = lambda x it is stable where |1 + z + z^2/2 + z^3/6 + z^4/24| <= 1, z = h lambda.

    Args:
        derivative: Function f(t, x), with the structure of x.
        t: Time at the beginning [s].
        x: State at the beginning, a pytree.
        h: Length of the step [s].
    """
    return _unrolled_step(derivative, t, x, derivative(t, x), h)


def rk4_step_from(
    derivative: Callable[[Scalar, X, PyTree], X], t: Scalar, x: X, rate: X, h: Scalar, given: PyTree
) -> X:
    """Return x(t + h) after one step of dx/dt = derivative(t, x, given) with a known first rate k1, for the body of a
    scan.

    Args:
        derivative: Function f(t, x, given), with the structure of x.
        t: Time at the beginning [s].
        x: State at the beginning, a pytree.
        rate: First rate k1 = f(t, x, given).
        h: Length of the step [s].
        given: Further arguments, a pytree. Every input of the function that is not a real number must come in by it.
    """
    # `custom_jvp` needs every differentiable input as an argument, also those in the closure of `derivative`.
    derivative, constants = jax.closure_convert(derivative, t, x, given)
    return _step(derivative, t, x, rate, h, (given, *constants))


def _unrolled_step(f: Any, t: Scalar, x: Scalar, rate: PyTree, h: Scalar) -> Scalar:
    """Return x(t + h) with the stages written out."""
    total = rate
    for place, weight in STAGES:
        rate, total = _stage(f, t, x, h, rate, total, place, weight)
    return axpy(h / 6, total, x)


# XLA fuses across everything but a loop. With unrolled stages it would compute the tangents of the first stage again in
# each later one: a gradient would take two to three times as long. For values alone the scan does not pay.
@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _step(f: Any, t: Scalar, x: Scalar, rate: PyTree, h: Scalar, constants: PyTree) -> Any:
    return _unrolled_step(lambda t, x: f(t, x, *constants), t, x, rate, h)


def _scan(f: Any, t: Scalar, x: Scalar, rate: PyTree, h: Scalar, constants: PyTree) -> Scalar:
    """Return x(t + h) with a scan over the stages."""

    def stage(carry: tuple[PyTree, PyTree], at: Any) -> tuple[tuple[PyTree, PyTree], None]:
        rates = _stage(lambda t, x: f(t, x, *constants), t, x, h, *carry, *at)
        return jax.tree.map(lambda rate, zero: jnp.asarray(rate, zero.dtype), rates, carry), None

    (rate, total), _ = jax.lax.scan(
        rematerialise(stage), (rate, rate), tuple(jnp.asarray(STAGES, jnp.result_type(h)).T)
    )
    return axpy(h / 6, total, x)


def _rule(f: Any, primals: PyTree, tangents: PyTree) -> tuple[PyTree, PyTree]:
    return jvp_nonzero(lambda *step: _scan(f, *step), primals, tangents)


_step.defjvp(_rule, symbolic_zeros=True)


def _stage(
    f: Any, t: Scalar, x: Scalar, h: Scalar, rate: PyTree, total: Scalar, place: Scalar, weight: Scalar
) -> tuple[PyTree, PyTree]:
    rate = f(t + place * h, axpy(place * h, rate, x))
    return rate, axpy(weight, rate, total)
