"""The fastest decay that a common Lyapunov matrix proves for a gain, differentiable in the gain. Pure JAX.

    minimise s   subject to   S_i = s X - L_i(X) >= 0,  X > 0        L(X) = He[C X],  or C X C' - X in discrete time

P = X^-1; the rate is -s/2, or -ln(1 + s)/(2 period). The problem is quasiconvex (s X is a product), and the central
path is the curve on which, with W_i = S_i^-1,

    sum trace(W_i X) = 1/mu,      sum [s W_i - L_i*(W_i)] + X^-1 = (V + 1) n M/trace(M X),

stationary in s/mu - sum log det S_i - log det X + (V + 1) n log trace(M X), which does not change with the size of X; M
is the unit matrix in balanced units. With mu, s - (least s) goes to zero. A step is Newton's for the SDP in which s X
is replaced by s X0, X0 the point before it, on the slice <sum W_i, X> = const, where the term left out of the Hessian
vanishes to first order. As in `centre`, X0 is the unit matrix of the coordinates in which a step is made. Source of the
method of centres: S. Boyd and L. El Ghaoui (1993).
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from diffabs.core.first_order import first_order
from diffabs.design.interior.central_path import (
    CENTRING_DECREMENT,
    FINAL_CENTRE_STEPS,
    STEP_LENGTHS,
    directions,
    he,
    logdet,
)
from diffabs.linear.lyapunov import as_float_arrays

NO_SECOND_DERIVATIVES = (
    "the certified decay has no second derivatives: its multipliers are those of the end of an iteration"
)
MAX_DECAY_STEPS = 300  # steps; the rig with gains over ten decades takes 29 to 160
MAX_STEPS_PER_MU = 25  # steps for one value of mu: where no optimum is attained, P degenerates and there is no centre
MU_REDUCTION = 0.1  # mu, from one centre to the next
SHIFT_GAP = 1e-8  # relative: s - (least s) at the end
ROUNDING_SHIFT_GAP = 1e-12  # the same relative to the closed loops: rounding
BALANCING_SWEEPS = 8  # of balancing


class _DecayPathState(NamedTuple):
    """Steps made, steps for this mu, T with T T' = X, s, mu, Newton's decrement, steps at the last centre."""

    steps: Any
    patience: Any
    T: Any
    s: Any
    mu: Any
    decrement: Any
    settled: Any


def certified_decay(gain: Any, A: Any, B: Any, period: Any = None) -> Any:
    """The largest decay rate [1/s] for which a common P > 0 proves |x| <= c exp(-rate t) at all vertices A (V, n, n),
    B (V, n, m) under u = K x, K = `gain` (m, n) or (n,), also while the system varies; `period` [s] in discrete time.

        He[P C_i] + 2 rate P <= 0,   C_i'P C_i <= exp(-2 rate period) P,      C_i = A_i + B_i K

    Negative where no common P proves stability. Below the largest by 1e-8 of itself at most, but for rounding. Works
    under jit, vmap and both modes of differentiation. The derivative is that of the multipliers W_i of the optimum,
    sum <W_i, d left side> = 0: first order only. Where the optimum is not unique (two modes equally slow) it is one of
    the possible ones. Where it is not attained (a double pole, no feedback at all) the rate is one that some P proves,
    smaller than the largest, and the derivative is large. NaN for input that is not finite.
    """
    A, B, K = as_float_arrays(A, B, jnp.atleast_2d(jnp.asarray(gain)))
    shift = _least_shift(period is not None, A + B @ K)
    return -shift / 2 if period is None else -jnp.log1p(shift) / 2 / period


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _least_shift(discrete: bool, closed: Any) -> Any:
    """The least s."""
    return _follow_path(discrete, closed)[0]


@_least_shift.defjvp
def _least_shift_jvp(discrete: bool, primals: Any, tangents: Any) -> Any:
    """ds = sum <W_i, dL_i(X)>/sum <W_i, X>, where X is the unit matrix."""
    s, T, weights = _follow_path(discrete, *primals)
    c, change = (jnp.linalg.inv(T) @ x @ T for x in (primals[0], first_order(tangents[0], NO_SECOND_DERIVATIVES)))
    left = change @ jnp.swapaxes(c, 1, 2) if discrete else change
    return s, first_order(
        2 * jnp.sum(weights * left) / jnp.sum(jnp.trace(weights, axis1=1, axis2=2)), NO_SECOND_DERIVATIVES
    )


@partial(jax.jit, static_argnums=0)
def _follow_path(discrete: bool, closed: Any) -> tuple[Any, Any, Any]:
    """s, T with T T' = X, and the multipliers W (V, n, n) where X is the unit matrix, at the end of the path."""
    vertices, n, _ = closed.shape
    one = jnp.eye(n, dtype=closed.dtype)
    units = _balancing_units(jnp.mean(jnp.abs(closed), 0))
    T, inverse = jnp.diag(units), 1 / units
    L = _lyapunov_operator(_transform_loops(closed, T), one, discrete)
    size = _largest_norm(L)
    start = _DecayPathState(0, 0, T, jnp.max(jnp.linalg.eigvalsh(L)) + size, size / vertices / n, 0.0 * size, 0)

    def going(path: _DecayPathState) -> Any:
        return (path.steps < MAX_DECAY_STEPS) & (path.settled < FINAL_CENTRE_STEPS) & jnp.isfinite(path.decrement)

    path = lax.while_loop(going, lambda path: _advance_path(closed, path, inverse, discrete), start)
    slack = path.s * one - _lyapunov_operator(_transform_loops(closed, path.T), one, discrete)
    return jnp.where(jnp.isfinite(path.decrement), path.s, jnp.nan), path.T, jnp.linalg.inv(slack)


def _advance_path(closed: Any, path: _DecayPathState, inverse: Any, discrete: bool) -> _DecayPathState:
    """A step, and the next mu if it ended near the centre; `inverse` has 1/unit of each state."""
    size = inverse[:, None] * path.T
    T, s, decrement = _step(_transform_loops(closed, path.T), path, size.T @ size / jnp.sum(size**2), discrete)
    vertices, n, _ = closed.shape
    size = _largest_norm(_lyapunov_operator(_transform_loops(closed, T), jnp.eye(n), discrete))
    end = jnp.maximum(SHIFT_GAP * jnp.abs(s), ROUNDING_SHIFT_GAP * size) / (vertices + 1) / n
    last = path.mu <= 1.01 * end
    ahead = ((decrement < CENTRING_DECREMENT) | (path.patience >= MAX_STEPS_PER_MU)) & ~last
    mu = jnp.where(ahead, jnp.maximum(MU_REDUCTION * path.mu, end), path.mu)
    patience = jnp.where(ahead, 0, path.patience + 1)
    return _DecayPathState(path.steps + 1, patience, T, s, mu, decrement, path.settled + (last & (decrement < 0.1)))


def _step(c: Any, path: _DecayPathState, m: Any, discrete: bool) -> tuple[Any, Any, Any]:
    """T and s after a step, and the decrement before it: c, and m = M/trace M, are seen from the point."""
    vertices, n, _ = c.shape
    degree = (vertices + 1) * n
    one, basis, s = jnp.eye(n, dtype=c.dtype), directions(n, 0)[0], path.s
    weights = jnp.linalg.inv(s * one - _lyapunov_operator(c, one, discrete))
    change = s * basis[:, None] - _lyapunov_operator(c, basis[:, None], discrete)
    change = jnp.concatenate([change, jnp.broadcast_to(one, (1, *c.shape))])  # the last unknown is s
    moved, x = weights @ change, jnp.concatenate([basis, jnp.zeros((1, n, n))])
    gradient = -jnp.einsum("avii->a", moved) + jnp.einsum("ij,aij->a", degree * m - one, x)
    hessian = jnp.einsum("avij,bvji->ab", moved, moved) + jnp.einsum("aij,bji->ab", x, x)
    step, decrement = _newton_step_in_plane(
        gradient.at[-1].add(1 / path.mu), hessian, jnp.einsum("vij,aji->a", weights, x)
    )
    lengths = jnp.append(jnp.asarray(STEP_LENGTHS), 1 / (1 + decrement))
    x, t = jnp.tensordot(lengths, jnp.tensordot(step[:-1], basis, 1), 0), lengths * step[-1]
    left = _lyapunov_operator(c, (one + x)[:, None], discrete)
    model = s * (one + x)[:, None] - left + (t[:, None, None] * one)[:, None]
    admitted = logdet(model + (t[:, None, None] * x)[:, None]).sum(-1)  # s X, not s X0: finite where positive definite
    values = t / path.mu - logdet(model).sum(-1) - logdet(one + x) + degree * jnp.log1p(jnp.sum(m * x, (1, 2)))
    best = jnp.argmin(jnp.where(jnp.isfinite(values + admitted), values, jnp.inf))
    return path.T @ jnp.linalg.cholesky(one + x[best]), s + t[best], decrement


def _newton_step_in_plane(gradient: Any, hessian: Any, normal: Any) -> tuple[Any, Any]:
    """Newton's step in the plane with a normal, and its decrement."""
    unit = 1 / jnp.sqrt(jnp.diagonal(hessian))
    hessian, normal = hessian * unit * unit[:, None], normal * unit
    normal = normal[:, None] / jnp.linalg.norm(normal)
    whole = jnp.block([[hessian, normal], [normal.T, jnp.zeros((1, 1))]])
    step = jnp.linalg.solve(whole, jnp.append(-gradient * unit, 0.0))[:-1]
    return unit * step, jnp.sqrt(jnp.maximum(step @ hessian @ step, 0.0))


def _lyapunov_operator(c: Any, x: Any, discrete: bool) -> Any:
    """L(X), and stacks of it."""
    return c @ x @ jnp.swapaxes(c, -1, -2) - x if discrete else he(c @ x)


def _transform_loops(closed: Any, T: Any) -> Any:
    return jnp.linalg.inv(T) @ closed @ T


def _largest_norm(left: Any) -> Any:
    """The largest of the vertices' norms; 1 if all are zero."""
    size = jnp.max(jnp.linalg.norm(left, axis=(1, 2)))
    return jnp.where(size == 0, 1.0, size)


def _balancing_units(size: Any) -> Any:
    """Units d (n,), x = d z, for which rows and columns of `size` have about equal sums, the diagonal left out."""
    size = size * (1 - jnp.eye(len(size)))

    def sweep(_: Any, d: Any) -> Any:
        row, column = size @ d / d, size.T @ (1 / d) * d
        fine = (row > 0) & (column > 0)
        return d * jnp.where(fine, row / jnp.where(fine, column, 1.0), 1.0) ** 0.25

    return lax.fori_loop(0, BALANCING_SWEEPS, sweep, jnp.ones_like(size[0]))
