"""Derivatives through a robust design, and through a robustness proof: for tuning by gradients, inside compiled code.

    robust_gain       the gain of `synthesis` with the least guaranteed cost, differentiable in the weights
    robust_design     the same from matrices, with P, differentiable in the vertices too
    certified_decay   the fastest decay that a common P proves for a gain, differentiable in the gain

All are pure JAX: they follow the central path of `centre` and end with Newton's method, so that they are compiled,
batched, and differentiated by the implicit function theorem instead of through their iterations. What they return is
floating point and not proved; `design` and `certify` prove it.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.design.interior import central_path
from diffabs.design.interior.central_path import CentralPathState, GuaranteedCostProblem, PathPoint
from diffabs.design.interior.decay_rate import certified_decay as certified_decay
from diffabs.design.polytopes import Polytope
from diffabs.linear.lyapunov import as_float_arrays
from diffabs.linear.riccati import care, dare

FINAL_MU = 1e-8  # relative: the cost is at most (V + 2) n MU, in discrete time 2 (V + 1) n MU, above its optimum
CENTRE_REDUCTION = 0.1  # mu, and a shift's distance from the least, from one centre to the next
SHIFT_TOLERANCE = 1e-8  # relative: a shift this close to the least, and positive, will not go to zero


class RobustFeedback(NamedTuple):
    """Gain K (m, n), u = K x, and P (n, n): x'P x is the cost that is guaranteed from x, its trace that of `design`."""

    gain: Any
    P: Any


def robust_gain(system: Polytope, Q: Any, R: Any) -> Any:
    """The gain (m, n) with the least guaranteed cost over a polytope, for weights Q (n, n) and R (m, m), R > 0. NaN
    where there is none; see `robust_design`."""
    return robust_design(system.A, system.B, Q, R, discrete=system.period is not None).gain


def robust_design(A: Any, B: Any, Q: Any, R: Any, *, discrete: bool = False) -> RobustFeedback:
    """The gain that minimises trace P over the vertices A (V, n, n), B (V, n, m): eqs. (29)-(32) of Maeda and Sugiura.

    Works under jit, vmap and both modes of differentiation, in all arguments. Everything is of the point of the central
    path at MU, whose cost is above the optimum by less than a millionth, and that satisfies the inequalities strictly.
    Errors, measured on the rig as d ln K/d ln weight: 1e-5 at the published weights; over eight decades below 1e-4 for
    nine weights of ten and 5e-4 for the worst, where input is dear and the cost hardly depends on K1. Where the optimal
    gain has a kink (an inequality becomes active or ceases to be: strict complementarity fails), there is no
    derivative, and what is returned is that of the central path, which rounds the kink off. Of Q and R the symmetric
    part counts.

    NaN without a solution: a vertex without a stabilising Riccati solution, no gain with a common P, Q that does not
    see every mode, R that is not positive definite, input that is not finite.

    Raises:
        ValueError: shapes that do not fit.
    """
    A, B, Q, R = as_float_arrays(A, B, Q, R)
    n, m = B.shape[-2:]
    if A.shape != (len(B), n, n) or Q.shape != (n, n) or R.shape != (m, m):
        raise ValueError(f"A, Q, R have shapes {A.shape}, {Q.shape}, {R.shape}; B has {B.shape}")
    gain, P, _ = _solve_central_path(discrete, GuaranteedCostProblem(A, B, (Q + Q.T) / 2, (R + R.T) / 2))
    return RobustFeedback(gain, P)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
@partial(jax.jit, static_argnums=0)
def _solve_central_path(discrete: bool, problem: GuaranteedCostProblem) -> tuple[Any, Any, Any]:
    """K, P, mu of the last centre; NaN where it was not reached."""
    path = central_path.follow_path(
        problem, _start_from_riccati(problem, discrete), _advance_parameters, discrete=discrete
    )
    fine = (path.settled >= central_path.FINAL_CENTRE_STEPS) & (path.shift == 0)
    inverse = jnp.linalg.inv(path.point.T)
    K, P, mu = (jnp.where(fine, x, jnp.nan) for x in (path.point.K, inverse.T @ inverse, path.mu))
    return K, P, mu


@_solve_central_path.defjvp
def _solve_central_path_jvp(discrete: bool, primals: Any, tangents: Any) -> Any:
    """H dx + d(gradient of phi at constant x) = 0, in the coordinates of the point."""
    (problem,), (change,) = primals, tangents
    K, P, mu = _solve_central_path(discrete, problem)
    T = jnp.linalg.inv(jnp.linalg.cholesky(P).T)

    def gradient(problem: GuaranteedCostProblem) -> Any:
        return central_path.gradient_and_hessian(
            central_path.localise_problem(problem, PathPoint(T, K)), 0.0, mu, discrete=discrete
        )

    (_, hessian), (by_problem, _) = jax.jvp(gradient, (problem,), (change,))
    step = -central_path.solve_newton_system(hessian, by_problem)
    y, g = (jnp.tensordot(step, basis, 1) for basis in central_path.directions(len(P), len(K)))
    inverse = jnp.linalg.inv(T)
    return (K, P, mu), (g @ inverse, -inverse.T @ y @ inverse, jnp.zeros_like(mu))


def _start_from_riccati(problem: GuaranteedCostProblem, discrete: bool) -> CentralPathState:
    """The path from the Riccati solution of the vertex whose P and gain come nearest to serving all; NaN if one vertex
    has no solution."""
    A, B, Q, R = problem

    def alone(a: Any, b: Any) -> tuple[Any, PathPoint, Any]:
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
    return central_path.start_path(points.T[best], points.K[best], traces[best] + 0 * jnp.sum(shift))


def _advance_parameters(path: CentralPathState, least: Any, cost: Any) -> CentralPathState:
    """First the shift goes to zero, then mu to its last value."""
    found, last = path.shift == 0, path.mu <= 1.01 * FINAL_MU * cost
    return path._replace(
        shift=jnp.where(least < 0, 0.0, least + CENTRE_REDUCTION * (path.shift - least)),
        mu=jnp.where(found & ~last, jnp.maximum(CENTRE_REDUCTION * path.mu, FINAL_MU * cost), path.mu),
        settled=path.settled + (found & last & (path.decrement < 0.1)),
        stuck=(least > 0) & (path.shift - least < SHIFT_TOLERANCE * least),
    )
