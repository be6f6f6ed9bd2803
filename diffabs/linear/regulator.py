"""Linear quadratic regulators, u = +K x: the sign of the rest of the package, and of the papers.

    lqr    minimises the integral of x'Q x + 2 x'S u + u'R u,  x' = A x + B u    K = -R^-1 (B'P + S')
    dlqr   minimises the sum,                                  x+ = A x + B u    K = -(R + B'P B)^-1 (B'P A + S')

Both are pure JAX: compiled, batched and differentiable in every matrix. Untraced matrices are checked before the
equation is solved. Inside `jit` and `vmap` the flag `stabilising` reports a failure, and K is NaN. Of traced Q and R
only the symmetric part counts.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from diffabs.core.compiling import SAME_RESULT_OPTIONS, compile_once
from diffabs.core.jax_flags import default_flags
from diffabs.core.shapes import Bool, Float, Num
from diffabs.core.types import AnyArray, Rows
from diffabs.linear.riccati import care, dare, symmetric_part
from diffabs.linear.stabilisability import unstabilisable_mode
from diffabs.linear.weights import as_weight_matrix, check_symmetric


class Regulator(NamedTuple):
    """A regulator u = K x.

    Attributes:
        gain: Gain K, shape (m, n).
        P: Solution of the Riccati equation, shape (n, n).
        residual: Relative residual of P, as in `Riccati`.
        stabilising: Whether P is proven to be the stabilising solution, as in `Riccati`.
    """

    gain: Float[AnyArray, "*batch m n"]
    P: Float[AnyArray, "*batch n n"]
    residual: Float[AnyArray, "*batch"]
    stabilising: Bool[AnyArray, "*batch"]


@default_flags()
def lqr(
    A: Num[AnyArray, "n n"] | Rows,
    B: Num[AnyArray, "n m"] | Rows,
    Q: Num[AnyArray, "n n"] | Rows,
    R: Num[AnyArray, "m m"] | Rows,
    S: Num[AnyArray, "n m"] | Rows | None = None,
) -> Regulator:
    """Return the regulator that minimises the integral of x'Q x + 2 x'S u + u'R u for x' = A x + B u.

    Args:
        A: State matrix, shape (n, n).
        B: Input matrix, shape (n, m).
        Q: Weight of the states, shape (n, n).
        R: Weight of the inputs, shape (m, m), positive definite.
        S: Cross weight, shape (n, m); None for zero.

    Raises:
        ValueError: The shapes do not fit, there is no state or no input, or the arrays are float32, in which no P can
            be proven. For matrices that are not traced also: an entry is not finite, Q or R is not symmetric, R is not
            positive definite, or the pair (A, B) is not stabilisable.

    See also:
        `linear.dlqr`: The same for a sampled system.
        `linear.care`: The Riccati equation alone.
        `linear.linearize`: A and B of a loop.
        `design.design`: One gain for many A and B, with a proof.

    Notes:
        The gain follows from the stabilising solution P of the Riccati equation

            A' P + P A - (P B + S) R^-1 (B' P + S') + Q = 0,   u = K x,   K = -R^-1 (B' P + S')

        and x(0)' P x(0) is the least cost. The sign is that of u = +K x; python-control and MATLAB return -K. Source:
        B. D. O. Anderson and J. B. Moore, Optimal Control: Linear Quadratic Methods, 1990.

    Examples:
        A double integrator has the gain (-1, -sqrt(3)):

        >>> import jax
        >>> import jax.numpy as jnp
        >>> from diffabs.linear import lqr
        >>> jax.config.update("jax_enable_x64", True)
        >>> A, B, Q = jnp.array([[0.0, 1.0], [0.0, 0.0]]), jnp.array([[0.0], [1.0]]), jnp.eye(2)
        >>> print(lqr(A, B, Q, jnp.array([[1.0]])).gain.round(4))
        [[-1.     -1.7321]]

        The gain's derivative by the weight r of the input; K1 = -r^(-1/2):

        >>> print(jax.jacobian(lambda r: lqr(A, B, Q, r[None, None]).gain[0, 0])(jnp.array(1.0)).round(6))
        0.5
    """
    _check_matrices(A, B, Q, R, S, discrete=False)
    return _solve_lqr(A, B, Q, R, S)


@default_flags()
def dlqr(
    A: Num[AnyArray, "n n"] | Rows,
    B: Num[AnyArray, "n m"] | Rows,
    Q: Num[AnyArray, "n n"] | Rows,
    R: Num[AnyArray, "m m"] | Rows,
    S: Num[AnyArray, "n m"] | Rows | None = None,
) -> Regulator:
    """Return the regulator that minimises the sum of x'Q x + 2 x'S u + u'R u for x(k+1) = A x(k) + B u(k).

    >>> import jax
    >>> from diffabs.linear import dlqr
    >>> jax.config.update("jax_enable_x64", True)
    >>> print(dlqr([[1.0]], [[1.0]], [[1.0]], [[1.0]]).gain.round(4))  # (1 - sqrt(5))/2
    [[-0.618]]

    Args:
        A: State matrix, shape (n, n).
        B: Input matrix, shape (n, m).
        Q: Weight of the states, shape (n, n).
        R: Weight of the inputs, shape (m, m). An untraced R must be positive definite. A traced one may be singular
            where R + B'P B > 0.
        S: Cross weight, shape (n, m); None for zero.

    Raises:
        ValueError: The same cases as in `lqr`.
    """
    _check_matrices(A, B, Q, R, S, discrete=True)
    return _solve_dlqr(A, B, Q, R, S)


@compile_once(options=SAME_RESULT_OPTIONS)
def _solve_lqr(
    A: Num[AnyArray, "n n"] | Rows,
    B: Num[AnyArray, "n m"] | Rows,
    Q: Num[AnyArray, "n n"] | Rows,
    R: Num[AnyArray, "m m"] | Rows,
    S: Num[AnyArray, "n m"] | Rows | None,
) -> Regulator:
    riccati = care(A, B, Q, R, S)
    turned = jnp.asarray(B).T @ riccati.P + (0.0 if S is None else jnp.asarray(S).T)
    return Regulator(-jnp.linalg.solve(symmetric_part(jnp.asarray(R, riccati.P.dtype)), turned), *riccati)


@compile_once(options=SAME_RESULT_OPTIONS)
def _solve_dlqr(
    A: Num[AnyArray, "n n"] | Rows,
    B: Num[AnyArray, "n m"] | Rows,
    Q: Num[AnyArray, "n n"] | Rows,
    R: Num[AnyArray, "m m"] | Rows,
    S: Num[AnyArray, "n m"] | Rows | None,
) -> Regulator:
    riccati = dare(A, B, Q, R, S)
    b = jnp.asarray(B)
    turned = b.T @ riccati.P @ jnp.asarray(A) + (0.0 if S is None else jnp.asarray(S).T)
    return Regulator(-jnp.linalg.solve(symmetric_part(jnp.asarray(R)) + b.T @ riccati.P @ b, turned), *riccati)


def _check_matrices(
    A: AnyArray | Rows,
    B: AnyArray | Rows,
    Q: AnyArray | Rows,
    R: AnyArray | Rows,
    S: AnyArray | Rows | None,
    *,
    discrete: bool,
) -> None:
    """Raise ValueError for matrices of numbers that have no regulator; accept traced ones."""
    if any(isinstance(x, Tracer) for x in (A, B, Q, R)):
        return
    a, b = np.asarray(A, float), np.asarray(B, float)
    if a.ndim != 2 or a.shape[0] != a.shape[1] or b.ndim != 2 or len(b) != len(a):
        raise ValueError(f"A has shape {a.shape} and B {b.shape}; (n, n) and (n, m) are needed")
    if not b.size:
        raise ValueError(f"B has shape {b.shape}; at least one state and one input are needed")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError("A or B has an entry that is not finite")
    check_symmetric("Q", Q, len(a))
    check_symmetric("R", R, b.shape[1])
    as_weight_matrix("R", R, b.shape[1], definite=True)
    if not isinstance(S, Tracer) and S is not None and not np.isfinite(np.asarray(S, float)).all():
        raise ValueError("S has an entry that is not finite")
    unmoved = unstabilisable_mode(a, b, discrete=discrete)
    if unmoved is not None:
        raise ValueError(f"the pair (A, B) is not stabilisable: the input does not move the mode at {unmoved:.6g}")
