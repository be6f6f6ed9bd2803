"""Witnesses that a single system x' = A x, or x+ = A x, is not stable.

    He(P A) < 2 growth P,  x'P x < 0        in discrete time A'P A < factor^2 P

The growth lies between the real parts of two modes, so A - growth I has no mode on the imaginary axis. The Lyapunov
equation of this matrix then has a solution P. It has as many negative eigenvalues as modes grow faster.

On the boundary, a sum w'x of states that stays constant gives P = -w w', with V' = 0.
"""

import itertools
import warnings
from collections.abc import Iterator

import numpy as np

BOUNDARY_TOLERANCE = 1e-9  # of the largest singular value of A: below it a sum of states may be constant


def growing_modes(a: np.ndarray, *, discrete: bool) -> Iterator[dict[str, float | np.ndarray]]:
    """Yield data of unproved claims `unstable` of A (n, n): modes that grow or stay, the most promising first."""
    from scipy.linalg import matrix_balance, solve_continuous_lyapunov, solve_discrete_lyapunov

    balanced, (units, _) = matrix_balance(a, permute=False, separate=True)
    modes = np.linalg.eigvals(balanced)
    rates = np.log(np.maximum(np.abs(modes), np.finfo(float).tiny)) if discrete else modes.real
    ends = np.unique(rates)
    gaps = itertools.pairwise([2 * ends[0] - ends[-1] - 1, *ends])
    between = [(max(0.0, (low + high) / 2), low, high) for low, high in gaps]
    choices = [(min(growth - low, high - growth), growth) for growth, low, high in between if growth < high]
    for _, growth in sorted(choices, reverse=True):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # of a solution near a pair of opposite eigenvalues
                if discrete:
                    p = solve_discrete_lyapunov((balanced * np.exp(-growth)).T, np.eye(len(a)))
                else:
                    p = solve_continuous_lyapunov((balanced - growth * np.eye(len(a))).T, -np.eye(len(a)))
        except np.linalg.LinAlgError:
            continue
        p = (p + p.T) / 2
        if not np.isfinite(p).all():
            continue
        values, vectors = np.linalg.eigh(p)
        rate = {"factor": float(np.exp(growth))} if discrete else {"rate": -float(growth)}
        yield {"P": p / np.abs(values).max() / units / units[:, None], "x": units * vectors[:, 0], **rate}
    if not discrete:
        _, sizes, vectors = np.linalg.svd(balanced.T)
        if sizes[-1] <= BOUNDARY_TOLERANCE * sizes[0]:
            w = vectors[-1] / units
            w /= np.abs(w).max()
            yield {"P": -np.outer(w, w), "x": w, "rate": 0.0}
