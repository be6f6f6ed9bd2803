"""The central path of a quadratic Lyapunov inequality, in pure JAX.

    phi(X, F) = trace(X^-1)/mu - log det X - sum log det S_i

    S_i = s X - He[A_i X + B_i F] - X Q X - F'R F                          continuous time, V = x'X^-1 x, u = F X^-1 x
    S_i = [ (1 + s) X - X Q X - F'R F   . ]
          [ A_i X + B_i F               X ]                                discrete time

With s = 0 these are eqs. (30) and (32) of Maeda and Sugiura after elimination of Z: its minimum costs at most
(V + 2) n mu (discrete time: 2 (V + 1) n mu) more than the least trace X^-1. Where there is no solution yet, a shift
s > 0 makes one. The function is self-concordant, so the step 1/(1 + decrement) is always admitted, and a small
decrement at the end proves, but for rounding, that the point is there (Nesterov and Nemirovskii 1994; Boyd and El
Ghaoui 1993 for the shift, "method of centres").

**Coordinates follow the point.** Each Newton step is made for x = T z, T T' = X, K = F X^-1, where X is the unit matrix
and the gain is in the closed loops. No weight or gain is too far from 1 for it, and no other scaling is needed.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

MAX_PATH_STEPS = 600  # steps; the rig with weights over ten decades takes 30 to 90, at 1 kHz up to 340
CENTRING_DECREMENT = 0.5  # decrement from which on the next centre is aimed at
STEP_LENGTHS = (1.0, 0.5, 0.2, 0.1, 0.03, 0.01, 0.003, 0.001)  # lengths of the step, besides 1/(1 + decrement)
FINAL_CENTRE_STEPS = 3  # steps at the last centre: the decrement is squared in each


class GuaranteedCostProblem(NamedTuple):
    """A (V, n, n), B (V, n, m), Q (n, n), R (m, m)."""

    A: Any
    B: Any
    Q: Any
    R: Any


class PathPoint(NamedTuple):
    """T (n, n) with T T' = X, and K = F X^-1 (m, n)."""

    T: Any
    K: Any


class CentralPathState(NamedTuple):
    """Where the path is: steps made, the point, shift s, mu, Newton's decrement, steps at the last centre, and whether
    there is none."""

    steps: Any
    point: PathPoint
    shift: Any
    mu: Any
    decrement: Any
    settled: Any
    stuck: Any


class LocalProblem(NamedTuple):
    """A problem in the coordinates of a point: closed loops c (V, n, n), b, k, q, r, and w with trace(w) = trace P."""

    c: Any
    b: Any
    k: Any
    q: Any
    r: Any
    w: Any


def start_path(T: Any, K: Any, mu: Any) -> CentralPathState:
    """The path from a point; its shift is set by the first step."""
    zero = jnp.zeros((), T.dtype)
    return CentralPathState(0, PathPoint(T, K), zero - 1, zero + mu, zero, 0, zero > 0)


def follow_path(
    problem: GuaranteedCostProblem, path: CentralPathState, onwards: Callable, *, discrete: bool
) -> CentralPathState:
    """Newton steps until `onwards(path, least shift, trace P)` says that the last centre is reached, or that there is
    none (`stuck`)."""
    here = localise_problem(problem, path.point)
    first = least_shift(here, discrete=discrete)
    rounding = jnp.finfo(first.dtype).eps ** 0.5 * jnp.max(jnp.abs(here.c))  # a Riccati solution has a first of 0
    path = path._replace(shift=jnp.maximum(2 * first, 0.0) + 1e-3 * jnp.abs(first) + rounding)

    def going(path: CentralPathState) -> Any:
        return (
            (path.steps < MAX_PATH_STEPS)
            & (path.settled < FINAL_CENTRE_STEPS)
            & ~path.stuck
            & jnp.isfinite(path.decrement)
        )

    def step(path: CentralPathState) -> CentralPathState:
        point, decrement = _newton(problem, path, discrete=discrete)
        path = path._replace(steps=path.steps + 1, point=point, decrement=decrement)
        here = localise_problem(problem, point)
        after = onwards(path, least_shift(here, discrete=discrete), jnp.trace(here.w))
        return jax.tree.map(lambda new, old: jnp.where(decrement < CENTRING_DECREMENT, new, old), after, path)

    return lax.while_loop(going, step, path)


def localise_problem(problem: GuaranteedCostProblem, point: PathPoint) -> LocalProblem:
    """The problem in a point's coordinates."""
    t, inverse = point.T, jnp.linalg.inv(point.T)
    closed = inverse @ (problem.A + problem.B @ point.K) @ t
    return LocalProblem(closed, inverse @ problem.B, point.K @ t, t.T @ problem.Q @ t, problem.R, inverse @ inverse.T)


def least_shift(here: LocalProblem, *, discrete: bool) -> Any:
    """The least s for which no S_i has a negative eigenvalue, at the point itself."""
    flow = _t(here.c) @ here.c - jnp.eye(len(here.q)) if discrete else he(here.c)
    return jnp.max(jnp.linalg.eigvalsh(flow + here.q + here.k.T @ here.r @ here.k))


def gradient_and_hessian(here: LocalProblem, shift: Any, mu: Any, *, discrete: bool) -> tuple[Any, Any]:
    """Gradient (d,) and Hessian (d, d) of phi in (X, F) at the point itself, in the basis of `directions`."""
    n = len(here.q)
    y, g = directions(n, len(here.k))
    f = here.k @ y + g
    cost = he(here.q @ y + here.k.T @ here.r @ f)
    inverse = jnp.linalg.inv(_slacks(here, jnp.zeros((n, n)), jnp.zeros_like(here.k), shift, discrete=discrete))
    change = _linear_part(here, y, g, discrete=discrete) + _pad_to_block(shift * y - cost, n, discrete)[:, None]
    moved, pushed, total = inverse @ change, here.w @ y, jnp.sum(inverse, 0)[:n, :n]
    gradient = -_trace(pushed) / mu - _trace(y) - jnp.sum(_trace(moved), 1)
    curved = y @ (here.q @ y)[:, None] + _t(f) @ (here.r @ f)[:, None]
    hessian = jnp.einsum("aij,bji->ab", y, y) + 2 / mu * jnp.einsum("aij,bji->ab", pushed, y)
    hessian += jnp.einsum("avij,bvji->ab", moved, moved) + 2 * jnp.einsum("ij,abji->ba", total, curved)
    return gradient, (hessian + hessian.T) / 2


def directions(n: int, m: int) -> tuple[np.ndarray, np.ndarray]:
    """A basis of the changes (Y, G), X = I + Y and F = K + K Y + G: (d, n, n), (d, m, n), d = n(n + 1)/2 + m n."""
    pairs = [(i, j) for i in range(n) for j in range(i + 1)]
    y, g = np.zeros((len(pairs) + m * n, n, n)), np.zeros((len(pairs) + m * n, m, n))
    for d, (i, j) in enumerate(pairs):
        y[d, i, j] = y[d, j, i] = 1.0
    g[len(pairs) :] = np.eye(m * n).reshape(m * n, m, n)
    return y, g


def solve_newton_system(hessian: Any, right: Any) -> Any:
    """H^-1 b, H positive definite and scaled to a unit diagonal."""
    unit = 1 / jnp.sqrt(jnp.diagonal(hessian))
    return unit * jnp.linalg.solve(hessian * unit * unit[:, None], unit * right)


def _newton(problem: GuaranteedCostProblem, path: CentralPathState, *, discrete: bool) -> tuple[PathPoint, Any]:
    """The point after the best of a few lengths of Newton's step, and the decrement before it."""
    here = localise_problem(problem, path.point)
    gradient, hessian = gradient_and_hessian(here, path.shift, path.mu, discrete=discrete)
    step = -solve_newton_system(hessian, gradient)
    decrement = jnp.sqrt(jnp.maximum(-gradient @ step, 0.0))
    y, g = (jnp.tensordot(step, basis, 1) for basis in directions(len(here.q), len(here.k)))
    lengths = jnp.concatenate([1 / (1 + decrement)[None], jnp.asarray(STEP_LENGTHS)])[:, None, None]
    values = _phi(here, lengths * y, lengths * g, path.shift, path.mu, discrete=discrete)
    best = lengths[jnp.argmin(jnp.where(jnp.isfinite(values), values, jnp.inf))]
    x = jnp.eye(len(y)) + best * y
    t, k = path.point
    return PathPoint(t @ jnp.linalg.cholesky(x), k + best * g @ jnp.linalg.inv(t @ x)), decrement


def _phi(here: LocalProblem, y: Any, g: Any, shift: Any, mu: Any, *, discrete: bool) -> Any:
    """phi at changes (Y, G), stacks of them."""
    x = jnp.eye(y.shape[-1]) + y
    inside = logdet(_slacks(here, y, g, shift, discrete=discrete))
    return _trace(jnp.linalg.inv(x) @ here.w) / mu - logdet(x) - jnp.sum(inside, -1)


def _slacks(here: LocalProblem, y: Any, g: Any, shift: Any, *, discrete: bool) -> Any:
    """S_i (..., V, n, n); in discrete time the matrix (2n, 2n) whose Schur complement it is."""
    x = jnp.eye(y.shape[-1]) + y
    f = here.k @ x + g
    rest = shift * x - x @ here.q @ x - _t(f) @ here.r @ f
    return _linear_part(here, x, g, discrete=discrete) + _pad_to_block(rest, y.shape[-1], discrete)[..., None, :, :]


def _linear_part(here: LocalProblem, x: Any, g: Any, *, discrete: bool) -> Any:
    """What is linear in (X, G): -He[c X + b G], or [[X, .], [c X + b G, X]]."""
    x = x[..., None, :, :]
    flow = here.c @ x + here.b @ g[..., None, :, :]
    if not discrete:
        return -he(flow)
    x = jnp.broadcast_to(x, flow.shape)
    return jnp.concatenate([jnp.concatenate([x, _t(flow)], -1), jnp.concatenate([flow, x], -1)], -2)


def _pad_to_block(x: Any, n: int, discrete: bool) -> Any:
    """x in the first rows and columns of a block."""
    return jnp.pad(x, [(0, 0)] * (x.ndim - 2) + [(0, n)] * 2) if discrete else x


def _t(x: Any) -> Any:
    return jnp.swapaxes(x, -1, -2)


def he(x: Any) -> Any:
    """He[M] = M + M'."""
    return x + _t(x)


def _trace(x: Any) -> Any:
    return jnp.trace(x, axis1=-2, axis2=-1)


def logdet(x: Any) -> Any:
    """log det, of positive definite matrices; NaN for others."""
    return 2 * jnp.sum(jnp.log(jnp.diagonal(jnp.linalg.cholesky(x), axis1=-2, axis2=-1)), -1)
