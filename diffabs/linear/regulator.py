"""Linear quadratic regulators, u = +K x: the sign is that of the rest of the package, and of the papers.

    lqr    minimises the integral of x'Q x + 2 x'S u + u'R u,  x' = A x + B u    K = -R^-1 (B'P + S')
    dlqr   minimises the sum,                                  x+ = A x + B u    K = -(R + B'P B)^-1 (B'P A + S')

Pure JAX: compiled, batched and differentiated in every matrix. What a caller can be told before the equation is solved
is told where the matrices are numbers; inside `jit` and `vmap` the flag `stabilising` says it, and K is NaN.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from diffabs.core.compiling import SAME_RESULT_OPTIONS, compile_once
from diffabs.linear.riccati import care, dare
from diffabs.linear.weights import as_weight_matrix

PBH_TOLERANCE = 1e-10  # relative: a mode with no more input than this is not moved by it


class Regulator(NamedTuple):
    """Gain K (m, n), and what `Riccati` says of P (n, n)."""

    gain: Any
    P: Any
    residual: Any
    stabilising: Any


def lqr(A: Any, B: Any, Q: Any, R: Any, S: Any = None) -> Regulator:
    """Return the gain that minimises the integral of x'Q x + 2 x'S u + u'R u of x' = A x + B u, and what belongs to it.

    A (n, n), B (n, m), Q (n, n), R (m, m), S (n, m) or none

    >>> import jax
    >>> from diffabs.linear import lqr
    >>> jax.config.update("jax_enable_x64", True)
    >>> A, B = [[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]]
    >>> print(lqr(A, B, [[1.0, 0.0], [0.0, 1.0]], [[1.0]]).gain.round(4))  # -1 and -sqrt(3)
    [[-1.     -1.7321]]

    Raises:
        ValueError: shapes that do not fit; float32, in which no P can be proven; and, for matrices that are numbers and
            not traced, entries that are not finite, Q or R that are not symmetric, R that is not positive definite, a
            pair that is not stabilisable.
    """
    _check_matrices(A, B, Q, R, discrete=False)
    return _solve_lqr(A, B, Q, R, S)


def dlqr(A: Any, B: Any, Q: Any, R: Any, S: Any = None) -> Regulator:
    """Return the gain that minimises the sum of x'Q x + 2 x'S u + u'R u of x(k+1) = A x(k) + B u(k).

    A (n, n), B (n, m), Q (n, n), R (m, m), S (n, m) or none; R may be singular where R + B'P B > 0

    >>> import jax
    >>> from diffabs.linear import dlqr
    >>> jax.config.update("jax_enable_x64", True)
    >>> print(dlqr([[1.0]], [[1.0]], [[1.0]], [[1.0]]).gain.round(4))  # (1 - sqrt(5))/2
    [[-0.618]]

    Raises ValueError as `lqr`."""
    _check_matrices(A, B, Q, R, discrete=True)
    return _solve_dlqr(A, B, Q, R, S)


@compile_once(options=SAME_RESULT_OPTIONS)
def _solve_lqr(A: Any, B: Any, Q: Any, R: Any, S: Any) -> Regulator:
    found = care(A, B, Q, R, S)
    turned = jnp.asarray(B).T @ found.P + (0.0 if S is None else jnp.asarray(S).T)
    return Regulator(-jnp.linalg.solve(jnp.asarray(R, found.P.dtype), turned), *found)


@compile_once(options=SAME_RESULT_OPTIONS)
def _solve_dlqr(A: Any, B: Any, Q: Any, R: Any, S: Any) -> Regulator:
    found = dare(A, B, Q, R, S)
    b = jnp.asarray(B)
    turned = b.T @ found.P @ jnp.asarray(A) + (0.0 if S is None else jnp.asarray(S).T)
    return Regulator(-jnp.linalg.solve(jnp.asarray(R) + b.T @ found.P @ b, turned), *found)


def _check_matrices(A: Any, B: Any, Q: Any, R: Any, *, discrete: bool) -> None:
    """What can be said of numbers."""
    if any(isinstance(x, Tracer) for x in (A, B, Q, R)):
        return
    a, b = np.asarray(A, float), np.asarray(B, float)
    if a.ndim != 2 or a.shape[0] != a.shape[1] or b.ndim != 2 or len(b) != len(a):
        raise ValueError(f"A has shape {a.shape} and B {b.shape}; (n, n) and (n, m) are needed")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError("A or B has an entry that is not finite")
    for name, value, size in (("Q", Q, len(a)), ("R", R, b.shape[1])):
        value = np.asarray(value, float)
        if value.shape != (size, size):
            raise ValueError(f"{name} has shape {value.shape}; ({size}, {size}) is needed")
        if not np.isfinite(value).all() or not np.allclose(value, value.T, rtol=1e-12, atol=0):
            raise ValueError(f"{name} = {value.tolist()} is not symmetric and finite")
    as_weight_matrix("R", R, b.shape[1], definite=True)
    unmoved = unstabilisable_mode(a, b, discrete=discrete)
    if unmoved is not None:
        raise ValueError(f"the pair (A, B) is not stabilisable: the input does not move the mode at {unmoved:.6g}")


def unstabilisable_mode(A: Any, B: Any, *, discrete: bool = False) -> complex | None:
    """An eigenvalue of A, not stable, that the input cannot move: (A - s I, B) has rank below n there (Popov, Belevitch
    and Hautus). None if there is none."""
    a, b = np.asarray(A, float), np.asarray(B, float)
    for mode in np.linalg.eigvals(a):
        unstable = abs(mode) >= 1 if discrete else np.real(mode) >= 0
        pencil = np.hstack([a - mode * np.eye(len(a)), b])
        if unstable and np.linalg.svd(pencil, compute_uv=False)[-1] <= PBH_TOLERANCE * np.linalg.norm(pencil, 2):
            return complex(mode) if abs(np.imag(mode)) > 0 else float(np.real(mode))
    return None
