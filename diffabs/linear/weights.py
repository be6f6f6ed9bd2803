"""Weights of a quadratic cost."""

import numpy as np

SYMMETRY_TOLERANCE = 1e-12  # difference of X[i, j] and X[j, i] that is rounding, relative to the entry's size


def is_symmetric(X: np.ndarray) -> bool:
    """Return whether a matrix is finite, and symmetric up to rounding of |X[i, j]| or sqrt|X[i, i] X[j, j]|."""
    if not np.isfinite(X).all():
        return False
    scale = np.sqrt(np.abs(np.diag(X)))
    size = np.maximum(np.abs(X), np.outer(scale, scale))
    return bool((np.abs(X - X.T) <= SYMMETRY_TOLERANCE * size).all())


def check_symmetric(name: str, value: object, size: int) -> None:
    """Raise ValueError for a matrix that is not finite and symmetric up to rounding, of shape (size, size)."""
    array = np.asarray(value, float)
    if array.shape != (size, size):
        raise ValueError(f"{name} has shape {array.shape}; ({size}, {size}) is needed")
    if not is_symmetric(array):
        raise ValueError(f"{name} = {array.tolist()} is not symmetric and finite")


def as_weight_matrix(name: str, value: object, size: int, *, definite: bool) -> np.ndarray:
    """Return a weight, a matrix, diagonal or (for size 1) number, as a symmetric (size, size) matrix.

    Args:
        definite: Whether the matrix must be positive definite; else semidefinite.
    """
    array = np.array(value, float)
    shape = array.shape
    if array.ndim < 2:
        array = np.diag(np.atleast_1d(array))
    if array.shape != (size, size):
        raise ValueError(f"{name} has shape {shape}; it needs ({size}, {size}), or its diagonal ({size},)")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} = {array.tolist()} has an entry that is not finite")
    if not is_symmetric(array):
        raise ValueError(f"{name} = {array.tolist()} is not symmetric")
    lowest, largest = np.linalg.eigvalsh(array)[[0, -1]]
    # Rounding makes an eigenvalue of a product negative, but no entry on the diagonal.
    negative = lowest < -1e-13 * max(largest, 0.0) or largest < 0 or (np.diag(array) < 0).any()
    if negative or (definite and lowest <= 0):
        kind, allowed = ("definite", "(0, inf)") if definite else ("semidefinite", "[0, inf)")
        raise ValueError(f"{name} is not positive {kind}: an eigenvalue is {lowest:g}, outside {allowed}")
    return (array + array.T) / 2
