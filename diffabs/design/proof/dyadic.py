"""Integers that floats are, times a power of two, with bounds on what they may be off by; arithmetic without rounding.

An array of floats is an array of integers and one scale (`Dyadic`), and so are sums and products. Positive definiteness
is Sylvester's criterion, by Bareiss's elimination.
"""

import functools
import operator
from collections.abc import Callable
from typing import Any

import numpy as np

RELATIVE_ERROR_BITS = 40  # 2^-40
Matrix = Any  # an array of floats, or Dyadic


class Dyadic:
    """`ints` 2^-bits, off by at most `error` 2^-bits (None: 0): arrays of Python integers that add and multiply."""

    __slots__ = ("bits", "error", "ints")
    __array_ufunc__ = None  # array * Dyadic is for Dyadic to compute, not element by element

    def __init__(self, ints: Any, bits: int, error: Any = None) -> None:
        """Takes them as they are; `exactly` and `about` make one of floats."""
        self.ints, self.bits, self.error = ints, bits, error

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the array."""
        return np.shape(self.ints)

    @property
    def mT(self) -> "Dyadic":
        """The last two axes exchanged."""
        return self.each(lambda array: array.mT)

    def each(self, function: Callable[[Any], Any], bits: int = 0) -> "Dyadic":
        """`function` of integers and errors, at a scale finer by `bits`."""
        return Dyadic(function(self.ints), self.bits + bits, None if self.error is None else function(self.error))

    def at(self, bits: int) -> "Dyadic":
        """The same at a finer scale."""
        finer = bits - self.bits
        return self.each(lambda array: array * (1 << finer), finer) if finer else self

    def product(self, other: Any, times: Callable[[Any, Any], Any]) -> "Dyadic":
        """Errors of a product: |a| db + da |b| + da db."""
        other = as_dyadic(other)
        a, b, da, db = self.ints, other.ints, self.error, other.error
        errors = [] if db is None else [times(abs(a), db)]
        errors += [] if da is None else [times(da, abs(b))]
        errors += [] if da is None or db is None else [times(da, db)]
        return Dyadic(times(a, b), self.bits + other.bits, functools.reduce(operator.add, errors) if errors else None)

    def __add__(self, other: Any) -> "Dyadic":
        other = as_dyadic(other)
        bits = max(self.bits, other.bits)
        a, b = self.at(bits), other.at(bits)
        errors = [each.error for each in (a, b) if each.error is not None]
        return Dyadic(a.ints + b.ints, bits, functools.reduce(operator.add, errors) if errors else None)

    def __mul__(self, other: Any) -> "Dyadic":
        return self.product(other, operator.mul)

    def __matmul__(self, other: Any) -> "Dyadic":
        return self.product(other, operator.matmul)

    def __neg__(self) -> "Dyadic":
        return Dyadic(-self.ints, self.bits, self.error)

    def __sub__(self, other: Any) -> "Dyadic":
        return self + -as_dyadic(other)

    def __rsub__(self, other: Any) -> "Dyadic":
        return -self + other

    def __getitem__(self, index: Any) -> "Dyadic":
        return self.each(lambda array: array[index])

    __radd__, __rmul__ = __add__, __mul__


def as_dyadic(value: Any) -> Dyadic:
    """The numbers of `value`, a float, an int or an array of floats. Raises ValueError where one is not finite."""
    if isinstance(value, Dyadic):
        return value
    if isinstance(value, int):
        return Dyadic(value, 0)
    value = np.asarray(value, float)
    if not np.isfinite(value).all():
        raise ValueError("a number in an exact computation is not finite")
    fraction, exponent = np.frexp(value)
    ints = np.asarray(fraction * 2.0**53).astype(np.int64).astype(object)
    lowest = int(np.min(exponent, where=value != 0, initial=1024))
    shift = np.where(value != 0, exponent - lowest, 0).astype(object)
    return Dyadic(np.left_shift(ints, shift), 53 - lowest)


def as_uncertain_dyadic(value: Any) -> Dyadic:
    """The numbers of `value`, each off by at most a relative 2^-RHO."""
    ints = as_dyadic(value)
    return Dyadic(ints.ints * (1 << RELATIVE_ERROR_BITS), ints.bits + RELATIVE_ERROR_BITS, abs(ints.ints))


def is_positive_definite(matrix: list[list[int]], strict: bool = True) -> bool:
    """Whether a symmetric matrix of integers is positive definite (semidefinite where not `strict`).

    Bareiss: the pivots are the leading minors, and every division leaves no remainder. A zero pivot of a semidefinite
    matrix has a zero row, which is left out. Works in place, in the lower triangle.
    """
    n, last = len(matrix), 1
    for k in range(n):
        pivot, below = matrix[k][k], [matrix[i][k] for i in range(n)]
        if pivot < 0 or (pivot == 0 and (strict or any(below[k:]))):
            return False
        if pivot == 0:
            continue
        for i in range(k + 1, n):
            row, factor = matrix[i], below[i]
            for j in range(k + 1, i + 1):
                row[j] = (pivot * row[j] - factor * below[j]) // last
        last = pivot
    return True
