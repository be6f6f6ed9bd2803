"""Lyapunov equations, and the linear algebra of many small matrices that the Riccati equations are solved with.

    lyapunov            A' P + P A + Q = 0
    discrete_lyapunov   A' P A - P + Q = 0

Functions below "Many small matrices" take stacks of shape (rows, columns, lanes). With the lanes last every operation
is one vectorised loop; on a CPU a call of LAPACK per matrix costs more than the whole elimination of a small one.
"""

from functools import reduce
from operator import add
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

MAX_SMITH_STEPS = 50  # C^(2^50): a radius of 1 - 1e-13 has contracted, one of 1 has not


class Lyapunov(NamedTuple):
    """P (n, n) and its relative residual: the norm of the left side over the sum of the norms of its terms."""

    P: Any
    residual: Any


def lyapunov(A: Any, Q: Any) -> Lyapunov:
    """P of A' P + P A + Q = 0, for any A (n, n) with no two eigenvalues of sum zero; else P is not finite.

    P = integral of exp(A't) Q exp(At) where A is stable. Q (n, n) need not be symmetric. Differentiable in both modes,
    as often as wanted, but not the residual.
    """
    A, Q = as_float_arrays(A, Q)
    I = jnp.eye(len(A), dtype=A.dtype)
    P = _solve_vectorised(jnp.kron(A.T, I) + jnp.kron(I, A.T), Q)
    return Lyapunov(P, relative_residual(A.T @ P + P @ A + Q, A.T @ P, P @ A, Q))


def discrete_lyapunov(A: Any, Q: Any) -> Lyapunov:
    """P of A' P A - P + Q = 0, for any A (n, n) with no two eigenvalues of product one; else P is not finite.

    P = sum of (A')^k Q A^k where A is stable. The rest as for `lyapunov`.
    """
    A, Q = as_float_arrays(A, Q)
    P = _solve_vectorised(jnp.kron(A.T, A.T) - jnp.eye(A.size, dtype=A.dtype), Q)
    return Lyapunov(P, relative_residual(A.T @ P @ A - P + Q, A.T @ P @ A, P, Q))


def _solve_vectorised(operator: jax.Array, Q: jax.Array) -> jax.Array:
    """P of operator vec(P) = -vec(Q), vec by rows."""
    return jnp.linalg.solve(operator, -Q.ravel()).reshape(Q.shape)


def as_float_arrays(*given: Any) -> tuple[Any, ...]:
    """As arrays of one floating type."""
    given = tuple(jnp.asarray(x) if isinstance(x, list | tuple) else x for x in given)
    kind = jnp.result_type(float, *given)
    return tuple(jnp.asarray(x, kind) for x in given)


def relative_residual(left: jax.Array, *terms: jax.Array) -> jax.Array:
    """Norm of a sum over the sum of the norms of its terms; 0 where these are 0. Its derivative is zero."""
    left, terms = lax.stop_gradient((left, terms))
    axes = (0, 1)
    total = reduce(add, (frobenius_norm(term, axes) for term in terms))
    return jnp.where(total == 0, 0.0, frobenius_norm(left, axes) / jnp.where(total == 0, 1.0, total))


# Many small matrices: (rows, columns, lanes)


def frobenius_norm(X: jax.Array, axes: Any = (0, 1)) -> jax.Array:
    """Frobenius norm, per lane."""
    return jnp.sqrt(jnp.sum(X * X, axes))


def transpose(X: jax.Array) -> jax.Array:
    """X', per lane."""
    return jnp.swapaxes(X, 0, 1)


def times(*factors: jax.Array) -> jax.Array:
    """Product of matrices, from the left, per lane. Written as a sum of outer products, which is one fused loop."""
    return reduce(lambda X, Y: reduce(add, (X[:, k, None] * Y[None, k] for k in range(len(Y)))), factors)


def eye(n: int, like: jax.Array) -> jax.Array:
    """Identity, per lane."""
    return jnp.broadcast_to(jnp.eye(n, dtype=like.dtype)[..., None], (n, n, like.shape[-1]))


def gauss_jordan_solve(M: jax.Array, W: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(M^-1 W, log abs det M), per lane, by Gauss-Jordan elimination with partial pivoting.

    The pivot's row is gathered: XLA would fuse a masked sum over the rows into its consumer and work it out once per
    element.
    """
    rows = jnp.arange(len(M))[:, None]

    def step(k: jax.Array, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        T, log = carry
        column = T[:, k]
        place = jnp.argmax(jnp.where(rows >= k, jnp.abs(column), -1.0), 0)[None]
        value = jnp.take_along_axis(column, place, 0)[0]
        row = jnp.take_along_axis(T, place[None], 0)[0] / value
        pivot = rows == place
        T = jnp.where(pivot[:, None], T[k], T) - jnp.where(pivot, column[k], column)[:, None] * row
        return jnp.where(rows[:, None] == k, row, T), log + jnp.log(jnp.abs(value))

    T, log = lax.fori_loop(0, len(M), step, (jnp.concatenate([M, W], 1), jnp.zeros_like(M[0, 0])))
    return T[:, len(M) :], log


def cholesky(R: jax.Array) -> jax.Array:
    """Lower triangular L with L L' = R, per lane; not finite where R is not positive definite."""
    L = jnp.zeros_like(R)
    for k in range(len(R)):
        column = R[:, k] - jnp.sum(L * L[k], 1)
        column = jnp.where(jnp.arange(len(R))[:, None] >= k, column, 0.0)
        L = L.at[:, k].set(column / jnp.sqrt(column[k]))
    return L


def solve_stein(C: jax.Array, *right: jax.Array) -> tuple[jax.Array, ...]:
    """X of C' X C - X + W = 0 for each W of `right`, per lane; not finite where C is not stable.

    Smith's squared method: X <- X + C' X C, C <- C^2. Where the powers of C do not vanish, C is not stable.
    """

    def going(carry: tuple[Any, ...]) -> jax.Array:
        k, C, _ = carry
        return (k < MAX_SMITH_STEPS) & jnp.any(frobenius_norm(C) > 1e-9)

    def double(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        k, C, X = carry
        return k + 1, times(C, C), tuple(x + times(transpose(C), x, C) for x in X)

    _, C, X = lax.while_loop(going, double, (0, C, right))
    return tuple(jnp.where(frobenius_norm(C) <= 1e-9, x, jnp.nan) for x in X)
