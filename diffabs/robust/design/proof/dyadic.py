"""Exact arithmetic on floats as integers times a power of two, with bounds on their errors.

An array of floats is an array of integers with one scale (`Dyadic`). So are sums and products, without rounding.
Positive definiteness is tested by Sylvester's criterion with Bareiss's elimination.
"""

import functools
import operator
from collections.abc import Callable
from typing import Any

import numpy as np

from diffabs.core.types import PyTree, Scalar

RELATIVE_ERROR_BITS = 40  # a relative error of 2^-40 covers the rounding in computing the matrices from a model
Exact = Any  # an array of floats, or Dyadic


class Dyadic:
    """The numbers `ints` 2^-bits, each with an error of at most `error` 2^-bits (None: 0).

    `ints` and `error` are arrays of Python integers.
    """

    __slots__ = ("bits", "error", "ints")
    __array_ufunc__ = None  # makes NumPy leave array * Dyadic to __rmul__ instead of an element-wise product

    def __init__(self, ints: Exact, bits: int, error: object = None) -> None:
        """Store `ints`, `bits` and `error` unchanged; `as_dyadic` and `as_uncertain_dyadic` convert floats."""
        self.ints: Exact = ints
        self.bits: int = bits
        self.error: object = error

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""
        return np.shape(self.ints)

    @property
    def mT(self) -> "Dyadic":
        """The array with its last two axes exchanged."""
        return self.each(lambda array: array.mT)

    def each(self, function: Callable[[PyTree], PyTree], bits: int = 0) -> "Dyadic":
        """Apply `function` to integers and errors, and make the scale finer by `bits`."""
        return Dyadic(function(self.ints), self.bits + bits, None if self.error is None else function(self.error))

    def at(self, bits: int) -> "Dyadic":
        """Return the same numbers at the finer scale 2^-bits, `bits` >= the present one."""
        finer = bits - self.bits
        return self.each(lambda array: array * (1 << finer), finer) if finer else self

    def product(self, other: Exact, times: Callable[[PyTree, PyTree], PyTree]) -> "Dyadic":
        """Return the product with `other` by the bilinear `times`, with its error |a| db + da |b| + da db."""
        other = as_dyadic(other)
        a, b, da, db = self.ints, other.ints, self.error, other.error
        errors = [] if db is None else [times(abs(a), db)]
        errors += [] if da is None else [times(da, abs(b))]
        errors += [] if da is None or db is None else [times(da, db)]
        return Dyadic(times(a, b), self.bits + other.bits, functools.reduce(operator.add, errors) if errors else None)

    def __add__(self, other: Exact) -> "Dyadic":
        other = as_dyadic(other)
        bits = max(self.bits, other.bits)
        a, b = self.at(bits), other.at(bits)
        errors: list[Any] = [each.error for each in (a, b) if each.error is not None]
        return Dyadic(a.ints + b.ints, bits, functools.reduce(operator.add, errors) if errors else None)

    def __mul__(self, other: Exact) -> "Dyadic":
        return self.product(other, operator.mul)

    def __matmul__(self, other: Exact) -> "Dyadic":
        return self.product(other, operator.matmul)

    def __neg__(self) -> "Dyadic":
        return Dyadic(-self.ints, self.bits, self.error)

    def __sub__(self, other: Exact) -> "Dyadic":
        return self + -as_dyadic(other)

    def __rsub__(self, other: Exact) -> "Dyadic":
        return -self + other

    def __getitem__(self, index: object) -> "Dyadic":
        return self.each(lambda array: array[index])

    __radd__, __rmul__ = __add__, __mul__


def as_dyadic(value: Scalar) -> Dyadic:
    """Return the numbers of an int, finite floats or a Dyadic as integers times a power of two, without error."""
    if isinstance(value, Dyadic):
        return value
    if isinstance(value, int):
        return Dyadic(value, 0)
    value = np.asarray(value, float)
    if not np.isfinite(value).all():
        raise ValueError("a number in an exact computation is not finite")
    fraction, exponent = np.frexp(value)
    # 53 bits hold the mantissa of every double; object arrays hold Python integers of any length.
    ints = np.asarray(fraction * 2.0**53).astype(np.int64).astype(object)
    # Zeros do not count: their exponent would set a needlessly fine scale.
    lowest = int(np.min(exponent, where=value != 0, initial=1024))
    shift = np.where(value != 0, exponent - lowest, 0).astype(object)
    return Dyadic(np.left_shift(ints, shift), 53 - lowest)


def as_uncertain_dyadic(value: Scalar) -> Dyadic:
    """Return the numbers of `value` with a relative error of at most 2^-RELATIVE_ERROR_BITS each."""
    ints = as_dyadic(value)
    # At a scale finer by 2^40, an error of |ints| units is a relative error of 2^-40.
    return Dyadic(ints.ints * (1 << RELATIVE_ERROR_BITS), ints.bits + RELATIVE_ERROR_BITS, abs(ints.ints))


def is_positive_definite(matrix: list[list[int]], strict: bool = True) -> bool:
    """Return whether a symmetric matrix of Python integers is positive definite, or semidefinite if not `strict`.

    The method is Bareiss's elimination: the pivots are the leading minors, and every division leaves no remainder. A
    zero pivot of a semidefinite matrix has a zero row, which is skipped. It overwrites the lower triangle.
    """
    n, last = len(matrix), 1
    for k in range(n):
        pivot, below = matrix[k][k], [matrix[i][k] for i in range(n)]
        # A semidefinite matrix with a zero on its diagonal has zeros in that row and column.
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
