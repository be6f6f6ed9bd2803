"""Algebraic Riccati equations: `care` in continuous time, `dare` in discrete time.

    care    A' P + P A - (P B + S) R^-1 (P B + S)' + Q = 0              A - B R^-1 (B' P + S') stable
    dare    A' P A - P - (A' P B + S) (R + B' P B)^-1 (A' P B + S)' + Q = 0

1. Transform R to the identity and S to zero. Balance the state, so that rows and columns of the Hamiltonian have about
   equal size.
2. Find P by structured doubling (Chu, Fan and Lin 2005); continuous time needs a Cayley transformation first. Where
   doubling does not converge, use the matrix sign of the Hamiltonian, by Newton's iteration with determinantal scaling
   (Byers 1987). Here discrete time needs the Cayley transformation. The stable subspace is spanned by (I, P).
3. Apply Newton-Kleinman steps, each a Lyapunov equation, until P is constant, because step 2 is not backward stable.
4. Prove the result, see `Riccati`. An unproven P is returned as NaN.

No step needs a Schur form, so all runs of a `vmap` iterate together. The implicit function theorem gives the
derivative: one Lyapunov equation with the closed loop.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.compiling import SAME_RESULT_OPTIONS, compile_once
from diffabs.core.jax_flags import default_flags
from diffabs.core.shapes import Bool, Float, Num
from diffabs.core.types import AnyArray, Array, Matrix, Rows
from diffabs.linear.lyapunov import as_float_arrays
from diffabs.linear.lyapunov import discrete_lyapunov as _discrete_lyapunov
from diffabs.linear.lyapunov import lyapunov as _lyapunov
from diffabs.linear.riccati_batched import solve_care, solve_dare, solve_one

FLOAT64_HINT = 'a proven P needs float64, for which JAX is asked by jax.config.update("jax_enable_x64", True)'


class Riccati(NamedTuple):
    """A solution of a Riccati equation. P is NaN unless it is proven to be the stabilising solution.

    `stabilising` is true under these conditions. P is finite and symmetric. The residual is at most 1e-9. The closed
    loop Ac is stable with a margin: in balanced coordinates X of Ac' X + X Ac + I = 0 exists, and

        eps |X| (sum of the norms of the terms) <= 1e-7 |P|

    This bounds the relative error of P to first order. `stabilising` is false in these cases, and for data too close to
    them:

    - (A, B) is not stabilisable.
    - The Hamiltonian has eigenvalues on the imaginary axis (in discrete time on the unit circle).
    - R is not positive definite (in `dare`: not semidefinite).
    - An input is not finite.

    Attributes:
        P: Solution, shape (n, n).
        residual: Norm of the equation's left side over the sum of the norms of its terms.
        stabilising: Whether P is proven to be the stabilising solution.
    """

    P: Float[AnyArray, "*batch n n"]
    residual: Float[AnyArray, "*batch"]
    stabilising: Bool[AnyArray, "*batch"]


@default_flags()
def care(
    A: Num[AnyArray, "n n"] | Rows,
    B: Num[AnyArray, "n m"] | Rows,
    Q: Num[AnyArray, "n n"] | Rows,
    R: Num[AnyArray, "m m"] | Rows,
    S: Num[AnyArray, "n m"] | Rows | None = None,
) -> Riccati:
    """Return the stabilising solution P of the continuous Riccati equation, with its proof.

        A' P + P A - (P B + S) R^-1 (P B + S)' + Q = 0,     u = -R^-1 (B' P + S') x

    u is the feedback that belongs to P. The function works under jit, vmap, and both modes of differentiation, in all
    arguments. The residual counts as constant.

    Args:
        A: State matrix, shape (n, n).
        B: Input matrix, shape (n, m).
        Q: Weight of the states, shape (n, n); only its symmetric part counts. It may be indefinite, and P then too.
        R: Weight of the inputs, shape (m, m), positive definite; only its symmetric part counts.
        S: Cross weight, shape (n, m); None for zero.

    Raises:
        ValueError: The shapes do not fit, there is no state or no input, or the matrices are complex or float32.

    See also:
        `linear.dare`: The equation in discrete time.
        `linear.lqr`: The regulator that belongs to P.
        `linear.kalman`: The filter, whose equation is the dual one.
        `linear.lyapunov`: The linear equation without feedback.

    Notes:
        P is computed by structured doubling or, where that does not converge, by the matrix sign of the Hamiltonian.
        Newton's steps, each a Lyapunov equation, then refine it. The derivative for changes dA, dB, dQ, dR, dS solves
        one Lyapunov equation with the closed loop Ac = A - B R^-1 (B'P + S')

            Ac' dP + dP Ac + dQ + (dA + dB F)' P + P (dA + dB F) + F'dR F + dS F + F'dS' = 0,   F = -R^-1 (B'P + S')

        Sources: E. K.-W. Chu, H.-Y. Fan and W.-W. Lin, A structure-preserving doubling algorithm for continuous-time
        algebraic Riccati equations, Linear Algebra Appl. 396 (2005); R. Byers, Solving the algebraic Riccati equation
        with the matrix sign function, ibid. 85 (1987); D. L. Kleinman, IEEE Trans. Autom. Control 13 (1968).

    Examples:
        For a double integrator P = [[sqrt(3), 1], [1, sqrt(3)]]:

        >>> import jax
        >>> from diffabs.linear import care
        >>> jax.config.update("jax_enable_x64", True)
        >>> solution = care([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0], [0.0, 1.0]], [[1.0]])
        >>> print(solution.P.round(4), bool(solution.stabilising))
        [[1.7321 1.    ]
         [1.     1.7321]] True
    """
    return _riccati(_solve_continuous, A, B, Q, R, S)


@default_flags()
def dare(
    A: Num[AnyArray, "n n"] | Rows,
    B: Num[AnyArray, "n m"] | Rows,
    Q: Num[AnyArray, "n n"] | Rows,
    R: Num[AnyArray, "m m"] | Rows,
    S: Num[AnyArray, "n m"] | Rows | None = None,
) -> Riccati:
    """Return the stabilising solution P of the discrete Riccati equation, with its proof.

        A' P A - P - (A' P B + S) (R + B' P B)^-1 (A' P B + S)' + Q = 0,     u = -(R + B' P B)^-1 (B' P A + S') x

    u is the feedback that belongs to P. Transformations of JAX work as in `care`.

    Args:
        A: State matrix, shape (n, n).
        B: Input matrix, shape (n, m).
        Q: Weight of the states, shape (n, n); only its symmetric part counts. It may be indefinite, and P then too.
        R: Weight of the inputs, shape (m, m), positive semidefinite; only its symmetric part counts. It may be singular
            where R + B' P B > 0.
        S: Cross weight, shape (n, m); None for zero.

    Raises:
        ValueError: The same cases as in `care`.
    """
    return _riccati(_solve_discrete, A, B, Q, R, S)


def symmetric_part(X: AnyArray) -> AnyArray:
    """Return (X + X')/2: the part of a weight that counts in x'X x."""
    return (X + X.T) / 2


def _riccati(
    solution: Callable,
    A: AnyArray | Rows,
    B: AnyArray | Rows,
    Q: AnyArray | Rows,
    R: AnyArray | Rows,
    S: AnyArray | Rows | None,
) -> Riccati:
    A, B, Q, R = as_float_arrays(A, B, Q, R)
    S = jnp.zeros_like(B) if S is None else as_float_arrays(S)[0].astype(B.dtype)
    if jnp.iscomplexobj(B) or jnp.iscomplexobj(S):
        raise ValueError("A, B, Q, R, S must be real; [[Re, -Im], [Im, Re]] of each is the same equation, real")
    if not B.size:
        raise ValueError(f"B has shape {B.shape}; at least one state and one input are needed")
    n, m = B.shape
    shapes = (A.shape, Q.shape, R.shape, S.shape)
    if shapes != ((n, n), (n, n), (m, m), (n, m)):
        raise ValueError(
            f"A, Q, R, S have shapes {shapes}; B of shape {(n, m)} needs {((n, n), (n, n), (m, m), (n, m))}"
        )
    if B.dtype != jnp.float64:
        raise ValueError(f"A, B, Q, R are {B.dtype}: {FLOAT64_HINT}")
    return _solve_compiled(solution, A, B, Q, R, S)


@compile_once(static=1, options=SAME_RESULT_OPTIONS)
def _solve_compiled(solution: Callable, A: AnyArray, B: AnyArray, Q: AnyArray, R: AnyArray, S: AnyArray) -> Riccati:
    P, residual = solution(A, B, symmetric_part(Q), symmetric_part(R), S)
    return Riccati(P, residual, jnp.all(jnp.isfinite(P)))


# The derivative


@jax.custom_jvp
def _solve_continuous(*data: jax.Array) -> tuple[jax.Array, jax.Array]:
    return solve_one(solve_care, data)


@jax.custom_jvp
def _solve_discrete(*data: jax.Array) -> tuple[jax.Array, jax.Array]:
    return solve_one(solve_dare, data)


@_solve_continuous.defjvp
def _solve_continuous_jvp(
    data: tuple[Array, ...], tangents: tuple[Array, ...]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Solve Ac' dP + dP Ac + (derivative of the left side at constant P) = 0 for the tangent dP."""
    P, residual = _solve_continuous(*data)

    def left_side(A: Matrix, B: Matrix, Q: Matrix, R: Matrix, S: AnyArray) -> Matrix:
        PA, T = P @ A, P @ B + S
        return PA + PA.T - T @ jnp.linalg.solve(R, T.T) + Q

    A, B, _, R, S = data
    closed = A - B @ jnp.linalg.solve(R, B.T @ P + S.T)
    return (P, residual), (_lyapunov(closed, jax.jvp(left_side, data, tangents)[1]).P, jnp.zeros_like(residual))


@_solve_discrete.defjvp
def _solve_discrete_jvp(
    data: tuple[Array, ...], tangents: tuple[Array, ...]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Solve Ac' dP Ac - dP + (derivative of the left side at constant P) = 0 for the tangent dP."""
    P, residual = _solve_discrete(*data)

    def left_side(A: Matrix, B: Matrix, Q: Matrix, R: Matrix, S: AnyArray) -> Matrix:
        T = A.T @ P @ B + S
        return A.T @ P @ A - T @ jnp.linalg.solve(R + B.T @ P @ B, T.T) + Q

    A, B, _, R, S = data
    closed = A - B @ jnp.linalg.solve(R + B.T @ P @ B, B.T @ P @ A + S.T)
    return (P, residual), (
        _discrete_lyapunov(closed, jax.jvp(left_side, data, tangents)[1]).P,
        jnp.zeros_like(residual),
    )
