"""Proofs with a parameter-dependent Lyapunov function, for a gain that no common P can prove.

    V = x'P(p) x,  P piecewise linear in a measured parameter p (speed, say) that moves within r_lo <= p' <= r_hi

In a cell between the nodes a and b, let D = (P_b - P_a)/(p_b - p_a). For every vertex of the cell and r = r_lo, r_hi,

    He[P (A + B K)] + r D + 2 rate P + Q + K'R K < 0

The left side is quadratic along the cell. The program requires this inequality of its three Bernstein coefficients: P
and K at a, at b, and mixed.

The speed of a braking car falls no faster than friction allows. A common P would also admit jumps of the speed.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from diffabs.core.numerics import spectral_bound
from diffabs.core.types import AnyArray, PyTree
from diffabs.robust.design.bounds import BOUND_LOOSENINGS
from diffabs.robust.design.polytopes import Schedule, as_gain_matrix
from diffabs.robust.design.proof import exact
from diffabs.robust.design.proof.certificate import Certificate, Claim
from diffabs.robust.design.proof.exact import he
from diffabs.robust.design.sdp import solver
from diffabs.robust.design.sdp.scaling import Frame, analysis_frame, definite_weight
from diffabs.robust.design.sdp.solver import Unknowns, group_blocks
from diffabs.robust.design.spec import Spec

SCHEDULE_DECAY_TOLERANCE = 0.01  # relative width at which the search for the fastest decay stops


def certify_schedule(
    gain: Sequence[float] | AnyArray, system: Schedule, spec: Spec, *, fastest: bool = False
) -> Certificate:
    """Return the proved properties, of decay and cost only, of a gain on a schedule, with a parameter-dependent P(p).

    One claim proves `spec.decay` (0 for stability alone). With Q and R another one, with its own P(p), proves the cost.
    A proof of the cost is also one of stability, and then the only claim for a decay of 0. A claim without a proof is
    left out. The search for the fastest decay, to 1 %, needs a proof of `spec.decay`.

    Args:
        gain: Gain K, constant of shape (m, n) or (n,), or linear between the nodes, shape (N + 1, m, n) for N cells.
    """
    cell = system.cells[0]
    spec = spec.check(cell.order, cell.inputs, cell.period, scheduled=True)
    gains = gains_at_nodes(gain, system)
    # In one inequality V' <= -2 rate V - x'(Q + K'RK)x the bound of the cost would grow with the asked decay.
    cost = None if spec.Q is None else _find_claim(gains, system, Spec(Q=spec.Q, R=spec.R, rates=spec.rates))
    decay = Spec(decay=spec.decay, rates=spec.rates)
    first = cost if cost and spec.decay == 0 else _find_claim(gains, system, decay)
    fast = _fastest_decay_claim(gains, system, spec) if fastest and first else None
    return Certificate(system, gains, tuple(dict.fromkeys(claim for claim in (first, cost, fast) if claim)))


def _fastest_decay_claim(gains: np.ndarray, system: Schedule, spec: Spec) -> Claim | None:
    """Return the claim with the fastest decay, by bisection up to the slowest mode of any vertex."""
    pairs = [(cell, k) for i, cell in enumerate(system.cells) for k in gains[i : i + 2]]
    # No P(p) proves a decay faster than the slowest mode of a frozen loop.
    low, high = spec.decay, min(-spectral_bound(cell.closed_loop(k)).max() for cell, k in pairs)
    best = None
    while high - low > SCHEDULE_DECAY_TOLERANCE * high:
        rate = (low + high) / 2
        claim = _find_claim(gains, system, Spec(decay=rate, rates=spec.rates))
        low, high, best = (low, rate, best) if claim is None else (rate, high, claim)
    return best


def gains_at_nodes(gain: Any, system: Schedule) -> np.ndarray:
    """Return the gains at the nodes, shape (N + 1, m, n); a constant gain has shape (m, n) or (n,)."""
    shape = (system.cells[0].inputs, system.cells[0].order)
    if np.ndim(gain) < 3:
        return np.repeat(as_gain_matrix(gain, shape)[None], len(system.nodes), axis=0)
    if len(gain) != len(system.nodes):
        raise ValueError(f"the gain has {len(gain)} rows of a table; the schedule has {len(system.nodes)} nodes")
    return np.array([as_gain_matrix(matrix, shape) for matrix in gain])


def _find_claim(gains: np.ndarray, system: Schedule, spec: Spec) -> Claim | None:
    """Return the claim with the smallest mean trace P (with Q, R) or the largest margin; None if no proof succeeds."""
    n, nodes = system.cells[0].order, range(len(system.nodes))
    # One loop of each cell suffices for a frame: the scaling need not be exact.
    middle = [(cell.A + cell.B @ gains[i])[:1] for i, cell in enumerate(system.cells)]
    frame = analysis_frame(np.concatenate(middle), discrete=False)
    unknowns = Unknowns(**{f"P{i}": n for i in nodes}, **({} if spec.Q is not None else {"t": (1, 1)}))
    blocks = [unknowns.affine(lambda v, i=i: v[f"P{i}"]) for i in nodes]
    for formulas in _bernstein_formulas(gains, system, spec, frame):
        blocks += unknowns.blocks(formulas)
    if spec.Q is None:
        total = len(nodes) * n
        blocks += unknowns.blocks(
            lambda v: [total - sum(np.trace(v[f"P{i}"], axis1=-2, axis2=-1)[..., None, None] for i in nodes)]
        )
        objective = unknowns.row(lambda v: -v["t"])
    else:
        weight = frame.trace_weight() / np.trace(frame.trace_weight())
        objective = unknowns.row(lambda v: sum(np.einsum("ij,dji->d", weight, v[f"P{i}"]) for i in nodes))
    answer = solver.solve_sdp(objective, group_blocks(blocks))
    if not np.isfinite(answer.y).all():
        return None
    values = unknowns.values(answer.y)
    forms = np.array([frame.form(values[f"P{i}"]) for i in nodes])
    cost = {} if spec.Q is None else {"Q": spec.Q, "R": spec.R}
    for loosening in BOUND_LOOSENINGS if cost else (0.0,):
        data = {"P": forms * (1 + loosening), "rates": np.array(spec.rates), "rate": spec.decay, **cost}
        claim = Claim("scheduled", data)
        if exact.is_proved(claim.kind, system, gains, claim.data):
            return claim
    return None


def _bernstein_formulas(gains: np.ndarray, system: Schedule, spec: Spec, frame: Frame) -> Iterator[PyTree]:
    """Yield for each cell, vertex and end of the rates the Bernstein coefficients as formulas of P at the nodes."""
    assert spec.rates is not None
    n = system.cells[0].order
    weight = np.zeros((n, n)) if spec.Q is None else spec.Q
    effort = np.zeros((system.cells[0].inputs,) * 2) if spec.R is None else spec.R
    for i, cell in enumerate(system.cells):
        width = float(system.nodes[i + 1] - system.nodes[i])
        low, high = gains[i], gains[i + 1]
        spent = low.T @ effort @ low, he(low.T @ effort @ high) / 2, high.T @ effort @ high
        # A margin for the exact proof, as in `Bounds.cost`.
        price = [frame.weight(definite_weight(weight + each, 1e-9)) for each in spent]
        for a, b in zip(cell.A, cell.B, strict=True):
            closed = frame.states(a + b @ low), frame.states(a + b @ high)
            size = float(max(np.linalg.norm(c) for c in closed))
            for rate in sorted(set(spec.rates)):
                # The defaults bind the loop variables at the definition: a formula may run after the loop has moved on.
                def coefficients(
                    v: Mapping[str, np.ndarray], i: int = i, c: tuple[np.ndarray, np.ndarray] = closed,
                    q: list[np.ndarray] = price, s: float = size, drift: float = rate / width / frame.tau,
                ) -> list[np.ndarray]:  # fmt: skip
                    start, end = v[f"P{i}"], v[f"P{i + 1}"]
                    # dP/dt is constant along the cell, so all three Bernstein coefficients contain it in full.
                    common = drift * (end - start)
                    spare = v["t"] * np.eye(n) if spec.Q is None else 0.0
                    flows = (he(start @ c[0]), (he(start @ c[1]) + he(end @ c[0])) / 2, he(end @ c[1]))
                    forms = (start, (start + end) / 2, end)
                    speed = 2 * spec.decay / frame.tau
                    return [-(f + common + speed * p + w) / s - spare for f, p, w in zip(flows, forms, q, strict=True)]

                yield coefficients
