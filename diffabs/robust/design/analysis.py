"""Proofs about a given state feedback u = K x, from any source.

    V = x'P x,  C = A + B K at every vertex,  P > 0
    decay      He[P C] + 2 rate P < 0
    cost       He[P C] + Q + K'RK < 0, minimise trace P

`design.proof.certificate` lists the inequalities of the other claims, of discrete time and of schedules.

A solver finds P in floating point. Then `design.proof.exact` proves the inequality for that P in exact arithmetic. If
no common P exists, the multipliers of the same program prove it: W_i >= 0 with sum He[C_i W_i] > 0. If the solver gives
no such proof, `design.pairs` looks for two vertices that exclude a common P. A vertex that is unstable by itself needs
no program: a P that is not definite proves it.
"""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from diffabs.core.jax_flags import default_flags
from diffabs.core.numerics import spectral_bound
from diffabs.core.types import AnyArray
from diffabs.robust.design import instability, pairs
from diffabs.robust.design.bounds import BOUND_LOOSENINGS, Bounds, decrease_matrix
from diffabs.robust.design.polytopes import Polytope, Schedule, as_gain_matrix
from diffabs.robust.design.proof import exact
from diffabs.robust.design.proof.certificate import Certificate, Claim
from diffabs.robust.design.proof.dyadic import RELATIVE_ERROR_BITS
from diffabs.robust.design.proof.exact import he
from diffabs.robust.design.proof.schema import DISPROOF_KINDS
from diffabs.robust.design.sdp import solver
from diffabs.robust.design.sdp.scaling import analysis_frame, lyapunov_frame
from diffabs.robust.design.sdp.solver import Unknowns
from diffabs.robust.design.spec import Spec

MAX_FRAMES = 4  # attempts, each in the frame of the last P
DECAY_TOLERANCE = 1e-3  # relative width at which the search for the fastest decay stops
MAX_SEARCH_PROGRAMS = 20  # programs of the search for the fastest decay, at most


@default_flags()
def certify(
    gain: Sequence[float] | AnyArray, system: Polytope | Schedule, spec: Spec | None = None, *, fastest: bool = False
) -> Certificate:
    """Return the proved properties of u = K x: quadratic stability or its impossibility, and each specification.

    A property without a proof raises no error: the certificate leaves it out. If no common P proves `spec.decay`,
    damping, L2 gain and input limit are not tried. A disproof of a positive `spec.decay` leaves stability open:
    `quadratically_stable` is then None, unless the cost is proved.

    A schedule is proved by `certify_schedule`, with a P that varies along its parameter. It needs `spec.rates`,
    continuous time, and no specifications but decay and cost.

    Args:
        gain: Gain K, shape (m, n) or (n,). For a schedule of N cells also one gain for each node, shape (N + 1, m, n).
        system: A polytope, within which the system may vary arbitrarily fast, or a schedule along a measured parameter.
        spec: Specification to prove; None stands for stability alone, which a polytope accepts and a schedule does not.
        fastest: Whether to search for the largest decay rate that has a proof, with a few more programs. Otherwise, on
            a polytope, the claimed rate is at least `spec.decay`: the largest that the first P proves.

    Returns:
        Certificate with the proved claims; it has none if nothing is proved.

    Raises:
        ValueError: Shapes that do not fit, a field of `spec` out of its range, or damping in discrete time. Also a
            schedule in discrete time, without `spec.rates`, or with specifications besides decay and cost.
        ModuleNotFoundError: cvxpy is not installed.

    See also:
        `design.design`: A gain with such a certificate.
        `design.Certificate`: What is proved. `diffabs verify FILE` proves a stored one again, by independent code.
        `prove_box`: Bounds of the nonlinear loop with its limits.

    Notes:
        With C = A + B K at every vertex, a matrix P > 0 proves

            decay   He[P C] + 2 rate P < 0
            cost    He[P C] + Q + K'R K < 0,   of which trace P is the bound

        where He[M] = M + M'. P is common to all vertices, so the system may vary arbitrarily fast. No such P exists if
        there are W_i >= 0, not all zero, with sum He[C_i W_i] > 0. A solver finds P or W in floating point; integers of
        any length then decide the inequalities, with 2^-40 of each entry for its rounding. Source: S. Boyd, L. El
        Ghaoui, E. Feron and V. Balakrishnan, Linear Matrix Inequalities in System and Control Theory, SIAM, 1994.

    Examples:
        Position feedback of the wrong sign has no common Lyapunov matrix, by proof:

        >>> from diffabs.robust.design import Polytope, certify
        >>> box = Polytope(A=[[[0.0, 1.0], [0.0, -1.0]], [[0.0, 1.0], [0.0, -2.0]]], B=[[[0.0], [1.0]]] * 2)
        >>> [certify(gain, box).quadratically_stable for gain in ((-1.0, -1.0), (1.0, -1.0))]
        [True, False]
    """
    spec = Spec() if spec is None else spec
    if isinstance(system, Schedule):
        from diffabs.robust.design.scheduled import certify_schedule

        return certify_schedule(gain, system, spec, fastest=fastest)
    spec = spec.check(system.order, system.inputs, system.period)
    k = as_gain_matrix(gain, (system.inputs, system.order))
    return Certificate(system, k, tuple(_Analysis(system, k, spec).claims(fastest)))


class _Analysis:
    """The search for the claims about one gain on one polytope."""

    def __init__(self, system: Polytope, k: np.ndarray, spec: Spec):
        self.system, self.k, self.spec = system, k, spec
        self.closed = system.closed_loop(k)
        self.discrete = system.period is not None
        self.frame = analysis_frame(self.closed, discrete=self.discrete)
        # Entries of A and B may be off by 2^-40, so no proof goes below: a deadbeat loop has a rate that is finite.
        terms = np.abs(system.A) + np.abs(system.B) @ np.abs(k)
        error_bound = 2.0 ** (2 - RELATIVE_ERROR_BITS) * np.abs(np.linalg.eigvals(terms)).max()
        self.least_factor = max(error_bound, np.finfo(float).tiny)

    def claims(self, fastest: bool) -> Iterator[Claim]:
        """Yield the claims whose proof succeeds; `fastest` asks for the largest decay rate."""
        spec, bounds = self.spec, Bounds(self.system, self.k, self.spec, self.frame)
        cost = bounds.cost() if spec.Q is not None and self._slowest_mode() > 0 else None
        # The P of the cost also proves a decay, so one program serves both claims.
        stable = None if cost is None or fastest else self._decay_claim(np.asarray(cost.data["P"]), spec.decay)
        stable = stable or self._stability(fastest)
        yield from (claim for claim in (stable, cost) if claim is not None)
        if stable is None or stable.kind in DISPROOF_KINDS:
            return
        for requirement, find in ((spec.damping, bounds.damping), (spec.l2, bounds.l2), (spec.input, bounds.input)):
            claim = find() if requirement else None
            if claim is not None:
                yield claim

    # quadratic stability, decay, and their impossibility

    def _stability(self, fastest: bool) -> Claim | None:
        decay = self.spec.decay
        if unstable := self._refute_by_vertex():
            return unstable
        for _ in range(MAX_FRAMES):
            p, margin, w = self._common(decay)
            if p is None:
                break
            if margin > 0:
                stable = self._decay_claim(p, decay)
                if stable is not None:
                    return self._fastest_decay_claim(stable) if fastest else stable
            # For any sign of the margin: without a common P the optimum is P = 0, with a margin of 0 up to
            # rounding.
            claim = Claim("infeasible", {"W": w, **self._rate_data(decay)})
            if np.isfinite(w).all() and self._verify_claim(claim):
                return claim
            try:
                # In the frame of the last P the unknown is near the unit matrix: the solver is more accurate at the
                # next attempt.
                self.frame = lyapunov_frame(p, self.closed, np.eye(1), discrete=self.discrete)
            except np.linalg.LinAlgError:
                break
        return self._refute_by_pair(decay)

    def _refute_by_vertex(self) -> Claim | None:
        """Return a proof that one vertex is unstable, or None."""
        for vertex, a in enumerate(self.closed):
            for data in instability.growing_modes(a, discrete=self.discrete):
                claim = Claim("unstable", {**data, "vertex": vertex})
                if self._verify_claim(claim):
                    return claim
        return None

    def _refute_by_pair(self, decay: float) -> Claim | None:
        """Return a proof of infeasibility from two vertices whose multipliers need no solver, or None."""
        rate, scaled = self._rate_data(decay), self.frame.states(self.closed) * self.frame.tau
        t, factor = self.frame.T, rate.get("factor")
        for w in pairs.witnesses(scaled + rate.get("rate", 0.0) * np.eye(self.system.order), factor):
            w = he(t @ w @ t.T)
            claim = Claim("infeasible", {"W": w / np.abs(w).max(), **rate})
            if self._verify_claim(claim):
                return claim
        return None

    def _common(self, rate: float) -> tuple[np.ndarray | None, float, np.ndarray]:
        """Return P with trace at most n in the frame (None without an answer), its least margin and the multipliers."""
        n = self.system.order
        unknowns, scaled = Unknowns(P=n, t=(1, 1)), self.frame.states(self.closed)
        # Unit of time in the frame: one period in discrete time, 1/tau in continuous time.
        step = self.system.period or 1 / self.frame.tau
        # Each inequality is divided by the size of its vertex, so that one margin t is comparable over slow and fast
        # vertices.
        sizes = np.linalg.norm(scaled, axis=(1, 2))
        sizes += 1.0 if self.discrete else sizes == 0
        identity = np.eye(n)
        decreases = [
            unknowns.affine(
                lambda v, c=c, s=s: (
                    decrease_matrix(v["P"], c, rate * step, discrete=self.discrete) / s - v["t"] * identity
                )
            )
            for c, s in zip(scaled, sizes, strict=True)
        ]
        positive = unknowns.affine(lambda v: v["P"] - v["t"] * identity)
        # The inequalities are homogeneous in P: without the bound on its trace the margin t would have no maximum.
        total = unknowns.affine(lambda v: (1 - np.trace(v["P"], axis1=-2, axis2=-1) / n)[:, None, None])
        answer = solver.solve_sdp(unknowns.row(lambda v: -v["t"]), [solver.stack_blocks([*decreases, positive]), total])
        if not np.isfinite(answer.y).all():
            return None, math.nan, np.zeros((0, n, n))
        values = unknowns.values(answer.y)
        # The last multiplier of the group belongs to P >= t I, not to a vertex.
        w = answer.multipliers[0][:-1]
        w = (w + np.swapaxes(w, 1, 2)) / 2
        # Moved off the boundary of the cone: rounding could make them indefinite there.
        w = w / np.trace(w.sum(axis=0)) + 1e-9 * identity
        t = self.frame.T
        w = t @ w @ t.T / sizes[:, None, None]
        return self.frame.form(values["P"]), float(values["t"][0, 0]), he(w) / np.abs(w).max()

    def _decay_claim(self, p: np.ndarray, specified: float) -> Claim | None:
        """Return the proved claim with the largest rate of this P, or None if that rate is below the specified one."""
        best = self._proved_rate(p)
        if best == -math.inf:
            return None
        for loosening in BOUND_LOOSENINGS:
            # At the best rate the inequality is singular, and no proof of a strict inequality succeeds: step back from
            # it.
            rate = best - loosening * (abs(best) + specified)
            claim = Claim("decay", {"P": p, **self._rate_data(max(rate, specified))})
            if self._verify_claim(claim):
                return claim
            if rate <= specified:
                return None
        return None

    def _fastest_decay_claim(self, claim: Claim) -> Claim:
        """Return the claim with the fastest rate that a common P proves, by bisection.

        P of a program bounds the rate from below, and its multipliers exclude every rate above an upper bound.
        """
        p = np.asarray(claim.data["P"])
        low, high = self._proved_rate(p), self._slowest_mode()
        for _ in range(MAX_SEARCH_PROGRAMS):
            if high - low <= DECAY_TOLERANCE * high:
                break
            self.frame = lyapunov_frame(p, self.closed, np.eye(1), discrete=self.discrete)
            middle = (low + high) / 2
            better, _, w = self._common(middle)
            if better is None:
                break
            high, rate = min(high, self._least_refuted_rate(w)), self._proved_rate(better)
            if rate > low:
                p, low = better, rate
            else:  # beyond the solver's accuracy: the same program again would say the same
                high = min(high, middle)
        return self._decay_claim(p, self.spec.decay) or claim

    def _slowest_mode(self) -> float:
        """Return the decay rate [1/s] of the slowest mode of all vertices."""
        slowest = spectral_bound(self.closed, discrete=self.discrete).max()
        return self._rate_of_factor(slowest) if self.discrete else -float(slowest)

    def _least_refuted_rate(self, w: np.ndarray) -> float:
        """Return the smallest rate [1/s] that the multipliers W exclude: sum He[C W] + 2 rate sum W >= 0."""
        root = np.linalg.inv(np.linalg.cholesky(w.sum(axis=0)))
        if self.discrete:
            spread = (self.closed @ w @ np.swapaxes(self.closed, 1, 2)).sum(axis=0)
            factor = np.linalg.eigvalsh(root @ spread @ root.T)[0]
            return self._rate_of_factor(factor) / 2
        return -float(np.linalg.eigvalsh(root @ he(self.closed @ w).sum(axis=0) @ root.T)[0]) / 2

    def _proved_rate(self, p: np.ndarray) -> float:
        """Return the decay rate [1/s] of V = x'Px at the slowest vertex; -inf if P is not positive definite."""
        try:
            root = np.linalg.cholesky(p).T
        except np.linalg.LinAlgError:
            return -math.inf
        c = root @ self.closed @ np.linalg.inv(root)
        if self.discrete:
            return self._rate_of_factor(np.linalg.norm(c, ord=2, axis=(1, 2)).max())
        return -float(np.linalg.eigvalsh(he(c)).max()) / 2

    def _rate_of_factor(self, factor: float) -> float:
        return -math.log(max(factor, self.least_factor)) / (self.system.period or 1.0)

    def _rate_data(self, rate: float) -> dict[str, float]:
        """Return the rate as claim data: `rate` [1/s], or in discrete time a safely rounded `factor` per step."""
        if self.discrete:
            # The relative 1e-15 rounds the factor up: a larger factor claims a slower decay.
            return {"factor": min(1.0, math.exp(-rate * (self.system.period or 1.0)) * (1 + 1e-15))}
        return {"rate": rate}

    def _verify_claim(self, claim: Claim) -> bool:
        return exact.is_proved(claim.kind, self.system, self.k, claim.data)
