"""Weights of a quadratic cost."""

import numpy as np

from diffabs.core.types import Scalar


def as_weight_matrix(name: str, value: Scalar, size: int, *, definite: bool) -> np.ndarray:
    """Return a weight as a symmetric matrix (size, size).

    Args:
        name: Name of the weight, for messages.
        value: Matrix, diagonal, or a number for size 1.
        size: Number of rows.
        definite: Whether the matrix must be positive definite; else semidefinite.

    Raises:
        ValueError: The shape is wrong, an entry is not finite, the matrix is not symmetric, or an eigenvalue is
            negative (zero, if `definite`).
    """
    array = np.array(value, float)
    if array.ndim < 2:
        array = np.diag(np.atleast_1d(array))
    if array.shape != (size, size):
        raise ValueError(f"{name} has shape {np.shape(value)}; it needs ({size}, {size}), or its diagonal ({size},)")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} = {array.tolist()} has an entry that is not finite")
    if not np.allclose(array, array.T, rtol=1e-12, atol=0):
        raise ValueError(f"{name} = {array.tolist()} is not symmetric")
    lowest, largest = np.linalg.eigvalsh(array)[[0, -1]]
    if lowest < -1e-13 * max(largest, 0.0) or largest < 0 or (definite and lowest <= 0):
        kind, allowed = ("definite", "(0, inf)") if definite else ("semidefinite", "[0, inf)")
        raise ValueError(f"{name} is not positive {kind}: an eigenvalue is {lowest:g}, outside {allowed}")
    return (array + array.T) / 2
