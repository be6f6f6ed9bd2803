"""The classical fourth-order Runge-Kutta step on any pytree."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax

from diffabs.pytree import Scalar

X = TypeVar("X")


def rk4_step(derivative: Callable[[Scalar, X], X], t: Scalar, x: X, h: Scalar) -> X:
    """One step of length h from (t, x) of dx/dt = derivative(t, x).

        k1 = f(t, x), k2 = f(t + h/2, x + h/2 k1), k3 = f(t + h/2, x + h/2 k2), k4 = f(t + h, x + h k3)
        x(t + h) = x + h/6 (k1 + 2 k2 + 2 k3 + k4)

    Local error O(h^5). On dx/dt = lambda x it is stable where |1 + z + z^2/2 + z^3/6 + z^4/24| <= 1, z = h lambda.
    """
    k1 = derivative(t, x)
    k2 = derivative(t + h / 2, axpy(h / 2, k1, x))
    k3 = derivative(t + h / 2, axpy(h / 2, k2, x))
    k4 = derivative(t + h, axpy(h, k3, x))
    return jax.tree.map(lambda x, a, b, c, d: x + h / 6 * (a + 2 * (b + c) + d), x, k1, k2, k3, k4)


def axpy(a: Scalar, x: Any, y: Any) -> Any:
    """a x + y on pytrees."""
    return jax.tree.map(lambda x, y: a * x + y, x, y)
