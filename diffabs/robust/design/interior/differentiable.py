"""Derivatives through a robust design, for tuning by gradients, inside compiled code.

    robust_gain     the gain of `synthesis` with the smallest guaranteed cost, differentiable in the weights
    robust_design   the same from matrices, with P, differentiable in the vertices too

`decay_rate.certified_decay` has the derivative of a robustness proof. All three are pure JAX. They follow the central
path of `central_path` and end with Newton's method. They can be compiled and batched, and the implicit function theorem
gives their derivatives instead of the iterations. The results are floating point and not proved; `design` and `certify`
prove them.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.types import AnyArray, Array, Matrix, PyTree, Scalar
from diffabs.linear.lyapunov import as_float_arrays
from diffabs.linear.riccati import care, dare
from diffabs.robust.design.interior import central_path
from diffabs.robust.design.interior.central_path import CentralPathState, GuaranteedCostProblem, PathPoint
from diffabs.robust.design.polytopes import Polytope

# Relative mu at the end: the cost exceeds its optimum by at most (V + 2) n mu, in discrete time by 2 (V + 1) n mu.
FINAL_MU = 1e-8
CENTRE_REDUCTION = 0.1  # factor of mu, and of the distance of the shift from the smallest, from one centre to the next
# Relative distance: a shift this close to a positive smallest shift means that no solution exists.
SHIFT_TOLERANCE = 1e-8


class RobustFeedback(NamedTuple):
    """Gain K (m, n) of u = K x, and its P (n, n).

    x'P x is the guaranteed cost from x, and trace P is the cost of `design`.
    """

    gain: AnyArray
    P: AnyArray


def robust_gain(system: Polytope, Q: AnyArray, R: AnyArray) -> AnyArray:
    """Return the gain (m, n) with the smallest guaranteed cost, NaN if there is none: see `robust_design`."""
    return robust_design(system.A, system.B, Q, R, discrete=system.period is not None).gain


def robust_design(A: AnyArray, B: AnyArray, Q: AnyArray, R: AnyArray, *, discrete: bool = False) -> RobustFeedback:
    """Return the gain that minimises trace P over the vertices, and P: eqs. (29)-(32) of Maeda and Sugiura.

    The function works under jit, vmap and both modes of differentiation, in all arguments. Only the symmetric parts of
    Q and R count. The vertices are A (V, n, n) and B (V, n, m).

    The result is the point of the central path at FINAL_MU. Its cost exceeds the optimum by less than a millionth, and
    it satisfies the inequalities strictly. Errors of the derivative, measured on the rig as d ln K/d ln weight, are
    1e-5 at the published weights. Over eight decades they are below 1e-4 for nine weights of ten. The worst error is
    5e-4, where input is expensive and the cost hardly depends on K1.

    The optimal gain has a kink where an inequality becomes active or inactive (strict complementarity fails). There is
    no derivative there: the function returns that of the central path, which rounds off the kink.

    The result is NaN without a solution (no stabilising Riccati solution of a vertex, no common P) or with invalid
    input: Q does not see every mode, R is not positive definite, or an entry is not finite.
    """
    A, B, Q, R = as_float_arrays(A, B, Q, R)
    n, m = B.shape[-2:]
    if A.shape != (len(B), n, n) or Q.shape != (n, n) or R.shape != (m, m):
        raise ValueError(f"A, Q, R have shapes {A.shape}, {Q.shape}, {R.shape}; B has {B.shape}")
    gain, P, _ = _solve_central_path(discrete, GuaranteedCostProblem(A, B, (Q + Q.T) / 2, (R + R.T) / 2))
    return RobustFeedback(gain, P)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
@partial(jax.jit, static_argnums=0)
def _solve_central_path(discrete: bool, problem: GuaranteedCostProblem) -> tuple[PyTree, PyTree, PyTree]:
    """Return K, P and mu of the last centre; NaN if the path does not reach it."""
    path = central_path.follow_path(
        problem, _start_from_riccati(problem, discrete), _advance_parameters, discrete=discrete
    )
    solved = (path.settled >= central_path.FINAL_CENTRE_STEPS) & (path.shift == 0)
    inverse = jnp.linalg.inv(path.point.T)
    K, P, mu = (jnp.where(solved, x, jnp.nan) for x in (path.point.K, inverse.T @ inverse, path.mu))
    return K, P, mu


@_solve_central_path.defjvp
def _solve_central_path_jvp(
    discrete: bool, primals: tuple[Array, ...], tangents: tuple[Array, ...]
) -> tuple[tuple[Array, Array, Array], tuple[Array, Array, Array]]:
    """Return the implicit derivative: H dx + d(gradient of phi at constant x) = 0, in the coordinates of the point."""
    (problem,), (change,) = primals, tangents
    K, P, mu = _solve_central_path(discrete, problem)
    # T from P: the primal's own T is no output, and any T with T T' = P^-1 gives the same derivative.
    T = jnp.linalg.inv(jnp.linalg.cholesky(P).T)

    def gradient(problem: GuaranteedCostProblem) -> tuple[Array, Array]:
        return central_path.gradient_and_hessian(
            central_path.localise_problem(problem, PathPoint(T, K)), 0.0, mu, discrete=discrete
        )

    # One jvp gives both: the Hessian as a primal, and the change of the gradient at constant (X, F) as a tangent.
    (_, hessian), (by_problem, _) = jax.jvp(gradient, (problem,), (change,))
    step = -central_path.solve_newton_system(hessian, by_problem)
    y, g = (jnp.tensordot(step, basis, 1) for basis in central_path.directions(len(P), len(K)))
    inverse = jnp.linalg.inv(T)
    return (K, P, mu), (g @ inverse, -inverse.T @ y @ inverse, jnp.zeros_like(mu))


def _start_from_riccati(problem: GuaranteedCostProblem, discrete: bool) -> CentralPathState:
    """Return the Riccati solution of the vertex with the smallest shift; NaN if one vertex has no solution."""
    A, B, Q, R = problem

    def alone(a: Matrix, b: Matrix) -> tuple[PyTree, PathPoint, PyTree]:
        """Return the shift, the point and trace P of one vertex's Riccati solution."""
        P = (dare if discrete else care)(a, b, Q, R).P
        K = -jnp.linalg.solve(R + b.T @ P @ b, b.T @ P @ a) if discrete else -jnp.linalg.solve(R, b.T @ P)
        point = PathPoint(jnp.linalg.inv(jnp.linalg.cholesky(P).T), K)
        return (
            central_path.least_shift(central_path.localise_problem(problem, point), discrete=discrete),
            point,
            jnp.trace(P),
        )

    shift, points, traces = jax.vmap(alone)(A, B)
    best = jnp.argmin(shift)
    # `0 * sum(shift)` is NaN if any vertex has no solution, and makes the whole path NaN.
    return central_path.start_path(points.T[best], points.K[best], traces[best] + 0 * jnp.sum(shift))


def _advance_parameters(path: CentralPathState, smallest: Scalar, cost: Scalar) -> CentralPathState:
    """Return the state with the next shift, or with the next mu once the shift is zero."""
    feasible, last = path.shift == 0, path.mu <= 1.01 * FINAL_MU * cost
    return path._replace(
        # As soon as the smallest shift is negative, the point is feasible without a shift.
        shift=jnp.where(smallest < 0, 0.0, smallest + CENTRE_REDUCTION * (path.shift - smallest)),
        mu=jnp.where(feasible & ~last, jnp.maximum(CENTRE_REDUCTION * path.mu, FINAL_MU * cost), path.mu),
        settled=path.settled + (feasible & last & (path.decrement < 0.1)),
        stuck=(smallest > 0) & (path.shift - smallest < SHIFT_TOLERANCE * smallest),
    )
