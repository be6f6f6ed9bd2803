"""That two vertices alone have no common P, without a solver.

V = x' P x falls along x' = C x where it falls along x' = C^-1 x, so with a common P every M(k) = C_i + k D, k > 0, is
stable, for D = C_j and for D = C_j^-1. M(k) is singular where -k is an eigenvalue of C_i C_j (of C_i C_j^-1): with a
negative one there is no P, of order 2 with neither there is one (Shorten and Narendra 2002).

Beyond such a k, M(k) has modes x with growth s > 0, and V_i = sum x x*, V_j = sum k x x* over some k are multipliers:

    He(C_i V_i) + He(D V_j) = sum 2 s x x* > 0        W_i = V_i, W_j = V_j or, for D = C_j^-1, D V_j D'

In discrete time V falls by factor^2 along C where it falls along (C - factor I)(C + factor I)^-1 in continuous time.
"""

import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from diffabs.design.sdp.solver import he

MAX_PAIRED_VERTICES = 64  # vertices of which every pair is looked at
RANGE_EXTENSION = 1e3  # how far past the last change of sign
MAX_PAIRS = 8  # pairs, those first whose M(k) is unstable for the widest range of k
RANGE_POINTS = 16  # of a range of k
OTHERS_SHARE = 1e-3  # of the multipliers' strength that the other vertices may take


class Pair(NamedTuple):
    """Vertices i and j, whether j counts by its inverse, and the range of k in which M(k) is unstable."""

    i: int
    j: int
    inverse: bool
    low: float
    high: float


def witnesses(closed: np.ndarray, factor: float | None = None) -> Iterator[np.ndarray]:
    """Multipliers W (V, n, n) of the closed loops (V, n, n), each of which may be a proof, `infeasible` of
    `certificate`; nothing where no pair refutes. `factor` is that of discrete time; a rate is added to C before.

    In floats: whether they prove anything is for `exact` to say. More than LARGEST vertices are not looked at.
    """
    one = np.eye(closed.shape[-1])
    flows = closed
    if len(closed) > MAX_PAIRED_VERTICES:
        return
    try:
        back = one if factor is None else np.linalg.inv(closed + factor * one)
        flows = closed if factor is None else (closed - factor * one) @ back
        inverses = np.linalg.inv(flows)
    except np.linalg.LinAlgError:
        return
    for pair in sorted(unstable_pairs(flows, inverses), key=lambda pair: pair.low / pair.high)[:MAX_PAIRS]:
        W = back @ multipliers(pair, flows, inverses) @ np.swapaxes(np.broadcast_to(back, flows.shape), 1, 2)
        W = (W + np.swapaxes(W, 1, 2)) / 2
        if np.isfinite(W).all() and W.any():
            yield W / np.abs(W).max()


def unstable_pairs(flows: np.ndarray, inverses: np.ndarray) -> Iterator[Pair]:
    """The ranges of k between sign changes of det M(k), or up to BEYOND times the last, where M(k) is not stable."""
    sign = (-1.0) ** flows.shape[-1]  # of the determinant of a stable matrix
    for inverse, others, products in ((False, flows, inverses), (True, inverses, flows)):
        for i, j in itertools.combinations(range(len(flows)), 2):
            for low, high in itertools.pairwise(singular_factors(flows[i] @ products[j])):
                middle = flows[i] + math.sqrt(low * high) * others[j]
                if high > low and sign * np.linalg.slogdet(middle)[0] < 0:
                    yield Pair(i, j, inverse, low, high)


def singular_factors(product: np.ndarray) -> list[float]:
    """Every k > 0 for which -k is an eigenvalue, in order, and one far below and above them."""
    modes = np.linalg.eigvals(product)
    k = np.sort(-np.real(modes[(np.real(modes) < 0) & (np.abs(np.imag(modes)) <= 1e-12 * np.abs(modes))]))
    return [float(k[0]) / RANGE_EXTENSION, *map(float, k), float(k[-1]) * RANGE_EXTENSION] if len(k) else []


def multipliers(pair: Pair, flows: np.ndarray, inverses: np.ndarray) -> np.ndarray:
    """W (V, n, n), of i and j as above, of the others as much of their sum as the inequality can bear; 0 if none."""
    C, D = flows[pair.i], (inverses if pair.inverse else flows)[pair.j]
    k = pair.low * (pair.high / pair.low) ** ((np.arange(RANGE_POINTS) + 0.5) / RANGE_POINTS)
    modes, vectors = np.linalg.eig(C + k[:, None, None] * D)
    growing = np.where(np.real(modes) > 0, 1.0, 0.0)
    each = np.real(np.einsum("kim,km,kjm->kij", vectors, growing, vectors.conj()))
    both, second = each.sum(axis=0), np.tensordot(k, each, 1)
    W = np.zeros(flows.shape)
    W[pair.i], W[pair.j] = both, D @ second @ D.T if pair.inverse else second
    others, total = np.setdiff1d(np.arange(len(flows)), (pair.i, pair.j)), W.sum(axis=0)
    W[others] = (
        OTHERS_SHARE
        / max(1.0, least_dominating_factor(he(flows @ W).sum(axis=0), he(flows[others] @ total).sum(axis=0)))
        * total
    )
    return W


def least_dominating_factor(strength: np.ndarray, taken: np.ndarray) -> float:
    """The least c for which c times a positive definite matrix and another are not negative; inf if it is not."""
    try:
        root = np.linalg.inv(np.linalg.cholesky(strength))
    except np.linalg.LinAlgError:
        return np.inf
    return -float(np.linalg.eigvalsh(root @ taken @ root.T)[0])
