"""Minimise the greatest of some smooth functions, many problems at once: a bundle method with exact curvature.

The model of a problem around x is the greatest of linear cuts plus a quadratic term:

    minimise over d   max_i (c_i + g_i d) + d'|H|d/2 + rho/(1 + |x|^2) d'd/2

The cuts are the functions themselves, and those of the last trials that did not descend. So a trial that finds a
function which the model does not know, or a kink of one, mends the model. H is the sum of the Hessians, weighted by the
multipliers of the cuts, with the absolute values of its eigenvalues. rho grows where the model fails. C. Lemarechal,
"Nonsmooth optimization and descent methods" (1978); K. C. Kiwiel, "Methods of Descent for Nondifferentiable
Optimization" (1985).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

SHARE = 0.1  # of the decrease that the model predicts, which a step must reach
MEMORY = 2  # trials whose cuts are kept
RHO = (1e-8, 1.0, 1e12)  # least, first, and one at which a search ends
INTERIOR_STEPS = 30
LEAST_GAP = 1e-15  # of complementarity, where the largest coefficient is 1


class Functions(NamedTuple):
    """Functions at some places; those of -inf do not count, and a place with one of +inf or NaN is no valid one.

    Attributes:
        values: Values (k, m).
        slopes: Gradients (k, m, n).
        bends: Hessians (k, m, n, n).
    """

    values: np.ndarray
    slopes: np.ndarray
    bends: np.ndarray


class Minimum(NamedTuple):
    """Ends of the searches.

    Attributes:
        x: Places (count, n).
        values: Greatest function there (count,).
        evaluations: Evaluations of each problem (count,).
    """

    x: np.ndarray
    values: np.ndarray
    evaluations: np.ndarray


def minimise_greatest(
    expand: Callable[[np.ndarray, np.ndarray], Functions],
    start: np.ndarray,
    rounds: int,
    tolerance: float = -np.inf,
    goal: float = -np.inf,
) -> Minimum:
    """Return minima of the greatest function of each problem.

    Args:
        expand: Maps places (k, n) and the indices of their problems (k,) to the functions.
        start: Valid places (count, n).
        rounds: Most evaluations of a problem.
        tolerance: Predicted decrease that ends a search.
        goal: Value that ends a search.
    """
    count = len(start)
    x, everything = start.copy(), np.arange(count)
    now = expand(x, everything)
    m = now.values.shape[1]
    best, evaluations, rho = now.values.max(axis=1), np.ones(count, int), np.full(count, RHO[1])
    old = Functions(*(np.concatenate([part] * MEMORY, axis=1) for part in now))
    old.values[:] = -np.inf
    active = np.isfinite(best) & (best > goal)
    while active.any() and evaluations.max() < rounds:
        at = np.flatnonzero(active)
        cuts = np.concatenate([now.values[at] - best[at, None], old.values[at]], axis=1)
        normals, bends = (np.concatenate([a[at], b[at]], axis=1) for a, b in zip(now[1:], old[1:], strict=True))
        anchor = (rho[at] / (1 + np.sum(x[at] ** 2, axis=1)))[:, None, None] * np.eye(x.shape[1])
        # The Hessian of the greatest function gives the first multipliers.
        weights = solve_models(cuts, normals, _positive(1.0 * (cuts == 0), bends) + anchor)[1]
        step, _, decrease = solve_models(cuts, normals, _positive(weights, bends) + anchor)
        ended = (decrease < tolerance) | (rho[at] > RHO[2])
        active[at[ended]] = False
        at, step, decrease = at[~ended], step[~ended], decrease[~ended]
        if not at.size:
            break
        trial = expand(x[at] + step, at)
        evaluations[at] += 1
        top = trial.values.max(axis=1)
        for j, i in enumerate(at):
            if top[j] <= best[i] - SHARE * decrease[j]:
                agrees = top[j] <= best[i] - 0.5 * decrease[j]
                x[i] += step[j]
                best[i], rho[i] = top[j], max(RHO[0], rho[i] / (10 if agrees else 2))
                for part, new in zip(now, trial, strict=True):
                    part[i] = new[j]
                old.values[i] = -np.inf
            elif np.isfinite(top[j]):
                cut = np.minimum(trial.values[j] - best[i] - trial.slopes[j] @ step[j], 0.0)
                for part, new in zip(old, (cut, trial.slopes[j], trial.bends[j]), strict=True):
                    part[i] = np.roll(part[i], m, axis=0)
                    part[i, :m] = new
                rho[i] *= 4
            else:
                rho[i] *= 10
        active[at] &= best[at] > goal
    return Minimum(x, best, evaluations)


def _positive(weights: np.ndarray, bends: np.ndarray) -> np.ndarray:
    """Return the weighted sums of the Hessians with the absolute values of their eigenvalues."""
    curvatures, axes = np.linalg.eigh(np.einsum("km,kmij->kij", weights, bends))
    return np.einsum("kij,kj,klj->kil", axes, np.abs(curvatures), axes)


def solve_models(
    cuts: np.ndarray, normals: np.ndarray, metric: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return minimisers (k, n), multipliers (k, m) and predicted decreases (k,) of models with cuts at most 0.

    The dual problem has the multipliers w on a simplex: minimise w'Q w/2 - c'w, Q = g metric^-1 g'. It is solved by an
    interior-point method.
    """
    moves = np.linalg.solve(metric, np.swapaxes(normals, 1, 2))  # (k, n, m)
    q = normals @ moves
    counts = np.isfinite(cuts)
    q = np.where(counts[:, :, None] & counts[:, None, :], q, 0.0)
    lowest = np.min(np.where(counts, cuts, 0.0), axis=1) - np.max(np.abs(q), axis=(1, 2)) - 1e-12
    c = np.where(counts, cuts, 2 * lowest[:, None])
    scale = np.maximum(np.abs(lowest), np.max(np.abs(q), axis=(1, 2)))
    q, c = q / scale[:, None, None], c / scale[:, None]
    k, m = c.shape
    w, ones = np.full((k, m), 1.0 / m), np.ones((k, m, 1))
    residual = (q @ w[:, :, None])[:, :, 0] - c
    shift = 0.1 - residual.min(axis=1)
    s = residual + shift[:, None]
    for _ in range(INTERIOR_STEPS):
        gap = np.maximum(0.1 * np.mean(w * s, axis=1, keepdims=True), LEAST_GAP)
        dual = (q @ w[:, :, None])[:, :, 0] - c + shift[:, None] - s
        right = -dual + gap / w - s
        matrix = q + (s / w)[:, :, None] * np.eye(m)
        both = np.linalg.solve(matrix, np.concatenate([right[:, :, None], ones], axis=2))
        d_shift = (both[:, :, 0].sum(axis=1) + w.sum(axis=1) - 1) / both[:, :, 1].sum(axis=1)
        dw = both[:, :, 0] - d_shift[:, None] * both[:, :, 1]
        ds = gap / w - s - s / w * dw
        room = np.minimum(_longest(w, dw), _longest(s, ds))
        w, s, shift = w + room[:, None] * dw, s + room[:, None] * ds, shift + room * d_shift
    w = np.where(counts, w, 0.0)
    w = w / w.sum(axis=1, keepdims=True)
    step = -(moves @ w[:, :, None])[:, :, 0]
    model = np.where(counts, cuts + (normals @ step[:, :, None])[:, :, 0], -np.inf).max(axis=1)
    return step, w, -model


def _longest(values: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """Return the share of the moves (k, m) that keeps positive values (k, m) positive, at most 1."""
    limits = np.where(moves < 0, -values / np.where(moves < 0, moves, -1.0), np.inf)
    return np.minimum(1.0, 0.99 * limits.min(axis=1))
