"""Robust state feedback by linear matrix inequalities.

    u = K x,  K = F X^-1,  V = x'X^-1 x,  one X and F for all vertices (or for each node of a schedule)

    [ -He[A X + B F]  X Qh'  F' Rh' ]
    [  Qh X           I      0      ] >= 0 at every vertex (A, B),   [ Z  I ] >= 0,   minimise trace Z
    [  Rh F           0      I      ]                                [ I  X ]

with Q = Qh'Qh and R = Rh'Rh.

Trace Z is the cost summed over starts at the unit vectors. It is guaranteed for every system of the polytope, also
while the system varies. Decay, damping, L2 gain and input limits join it with the same X and F
(`design.sdp.program`).

Source: Maeda and Sugiura, eqs. (29)-(32). Here a vertex is a pair (A, B) of the same parameters. Their eq. (31) pairs A
of one speed with B of another in two blocks of four, which leaves two systems uncovered.
"""

import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np

from diffabs.core.jax_flags import default_flags
from diffabs.robust.design.analysis import certify
from diffabs.robust.design.polytopes import Polytope, Schedule
from diffabs.robust.design.proof.certificate import Certificate
from diffabs.robust.design.proof.exact import he
from diffabs.robust.design.sdp import solver as lmi
from diffabs.robust.design.sdp.program import DesignProgram
from diffabs.robust.design.sdp.scaling import Frame, design_frames
from diffabs.robust.design.spec import Spec

GAP = 1e-6  # relative: how far a cost may be below its lower bound; ten times this above the optimum
ROUGH_GAP = 1e-4  # the same for a schedule, an L2 gain, and discrete time, where a short period costs digits
FRAMES_PER_SOLVER = 3  # frames to try for each solver
# Levels of the invariant set for an input limit, relative to the smallest possible level.
INPUT_LIMIT_LEVELS = np.geomspace(1.0, 1e4, 25)
# Kind of the claim that proves a field of the specification.
CLAIM_OF_SPECIFICATION = {"Q": "cost", "decay": "decay", "damping": "damping", "l2": "l2", "input": "input"}


class DesignError(RuntimeError):
    """No gain passes its checks; the message has the numbers."""


@dataclasses.dataclass(frozen=True, eq=False)
class Design:
    """A gain and its proof.

    Attributes:
        gain: Gain K of u = K x, shape (m, n), or (N + 1, m, n) at the nodes of a schedule of N cells.
        certificate: Proof of the specifications.
        trace_cost: Trace Z in floats: the least bound of the cost for which one P proves all specifications. The
            certificate proves the cost with a P of its own, so its `guaranteed_cost` may be lower. For a schedule, the
            mean over the nodes. None without Q, R.
        lower_bound: Largest trace of the vertices' own Riccati solutions, which no common gain can beat. None without
            Q, R, and for a schedule.
        gap: Bound [1] on (objective - optimum)/objective. The objective is `trace_cost`, or without Q, R the objective
            of `design` for an L2 gain. It says nothing about the `guaranteed_cost` of other gains.
        residual: Largest eigenvalue over the vertices of He[P(A + BK)] + K'RK + Q, relative to that of Q + K'RK. Both
            are taken in coordinates with P = I. At the active vertices it is 0 up to rounding. None where `lower_bound`
            is.
    """

    gain: np.ndarray
    certificate: Certificate
    trace_cost: float | None
    lower_bound: float | None
    gap: float
    residual: float | None


@default_flags()
def design(system: Polytope | Schedule, spec: Spec) -> Design:
    """Return the gain that minimises the bound of the cost (with Q, R), or else the L2 gain, under all specifications.

    For an L2 gain the objective is its square plus 1e-4 trace Z, in units in which both are near 1. Without trace Z the
    infimum often needs infinite feedback. A gain with a slightly lower L2 gain, and a larger trace Z, may thus exist.

    One matrix P proves the bound and all specifications. With more specifications than the cost, another gain may thus
    have a lower cost that is proved with a P for the cost alone.

    Exactly one objective is needed: Q and R, or an `L2Gain` without a bound. An `L2Gain` beside Q and R needs a bound.
    A schedule needs Q, R and `rates` in continuous time, and accepts no other specification but a decay.

    Every answer is checked: exact proof of every specification (`certify`), duality gap, lower bound. After a failed
    check the search tries other coordinates, then other solvers.

    Args:
        system: A polytope, or a schedule along a measured parameter.
        spec: Weights, decay, damping, input limit and L2 gain that hold everywhere in the system.

    Raises:
        ValueError: A specification that does not fit, none or two objectives, damping in discrete time, or a vertex
            that is not stabilisable.
        DesignError: No gain passes the checks; the message has the reason for each attempt.
        ModuleNotFoundError: cvxpy or a solver is missing.

    See also:
        `design.polytope`: The linear models of a box of parameters.
        `design.certify`: Proofs about a given gain.
        `linear.lqr`: The gain for a single model, without a proof.
        `prove_box`: Bounds of the nonlinear loop with its limits.

    Notes:
        With u = K x, K = F X^-1 and V = x' X^-1 x the gain minimises trace Z over X, F and Z under

            [ -He[A X + B F]  X Qh'  F' Rh' ]
            [  Qh X           I      0      ] >= 0 at every vertex (A, B),   [ Z  I ] >= 0
            [  Rh F           0      I      ]                                [ I  X ]

        where He[M] = M + M', Q = Qh' Qh, R = Rh' Rh. Trace Z bounds the sum of the costs from the unit vectors, for
        every system of the polytope, also while it varies. Sources: Maeda and Sugiura, eqs. (29)-(32); S. Boyd, L. El
        Ghaoui, E. Feron and V. Balakrishnan, Linear Matrix Inequalities in System and Control Theory, SIAM, 1994.

    Examples:
        One gain for a damping of 1 to 2 that decays at least as exp(-0.5 t):

        >>> from diffabs.robust.design import Polytope, Spec, design
        >>> box = Polytope(A=[[[0.0, 1.0], [0.0, -1.0]], [[0.0, 1.0], [0.0, -2.0]]], B=[[[0.0], [1.0]]] * 2)
        >>> robust = design(box, Spec(Q=(1.0, 1.0), R=1.0, decay=0.5))
        >>> robust.certificate.verified_exactly, robust.certificate.decay_rate > 0.5
        (True, True)
    """
    whole = pool_vertices(system)
    spec = _check_specification(system, whole, spec)
    attempts: list[str] = []
    for solver in lmi.solvers():
        for frame, bound in itertools.islice(_frames(whole, spec), FRAMES_PER_SOLVER):
            # The cost of a schedule is a mean over its nodes, which the largest Riccati trace does not bound.
            lower = bound if spec.Q is not None and isinstance(system, Polytope) else None
            candidate, trouble = _attempt(system, whole, spec, frame, solver, lower)
            attempts.append(f"{solver}: {trouble or 'passed'}")
            if candidate is not None and not trouble:
                return candidate
    raise DesignError("no gain passes its checks. " + "; ".join(dict.fromkeys(attempts)))


def pool_vertices(system: Polytope | Schedule) -> Polytope:
    """Return all vertices of a schedule as one polytope; a polytope is returned unchanged."""
    if isinstance(system, Polytope):
        return system
    a, b = (np.concatenate([getattr(cell, name) for cell in system.cells]) for name in "AB")
    labelled = all(cell.corners for cell in system.cells)
    corners = tuple(itertools.chain.from_iterable(cell.corners for cell in system.cells)) if labelled else ()
    return Polytope(A=a, B=b, period=system.cells[0].period, states=system.cells[0].states, corners=corners)


def _check_specification(system: Polytope | Schedule, whole: Polytope, spec: Spec) -> Spec:
    spec = spec.check(whole.order, whole.inputs, whole.period, scheduled=isinstance(system, Schedule))
    if spec.Q is None and (spec.l2 is None or spec.l2.bound is not None):
        raise ValueError("nothing to minimise: give the weights Q and R, or an L2 gain without a bound")
    if spec.Q is not None and spec.l2 is not None and spec.l2.bound is None:
        raise ValueError("two things to minimise: with Q and R, the L2 gain needs a bound")
    return spec


def _frames(whole: Polytope, spec: Spec) -> Iterator[tuple[Frame, float]]:
    if spec.Q is not None:
        yield from design_frames(whole, spec.Q, spec.R)
    elif spec.l2 is not None:
        c, d = spec.l2.output, spec.l2.feedthrough
        effort = d.T @ d
        # Without feedthrough the output gives no weight on the input; the frame's Riccati equation then takes R = I.
        definite = np.linalg.eigvalsh(effort)[0] > 1e-12 * np.trace(effort)
        weight = c.T @ c + 1e-8 * np.trace(c.T @ c) * np.eye(whole.order)
        yield from design_frames(whole, weight, effort if definite else np.eye(whole.inputs))


def _attempt(
    system: Polytope | Schedule, whole: Polytope, spec: Spec, frame: Frame, solver: str, lower: float | None
) -> tuple[Design | None, str]:
    """Return a design by one solver in one frame, and the reason for its rejection (empty if there is no reason)."""
    program = DesignProgram(system, whole, spec, frame)
    c, best, status = program.objective(), None, "no answer"
    # The input limit is no LMI in X, F and the level together: the level is fixed, and the best of a grid is taken.
    for level in INPUT_LIMIT_LEVELS * program.least_level() if spec.input else (1.0,):
        blocks = program.blocks(level)
        answer = lmi.solve_sdp(c, blocks, solver)
        status = answer.status
        # The status of a solver is no criterion: the violation and the gap are computed from its numbers.
        if np.isfinite(answer.y).all() and answer.violation(blocks) < 1e-6:
            value = float(c @ answer.y)
            if best is None or value < best[0]:
                best = value, answer.y, answer.gap(c, blocks) / abs(value)
    if best is None:
        return None, f"the solver says {status}"
    value, y, gap = best
    try:
        gains, forms = program.read(y)
        residual = _residual(whole, gains[0], forms[0], spec) if lower is not None else None
    except np.linalg.LinAlgError:
        return None, f"the solver says {status}, with a singular X"
    gain = gains[0] if isinstance(system, Polytope) else gains
    proof = certify(gain, system, spec, fastest=False)
    cost = None if spec.Q is None else value * program.scale
    candidate = Design(gain, proof, cost, lower, gap, residual)
    return candidate, _rejection_reason(candidate, spec, isinstance(system, Schedule))


def _residual(system: Polytope, k: np.ndarray, p: np.ndarray, spec: Spec) -> float:
    """Return the largest eigenvalue of the Riccati inequality (29) over the vertices, relative to Q + K'RK."""
    closed, weight = system.closed_loop(k), spec.Q + k.T @ spec.R @ k
    discrete = system.period is not None
    inequality = weight + (np.swapaxes(closed, 1, 2) @ p @ closed - p if discrete else he(p @ closed))
    # Evaluated in the coordinates of P = I, where the solver worked.
    root = np.linalg.inv(np.linalg.cholesky(p)).T
    return float(
        np.linalg.eigvalsh(root.T @ inequality @ root).max() / np.linalg.eigvalsh(root.T @ weight @ root).max()
    )


def _rejection_reason(candidate: Design, spec: Spec, scheduled: bool) -> str:
    """Return the reason to reject a design; empty if it passes all checks."""
    proof = candidate.certificate
    missing = {kind for name, kind in CLAIM_OF_SPECIFICATION.items() if _is_specified(getattr(spec, name))}
    missing -= {claim.kind for claim in proof.claims}
    if scheduled:  # a claim of kind "scheduled" may hold a decay or a cost
        missing -= {"decay"} if (proof.decay_rate or 0.0) >= spec.decay else set()
        missing -= {"cost"} if proof.guaranteed_cost is not None else set()
    if missing or not proof.verified_exactly:
        return f"gain {candidate.gain.tolist()}: not proved: {', '.join(sorted(missing)) or 'its claims'}"
    # `certify` proves the least bounds that it can, not those of the specification.
    bound, l2_gain = spec.l2 and spec.l2.bound, proof.l2_gain
    if bound is not None and l2_gain is not None and l2_gain > bound:
        return f"gain {candidate.gain.tolist()}: L2 gain {l2_gain:.10g} is above its bound {bound:.10g}"
    allowed, limit = spec.input and spec.input.limit, proof.input_limit
    if allowed is not None and limit is not None and np.any(limit > allowed):
        return (
            f"gain {candidate.gain.tolist()}: inputs within {limit.tolist()}, not within {np.asarray(allowed).tolist()}"
        )
    cost, lower, guaranteed = candidate.trace_cost, candidate.lower_bound, proof.guaranteed_cost
    if cost is not None and lower is not None and cost < lower * (1 - GAP):
        return f"cost {cost:.10g} is below its lower bound {lower:.10g}"
    # The proof minimises the cost for the gain alone: a larger value shows that the solver's X is inaccurate.
    if cost is not None and guaranteed is not None and not scheduled and guaranteed > cost * (1 + 10 * GAP):
        return f"the gain guarantees {guaranteed:.10g}, not the cost {cost:.10g}"
    # Where Q + K'RK is singular, the last digits of the multipliers leave a gap of some 3e-6.
    if not candidate.gap <= (ROUGH_GAP if scheduled or spec.Q is None or proof.period is not None else 10 * GAP):
        return f"the answer may be {candidate.gap:.2g} (relative) above the optimum"
    return ""


def _is_specified(value: object) -> bool:
    return value is not None and (not isinstance(value, float | int) or value > 0)
