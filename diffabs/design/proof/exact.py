"""Proofs of matrix inequalities about the stated numbers, without rounding.

Each kind of claim is written once, over matrices that are either float arrays (how much is left: `margins`) or exact,
`Dyadic` (is it true: `verify`).

Rounded outward: entries of A, B and Bw may be off by a relative RHO = 2^-40, which covers the rounding in computing
them from a model. Sums and products carry the error along: of A + B K at most RHO (|A| + |B| |K|) = RHO Abar, of P C
at most RHO |P| Abar. If M may so change by a symmetric D with |D| <= E entrywise, it stays positive definite if
M - diag_i(sum_j E_ij s_i / s_j) > 0 for some s > 0, since 2 |x_i x_j| <= (s_i/s_j) x_i^2 + (s_j/s_i) x_j^2.

He(M) = M + M', C = A + B K.
"""

import functools
import operator
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from diffabs.design.polytopes import Polytope, Schedule
from diffabs.design.proof.dyadic import Dyadic, Matrix, as_dyadic, as_uncertain_dyadic, is_positive_definite
from diffabs.design.proof.schema import check_claim


class Inequality(NamedTuple):
    """sum(terms) > 0 (>= 0 where not `strict`), all of (..., k, k).

    `vertex` is the number of the first vertex where there is one for each vertex, ALL where it is about them together,
    None for a side condition such as P > 0.
    """

    terms: tuple[Matrix, ...]
    vertex: int | None = None
    strict: bool = True


ALL_VERTICES = -1


class ClosedLoop(NamedTuple):
    """Gain and C of the vertices, as floats or Dyadic."""

    K: Matrix
    C: Matrix
    discrete: bool


def he(M: Matrix) -> Matrix:
    """M + M'."""
    return M + M.mT


def block_matrix(rows: list[list[Matrix]]) -> Matrix:
    """The matrices put together; those without leading axes are the same for every vertex."""
    flat = [each for row in rows for each in row]
    lead = np.broadcast_shapes(*(each.shape[:-2] for each in flat))

    def joined(get: Callable[[Matrix], Any]) -> Any:
        return np.block([[np.broadcast_to(get(each), (*lead, *each.shape[-2:])) for each in row] for row in rows])

    if not isinstance(flat[0], Dyadic):
        return joined(np.asarray)
    rows = [[as_dyadic(each) for each in row] for row in rows]
    bits = max(each.bits for row in rows for each in row)
    rows = [[each.at(bits) for each in row] for row in rows]
    return Dyadic(
        joined(lambda each: each.ints), bits, joined(lambda each: 0 * each.ints if each.error is None else each.error)
    )


def decrease_terms(loop: ClosedLoop, P: Matrix, data: Mapping[str, Matrix]) -> tuple[Matrix, ...]:
    """Terms of -He(P C) - 2 rate P, in discrete time of factor^2 P - C' P C."""
    if loop.discrete:
        factor = data.get("factor", 1)
        return factor * factor * P, -(loop.C.mT @ P @ loop.C)
    return -he(P @ loop.C), -2 * data.get("rate", 0) * P


def decay_conditions(loop: ClosedLoop, data: Mapping[str, Matrix]) -> Iterator[Inequality]:
    """V = x' P x falls at least like exp(-2 rate t), in discrete time by factor^2 a period."""
    yield Inequality((data["P"],))
    yield Inequality(decrease_terms(loop, data["P"], data), 0)


def cost_conditions(loop: ClosedLoop, data: Mapping[str, Matrix]) -> Iterator[Inequality]:
    """V' <= -x' (Q + K' R K) x: the integral (sum) of the right side from x0 is at most x0' P x0.

    V falls without Q and R too, so that V -> 0 and the bound need no sign of Q, which may have been rounded.
    """
    terms = decrease_terms(loop, data["P"], {})
    yield Inequality((data["P"],))
    yield Inequality(terms)
    yield Inequality((*terms, -data["Q"], -(loop.K.mT @ data["R"] @ loop.K)), 0)


def damping_conditions(loop: ClosedLoop, data: Mapping[str, Matrix]) -> Iterator[Inequality]:
    """With M = P C, -[[He(M), cot (M - M')], [cot (M' - M), He(M)]] > 0, cot >= zeta / sqrt(1 - zeta^2).

    Eigenvalues of every fixed system of the hull then lie in |Im| < |Re| / cot, left of 0 (Chilali and Gahinet 1996).
    """
    M, cot, zeta = data["P"] @ loop.C, data["cot"], data["zeta"]
    skew = cot * (M - M.mT)
    yield Inequality((data["P"],))
    yield Inequality(((cot * cot * (1 - zeta * zeta) - zeta * zeta) * np.eye(1),), strict=False)
    yield Inequality((-block_matrix([[he(M), skew], [skew.mT, he(M)]]),), 0)


def l2_conditions(loop: ClosedLoop, data: Mapping[str, Matrix]) -> Iterator[Inequality]:
    """V' + |z|^2 - gamma^2 |w|^2 < 0 with x' = C x + Bw w, z = (C + D K) x: the gain from w to z is below gamma.

    Bounded real lemma; in discrete time V' is the difference V(x+) - V(x).
    """
    P, Bw, Z = data["P"], data["Bw"], data["C"] + data["D"] @ loop.K
    none, supply = np.zeros((P.shape[-1], Bw.shape[-1])), data["gamma"] * data["gamma"] * np.eye(Bw.shape[-1])
    yield Inequality((P,))
    if loop.discrete:
        F = block_matrix([[loop.C, Bw]])
        yield Inequality((block_matrix([[P - Z.mT @ Z, none], [none.T, supply]]), -(F.mT @ P @ F)), 0)
    else:
        cross = -(P @ Bw)
        yield Inequality((block_matrix([[-he(P @ loop.C) - Z.mT @ Z, cross], [cross.mT, supply]]),), 0)


def input_conditions(loop: ClosedLoop, data: Mapping[str, Matrix]) -> Iterator[Inequality]:
    """|u_j| <= limit_j for ever from the hull of `points`: they lie in {x' P x <= 1}, which no x leaves, and there
    (K_j x)^2 <= K_j P^-1 K_j' < limit_j^2, by [[P, K_j'], [K_j, limit_j^2]] > 0."""
    P, limit, points = data["P"], data["limit"], data["points"]
    yield Inequality((P,))
    yield Inequality(decrease_terms(loop, P, {}), 0)
    for x in (points[i : i + 1] for i in range(points.shape[0])):
        yield Inequality((1 - x @ P @ x.mT,), strict=False)
    for j in range(limit.shape[0]):
        row = loop.K[j : j + 1]
        yield Inequality((block_matrix([[P, row.mT], [row, limit[j] * limit[j] * np.eye(1)]]),))


def infeasibility_conditions(loop: ClosedLoop, data: Mapping[str, Matrix]) -> Iterator[Inequality]:
    """No P > 0 has He(P (C_i + rate I)) <= 0 at all vertices: W_i >= 0 and S = sum_i He((C_i + rate I) W_i) > 0.

    Such a P would give 0 >= sum_i tr(W_i He(P (C_i + rate I))) = tr(P S) > 0. In discrete time C_i' P C_i <= factor^2 P
    and S = sum_i (C_i W_i C_i' - factor^2 W_i).
    """
    W, factor = data["W"], data.get("factor", 1)
    yield Inequality((W,), strict=False)
    S = he(loop.C @ W) + 2 * data.get("rate", 0) * W
    if loop.discrete:
        S = loop.C @ W @ loop.C.mT - factor * factor * W
    yield Inequality(tuple(S[i] for i in range(W.shape[0])), ALL_VERTICES)


def schedule_conditions(
    cells: list[tuple[Matrix, Matrix]], nodes: Matrix, gain: Matrix, data: Mapping[str, Matrix]
) -> Iterator[Inequality]:
    """V = x' P(p) x with V' <= -2 rate V - x' (Q + K' R K) x, P and K linear in the parameter p between nodes.

    In a cell, p = a + l (b - a), V' + ... is x' G(l) x with G quadratic in l, affine in (A, B) and in p' in `rates`.
    G(l) is (1-l)^2 G_aa + 2 l (1-l) G_ab + l^2 G_bb with Bernstein coefficients that for a product X Y of linear
    functions are X_a Y_a, (X_a Y_b + X_b Y_a)/2 and X_b Y_b; the weights are not negative, so coefficients < 0 make
    G(l) < 0. Vertices and ends of `rates` suffice because G is affine in (A, B) and p', which may depend on l: in a
    cell they are anywhere in its hull. V is continuous, so its kinks at nodes do no harm. Shown is -(b - a) G > 0.
    """
    P, vertex = data["P"], 0
    yield Inequality((P,))
    for c, (A, B) in enumerate(cells):
        width = nodes[c + 1] - nodes[c]
        ends = [(P[i], A + B @ K, K) for i in (c, c + 1) for K in (gain[i] if len(gain.shape) == 3 else gain,)]
        for (Px, Cx, Kx), (Py, Cy, Ky) in (ends[:1] * 2, ends, ends[1:] * 2):
            terms = (-0.5 * width * he(Px @ Cy + Py @ Cx), -data.get("rate", 0) * width * (Px + Py))
            spent = (-width * data["Q"],) if "Q" in data else ()
            spent += (-0.5 * width * he(Kx.mT @ data["R"] @ Ky),) if "R" in data else ()
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
# a letter for each axis: n states, m inputs, V vertices, N nodes, others free; "?" need not be there


def conditions(
    kind: str, system: Polytope | Schedule, gain: Any, data: Mapping[str, Any], proof: bool
) -> Iterator[Inequality]:
    """What a claim of `kind` says, for `proof` in exact numbers. Raises ValueError for data that do not fit."""
    check_claim(kind, system, gain, data)
    known, vertex = (as_dyadic, as_uncertain_dyadic) if proof else (np.asarray, np.asarray)
    lifted = {name: (vertex if name == "Bw" else known)(value) for name, value in data.items()}
    K = known(gain)
    if isinstance(system, Schedule):
        cells = [(vertex(cell.A), vertex(cell.B)) for cell in system.cells]
        return schedule_conditions(cells, known(system.nodes), K, lifted)
    return CLAIM_CONDITIONS[kind](
        ClosedLoop(K, vertex(system.A) + vertex(system.B) @ K, system.period is not None), lifted
    )


def is_satisfied(inequality: Inequality) -> bool:
    """Whether an inequality over Dyadic matrices holds, errors included. Matrices that are not symmetric do not."""
    total = functools.reduce(operator.add, inequality.terms)
    k = total.shape[-1]
    matrices = total.ints.reshape(-1, k, k)
    if not (matrices == matrices.mT).all():
        return False
    if total.error is None:
        return all(is_positive_definite(matrix, inequality.strict) for matrix in matrices.tolist())
    errors = np.broadcast_to(total.error, total.shape).reshape(-1, k, k)
    return all(is_robustly_positive(matrix, error, total.bits) for matrix, error in zip(matrices, errors, strict=True))


def is_robustly_positive(matrix: np.ndarray, error: np.ndarray, bits: int) -> bool:
    """Whether integers 2^-bits `matrix` - diag_i(sum_j error_ij s_i / s_j) > 0, s_i a power of 2 near sqrt(M_ii).

    Multiplied from both sides by 1 / s, times a power of 2 that leaves integers: rows of unlike size lose alike. The
    bound carried for C' P C is not symmetric; the error is, so that either of error_ij and error_ji bounds it.
    """
    diagonal = np.diagonal(matrix)
    if (diagonal <= 0).any():
        return False
    sizes = [(int(entry).bit_length() - bits) // 2 for entry in diagonal]
    up = np.array([max(sizes) - size for size in sizes], object)
    shift = up[:, None] + up
    rows = np.left_shift(matrix, shift).tolist()
    for i, taken in enumerate(np.left_shift(error, shift).sum(axis=1)):
        rows[i][i] -= taken
    return is_positive_definite(rows)


def is_proved(kind: str, system: Polytope | Schedule, gain: Any, data: Mapping[str, Any]) -> bool:
    """Whether a claim is proved, exactly and rounded outward. Raises ValueError for data that do not fit (`SHAPES`)."""
    return all(map(is_satisfied, conditions(kind, system, gain, data, proof=True)))


def vertex_margins(kind: str, system: Polytope | Schedule, gain: Any, data: Mapping[str, Any]) -> dict[int, float]:
    """For each vertex the least eigenvalue of a claim's inequality relative to the largest of its terms, in floats.

    One under ALL where the inequality is about all vertices together. Side conditions are left out.
    """
    left: dict[int, float] = {}
    for each in conditions(kind, system, gain, data, proof=False):
        if each.vertex is None:
            continue
        total = functools.reduce(operator.add, each.terms)
        sizes = [np.abs(np.linalg.eigvalsh(term)).max(axis=-1) for term in each.terms]
        size = functools.reduce(np.maximum, sizes)
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = np.nan_to_num(np.linalg.eigvalsh(total)[..., 0] / size)
        for i, value in enumerate(np.atleast_1d(relative)):
            left[each.vertex + i] = min(left.get(each.vertex + i, np.inf), float(value))
    return left
