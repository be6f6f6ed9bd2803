"""Bounds that a common P proves for a gain: the smallest cost, L2 gain and inputs, and a given damping ratio."""

import math
from collections.abc import Callable, Mapping

import numpy as np

from diffabs.core.types import PyTree
from diffabs.robust.design.polytopes import Polytope
from diffabs.robust.design.proof import exact
from diffabs.robust.design.proof.certificate import Claim
from diffabs.robust.design.proof.exact import he
from diffabs.robust.design.sdp import solver
from diffabs.robust.design.sdp.program import damping_matrix
from diffabs.robust.design.sdp.scaling import Frame, analysis_frame, definite_weight, whitening_matrix
from diffabs.robust.design.sdp.solver import Unknowns, group_blocks, symmetric_from_blocks
from diffabs.robust.design.spec import Spec

# Relative amounts by which a bound is loosened, in this order, until its proof succeeds.
BOUND_LOOSENINGS = (1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4)


def decrease_matrix(p: np.ndarray, c: np.ndarray, rate: float, *, discrete: bool) -> np.ndarray:
    """Return the matrix of -dV/dt - 2 rate V (..., n, n) for V = x'P x along dx/dt = C x; it is > 0 if V falls faster.

    In discrete time, x+ = C x, it is the matrix of exp(-2 rate) V - V+, with the rate per step.
    """
    if discrete:
        return math.exp(-2 * rate) * p - c.T @ p @ c
    return -he(p @ c) - 2 * rate * p


class Bounds:
    """The search for the bounds of one gain: each method returns a proved claim, or None if no proof succeeds."""

    def __init__(self, system: Polytope, k: np.ndarray, spec: Spec, frame: Frame):
        """Prepare the closed loops of gain `k` (m, n) on `system`; `frame` is one for quadratic stability."""
        self.system = system
        self.k = k
        self.spec = spec
        self.frame = frame
        self.closed: np.ndarray = system.closed_loop(k)
        self.discrete: bool = system.period is not None

    def cost(self) -> Claim | None:
        """Return the claim with the smallest trace P."""
        q, r = self.spec.Q, self.spec.R
        # W = Q + K'RK may be singular, and P loosened by (more - 1) P then proves no strict inequality. The P of
        # W + 1e-9 diag W leaves 1e-9 diag W, a margin in each state that scales with the unit of the state.
        weight = definite_weight(q + self.k.T @ r @ self.k, 1e-9)
        at = analysis_frame(self.closed, discrete=self.discrete, weight=weight)
        scaled = at.weight(weight)
        # Congruence by `even` makes the solver's absolute tolerance relative to the weight in every direction.
        even = whitening_matrix(scaled)
        # trace P in the original coordinates, as a linear form of the scaled P.
        trace = at.trace_weight() / np.trace(at.trace_weight())
        return self._solve_in_frame(
            at,
            {"P": self.system.order},
            lambda v: np.einsum("ij,dji->d", trace, v["P"]),
            lambda v, c, b: [even.T @ (decrease_matrix(v["P"], c, 0.0, discrete=self.discrete) - scaled) @ even],
            lambda p, v, more: {"kind": "cost", "P": more * p, "Q": q, "R": r},
        )

    def damping(self) -> Claim | None:
        """Return the claim that every frozen system has at least the specified damping ratio; it is not maximised."""
        zeta = self.spec.damping
        # Rounded up: the proof requires cot^2 (1 - zeta^2) >= zeta^2 exactly.
        cot = zeta / math.sqrt(1 - zeta**2) * (1 + 1e-12)

        def cone(v: Mapping[str, np.ndarray], c: np.ndarray, b: np.ndarray) -> list[np.ndarray]:
            return [damping_matrix(v["P"] @ c / np.linalg.norm(c), cot) - v["t"] * np.eye(2 * len(c))]

        return self._solve_in_frame(
            self.frame,
            {"P": self.system.order, "t": (1, 1)},
            lambda v: -v["t"],
            cone,
            lambda p, v, more: {"kind": "damping", "P": p, "zeta": zeta, "cot": cot},
            lambda v: [1 - np.trace(v["P"], axis1=-2, axis2=-1)[..., None, None]],
        )

    def l2(self) -> Claim | None:
        """Return the claim with the smallest L2 gain; the bound of the specification plays no part."""
        l2 = self.spec.l2
        assert l2 is not None
        z = l2.output + l2.feedthrough @ self.k
        weight = z.T @ z
        # A small weight on every state, so that the Lyapunov solution of the frame is definite where the output misses
        # a state.
        weight = weight + 1e-9 * np.trace(weight) * np.eye(len(weight))
        at = analysis_frame(self.closed, discrete=self.discrete, weight=weight)
        input_matrix = None if l2.disturbance is None else at.inverse @ l2.disturbance / math.sqrt(at.tau)

        def gain_inequalities(v: Mapping[str, np.ndarray], c: np.ndarray, b: np.ndarray) -> list[np.ndarray]:
            e = at.inverse @ b / math.sqrt(at.tau) if input_matrix is None else input_matrix
            limit = v["g"] * np.eye(e.shape[1])
            # 1e-10 keeps the answer strictly inside the inequality that the exact proof requires.
            top = decrease_matrix(v["P"], c, 0.0, discrete=self.discrete) - at.weight(z.T @ z) - 1e-10 * np.eye(len(c))
            if self.discrete:
                return [symmetric_from_blocks([[top], [-e.T @ v["P"] @ c, limit - e.T @ v["P"] @ e]])]
            return [symmetric_from_blocks([[top], [-e.T @ v["P"], limit]])]

        disturbance = self.system.B if l2.disturbance is None else l2.disturbance
        return self._solve_in_frame(
            at,
            {"P": self.system.order, "g": (1, 1)},
            lambda v: v["g"],
            gain_inequalities,
            lambda p, v, more: {
                "kind": "l2",
                "P": more * p,
                # gamma^2 grows a little more than P, so that gamma^2 - Bw'P Bw has a margin in discrete time.
                "gamma": (1 + 1e-9) * math.sqrt(more * float(v["g"][0, 0])),
                "Bw": disturbance,
                "C": l2.output,
                "D": l2.feedthrough,
            },
        )

    def input(self) -> Claim | None:
        """Return the claim with the smallest input limits that an invariant ellipsoid around the starts proves.

        All limits share one factor sqrt(g) relative to the specified limits.
        """
        limit, at = self.spec.input, self.frame
        assert limit is not None
        rows = self.k @ at.T / limit.limit[:, None]
        starts = at.inverse @ limit.points.T
        # P scales as 1/size^2: the unknown is P size^2, near the unit matrix for starts in any unit.
        starts_size = float(np.linalg.norm(starts, axis=0).max())

        def input_inequalities(v: Mapping[str, np.ndarray]) -> list[np.ndarray]:
            p = v["P"]
            inside = [1 - starts_size**-2 * (x @ p @ x)[..., None, None] for x in starts.T]
            return inside + [symmetric_from_blocks([[p], [row[None] * starts_size, v["g"]]]) for row in rows]

        return self._solve_in_frame(
            at,
            {"P": self.system.order, "g": (1, 1)},
            lambda v: v["g"],
            # The rate 1e-9 keeps the ellipsoid strictly invariant.
            lambda v, c, b: [decrease_matrix(v["P"], c, 1e-9, discrete=self.discrete) / np.linalg.norm(c)],
            lambda p, v, more: {
                "kind": "input",
                "P": p / starts_size**2 / more,
                "limit": limit.limit * math.sqrt(float(v["g"][0, 0])) * more,
                "points": limit.points,
            },
            input_inequalities,
        )

    def _solve_in_frame(
        self,
        at: Frame,
        shapes: dict[str, PyTree],
        objective: Callable[[PyTree], PyTree],
        everywhere: Callable[[PyTree, np.ndarray, np.ndarray], list[np.ndarray]],
        claim: Callable[[np.ndarray, PyTree, float], dict[str, PyTree]],
        once: Callable[[PyTree], list[np.ndarray]] | None = None,
    ) -> Claim | None:
        """Return the claim of a solved program, loosened until its proof succeeds, or None.

        `everywhere` gives the inequalities of a vertex, `once` the inequalities without a vertex.
        """
        unknowns = Unknowns(**shapes)
        blocks = unknowns.blocks(lambda v: [v["P"], *(once(v) if once else [])])
        for c, b in zip(at.states(self.closed), self.system.B, strict=True):
            blocks += unknowns.blocks(lambda v, c=c, b=b: everywhere(v, c, b))
        answer = solver.solve_sdp(unknowns.row(objective), group_blocks(blocks))
        if not np.isfinite(answer.y).all():
            return None
        values = unknowns.values(answer.y)
        for loosening in BOUND_LOOSENINGS if "g" not in values or values["g"] > 0 else ():
            fields = claim(at.form(values["P"]), values, 1 + loosening)
            proposal = Claim(fields.pop("kind"), fields)
            if exact.is_proved(proposal.kind, self.system, self.k, proposal.data):
                return proposal
        return None
