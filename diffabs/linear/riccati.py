"""Algebraic Riccati equations: `care` in continuous time, `dare` in discrete time.

    care    A' P + P A - (P B + S) R^-1 (P B + S)' + Q = 0              A - B R^-1 (B' P + S') stable
    dare    A' P A - P - (A' P B + S) (R + B' P B)^-1 (A' P B + S)' + Q = 0

1. R to the identity and S to zero; the state balanced, so that rows and columns of the Hamiltonian are of one size.
2. The sign of the Hamiltonian by Newton's iteration with determinantal scaling (Byers 1987); discrete time first by a
   Cayley transformation. Its stable subspace is spanned by (I, P).
3. Newton-Kleinman steps, each a Lyapunov equation, until P moves no more: step 2 is not backward stable.
4. The proof: see `Riccati`. What is not proven is returned as NaN.

There is no Schur form, which cannot be batched: all lanes of a `vmap` advance together. The derivative is that of the
implicit function theorem, one Lyapunov equation with the closed loop.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.compiling import SAME_RESULT_OPTIONS, compile_once
from diffabs.linear.lyapunov import as_float_arrays
from diffabs.linear.lyapunov import discrete_lyapunov as _discrete_lyapunov
from diffabs.linear.lyapunov import lyapunov as _lyapunov
from diffabs.linear.riccati_batched import solve_care, solve_dare, solve_one

FLOAT64_HINT = 'a proven P needs float64, for which JAX is asked by jax.config.update("jax_enable_x64", True)'


class Riccati(NamedTuple):
    """P (n, n), its relative residual, and whether it is proven to be the stabilising solution. If not, P is NaN.

    residual: norm of the equation's left side over the sum of the norms of its terms.
    stabilising: P is finite and symmetric; the residual is at most 1e-9; the closed loop Ac is stable, and by enough:
    in balanced coordinates X of Ac' X + X Ac + I = 0 exists and eps |X| (sum of the norms of the terms) <= 1e-7 |P|,
    which bounds to first order the relative error of P. It is false for a pair that cannot be stabilised, for a
    Hamiltonian with eigenvalues on the imaginary axis (unit circle), for R that is not positive definite (of `dare`:
    semidefinite), for input that is not finite, and for what is too close to one of these to tell.
    """

    P: Any
    residual: Any
    stabilising: Any


def care(A: Any, B: Any, Q: Any, R: Any, S: Any = None) -> Riccati:
    """Return the stabilising P of A' P + P A - (P B + S) R^-1 (P B + S)' + Q = 0.

    A (n, n), B (n, m), Q (n, n), R (m, m) > 0, S (n, m) or none; of Q and R the symmetric part counts. Q may be
    indefinite: P then too, if there is a stabilising one. Works under jit, vmap, and both modes of differentiation, in
    all arguments; the residual counts as constant. The feedback is u = -R^-1 (B' P + S') x.

    Raises ValueError for shapes that do not fit, complex matrices, and float32.
    """
    return _riccati(_solve_continuous, A, B, Q, R, S)


def dare(A: Any, B: Any, Q: Any, R: Any, S: Any = None) -> Riccati:
    """Return the stabilising P of A' P A - P - (A' P B + S) (R + B' P B)^-1 (A' P B + S)' + Q = 0.

    A (n, n), B (n, m), Q (n, n), R (m, m), S (n, m) or none. As `care`, but R may be singular, R >= 0, where
    R + B' P B > 0. The feedback is u = -(R + B' P B)^-1 (B' P A + S') x. Raises ValueError as `care`.
    """
    return _riccati(_solve_discrete, A, B, Q, R, S)


def _riccati(solution: Callable, A: Any, B: Any, Q: Any, R: Any, S: Any) -> Riccati:
    A, B, Q, R = as_float_arrays(A, B, Q, R)
    S = jnp.zeros_like(B) if S is None else as_float_arrays(S)[0].astype(B.dtype)
    if jnp.iscomplexobj(B) or jnp.iscomplexobj(S):
        raise ValueError("A, B, Q, R, S must be real; [[Re, -Im], [Im, Re]] of each is the same equation, real")
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
def _solve_compiled(solution: Callable, A: Any, B: Any, Q: Any, R: Any, S: Any) -> Riccati:
    P, residual = solution(A, B, (Q + Q.T) / 2, (R + R.T) / 2, S)
    return Riccati(P, residual, jnp.all(jnp.isfinite(P)))


# The derivative


@jax.custom_jvp
def _solve_continuous(*data: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(P, residual) of the continuous equation."""
    return solve_one(solve_care, data)


@jax.custom_jvp
def _solve_discrete(*data: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(P, residual) of the discrete equation."""
    return solve_one(solve_dare, data)


@_solve_continuous.defjvp
def _solve_continuous_jvp(data: Any, tangents: Any) -> Any:
    """Ac' dP + dP Ac + (derivative of the left side at constant P) = 0."""
    P, residual = _solve_continuous(*data)

    def left(A: Any, B: Any, Q: Any, R: Any, S: Any) -> Any:
        PA, T = P @ A, P @ B + S
        return PA + PA.T - T @ jnp.linalg.solve(R, T.T) + Q

    A, B, _, R, S = data
    closed = A - B @ jnp.linalg.solve(R, B.T @ P + S.T)
    return (P, residual), (_lyapunov(closed, jax.jvp(left, data, tangents)[1]).P, jnp.zeros_like(residual))


@_solve_discrete.defjvp
def _solve_discrete_jvp(data: Any, tangents: Any) -> Any:
    """Ac' dP Ac - dP + (derivative of the left side at constant P) = 0."""
    P, residual = _solve_discrete(*data)

    def left(A: Any, B: Any, Q: Any, R: Any, S: Any) -> Any:
        T = A.T @ P @ B + S
        return A.T @ P @ A - T @ jnp.linalg.solve(R + B.T @ P @ B, T.T) + Q

    A, B, _, R, S = data
    closed = A - B @ jnp.linalg.solve(R + B.T @ P @ B, B.T @ P @ A + S.T)
    return (P, residual), (_discrete_lyapunov(closed, jax.jvp(left, data, tangents)[1]).P, jnp.zeros_like(residual))
