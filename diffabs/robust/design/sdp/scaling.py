"""Coordinates in which a solver of LMIs works well.

    x = T z,  u = U v,  t = s/tau

The rig's weights span eight decades and its states three. Without scaling, Clarabel fails or returns a destabilising
gain as optimal. The coordinates of a Riccati solution P = T^-T T^-1 (or a Lyapunov solution) bring the unknown near the
unit matrix. The weights of the input and, with tau, the closed loop are then near it too.
"""

import warnings
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from diffabs.robust.design.polytopes import Polytope


class Frame(NamedTuple):
    """A change of coordinates: T (n, n) and its inverse, U (m, m), and tau [1/s] (1 in discrete time)."""

    T: np.ndarray
    inverse: np.ndarray
    U: np.ndarray
    tau: float

    def states(self, a: np.ndarray) -> np.ndarray:
        """Return the scaled state matrix of `a`, shape (..., n, n)."""
        return self.inverse @ a @ self.T / self.tau

    def inputs(self, b: np.ndarray) -> np.ndarray:
        """Return the scaled input matrix of `b`, shape (n, m)."""
        return self.inverse @ b @ self.U / self.tau

    def weight(self, q: np.ndarray) -> np.ndarray:
        """Return the scaled weight of `q`, a quadratic form of x per unit of time."""
        return self.T.T @ q @ self.T / self.tau

    def form(self, p: np.ndarray) -> np.ndarray:
        """Return P in the original coordinates from `p` in the scaled ones."""
        whole = self.inverse.T @ p @ self.inverse
        return (whole + np.swapaxes(whole, -1, -2)) / 2

    def gain(self, k: np.ndarray) -> np.ndarray:
        """Return K in the original coordinates from `k` in the scaled ones."""
        return self.U @ k @ self.inverse

    def trace_weight(self) -> np.ndarray:
        """Return W with trace P = trace(W P'), where P is in the original coordinates and P' in the scaled ones."""
        return self.inverse @ self.inverse.T


def whitening_matrix(weight: np.ndarray) -> np.ndarray:
    """Return D with D' `weight` D = I, except in directions with less than 1e-6 of the largest weight.

    A slow closed loop beside a fast one has a small cost per unit of time. If M >= 0 is an inequality, the congruence
    D' M D makes a solver's tolerance relative. In a direction without weight it would only magnify rounding.
    """
    values, vectors = np.linalg.eigh(weight)
    return vectors / np.sqrt(np.maximum(values, 1e-6 * (values[-1] or 1.0)))


def definite_weight(q: np.ndarray, share: float) -> np.ndarray:
    """Return Q plus `share` of its diagonal, which gives every state a weight in its own unit unless Q = 0.

    A diagonal entry below 1e-6 of their mean counts as that.
    """
    return q + share * np.diag(np.maximum(np.diag(q), 1e-6 * np.trace(q) / len(q)))


def lyapunov_frame(p: np.ndarray, a: np.ndarray, r: np.ndarray, *, discrete: bool) -> Frame:
    """Return the frame in which P and R are unit matrices and the closed loops `a` (V, n, n) have norms of about 1."""
    lower = np.linalg.cholesky((p + p.T) / 2)
    inverse = lower.T
    t = np.linalg.inv(inverse)
    # The geometric mean of the norms; 1e-300 keeps the logarithm of a zero loop finite.
    tau = 1.0 if discrete else float(np.exp(np.mean(np.log(np.linalg.norm(inverse @ a @ t, axis=(1, 2)) + 1e-300))))
    u = np.linalg.inv(np.linalg.cholesky(r)).T * np.sqrt(tau)
    return Frame(t, inverse, u, tau)


def design_frames(system: Polytope, q: np.ndarray, r: np.ndarray) -> Iterator[tuple[Frame, float]]:
    """Yield frames for a design from the vertices' Riccati solutions P, with trace P, in decreasing order of it.

    No gain has a guaranteed cost below any of these traces.
    """
    # A small weight on every state keeps P definite. It is relative, and too small to change the result.
    q = definite_weight(q, 1e-12)
    solutions = [_riccati(a, b, q, r, i, system) for i, (a, b) in enumerate(zip(system.A, system.B, strict=True))]
    traces = np.array([np.trace(p) for p in solutions])
    for i in np.argsort(-traces):
        p, b = solutions[i], system.B[i]
        k = -np.linalg.solve(r, b.T @ p)
        if system.period is not None:
            k = -np.linalg.solve(r + b.T @ p @ b, b.T @ p @ system.A[i])
        closed = (system.A[i] + b @ k)[None]
        yield lyapunov_frame(p, closed, r, discrete=system.period is not None), float(traces[i])


def _riccati(a: np.ndarray, b: np.ndarray, q: np.ndarray, r: np.ndarray, i: int, system: Polytope) -> np.ndarray:
    """Return the stabilising Riccati solution of vertex i, or raise ValueError with its parameters."""
    from scipy.linalg import solve_continuous_are, solve_discrete_are

    try:
        if system.period is not None:
            p = solve_discrete_are(a, b, q, r)
        else:
            p = _solve_by_hamiltonian(a, b, q, r)
            p = solve_continuous_are(a, b, q, r) if p is None else p
        np.linalg.cholesky(p)
    except (np.linalg.LinAlgError, ValueError):
        where = f" ({dict(system.corners[i])})" if system.corners else ""
        raise ValueError(
            f"vertex {i}{where} has no stabilising Riccati solution P > 0: (A, B) is not stabilisable, or Q is 0 and a "
            f"mode does not grow; A = {a.tolist()}, B = {b.tolist()}"
        ) from None
    return p


def _solve_by_hamiltonian(a: np.ndarray, b: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray | None:
    """Return the Riccati solution from the stable eigenvectors of the Hamiltonian matrix and one Newton step.

    A large residual makes the result None. The method takes a thirtieth of the time of SciPy's solver, whose BLAS may
    start threads for such small matrices.
    """
    n, push = len(a), b @ np.linalg.solve(r, b.T)
    # Scaling by `size` gives both off-diagonal blocks of the Hamiltonian matrix the same norm, for accurate
    # eigenvectors.
    size = np.sqrt(np.linalg.norm(q) / np.linalg.norm(push)) if push.any() and q.any() else 1.0
    modes, vectors = np.linalg.eig(np.block([[a, -push * size], [-q / size, -a.T]]))
    stable = vectors[:, np.argsort(np.real(modes))[:n]]
    try:
        p = size * np.real(stable[n:] @ np.linalg.inv(stable[:n]))
        closed = a - push @ p
        # Newton's step for the Riccati equation is a Lyapunov equation of the closed loop.
        operator = np.kron(closed.T, np.eye(n)) + np.kron(np.eye(n), closed.T)
        p = -np.linalg.solve(operator, (q + p @ push @ p).ravel()).reshape(n, n)
    except np.linalg.LinAlgError:
        return None
    p = (p + p.T) / 2
    terms = (a.T @ p + p @ a, p @ push @ p, q)
    residual = np.abs(terms[0] - terms[1] + terms[2]) / np.maximum(sum(np.abs(t) for t in terms), 1e-300)
    settled = np.real(np.linalg.eigvals(a - push @ p)).max() < 0
    return p if settled and residual.max() < 1e-10 else None


def analysis_frame(closed: np.ndarray, *, discrete: bool, weight: np.ndarray | None = None) -> Frame:
    """Return a frame for the analysis of closed loops from the mean of their Lyapunov solutions.

    For an unstable loop the Lyapunov equation is shifted. All equations are in balanced units. `weight` (n, n) is the
    cost rate on their right side, by default the unit matrix.
    """
    from scipy.linalg import matrix_balance

    units = matrix_balance(np.abs(closed).mean(axis=0), permute=False, separate=True)[1][0]
    try:
        p = _mean_lyapunov_solution(closed, units, discrete=discrete, weight=weight)
        return lyapunov_frame(p, closed, np.eye(1), discrete=discrete)
    except np.linalg.LinAlgError:  # a mode on the edge of stability, or a weight that is blind to a state
        return lyapunov_frame(np.diag(units**-2.0), closed, np.eye(1), discrete=discrete)


def _mean_lyapunov_solution(
    closed: np.ndarray, units: np.ndarray, *, discrete: bool, weight: np.ndarray | None
) -> np.ndarray:
    """Return the mean of the Lyapunov solutions, each loop shifted until it is stable; `units` (n,) are the states'."""
    from scipy.linalg import solve_continuous_lyapunov, solve_discrete_lyapunov

    n = closed.shape[1]
    mean = np.zeros((n, n))
    for a in closed:
        modes = np.linalg.eigvals(a)
        if discrete:
            a = a / max(1.0, 1.02 * np.abs(modes).max())
        else:
            # An unstable loop is shifted until its slowest mode is just stable: only then has the Lyapunov equation a
            # solution P > 0.
            size = np.abs(modes).max() or np.linalg.norm(a) or 1.0
            a = a - (max(0.0, 1.02 * modes.real.max()) + 1e-6 * size) * np.eye(n)
        a = a * units / units[:, None]
        q = np.eye(n) if weight is None else weight * units * units[:, None]
        with warnings.catch_warnings():
            # The solution is only a choice of coordinates, and an inaccurate one is as good.
            warnings.simplefilter("ignore", RuntimeWarning)
            p = solve_discrete_lyapunov(a.T, q) if discrete else solve_continuous_lyapunov(a.T, -q)
        # Without a weight all solutions count equally: each is divided by its trace.
        mean += p / units / units[:, None] / (np.trace(p) if weight is None else len(closed))
    return mean
