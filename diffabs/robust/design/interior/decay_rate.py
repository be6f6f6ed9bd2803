"""The fastest decay that a common Lyapunov matrix proves for a gain, differentiable in the gain. Pure JAX.

    minimise s   subject to   S_i = s X - L_i(X) >= 0,  X > 0        L(X) = He[C X],  or C X C' in discrete time

P = X^-1; the rate is -s/2, or -ln(s)/(2 period). The problem is quasiconvex (s X is a product). With W_i = S_i^-1,
the central path is the curve

    sum trace(W_i X) = 1/mu,      sum [s W_i - L_i*(W_i)] + X^-1 = (V + 1) n M/trace(M X)

On it s/mu - sum log det S_i - log det X + (V + 1) n log trace(M X) is stationary. This function does not change with
the size of X; M is the unit matrix in balanced units. As mu goes to zero, so does s - (smallest s).

A step is Newton's for the SDP in which s X0 replaces s X, where X0 is the point before the step. It stays on the slice
<sum W_i, X> = const, where the neglected term of the Hessian vanishes to first order. As in `central_path`, X0 is the
unit matrix of the coordinates of the step.

Source of the method of centres: S. Boyd and L. El Ghaoui (1993).
"""

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from diffabs.core.first_order import first_order
from diffabs.core.types import AnyArray, Array, Int, Matrix, PyTree, Scalar, Vector
from diffabs.linear.lyapunov import as_float_arrays
from diffabs.robust.design.interior.central_path import (
    CENTRING_DECREMENT,
    FINAL_CENTRE_STEPS,
    STEP_LENGTHS,
    directions,
    he,
    logdet,
)

NO_SECOND_DERIVATIVES = (
    "the certified decay has no second derivatives: its multipliers are those of the end of an iteration"
)
MAX_DECAY_STEPS = 300  # steps; the rig with gains over ten decades takes 29 to 160
MAX_STEPS_PER_MU = 25  # steps for one value of mu, without a centre if the optimum is not attained and P degenerates
MU_REDUCTION = 0.1  # factor of mu from one centre to the next
SHIFT_GAP = 1e-8  # relative distance of s from the smallest s at the end
ROUNDING_SHIFT_GAP = 1e-12  # the same relative to the closed loops, for rounding
BALANCING_SWEEPS = 8  # sweeps of balancing over all states


class _DecayPathState(NamedTuple):
    """State of the iteration.

    Fields: steps, steps for this mu, T with T T' = X, s, mu, Newton's decrement, steps at the last centre.
    """

    steps: Scalar
    patience: Int
    T: Matrix
    s: Scalar
    mu: Scalar
    decrement: Scalar
    settled: Scalar


def certified_decay(gain: Matrix, A: Matrix, B: Matrix, period: Scalar | None = None) -> Matrix:
    """Return the largest decay rate [1/s] for which a common P > 0 proves |x| <= c exp(-rate t) at all vertices.

        He[P C_i] + 2 rate P <= 0,   C_i'P C_i <= exp(-2 rate period) P,      C_i = A_i + B_i K

    The first inequality is for continuous time (period None), the second for discrete time. The rate also holds while
    the system varies. It is negative if no common P proves stability. It is below the largest rate by at most 1e-8 of
    itself, up to rounding. This accuracy and the derivative need float64.

    The function works under jit, vmap and both modes of differentiation, to first order only. The derivative uses the
    multipliers W_i of the optimum: sum <W_i, d left side> = 0.

    If the optimum is not unique (two modes equally slow), the derivative is one of the possible ones. A double pole, or
    a deadbeat loop (whose largest rate is infinite), does not attain the optimum. The rate is then one that some P
    proves. It is below the largest, and the derivative is NaN. The rate is NaN for input that is not finite.
    """
    A, B, K = as_float_arrays(A, B, jnp.atleast_2d(jnp.asarray(gain)))
    if A.ndim != 3:
        raise ValueError(f"A has shape {A.shape}; the vertices need (V, n, n)")
    if isinstance(period, float | int) and not 0 < period < math.inf:
        raise ValueError(f"period = {period:g} is outside (0, inf) s")
    shift = _least_shift(period is not None, A + B @ K)
    return -shift / 2 if period is None else -jnp.log(shift) / 2 / period


# The implicit derivative at the optimum, instead of one through some hundred iterations.
@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _least_shift(discrete: bool, closed: Matrix) -> Matrix:
    return _follow_path(discrete, closed)[0]


@_least_shift.defjvp
def _least_shift_jvp(discrete: bool, primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Array, Array]:
    """Return s and ds = sum <W_i, dL_i(X)>/sum <W_i, X>, in the coordinates where X is the unit matrix."""
    s, T, weights = _follow_path(discrete, *primals)
    c, change = (jnp.linalg.inv(T) @ x @ T for x in (primals[0], first_order(tangents[0], NO_SECOND_DERIVATIVES)))
    # dL(I) = dC C' + C dC'; the trace with a symmetric W counts both terms, hence the factor 2 below.
    derivative = change @ jnp.swapaxes(c, 1, 2) if discrete else change
    return s, first_order(
        2 * jnp.sum(weights * derivative) / jnp.sum(jnp.trace(weights, axis1=1, axis2=2)), NO_SECOND_DERIVATIVES
    )


@partial(jax.jit, static_argnums=0)
def _follow_path(discrete: bool, closed: Matrix) -> tuple[PyTree, PyTree, PyTree]:
    """Return s, T with T T' = X, and the multipliers W (V, n, n) at X = I, at the path's end.

    W is NaN if the path did not settle at an optimum; s then still satisfies the inequalities with X.
    """
    vertices, n, _ = closed.shape
    identity = jnp.eye(n, dtype=closed.dtype)
    units = _balancing_units(jnp.mean(jnp.abs(closed), 0))
    T, inverse = jnp.diag(units), 1 / units
    L = _lyapunov_operator(_transform_loops(closed, T), identity, discrete)
    size = _largest_norm(L)
    # The initial s exceeds the largest eigenvalue of all L_i(I), so that every S_i > 0.
    start = _DecayPathState(0, 0, T, jnp.max(jnp.linalg.eigvalsh(L)) + size, size / vertices / n, 0.0 * size, 0)

    def goes_on(path: _DecayPathState) -> Matrix:
        return (path.steps < MAX_DECAY_STEPS) & (path.settled < FINAL_CENTRE_STEPS) & jnp.isfinite(path.decrement)

    def advance(path: _DecayPathState) -> _DecayPathState:
        """Return the state after a step, with the next mu if the step began near the centre."""
        # M is the unit matrix in balanced units; in the coordinates of the point it is T'M T.
        scaled = inverse[:, None] * path.T
        c, m = _transform_loops(closed, path.T), scaled.T @ scaled / jnp.sum(scaled**2)
        T, s, decrement = _step(c, path, m, discrete)
        image = _lyapunov_operator(_transform_loops(closed, T), identity, discrete)
        size = _largest_norm(image - identity if discrete else image)
        # A change ds of s changes the rate times 2 period by ds/s: near s = 0 only small ones leave the rate accurate.
        unit, size = (s * jnp.abs(jnp.log(s)), jnp.minimum(size, s)) if discrete else (jnp.abs(s), size)
        end = jnp.maximum(SHIFT_GAP * unit, ROUNDING_SHIFT_GAP * size) / (vertices + 1) / n
        last = path.mu <= 1.01 * end
        # Without an attained optimum P degenerates and the decrement stays large: after MAX_STEPS_PER_MU steps mu falls
        # anyway.
        ahead = ((decrement < CENTRING_DECREMENT) | (path.patience >= MAX_STEPS_PER_MU)) & ~last
        mu = jnp.where(ahead, jnp.maximum(MU_REDUCTION * path.mu, end), path.mu)
        patience = jnp.where(ahead, 0, path.patience + 1)
        return _DecayPathState(path.steps + 1, patience, T, s, mu, decrement, path.settled + (last & (decrement < 0.1)))

    path = lax.while_loop(goes_on, advance, start)
    slack = path.s * identity - _lyapunov_operator(_transform_loops(closed, path.T), identity, discrete)
    weights = jnp.where(path.settled >= FINAL_CENTRE_STEPS, jnp.linalg.inv(slack), jnp.nan)
    # The first decrement is 0 times the size of the loops: NaN if they are not finite.
    return path.s + start.decrement, path.T, weights


def _step(c: AnyArray, path: _DecayPathState, m: Scalar, discrete: bool) -> tuple[PyTree, PyTree, PyTree]:
    """Return T and s after a step, and the decrement before it, NaN if no step is possible; m = M/trace M."""
    vertices, n, _ = c.shape
    degree = (vertices + 1) * n
    identity, basis, s = jnp.eye(n, dtype=c.dtype), directions(n, 0)[0], path.s
    weights = jnp.linalg.inv(s * identity - _lyapunov_operator(c, identity, discrete))
    change = s * basis[:, None] - _lyapunov_operator(c, basis[:, None], discrete)
    change = jnp.concatenate([change, jnp.broadcast_to(identity, (1, *c.shape))])  # the last unknown is s
    moved, x = weights @ change, jnp.concatenate([basis, jnp.zeros((1, n, n))])
    gradient = -jnp.einsum("avii->a", moved) + jnp.einsum("ij,aij->a", degree * m - identity, x)
    # Left out: the cross term of s X, t <sum W_i, x>, which is 0 on the slice, and the negative curvature of
    # log trace(M X), which could make the Hessian indefinite.
    hessian = jnp.einsum("avij,bvji->ab", moved, moved) + jnp.einsum("aij,bji->ab", x, x)
    step, decrement = _newton_step_in_plane(
        gradient.at[-1].add(1 / path.mu), hessian, jnp.einsum("vij,aji->a", weights, x)
    )
    lengths = jnp.append(jnp.asarray(STEP_LENGTHS), 1 / (1 + decrement))
    x, t = jnp.tensordot(lengths, jnp.tensordot(step[:-1], basis, 1), 0), lengths * step[-1]
    image = _lyapunov_operator(c, (identity + x)[:, None], discrete)
    model = s * (identity + x)[:, None] - image + (t[:, None, None] * identity)[:, None]
    # With s X in place of s X0: finite exactly where the new point satisfies the true inequality.
    admitted = logdet(model + (t[:, None, None] * x)[:, None]).sum(-1)
    values = t / path.mu - logdet(model).sum(-1) - logdet(identity + x) + degree * jnp.log1p(jnp.sum(m * x, (1, 2)))
    values = jnp.where(jnp.isfinite(values + admitted), values, jnp.inf)
    best = jnp.argmin(values)
    possible, point = jnp.isfinite(values[best]), (path.T @ jnp.linalg.cholesky(identity + x[best]), s + t[best])
    # Without a possible length the path ends where it is, at the last point whose inequality holds.
    T, s = (jnp.where(possible, new, old) for new, old in zip(point, (path.T, s), strict=True))
    return T, s, jnp.where(possible, decrement, jnp.nan)


def _newton_step_in_plane(gradient: Matrix, hessian: Matrix, normal: Matrix) -> tuple[PyTree, PyTree]:
    """Return Newton's step in the plane with a normal, and its decrement."""
    unit = 1 / jnp.sqrt(jnp.diagonal(hessian))
    hessian, normal = hessian * unit * unit[:, None], normal * unit
    normal = normal[:, None] / jnp.linalg.norm(normal)
    # KKT system of the equality constraint normal' step = 0.
    whole = jnp.block([[hessian, normal], [normal.T, jnp.zeros((1, 1))]])
    step = jnp.linalg.solve(whole, jnp.append(-gradient * unit, 0.0))[:-1]
    return unit * step, jnp.sqrt(jnp.maximum(step @ hessian @ step, 0.0))


def _lyapunov_operator(c: AnyArray, x: AnyArray, discrete: bool) -> AnyArray:
    return c @ x @ jnp.swapaxes(c, -1, -2) if discrete else he(c @ x)


def _transform_loops(closed: AnyArray, T: Matrix) -> Array:
    return jnp.linalg.inv(T) @ closed @ T


def _largest_norm(matrices: AnyArray) -> Matrix:
    """Return the largest of the vertices' norms; 1 if all are zero."""
    size = jnp.max(jnp.linalg.norm(matrices, axis=(1, 2)))
    return jnp.where(size == 0, 1.0, size)


def _balancing_units(size: Vector) -> Matrix:
    """Return units d (n,), x = d z, that give rows and columns of `size` about equal sums without the diagonal."""
    size = size * (1 - jnp.eye(len(size)))

    def sweep(_: object, d: Array) -> Matrix:
        row, column = size @ d / d, size.T @ (1 / d) * d
        # A state without coupling keeps its unit; the inner where avoids 0/0 for it.
        coupled = (row > 0) & (column > 0)
        return d * jnp.where(coupled, row / jnp.where(coupled, column, 1.0), 1.0) ** 0.25

    return lax.fori_loop(0, BALANCING_SWEEPS, sweep, jnp.ones_like(size[0]))
