"""Multipliers from two vertices that exclude a common P, without a solver.

V = x'P x falls along x' = C x exactly if it falls along x' = C^-1 x. With a common P every M(k) = C_i + k D, k > 0, is
therefore stable, for D = C_j and for D = C_j^-1. M(k) is singular where -k is an eigenvalue of C_i C_j (for D = C_j^-1)
or of C_i C_j^-1 (for D = C_j). If one of these products has a negative eigenvalue, no P exists. For order 2 a P exists
if neither product has a negative eigenvalue (Shorten and Narendra 2002).

Beyond such a k, M(k) has modes x with growth s > 0. Sums over some k give multipliers V_i = sum x x* and V_j = sum k x
x*:

    He(C_i V_i) + He(D V_j) = sum 2 s x x* > 0        W_i = V_i, W_j = V_j or, for D = C_j^-1, D V_j D'

In discrete time V falls by factor^2 along C exactly if it falls along (C - factor I)(C + factor I)^-1 in continuous
time.
"""

import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from diffabs.robust.design.proof.exact import he

MAX_PAIRED_VERTICES = 64  # no pairs are tried above this number of vertices
RANGE_EXTENSION = 1e3  # factor by which a range extends beyond the last change of sign
MAX_PAIRS = 8  # pairs to try, in decreasing order of the width of their range of k
RANGE_POINTS = 16  # points in a range of k
OTHERS_SHARE = 1e-3  # largest share of W_i + W_j for each of the other vertices


class Pair(NamedTuple):
    """Vertices i and j, whether D is the inverse of C_j, and the range (low, high) of k with an unstable M(k)."""

    i: int
    j: int
    inverse: bool
    low: float
    high: float


def witnesses(closed: np.ndarray, factor: float | None = None) -> Iterator[np.ndarray]:
    """Yield candidate multipliers W, shape (vertices, n, n), for a proof that no common P exists.

    They are floating point: `design.proof.exact` decides whether they prove anything. There are at most MAX_PAIRS of
    them, and none if no pair excludes a common P, or above MAX_PAIRED_VERTICES vertices.

    Args:
        closed: Closed loops C, shape (vertices, n, n); in continuous time with the rate already added to the diagonal.
        factor: Factor of the decay per step in discrete time; None for continuous time.
    """
    identity = np.eye(closed.shape[-1])
    flows = closed
    if len(closed) > MAX_PAIRED_VERTICES:
        return
    try:
        # The Cayley transform maps discrete time to continuous time; W of the transformed loops returns as back W
        # back'.
        back = identity if factor is None else np.linalg.inv(closed + factor * identity)
        flows = closed if factor is None else (closed - factor * identity) @ back
        inverses = np.linalg.inv(flows)
    except np.linalg.LinAlgError:
        return
    # Widest range of k first: its M(k) are furthest from stable ones.
    for pair in sorted(unstable_pairs(flows, inverses), key=lambda pair: pair.low / pair.high)[:MAX_PAIRS]:
        W = back @ multipliers(pair, flows, inverses) @ np.swapaxes(np.broadcast_to(back, flows.shape), 1, 2)
        W = (W + np.swapaxes(W, 1, 2)) / 2
        if np.isfinite(W).all() and W.any():
            yield W / np.abs(W).max()


def unstable_pairs(flows: np.ndarray, inverses: np.ndarray) -> Iterator[Pair]:
    """Yield the ranges of k on which the determinant proves M(k) unstable, for every pair of vertices.

    A range lies between two neighbouring values of `singular_factors`.
    """
    sign = (-1.0) ** flows.shape[-1]  # of the determinant of a stable matrix
    for inverse, partners, products in ((False, flows, inverses), (True, inverses, flows)):
        for i, j in itertools.combinations(range(len(flows)), 2):
            for low, high in itertools.pairwise(singular_factors(flows[i] @ products[j])):
                # det M(k) keeps its sign between two singular k, so one point, the geometric mean, decides for the
                # whole range.
                middle = flows[i] + math.sqrt(low * high) * partners[j]
                if high > low and sign * np.linalg.slogdet(middle)[0] < 0:
                    yield Pair(i, j, inverse, low, high)


def singular_factors(product: np.ndarray) -> list[float]:
    """Return the ends of the ranges of k, increasing: every k > 0 for which -k is an eigenvalue of `product`.

    The list also has one value a factor of 1000 below the smallest and one as far above the largest. It is empty
    without such an eigenvalue.
    """
    modes = np.linalg.eigvals(product)
    k = np.sort(-np.real(modes[(np.real(modes) < 0) & (np.abs(np.imag(modes)) <= 1e-12 * np.abs(modes))]))
    return [float(k[0]) / RANGE_EXTENSION, *map(float, k), float(k[-1]) * RANGE_EXTENSION] if len(k) else []


def multipliers(pair: Pair, flows: np.ndarray, inverses: np.ndarray) -> np.ndarray:
    """Return the multipliers W of a pair, shape (vertices, n, n).

    Each other vertex gets the share OTHERS_SHARE of W_i + W_j, or as much of it as the inequality bears.
    """
    C, D = flows[pair.i], (inverses if pair.inverse else flows)[pair.j]
    k = pair.low * (pair.high / pair.low) ** ((np.arange(RANGE_POINTS) + 0.5) / RANGE_POINTS)
    modes, vectors = np.linalg.eig(C + k[:, None, None] * D)
    # A mode with growth s adds 2 s x x* to the sum. Decaying modes would subtract from it.
    growing = np.where(np.real(modes) > 0, 1.0, 0.0)
    each = np.real(np.einsum("kim,km,kjm->kij", vectors, growing, vectors.conj()))
    both, second = each.sum(axis=0), np.tensordot(k, each, 1)
    W = np.zeros(flows.shape)
    W[pair.i], W[pair.j] = both, D @ second @ D.T if pair.inverse else second
    # The factor keeps the sum over the vertices positive definite; inf makes the share of the unpaired 0.
    unpaired, total = np.setdiff1d(np.arange(len(flows)), (pair.i, pair.j)), W.sum(axis=0)
    W[unpaired] = (
        OTHERS_SHARE
        / max(1.0, least_dominating_factor(he(flows @ W).sum(axis=0), he(flows[unpaired] @ total).sum(axis=0)))
        * total
    )
    return W


def least_dominating_factor(strength: np.ndarray, deficit: np.ndarray) -> float:
    """Return the smallest c for which c strength + deficit >= 0; inf if `strength` is not positive definite."""
    try:
        root = np.linalg.inv(np.linalg.cholesky(strength))
    except np.linalg.LinAlgError:
        return np.inf
    return -float(np.linalg.eigvalsh(root @ deficit @ root.T)[0])
