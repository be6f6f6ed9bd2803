"""Which modes of x' = A x + B u, or of x+ = A x + B u, no input moves, in any units of states, inputs and time.

A mode s is unmoved where (A - s I, B) has a rank below n (test of Popov, Belevitch and Hautus). Units do not change the
rank, but they change its numerical value: a pressure in Pa beside a length in m hides a link. So the matrix is scaled.

1. States that no input reaches through nonzero entries are taken apart: their modes are unmoved.
2. Each strongly connected group of states has its own eigenvalues, from its own balanced matrix.
3. Rows and columns of (|A| + |s| I, |B|) are scaled so that the entries of largest product, one in each row and in
   different columns, become 1, and no entry is larger (Duff and Koster, On algorithms for permuting large entries to
   the diagonal of a sparse matrix, SIAM J. Matrix Anal. Appl. 22, 2001). |s| stays in the sum, since a difference
   A - s I that is rounding must not be scaled up.
4. Where several such scalings exist, the one nearest to the response of each state to the inputs is taken. It follows
   the units of the states.
"""

from collections.abc import Iterator

import numpy as np

from diffabs.core.numerics import spectral_bound
from diffabs.core.types import AnyArray

# The input moves a mode s if the smallest singular value of the scaled (A - s I, B) exceeds this.
PBH_TOLERANCE = 1e-10
EIGENVALUE_ROUNDING = 8 * np.finfo(float).eps  # error of an eigenvalue over n, the norm, and its condition number


def unstabilisable_mode(A: AnyArray, B: AnyArray, *, discrete: bool = False) -> complex | None:
    """Return an eigenvalue of A that is not stable and that the input cannot move, or None.

    Eigenvalues on the stability boundary, but for rounding, count as not stable.
    """
    a, b = np.asarray(A, float), np.asarray(B, float)
    reached = (b != 0).any(axis=1)
    for _ in a:
        reached |= (a[:, reached] != 0).any(axis=1)
    unreached = ~reached
    for mode, error in _modes(a[np.ix_(unreached, unreached)]):
        if _is_unstable(mode, error, discrete=discrete):
            return _as_number(mode)
    a, b = a[np.ix_(reached, reached)], b[reached]
    for mode, error in _modes(a):
        if _is_unstable(mode, error, discrete=discrete) and not _moves(a, b, mode):
            return _as_number(mode)
    return None


def _as_number(mode: complex) -> complex:
    return complex(mode) if abs(np.imag(mode)) > 0 else float(np.real(mode))


def _is_unstable(mode: complex, error: float, *, discrete: bool) -> bool:
    return abs(mode) >= 1 - error if discrete else np.real(mode) >= -error


def _groups(a: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield each strongly connected group of states as a mask (n,), with its balanced matrix."""
    from scipy.linalg import matrix_balance
    from scipy.sparse.csgraph import connected_components

    _, labels = connected_components(a != 0, connection="strong")
    for label in np.unique(labels):
        group = labels == label
        yield group, matrix_balance(a[np.ix_(group, group)], permute=False)[0]


def _modes(a: np.ndarray) -> Iterator[tuple[complex, float]]:
    """Yield each eigenvalue with a bound of its rounding error."""
    from scipy.linalg import eig

    for _, matrix in _groups(a) if len(a) else ():
        modes, left_vectors, right_vectors = eig(matrix, left=True, right=True)
        cosines = np.maximum(np.abs(np.sum(left_vectors.conj() * right_vectors, axis=0)), EIGENVALUE_ROUNDING**0.5)
        yield from zip(modes, EIGENVALUE_ROUNDING * len(a) * np.linalg.norm(matrix) / cosines, strict=True)


def _moves(a: np.ndarray, b: np.ndarray, mode: complex) -> bool:
    """Return whether an input moves the mode; some input reaches every state."""
    identity = np.eye(len(a))
    scales = _scale_to_unit_entries(
        np.hstack([np.abs(a) + abs(mode) * identity, np.abs(b)]), _row_scales(a, b, abs(mode))
    )
    if scales is None:
        return False
    pencil = np.hstack([a - mode * identity, b]) * scales[0][:, None] * scales[1]
    return bool(np.linalg.svd(pencil, compute_uv=False)[-1] > PBH_TOLERANCE)


def _row_scales(a: np.ndarray, b: np.ndarray, rate: float) -> np.ndarray:
    """Return logarithms of row scales (n,) with which the strongest way from an input to each state has entries of 1.

    The unit of a state is its response to the inputs along this way, over the time of its group of states. That time is
    1 over the spectral radius of |A| of the group, or over `rate` if that is larger, so no cycle grows.
    """
    rates = np.full(len(a), rate)
    for group, matrix in _groups(a):
        rates[group] = max(rate, spectral_bound(np.abs(matrix), discrete=True))
    rates[rates == 0] = 1.0
    with np.errstate(divide="ignore"):
        links, states = np.log(np.abs(a) / rates[:, None]), np.log(np.abs(b).max(axis=1) / rates)
    for _ in a:
        states = np.maximum(states, np.max(links + states, axis=1))
    return -states - np.log(rates)


def _scale_to_unit_entries(sizes: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return scales of rows (n,) and columns (k,) with which n entries are 1 and no entry is larger.

    The n entries are in different rows and columns of `sizes` (n, k), k >= n. None if every such choice has a zero. The
    logarithms of the row scales begin with `rows` (n,) and only become smaller.
    """
    from scipy.optimize import linear_sum_assignment

    with np.errstate(divide="ignore"):
        logs = np.log(sizes)
    try:
        _, columns = linear_sum_assignment(logs, maximize=True)
    except ValueError:
        return None
    selected = logs[:, columns]
    gaps = np.diag(selected) - selected  # row i of scale r_i keeps below 1 in the column of row k: r_i <= r_k + gap
    for _ in rows:
        rows = np.min(rows + gaps, axis=1)
    highest = np.max(logs + rows[:, None], axis=0)
    return np.exp(rows), np.exp(np.where(np.isfinite(highest), -highest, 0.0))
