"""The central path of a quadratic Lyapunov inequality, in pure JAX.

    phi(X, F) = trace(X^-1)/mu - log det X - sum log det S_i

    S_i = s X - He[A_i X + B_i F] - X Q X - F'R F                          continuous time, V = x'X^-1 x, u = F X^-1 x
    S_i = [ (1 + s) X - X Q X - F'R F   . ]
          [ A_i X + B_i F               X ]                                discrete time

With s = 0 these are eqs. (30) and (32) of Maeda and Sugiura after elimination of Z. At the minimum of phi, trace X^-1
exceeds the smallest one by at most (V + 2) n mu. In discrete time that bound is 2 (V + 1) n mu. A shift s > 0 makes a
point feasible that is no solution yet.

The function is self-concordant, so the step 1/(1 + decrement) is always admissible. A small decrement at the end
proves, up to rounding, that the point is at the centre (Nesterov and Nemirovskii 1994). The shift follows Boyd and El
Ghaoui (1993), "method of centres".

**Coordinates follow the point.** Each Newton step uses x = T z, T T' = X, K = F X^-1. There X is the unit matrix and
the closed loops contain the gain. Weights and gains of any size need no other scaling.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from diffabs.core.types import AnyArray, Array, Bool, Matrix, PyTree, Scalar, Vector

MAX_PATH_STEPS = 600  # steps; the rig with weights over ten decades takes 30 to 90, at 1 kHz up to 340
CENTRING_DECREMENT = 0.5  # below this decrement the path goes on to the next centre
STEP_LENGTHS = (1.0, 0.5, 0.2, 0.1, 0.03, 0.01, 0.003, 0.001)  # lengths of the step, with 1/(1 + decrement) as another
FINAL_CENTRE_STEPS = 3  # steps at the last centre: the decrement is squared in each


class GuaranteedCostProblem(NamedTuple):
    """The vertices A (V, n, n) and B (V, n, m) and the weights Q (n, n) and R (m, m) of a problem."""

    A: Matrix
    B: Matrix
    Q: Matrix
    R: Matrix


class PathPoint(NamedTuple):
    """A point of the path: T (n, n) with T T' = X, and K = F X^-1 (m, n)."""

    T: Matrix
    K: Matrix


class CentralPathState(NamedTuple):
    """State of the iteration along the path.

    Attributes:
        steps: Number of Newton steps.
        point: Present point.
        shift: Shift s.
        mu: Weight of the barrier.
        decrement: Newton decrement before the last step.
        settled: Number of steps at the last centre.
        stuck: Whether no last centre exists.
    """

    steps: Scalar
    point: PathPoint
    shift: Array
    mu: Scalar
    decrement: Scalar
    settled: Scalar
    stuck: Bool


class LocalProblem(NamedTuple):
    """A problem in the coordinates of a point: closed loops c (V, n, n), b, k, q, r, and w with trace(w) = trace P."""

    c: Scalar
    b: Scalar
    k: Vector
    q: Matrix
    r: Any
    w: Scalar


def start_path(T: Matrix, K: Matrix, mu: Scalar) -> CentralPathState:
    """Return the initial state, with T T' = X and gain K (m, n); `follow_path` sets its shift."""
    zero = jnp.zeros((), T.dtype)
    return CentralPathState(0, PathPoint(T, K), zero - 1, zero + mu, zero, 0, zero > 0)


def follow_path(
    problem: GuaranteedCostProblem, path: CentralPathState, onwards: Callable, *, discrete: bool
) -> CentralPathState:
    """Return the state at the last centre, or `stuck`; also at an invalid number, and after MAX_PATH_STEPS steps.

    Args:
        onwards: Function (path, smallest shift, trace P) that returns the state with the next shift and mu.
    """
    local = localise_problem(problem, path.point)
    first = least_shift(local, discrete=discrete)
    # A Riccati solution satisfies its inequality with equality: `first` is 0 up to rounding, and the start needs a
    # margin.
    rounding = jnp.finfo(first.dtype).eps ** 0.5 * jnp.max(jnp.abs(local.c))
    path = path._replace(shift=jnp.maximum(2 * first, 0.0) + 1e-3 * jnp.abs(first) + rounding)

    def goes_on(path: CentralPathState) -> Matrix:
        return (
            (path.steps < MAX_PATH_STEPS)
            & (path.settled < FINAL_CENTRE_STEPS)
            & ~path.stuck
            & jnp.isfinite(path.decrement)
        )

    def step(path: CentralPathState) -> CentralPathState:
        """Return the state after a Newton step, with the next shift and mu if the step began near the centre."""
        point, decrement = _newton(problem, path, discrete=discrete)
        path = path._replace(steps=path.steps + 1, point=point, decrement=decrement)
        local = localise_problem(problem, point)
        after = onwards(path, least_shift(local, discrete=discrete), jnp.trace(local.w))
        # Shift and mu change only near the centre, where the full Newton step converges quadratically.
        return jax.tree.map(lambda new, old: jnp.where(decrement < CENTRING_DECREMENT, new, old), after, path)

    return lax.while_loop(goes_on, step, path)


def localise_problem(problem: GuaranteedCostProblem, point: PathPoint) -> LocalProblem:
    """Return the problem in a point's coordinates."""
    t, inverse = point.T, jnp.linalg.inv(point.T)
    closed = inverse @ (problem.A + problem.B @ point.K) @ t
    return LocalProblem(closed, inverse @ problem.B, point.K @ t, t.T @ problem.Q @ t, problem.R, inverse @ inverse.T)


def least_shift(local: LocalProblem, *, discrete: bool) -> Matrix:
    """Return the smallest s, a scalar, for which no S_i has a negative eigenvalue; <= 0 where all inequalities hold."""
    # At X = I the Schur complement of the discrete block matrix is (1 + s) I - Q - K'RK - C'C.
    flow = _t(local.c) @ local.c - jnp.eye(len(local.q)) if discrete else he(local.c)
    return jnp.max(jnp.linalg.eigvalsh(flow + local.q + local.k.T @ local.r @ local.k))


def gradient_and_hessian(local: LocalProblem, shift: Scalar, mu: Scalar, *, discrete: bool) -> tuple[PyTree, PyTree]:
    """Return gradient (d,) and Hessian (d, d) of phi in (X, F) at the point itself, in the basis of `directions`."""
    n = len(local.q)
    y, g = directions(n, len(local.k))
    f = local.k @ y + g
    cost = he(local.q @ y + local.k.T @ local.r @ f)
    inverse = jnp.linalg.inv(_slacks(local, jnp.zeros((n, n)), jnp.zeros_like(local.k), shift, discrete=discrete))
    # First derivatives of S_i at the point; the quadratic terms enter the Hessian through `curved`.
    change = _linear_part(local, y, g, discrete=discrete) + _pad_to_block(shift * y - cost, n, discrete)[:, None]
    moved, pushed, total = inverse @ change, local.w @ y, jnp.sum(inverse, 0)[:n, :n]
    gradient = -_trace(pushed) / mu - _trace(y) - jnp.sum(_trace(moved), 1)
    curved = y @ (local.q @ y)[:, None] + _t(f) @ (local.r @ f)[:, None]
    hessian = jnp.einsum("aij,bji->ab", y, y) + 2 / mu * jnp.einsum("aij,bji->ab", pushed, y)
    hessian += jnp.einsum("avij,bvji->ab", moved, moved) + 2 * jnp.einsum("ij,abji->ba", total, curved)
    return gradient, (hessian + hessian.T) / 2


def directions(n: int, m: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a basis of the changes (Y, G), shapes (d, n, n) and (d, m, n), with d = n(n + 1)/2 + m n.

    The changed point is X = I + Y and F = K + K Y + G, for n states and m inputs.
    """
    pairs = [(i, j) for i in range(n) for j in range(i + 1)]
    y, g = np.zeros((len(pairs) + m * n, n, n)), np.zeros((len(pairs) + m * n, m, n))
    for d, (i, j) in enumerate(pairs):
        y[d, i, j] = y[d, j, i] = 1.0
    g[len(pairs) :] = np.eye(m * n).reshape(m * n, m, n)
    return y, g


def solve_newton_system(hessian: Matrix, right: Array) -> Matrix:
    """Return H^-1 b for a positive definite H (d, d), which is first scaled to a unit diagonal."""
    # Scaling the diagonal to 1 lowers the condition number: directions of X and F differ by many decades.
    unit = 1 / jnp.sqrt(jnp.diagonal(hessian))
    return unit * jnp.linalg.solve(hessian * unit * unit[:, None], unit * right)


def _newton(problem: GuaranteedCostProblem, path: CentralPathState, *, discrete: bool) -> tuple[PathPoint, PyTree]:
    """Return the point after the best of several lengths of Newton's step, and the decrement before it."""
    local = localise_problem(problem, path.point)
    gradient, hessian = gradient_and_hessian(local, path.shift, path.mu, discrete=discrete)
    step = -solve_newton_system(hessian, gradient)
    decrement = jnp.sqrt(jnp.maximum(-gradient @ step, 0.0))
    y, g = (jnp.tensordot(step, basis, 1) for basis in directions(len(local.q), len(local.k)))
    # Several lengths are tried at once, without a line search: a batch under vmap needs no loop of its own.
    lengths = jnp.concatenate([1 / (1 + decrement)[None], jnp.asarray(STEP_LENGTHS)])[:, None, None]
    values = _phi(local, lengths * y, lengths * g, path.shift, path.mu, discrete=discrete)
    # Outside the domain logdet is NaN, and such a length is never the best.
    best = lengths[jnp.argmin(jnp.where(jnp.isfinite(values), values, jnp.inf))]
    x = jnp.eye(len(y)) + best * y
    t, k = path.point
    # T T' = T_old X T_old' makes X the unit matrix of the new coordinates.
    return PathPoint(t @ jnp.linalg.cholesky(x), k + best * g @ jnp.linalg.inv(t @ x)), decrement


def _phi(local: LocalProblem, y: Array, g: Matrix, shift: Scalar, mu: Scalar, *, discrete: bool) -> Matrix:
    x = jnp.eye(y.shape[-1]) + y
    inside = logdet(_slacks(local, y, g, shift, discrete=discrete))
    return _trace(jnp.linalg.inv(x) @ local.w) / mu - logdet(x) - jnp.sum(inside, -1)


def _slacks(local: LocalProblem, y: Array, g: Matrix, shift: Scalar, *, discrete: bool) -> Matrix:
    """Return S_i (..., V, n, n), or in discrete time the block matrix (..., V, 2n, 2n) above."""
    x = jnp.eye(y.shape[-1]) + y
    f = local.k @ x + g
    quadratic = shift * x - x @ local.q @ x - _t(f) @ local.r @ f
    return (
        _linear_part(local, x, g, discrete=discrete) + _pad_to_block(quadratic, y.shape[-1], discrete)[..., None, :, :]
    )


def _linear_part(local: LocalProblem, x: Vector, g: Matrix, *, discrete: bool) -> Matrix:
    """Return the part that is linear in (X, G): -He[c X + b G], or [[X, .], [c X + b G, X]]."""
    x = x[..., None, :, :]
    flow = local.c @ x + local.b @ g[..., None, :, :]
    if not discrete:
        return -he(flow)
    x = jnp.broadcast_to(x, flow.shape)
    return jnp.concatenate([jnp.concatenate([x, _t(flow)], -1), jnp.concatenate([flow, x], -1)], -2)


def _pad_to_block(x: AnyArray, n: int, discrete: bool) -> Matrix:
    """Return x in the first rows and columns of a block matrix, in discrete time only."""
    return jnp.pad(x, [(0, 0)] * (x.ndim - 2) + [(0, n)] * 2) if discrete else x


def _t(x: Scalar) -> Matrix:
    return jnp.swapaxes(x, -1, -2)


def he(x: Scalar) -> Matrix:
    """Return He[M] = M + M'."""
    return x + _t(x)


def _trace(x: Scalar) -> Matrix:
    return jnp.trace(x, axis1=-2, axis2=-1)


def logdet(x: Scalar) -> Matrix:
    """Return log det of positive definite matrices (..., n, n); NaN for other matrices."""
    return 2 * jnp.sum(jnp.log(jnp.diagonal(jnp.linalg.cholesky(x), axis1=-2, axis2=-1)), -1)
