"""Lyapunov equations, and the linear algebra of many small matrices on which the Riccati solvers rest.

    lyapunov            A' P + P A + Q = 0
    discrete_lyapunov   A' P A - P + Q = 0

The functions below "Many small matrices" take stacks of shape (rows, columns, batch). With the batch as last axis each
operation is one vectorised loop. On a CPU, a LAPACK call per small matrix takes longer than its whole elimination here.
"""

from functools import reduce
from operator import add
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from diffabs.core.jax_flags import default_flags
from diffabs.core.shapes import Float, Num
from diffabs.core.types import AnyArray, Array, PyTree, Rows

MAX_SMITH_STEPS = 50  # C^(2^50) is 0 for a spectral radius of 1 - 1e-13, and not for a radius of 1


class Lyapunov(NamedTuple):
    """A solution of a Lyapunov equation.

    Attributes:
        P: Solution, shape (n, n).
        residual: Relative residual: the norm of the left side over the sum of the norms of its terms.
    """

    P: Float[Array, "*batch n n"]
    residual: Float[Array, "*batch"]


@default_flags()
def lyapunov(A: Num[AnyArray, "n n"], Q: Num[AnyArray, "n n"]) -> Lyapunov:
    """Return P of A' P + P A + Q = 0 and its relative residual.

    For a stable A, P is the integral of exp(A't) Q exp(At). P is differentiable to any order in both modes; the
    residual counts as constant.

    If two eigenvalues of A have the sum zero, the equation has no unique solution. P is then not finite, or rounding
    determines it. Such a P is often 1e15 times as large as Q, and its residual can be small.

    Args:
        A: State matrix, shape (n, n).
        Q: Constant term, shape (n, n); it need not be symmetric.
    """
    A, Q = as_float_arrays(A, Q)
    I = jnp.eye(len(A), dtype=A.dtype)
    P = _solve_vectorised(jnp.kron(A.T, I) + jnp.kron(I, A.T), Q)
    return Lyapunov(P, relative_residual(A.T @ P + P @ A + Q, A.T @ P, P @ A, Q))


@default_flags()
def discrete_lyapunov(A: Num[AnyArray, "n n"], Q: Num[AnyArray, "n n"]) -> Lyapunov:
    """Return P of A' P A - P + Q = 0 and its relative residual.

    For a stable A, P is the sum of (A')^k Q A^k. P is differentiable to any order in both modes; the residual counts as
    constant.

    If two eigenvalues of A have the product one, the equation has no unique solution. P is then as in `lyapunov`.

    Args:
        A: State matrix, shape (n, n).
        Q: Constant term, shape (n, n); it need not be symmetric.
    """
    A, Q = as_float_arrays(A, Q)
    P = _solve_vectorised(jnp.kron(A.T, A.T) - jnp.eye(A.size, dtype=A.dtype), Q)
    return Lyapunov(P, relative_residual(A.T @ P @ A - P + Q, A.T @ P @ A, P, Q))


def _solve_vectorised(operator: jax.Array, Q: Array) -> jax.Array:
    """Return P of operator vec(P) = -vec(Q), where vec stacks rows."""
    return jnp.linalg.solve(operator, -Q.ravel()).reshape(Q.shape)


def as_float_arrays(*values: AnyArray | Rows) -> tuple[Array, ...]:
    """Return the arguments as arrays of one common floating-point type."""
    values = tuple(jnp.asarray(x) if isinstance(x, list | tuple) else x for x in values)
    kind = jnp.result_type(float, *values)
    return tuple(jnp.asarray(x, kind) for x in values)


def relative_residual(summed: Array, *terms: jax.Array) -> jax.Array:
    """Return the norm of the sum of terms over the sum of their norms, 0 for zero terms, without a derivative."""
    summed, terms = lax.stop_gradient((summed, terms))
    axes = (0, 1)
    # `where` computes both branches, so the divisor is replaced too: no 0/0.
    total = reduce(add, (frobenius_norm(term, axes) for term in terms))
    return jnp.where(total == 0, 0.0, frobenius_norm(summed, axes) / jnp.where(total == 0, 1.0, total))


# Many small matrices: (rows, columns, batch)


def frobenius_norm(X: jax.Array, axes: int | tuple[int, ...] = (0, 1)) -> jax.Array:
    """Return the Frobenius norm of each matrix; `axes` are those of rows and columns."""
    return jnp.sqrt(jnp.sum(X * X, axes))


def transpose(X: Float[Array, "n m batch"]) -> Float[Array, "m n batch"]:
    """Return the transpose of each matrix, shape (rows, columns, batch)."""
    return jnp.swapaxes(X, 0, 1)


def times(*factors: jax.Array) -> jax.Array:
    """Return the product of `factors`, each of shape (rows, columns, batch), in their order.

    Each product is a sum of outer products, which XLA fuses into one loop.
    """
    return reduce(lambda X, Y: reduce(add, (X[:, k, None] * Y[None, k] for k in range(len(Y)))), factors)


def eye(n: int, like: Num[Array, "... batch"]) -> Num[Array, "{n} {n} batch"]:
    """Return an identity matrix (n, n, batch) for each matrix of `like`, of its data type."""
    return jnp.broadcast_to(jnp.eye(n, dtype=like.dtype)[..., None], (n, n, like.shape[-1]))


def gauss_jordan_solve(
    M: Num[Array, "n n batch"], W: Num[Array, "n m batch"]
) -> tuple[Num[Array, "n m batch"], Float[Array, " batch"]]:
    """Return M^-1 W and log abs det M for each M (n, n, batch), by elimination with partial pivoting."""
    rows = jnp.arange(len(M))[:, None]

    def step(k: jax.Array, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        T, log = carry
        column = T[:, k]
        # Gather the pivot's row. XLA would fuse a masked sum over the rows into its consumer, and compute the sum once
        # per element.
        place = jnp.argmax(jnp.where(rows >= k, jnp.abs(column), -1.0), 0)[None]
        value = jnp.take_along_axis(column, place, 0)[0]
        row = jnp.take_along_axis(T, place[None], 0)[0] / value
        pivot = rows == place
        T = jnp.where(pivot[:, None], T[k], T) - jnp.where(pivot, column[k], column)[:, None] * row
        return jnp.where(rows[:, None] == k, row, T), log + jnp.log(jnp.abs(value))

    T, log = lax.fori_loop(0, len(M), step, (jnp.concatenate([M, W], 1), jnp.zeros_like(jnp.abs(M[0, 0]))))
    return T[:, len(M) :], log


def cholesky(R: Float[Array, "n n batch"]) -> Float[Array, "n n batch"]:
    """Return the lower triangular L (n, n, batch) with L L' = R; not finite where R is not positive definite."""
    L = jnp.zeros_like(R)
    for k in range(len(R)):
        column = R[:, k] - jnp.sum(L * L[k], 1)
        column = jnp.where(jnp.arange(len(R))[:, None] >= k, column, 0.0)
        L = L.at[:, k].set(column / jnp.sqrt(column[k]))
    return L


def solve_stein(
    C: Float[Array, "n n batch"], *right: Float[Array, "n n batch"]
) -> tuple[Float[Array, "n n batch"], ...]:
    """Return X of C' X C - X + W = 0 for each W of `right`, all (n, n, batch); NaN where C is not stable.

    Smith's squared method: X <- X + C' X C, C <- C^2. C is not stable where its powers do not vanish.
    """

    def goes_on(carry: tuple[PyTree, ...]) -> jax.Array:
        k, C, _ = carry
        return (k < MAX_SMITH_STEPS) & jnp.any(frobenius_norm(C) > 1e-9)

    def double(carry: tuple[PyTree, ...]) -> tuple[PyTree, ...]:
        k, C, X = carry
        return k + 1, times(C, C), tuple(x + times(transpose(C), x, C) for x in X)

    # The loop runs until all matrices have converged; the test below then decides for each matrix.
    _, C, X = lax.while_loop(goes_on, double, (0, C, right))
    return tuple(jnp.where(frobenius_norm(C) <= 1e-9, x, jnp.nan) for x in X)
