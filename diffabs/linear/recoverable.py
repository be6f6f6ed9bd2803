"""How far from rest any control at all can bring a linear system back, |u| <= U: the bound that a design is judged by.

The control reaches the coordinate z = w'x of an unstable mode s, w'A = s w', only through z' = s z + (w'B) u. Whatever
u does, it cannot return from |z| > |w'B| U/s, and if that is the only unstable mode, every start within is returned (T.
Hu, Z. Lin, L. Qiu, Stabilization of exponentially unstable linear systems with saturating actuators, IEEE Trans. Autom.
Control 46, 2001). Of the multiples c d of a start d those up to c = |w'B| U/(s |w'd|) are recoverable. With the P of
the least energy, A'P + PA - PBB'P = 0 (an LQR without Q), P = 2 s w w'/(w'B)^2 and B'PB = 2 s, so that

    c = 2 U / sqrt((B'P B)(d'P d))

which a Riccati equation differentiates, without eigenvectors.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from diffabs.linear.riccati import care


def recoverable_bound(A: Any, B: Any, start: Any, limit: Any) -> Any:
    """The greatest multiple of `start` (n,) that some |u| <= limit recovers; A (n, n) with one unstable pole, B (n, 1).
    Differentiable; NaN if A has poles on the imaginary axis. With several unstable poles it is no bound: see
    `mode_bounds`."""
    b, d = jnp.asarray(B).reshape(-1), jnp.asarray(start)
    p = care(A, b[:, None], jnp.zeros_like(jnp.asarray(A)), jnp.eye(1)).P
    return 2 * limit / jnp.sqrt((b @ p @ b) * (d @ p @ d))


def mode_bounds(A: Any, B: Any, start: Any, limit: float) -> dict[float, float]:
    """By unstable real pole, the greatest multiple of `start` from which that mode alone can be returned. No control
    recovers more than the least of them; with one unstable pole some control recovers all of it."""
    a, b, d = np.asarray(A, float), np.asarray(B, float).reshape(-1), np.asarray(start, float)
    poles, left = np.linalg.eig(a.T)
    found = {}
    for pole, w in zip(poles, left.T, strict=True):
        if pole.real > 0 and abs(pole.imag) <= 1e-12 * abs(pole):
            reach, there = abs(np.real(w) @ b) * limit / pole.real, abs(np.real(w) @ d)
            found[float(pole.real)] = float(reach / there) if there > 0 else np.inf
    return found


def transmission_zeros(A: Any, B: Any, output: Any) -> np.ndarray:
    """Finite transmission zeros of x' = A x + B u, y = c'x, one input: where the Rosenbrock matrix loses rank. They are
    the poles of the inverse, which exists on the states that keep y at 0: with relative degree r, the eigenvalues of
    (I - B (c'A^(r-1)B)^-1 c'A^(r-1)) A other than r zeros of its own making."""
    a, b, c = np.asarray(A, float), np.asarray(B, float).reshape(-1, 1), np.asarray(output, float).reshape(1, -1)
    degree, row = 1, c
    while abs((row @ b).item()) <= 1e-12 * np.linalg.norm(row) * np.linalg.norm(b):
        degree, row = degree + 1, row @ a
        if degree > len(a):
            return np.array([])
    found = np.linalg.eigvals(a - b @ (row @ a) / (row @ b).item())
    return np.delete(found, np.argsort(np.abs(found))[:degree])
