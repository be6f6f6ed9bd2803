"""Proofs of matrix inequalities about the stated numbers, without rounding.

Each kind of claim is written once, over matrices of two types: float arrays for its margins, `Dyadic` for its proof.

Rounded outward: each entry of A, B and Bw may have a relative error of RHO = 2^-40. That covers the rounding in
computing them from a model. Sums and products propagate the error:

    |error of A + B K| <= RHO (|A| + |B| |K|) = RHO Abar,       |error of P C| <= RHO |P| Abar

Let M have a symmetric error D with |D| <= E entrywise. M + D is positive definite if for some s > 0

    M - diag_i(sum_j E_ij s_i / s_j) > 0,       since 2 |x_i x_j| <= (s_i/s_j) x_i^2 + (s_j/s_i) x_j^2

He(M) = M + M', C = A + B K.
"""

import functools
import operator
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from diffabs.core.types import Params, PyTree
from diffabs.robust.design.polytopes import Polytope, Schedule
from diffabs.robust.design.proof.dyadic import Dyadic, Exact, as_dyadic, as_uncertain_dyadic, is_positive_definite
from diffabs.robust.design.proof.schema import check_claim


class Inequality(NamedTuple):
    """The inequality sum(terms) > 0 (>= 0 if not `strict`) over terms of shape (..., k, k).

    The terms may be stacks with one inequality for each vertex; `vertex` is then the number of the first vertex. It is
    ALL_VERTICES if the inequality concerns all vertices together, and None for a side condition such as P > 0.
    """

    terms: tuple[Exact, ...]
    vertex: int | None = None
    strict: bool = True


ALL_VERTICES = -1


class ClosedLoop(NamedTuple):
    """Gain K and closed loops C of the vertices, as floats or Dyadic."""

    K: Exact
    C: Exact
    discrete: bool


def he(M: Exact) -> Exact:
    """Return M + M'."""
    return M + M.mT


def block_matrix(rows: list[list[Exact]]) -> Exact:
    """Return the block matrix of the rows; blocks without leading axes are the same for every vertex."""
    flat = [each for row in rows for each in row]
    lead = np.broadcast_shapes(*(each.shape[:-2] for each in flat))

    def join_blocks(get: Callable[[Exact], PyTree]) -> Exact:
        return np.block([[np.broadcast_to(get(each), (*lead, *each.shape[-2:])) for each in row] for row in rows])

    if not isinstance(flat[0], Dyadic):
        return join_blocks(np.asarray)
    rows = [[as_dyadic(each) for each in row] for row in rows]
    bits = max(each.bits for row in rows for each in row)
    rows = [[each.at(bits) for each in row] for row in rows]
    return Dyadic(
        join_blocks(lambda each: each.ints),
        bits,
        join_blocks(lambda each: 0 * each.ints if each.error is None else each.error),
    )


def decrease_terms(loop: ClosedLoop, P: Exact, data: Mapping[str, Exact]) -> tuple[Exact, ...]:
    """Return the terms of -He(P C) - 2 rate P, or in discrete time of factor^2 P - C' P C."""
    if loop.discrete:
        factor = data.get("factor", 1)
        return factor * factor * P, -(loop.C.mT @ P @ loop.C)
    return -he(P @ loop.C), -2 * data.get("rate", 0) * P


def decay_conditions(loop: ClosedLoop, data: Mapping[str, Exact]) -> Iterator[Inequality]:
    """Yield the conditions that V = x' P x falls at least like exp(-2 rate t), or by factor^2 a period."""
    yield Inequality((data["P"],))
    yield Inequality(decrease_terms(loop, data["P"], data), 0)


def cost_conditions(loop: ClosedLoop, data: Mapping[str, Exact]) -> Iterator[Inequality]:
    """Yield the conditions for V' <= -x' (Q + K' R K) x.

    The integral (sum) of x' (Q + K' R K) x from x0 is then at most x0' P x0. A further condition is that V falls,
    without Q and R. V therefore goes to 0, and the bound needs no sign of Q, which may have rounding errors.
    """
    terms = decrease_terms(loop, data["P"], {})
    yield Inequality((data["P"],))
    # No vertex number: this is a side condition, and the margin is that of the next line.
    yield Inequality(terms)
    yield Inequality((*terms, -data["Q"], -(loop.K.mT @ data["R"] @ loop.K)), 0)


def damping_conditions(loop: ClosedLoop, data: Mapping[str, Exact]) -> Iterator[Inequality]:
    """Yield the conditions for a damping of at least zeta, with M = P C and cot >= zeta / sqrt(1 - zeta^2).

        -[[He(M), cot (M - M')], [cot (M' - M), He(M)]] > 0

    Eigenvalues of every fixed system of the hull then lie in |Im| < |Re| / cot, left of 0 (Chilali and Gahinet 1996).
    """
    M, cot, zeta = data["P"] @ loop.C, data["cot"], data["zeta"]
    skew = cot * (M - M.mT)
    yield Inequality((data["P"],))
    yield Inequality(((cot * cot * (1 - zeta * zeta) - zeta * zeta) * np.eye(1),), strict=False)
    yield Inequality((-block_matrix([[he(M), skew], [skew.mT, he(M)]]),), 0)


def l2_conditions(loop: ClosedLoop, data: Mapping[str, Exact]) -> Iterator[Inequality]:
    """Yield the conditions for V' + |z|^2 - gamma^2 |w|^2 < 0: the gain from w to z is below gamma.

    This is the bounded real lemma, x' = C x + Bw w and z = (C + D K) x with C and D of the claim. In discrete time V'
    is the difference V(x+) - V(x).
    """
    P, Bw, Z = data["P"], data["Bw"], data["C"] + data["D"] @ loop.K
    none, supply = np.zeros((P.shape[-1], Bw.shape[-1])), data["gamma"] * data["gamma"] * np.eye(Bw.shape[-1])
    yield Inequality((P,))
    if loop.discrete:
        # V(x+) = (C x + Bw w)' P (C x + Bw w): one product, so that its error is propagated once.
        F = block_matrix([[loop.C, Bw]])
        yield Inequality((block_matrix([[P - Z.mT @ Z, none], [none.T, supply]]), -(F.mT @ P @ F)), 0)
    else:
        cross = -(P @ Bw)
        yield Inequality((block_matrix([[-he(P @ loop.C) - Z.mT @ Z, cross], [cross.mT, supply]]),), 0)


def input_conditions(loop: ClosedLoop, data: Mapping[str, Exact]) -> Iterator[Inequality]:
    """Yield the conditions for |u_j| <= limit_j for ever from the hull of `points`.

    The points lie in {x' P x <= 1}, which no trajectory leaves. There (K_j x)^2 <= K_j P^-1 K_j' < limit_j^2, by [[P,
    K_j'], [K_j, limit_j^2]] > 0.
    """
    P, limit, points = data["P"], data["limit"], data["points"]
    yield Inequality((P,))
    yield Inequality(decrease_terms(loop, P, {}), 0)
    for x in (points[i : i + 1] for i in range(points.shape[0])):
        yield Inequality((1 - x @ P @ x.mT,), strict=False)
    for j in range(limit.shape[0]):
        row = loop.K[j : j + 1]
        yield Inequality((block_matrix([[P, row.mT], [row, limit[j] * limit[j] * np.eye(1)]]),))


def infeasibility_conditions(loop: ClosedLoop, data: Mapping[str, Exact]) -> Iterator[Inequality]:
    """Yield the conditions that no P > 0 has He(P (C_i + rate I)) <= 0 at all vertices.

    They are W_i >= 0 and S = sum_i He((C_i + rate I) W_i) > 0. Such a P gives the contradiction 0 >= sum_i tr(W_i He(P
    (C_i + rate I))) = tr(P S) > 0. In discrete time C_i' P C_i <= factor^2 P and S = sum_i (C_i W_i C_i' - factor^2
    W_i).
    """
    W, factor = data["W"], data.get("factor", 1)
    yield Inequality((W,), strict=False)
    S = he(loop.C @ W) + 2 * data.get("rate", 0) * W
    if loop.discrete:
        S = loop.C @ W @ loop.C.mT - factor * factor * W
    yield Inequality(tuple(S[i] for i in range(W.shape[0])), ALL_VERTICES)


def instability_conditions(loop: ClosedLoop, data: Mapping[str, Exact], vertex: int) -> Iterator[Inequality]:
    """Yield the conditions that the loop at one vertex falls slower than exp(-rate t), or `factor` a period.

    They are He(P C) + 2 rate P <= 0 and x'P x < 0. From x on, V = x'P x is at most V(0) exp(-2 rate t), so it stays
    negative, and |x| does not fall faster (Lyapunov's theorem of instability, for a rate of at most 0).
    """
    x = data["x"]
    row = block_matrix([[x[i : i + 1] * np.eye(1) for i in range(x.shape[0])]])
    yield Inequality((-(row @ data["P"] @ row.mT),))
    yield Inequality(decrease_terms(loop._replace(C=loop.C[vertex : vertex + 1]), data["P"], data), vertex, False)


def schedule_conditions(
    cells: list[tuple[Exact, Exact]], nodes: Exact, gain: Exact, data: Mapping[str, Exact]
) -> Iterator[Inequality]:
    """Yield the conditions for V = x' P(p) x with V' <= -2 rate V - x' (Q + K' R K) x.

    `cells` has A and B of the vertices. P and K are linear in the parameter p between nodes. In a cell,
    p = a + l (b - a). V' + ... is x' G(l) x with G quadratic in l, and affine in (A, B) and in p', which lies in
    `rates`.

    G(l) is (1-l)^2 G_aa + 2 l (1-l) G_ab + l^2 G_bb. Its Bernstein coefficients for a product X Y of linear functions
    are X_a Y_a, (X_a Y_b + X_b Y_a)/2 and X_b Y_b. The weights are not negative, so negative definite coefficients make
    G(l) < 0.

    Vertices and ends of `rates` suffice because G is affine in (A, B) and p'. Both may depend on l: in a cell they are
    anywhere in its hull. V is continuous, so its kinks at nodes do no harm. The inequality is stated as -(b - a) G > 0.
    """
    P, vertex = data["P"], 0
    yield Inequality((P,))
    for c, (A, B) in enumerate(cells):
        width = nodes[c + 1] - nodes[c]
        ends = [(P[i], A + B @ K, K) for i in (c, c + 1) for K in (gain[i] if len(gain.shape) == 3 else gain,)]
        for (Px, Cx, Kx), (Py, Cy, Ky) in (ends[:1] * 2, ends, ends[1:] * 2):
            terms = (-0.5 * width * he(Px @ Cy + Py @ Cx), -data.get("rate", 0) * width * (Px + Py))
            spent = (-width * data["Q"],) if "Q" in data else ()
            # Both orders: he() of one of them would hide that R is not symmetric.
            spent += (-0.5 * width * (Kx.mT @ data["R"] @ Ky + Ky.mT @ data["R"] @ Kx),) if "R" in data else ()
            for s in (data["rates"][0], data["rates"][1]):
                moved = (*terms, -s * (P[c + 1] - P[c]))
                yield Inequality(moved, vertex)
                if spent:
                    yield Inequality((*moved, *spent), vertex)
        vertex += A.shape[0]


CLAIM_CONDITIONS = {
    "decay": decay_conditions,
    "cost": cost_conditions,
    "damping": damping_conditions,
    "l2": l2_conditions,
    "input": input_conditions,
    "infeasible": infeasibility_conditions,
}


def conditions(kind: str, system: Polytope | Schedule, gain: Exact, data: Params, proof: bool) -> Iterator[Inequality]:
    """Yield the inequalities of a claim, with `proof` in exact numbers with errors of the vertices, else in floats."""
    check_claim(kind, system, gain, data)
    # The gain, P and the bounds are exact as stored; only the system's matrices come from a computation with rounding.
    exact, vertex = (as_dyadic, as_uncertain_dyadic) if proof else (np.asarray, np.asarray)
    lifted = {name: (vertex if name == "Bw" else exact)(value) for name, value in data.items()}
    K = exact(gain)
    if isinstance(system, Schedule):
        cells = [(vertex(cell.A), vertex(cell.B)) for cell in system.cells]
        return schedule_conditions(cells, exact(system.nodes), K, lifted)
    loop = ClosedLoop(K, vertex(system.A) + vertex(system.B) @ K, system.period is not None)
    if kind == "unstable":
        return instability_conditions(loop, lifted, int(data["vertex"]))
    return CLAIM_CONDITIONS[kind](loop, lifted)


def is_satisfied(inequality: Inequality) -> bool:
    """Return whether an inequality over Dyadic matrices holds, errors included; False without symmetry."""
    total = functools.reduce(operator.add, inequality.terms)
    k = total.shape[-1]
    matrices = total.ints.reshape(-1, k, k)
    if not (matrices == matrices.mT).all():
        return False
    if total.error is None or not (inequality.strict or np.any(total.error)):
        return all(is_positive_definite(matrix, inequality.strict) for matrix in matrices.tolist())
    errors = np.broadcast_to(total.error, total.shape).reshape(-1, k, k)
    return all(is_robustly_positive(matrix, error, total.bits) for matrix, error in zip(matrices, errors, strict=True))


def is_robustly_positive(matrix: np.ndarray, error: np.ndarray, bits: int) -> bool:
    """Return whether 2^-bits `matrix` - diag_i(sum_j error_ij s_i / s_j) > 0, with s_i a power of 2 near sqrt(M_ii).

    Both sides are multiplied by 1 / s and by a power of 2 that leaves integers. So rows of unlike size lose equally.
    The propagated bound of C' P C is not symmetric. The error itself is symmetric, so either of error_ij and error_ji
    bounds it. One unit of both integer matrices is 2^-bits.
    """
    # bit_length needs positive numbers, and no definite matrix has another diagonal.
    diagonal = np.diagonal(matrix)
    if (diagonal <= 0).any():
        return False
    sizes = [(int(entry).bit_length() - bits) // 2 for entry in diagonal]
    up = np.array([max(sizes) - size for size in sizes], object)
    shift = up[:, None] + up
    rows = np.left_shift(matrix, shift).tolist()
    for i, loss in enumerate(np.left_shift(error, shift).sum(axis=1)):
        rows[i][i] -= loss
    return is_positive_definite(rows)


def is_proved(kind: str, system: Polytope | Schedule, gain: Exact, data: Params) -> bool:
    """Return whether a claim is proved, exactly and rounded outward."""
    return all(map(is_satisfied, conditions(kind, system, gain, data, proof=True)))


def vertex_margins(kind: str, system: Polytope | Schedule, gain: Exact, data: Params) -> dict[int, float]:
    """Return for each vertex the smallest eigenvalue of a claim's inequality relative to its largest term, in floats.

    The margin of an inequality about all vertices together has the key ALL_VERTICES. Side conditions are left out.
    """
    margins: dict[int, float] = {}
    for each in conditions(kind, system, gain, data, proof=False):
        if each.vertex is None:
            continue
        total = functools.reduce(operator.add, each.terms)
        sizes = [np.abs(np.linalg.eigvalsh(term)).max(axis=-1) for term in each.terms]
        size = functools.reduce(np.maximum, sizes)
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = np.nan_to_num(np.linalg.eigvalsh(total)[..., 0] / size)
        for i, value in enumerate(np.atleast_1d(relative)):
            margins[each.vertex + i] = min(margins.get(each.vertex + i, np.inf), float(value))
    return margins
