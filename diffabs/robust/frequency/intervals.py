"""Arrays of intervals whose ends are rounded outwards, in NumPy.

IEEE 754 rounds each sum and product to nearest, so the next double beyond a result bounds the exact one. Functions of
the C library and of NumPy are not rounded correctly: `FUNCTION_ERROR` bounds their error, many times what they state.
NaN marks an interval that nothing is known of; every comparison with it is false.
"""

import math
from fractions import Fraction
from typing import Any, TypeAlias

import numpy as np

FUNCTION_ERROR = 4e-15  # of cos and sin, absolute, and of exp, log and atan, relative
LARGEST_ANGLE = 1e6  # beyond which cos is only known to lie in [-1, 1]
ANGLE_SLACK = 1e-9  # of an angle, in which an extremum of cos counts as inside

Ends: TypeAlias = Any  # arrays of NumPy, or its numbers


def _down(x: Ends) -> Ends:
    return np.nextafter(x, -np.inf)


def _up(x: Ends) -> Ends:
    return np.nextafter(x, np.inf)


class Enclosure:
    """Arrays `low` and `high` of one shape; every operation contains all its exact results."""

    __slots__ = ("high", "low")

    def __init__(self, low: Ends, high: Ends | None = None):
        """Store the ends; without `high` the numbers are exact."""
        self.low: Ends = low
        self.high: Ends = low if high is None else high

    def __getitem__(self, index: object) -> "Enclosure":
        return Enclosure(self.low[index], self.high[index])

    def __neg__(self) -> "Enclosure":
        return Enclosure(-self.high, -self.low)

    def __add__(self, other: "Enclosure") -> "Enclosure":
        return Enclosure(_down(self.low + other.low), _up(self.high + other.high))

    def __sub__(self, other: "Enclosure") -> "Enclosure":
        return Enclosure(_down(self.low - other.high), _up(self.high - other.low))

    def __mul__(self, other: "Enclosure") -> "Enclosure":
        a, b, c, d = self.low * other.low, self.low * other.high, self.high * other.low, self.high * other.high
        return Enclosure(
            _down(np.minimum(np.minimum(a, b), np.minimum(c, d))), _up(np.maximum(np.maximum(a, b), np.maximum(c, d)))
        )

    def times(self, factor: float) -> "Enclosure":
        """Return the product with a double."""
        a, b = (self.low, self.high) if factor >= 0 else (self.high, self.low)
        return Enclosure(_down(a * factor), _up(b * factor))

    def square(self) -> "Enclosure":
        """Return the squares."""
        a, b = self.low * self.low, self.high * self.high
        inside = (self.low <= 0) & (self.high >= 0)
        low = np.where(inside, 0.0, np.maximum(_down(np.minimum(a, b)), 0.0))
        return Enclosure(np.where(np.isnan(a), np.nan, low), _up(np.maximum(a, b)))

    def inverse(self) -> "Enclosure":
        """Return 1/x; NaN where x may be 0."""
        valid = (self.low > 0) | (self.high < 0)
        low, high = np.where(valid, self.low, np.nan), np.where(valid, self.high, np.nan)
        return Enclosure(_down(1.0 / high), _up(1.0 / low))

    def size(self) -> Ends:
        """Return the greatest absolute value."""
        return np.maximum(np.abs(self.low), np.abs(self.high))

    def middle(self) -> Ends:
        """Return the middles, rounded."""
        return 0.5 * (self.low + self.high)

    def sum(self, axis: int) -> "Enclosure":
        """Return the sum along an axis."""
        total = self[(slice(None),) * (axis % self.low.ndim) + (0,)]
        for i in range(1, self.low.shape[axis]):
            total = total + self[(slice(None),) * (axis % self.low.ndim) + (i,)]
        return total


def enclose_number(value: float) -> Enclosure:
    """Return an interval of shape () that contains a double and the decimal that its shortest text shows."""
    x = np.float64(value)
    if not np.isfinite(x):
        return Enclosure(np.float64(np.nan))
    if Fraction(repr(float(value))) == Fraction(float(value)):
        return Enclosure(x)
    return Enclosure(_down(x), _up(x))


def union(x: Enclosure, y: Enclosure) -> Enclosure:
    """Return the least interval that contains two others."""
    return Enclosure(np.minimum(x.low, y.low), np.maximum(x.high, y.high))


def intersection(x: Enclosure, y: Enclosure) -> Enclosure:
    """Return the numbers that lie in both intervals; NaN without any, or where one is NaN."""
    low, high = np.maximum(x.low, y.low), np.minimum(x.high, y.high)
    valid = low <= high
    return Enclosure(np.where(valid, low, np.nan), np.where(valid, high, np.nan))


def widen(low: Ends, high: Ends, absolute: float, relative: float) -> Enclosure:
    """Return [low, high], computed by a library's function, with the bounds of its error."""
    return Enclosure(_down(low - (absolute + relative * np.abs(low))), _up(high + (absolute + relative * np.abs(high))))


HALF_PI = Enclosure(np.float64(math.pi / 2), np.nextafter(math.pi / 2, 2.0))


def cosine(x: Enclosure) -> Enclosure:
    """Return cos x."""
    a, b = np.cos(x.low), np.cos(x.high)
    y = widen(np.minimum(a, b), np.maximum(a, b), FUNCTION_ERROR, 0.0)
    # Multiples of pi inside: even ones are maxima, odd ones minima. The slack covers the rounding of x/pi.
    slack = ANGLE_SLACK * (1.0 + x.size())
    first, last = np.ceil((x.low - slack) / math.pi), np.floor((x.high + slack) / math.pi)
    even = 2 * np.ceil(first / 2) <= last
    odd = 2 * np.ceil((first - 1) / 2) + 1 <= last
    far = ~(x.size() < LARGEST_ANGLE)
    unknown = np.isnan(x.low + x.high)
    low = np.where(odd | far, -1.0, np.maximum(y.low, -1.0))
    high = np.where(even | far, 1.0, np.minimum(y.high, 1.0))
    return Enclosure(np.where(unknown, np.nan, low), np.where(unknown, np.nan, high))


def sine(x: Enclosure) -> Enclosure:
    """Return sin x."""
    return cosine(x - HALF_PI)


def monotone(function: np.ufunc, x: Enclosure) -> Enclosure:
    """Return exp, log or atan of an interval; NaN outside of its domain."""
    with np.errstate(all="ignore"):
        return widen(function(x.low), function(x.high), 1e-300, FUNCTION_ERROR)


def enclose_power(x: Enclosure, exponent: Enclosure) -> Enclosure:
    """Return x^e for e > 0; the operation means 0 where x is negative."""
    with np.errstate(all="ignore"):
        low, high = np.maximum(x.low, 0.0), np.maximum(x.high, 0.0)
        y = union(
            widen(low**exponent.low, high**exponent.low, 0.0, FUNCTION_ERROR),
            widen(low**exponent.high, high**exponent.high, 0.0, FUNCTION_ERROR),
        )
    valid = (exponent.low > 0) & ~np.isnan(x.low + x.high)
    return Enclosure(np.where(valid, np.maximum(y.low, 0.0), np.nan), np.where(valid, y.high, np.nan))


class Jet:
    """An interval with derivatives along some variables; a missing one is 0."""

    __slots__ = ("slopes", "value")

    def __init__(self, value: Enclosure, slopes: dict[int, Enclosure] | None = None):
        """Store the parts."""
        self.value: Enclosure = value
        self.slopes: dict[int, Enclosure] = slopes or {}

    def __neg__(self) -> "Jet":
        return Jet(-self.value, {k: -x for k, x in self.slopes.items()})

    def __add__(self, other: "Jet") -> "Jet":
        slopes = dict(self.slopes)
        for k, x in other.slopes.items():
            slopes[k] = slopes[k] + x if k in slopes else x
        return Jet(self.value + other.value, slopes)

    def __sub__(self, other: "Jet") -> "Jet":
        return self + (-other)

    def __mul__(self, other: "Jet") -> "Jet":
        slopes = {k: x * other.value for k, x in self.slopes.items()}
        for k, x in other.slopes.items():
            y = self.value * x
            slopes[k] = slopes[k] + y if k in slopes else y
        return Jet(self.value * other.value, slopes)

    def times(self, factor: float) -> "Jet":
        """Return the product with a double."""
        return Jet(self.value.times(factor), {k: x.times(factor) for k, x in self.slopes.items()})

    def follow(self, value: Enclosure, factor: Enclosure) -> "Jet":
        """Return a function of this jet with this value and this derivative."""
        return Jet(value, {k: factor * x for k, x in self.slopes.items()})
