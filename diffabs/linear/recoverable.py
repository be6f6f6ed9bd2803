"""The largest initial deviation of a linear system from which any control |u| <= U can return: a bound on every design.

Let w be the left eigenvector of an unstable mode s, w'A = s w'. The control reaches the coordinate z = w'x only through
z' = s z + (w'B) u. No u returns from |z| > |w'B| U/s. If this is the only unstable mode, some u returns from every
start with a smaller |z|. The multiples c d of a start d are recoverable up to c = |w'B| U/(s |w'd|).

Let P be the solution for the least control energy, A'P + PA - PBB'P = 0 (an LQR without Q). Then P = 2 s w w'/(w'B)^2
and B'PB = 2 s, so that

    c = 2 U / sqrt((B'P B)(d'P d))

A Riccati equation gives this c with its derivatives, without eigenvectors.

Source: T. Hu, Z. Lin, L. Qiu, Stabilization of exponentially unstable linear systems with saturating actuators, IEEE
Trans. Autom. Control 46, 2001.
"""

import jax.numpy as jnp
import numpy as np

from diffabs.core.jax_flags import default_flags
from diffabs.core.types import AnyArray, Scalar
from diffabs.linear.riccati import care

UNIT_SWEEPS = 30  # over the states, for their units; enough where these differ by 1e12
ROUNDING = 1e-12  # products below this, relative to the norms of their factors, are rounding


@default_flags()
def recoverable_bound(A: AnyArray, B: AnyArray, start: object, limit: Scalar) -> AnyArray:
    """Return the largest multiple of `start` from which some |u| <= limit returns, for a system with one unstable pole.

    The result is a scalar, differentiable in all arguments. It is NaN if A has poles on the imaginary axis. With
    several unstable poles it is not a bound: use `mode_bounds`.

    Args:
        A: State matrix, shape (n, n), with one unstable pole.
        B: Input matrix, shape (n, 1).
        start: Initial deviation, shape (n,).
        limit: Largest |u|.
    """
    b, d = jnp.asarray(B).reshape(-1), jnp.asarray(start)
    p = care(A, b[:, None], jnp.zeros_like(jnp.asarray(A)), jnp.eye(1)).P
    return 2 * limit / jnp.sqrt((b @ p @ b) * (d @ p @ d))


def mode_bounds(A: AnyArray, B: AnyArray, start: object, limit: float) -> dict[float, float]:
    """Return {pole: multiple} over the unstable real poles [1/s], the largest recoverable multiple of `start` for each.

    Some |u| <= limit returns the mode from every smaller multiple, and none from a larger one. Each mode is taken
    alone, so no control returns the whole system from more than the least of the multiples. If only one pole is
    unstable, some control returns from every smaller multiple. A multiple is infinite where `start` does not excite the
    mode. Modes with equal poles have one entry, the least multiple of all their left eigenvectors. Complex pairs are
    left out.
    """
    a, b, d = np.asarray(A, float), np.asarray(B, float).reshape(-1), np.asarray(start, float)
    poles, vectors = np.linalg.eig(a.T)
    multiples, waiting = {}, (np.real(poles) > 0) & (abs(np.imag(poles)) <= ROUNDING * abs(poles))
    while waiting.any():
        pole = float(np.real(poles[waiting][0]))
        equal = waiting & (abs(poles - pole) <= 2 * ROUNDING * pole)
        waiting &= ~equal
        # The one input moves the left eigenvectors of a pole along one direction only, B in the basis W.
        _, sizes, basis = np.linalg.svd(
            np.vstack([np.real(vectors.T[equal]), np.imag(vectors.T[equal])]), full_matrices=False
        )
        basis = basis[sizes > ROUNDING * sizes[0]]
        reach, offset = basis @ b, basis @ d
        size = np.linalg.norm(reach)
        moved = reach / size if size > 0 else reach
        along = moved @ offset
        if np.linalg.norm(offset - along * moved) > ROUNDING * np.linalg.norm(d):
            multiples[pole] = 0.0
        else:
            multiples[pole] = float(size * limit / (pole * abs(along))) if along else np.inf
    return multiples


def transmission_zeros(A: AnyArray, B: AnyArray, output: object) -> np.ndarray:
    """Return the finite invariant zeros of x' = A x + B u, y = c'x, shape (n - r,) for relative degree r.

    They are the transmission zeros, and the modes that u does not move or y does not show. At a zero the Rosenbrock
    matrix loses rank. The zeros are the poles of the inverse system, whose states keep y and its first r - 1
    derivatives at 0. They are eigenvalues of the matrix below on the states x with c'x = c'A x = ... = c'A^(r-1)x = 0.

        (I - B (c'A^(r-1)B)^-1 c'A^(r-1)) A

    The result is empty if u does not influence y.
    """
    a, b, rows = np.asarray(A, float), np.asarray(B, float).reshape(-1), np.asarray(output, float).reshape(1, -1)
    if not all(np.isfinite(x).all() for x in (a, b, rows)):
        raise ValueError("A, B or the output has an entry that is not finite")
    a, b, rows = _balance(a, b, rows)
    size = np.linalg.norm(rows)
    for degree in range(1, len(a) + 1):
        # The last row of the orthonormal basis replaces c'A^(degree - 1): powers of A would lose digits.
        basis, triangle = np.linalg.qr(rows.T, mode="complete")
        row, complement, pivot = basis[:, degree - 1], basis[:, degree:], abs(triangle[degree - 1, degree - 1])
        if pivot <= ROUNDING * size:
            break
        if pivot * abs(row @ b) > ROUNDING * size * np.linalg.norm(b):
            return np.linalg.eigvals(complement.T @ (a @ complement - np.outer(b, row @ a @ complement) / (row @ b)))
        rows, size = np.vstack([rows, row @ a]), np.linalg.norm(abs(row) @ abs(a))
    return np.array([])


def _balance(a: np.ndarray, b: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a system in units of its states, input and output, powers of two, in which no entry hides another one."""
    whole = np.block([[a, b[:, None]], [row, np.zeros((1, 1))]])
    for _ in range(UNIT_SWEEPS):
        for i in range(len(whole)):
            by_others, on_others = (np.sum(np.abs(np.delete(x, i))) for x in (whole[i], whole[:, i]))
            if by_others > 0 and on_others > 0:
                unit = 2.0 ** np.round(0.5 * (np.log2(by_others) - np.log2(on_others)))
                whole[i] /= unit
                whole[:, i] *= unit
    return whole[:-1, :-1], whole[:-1, -1], whole[-1:, :-1]
