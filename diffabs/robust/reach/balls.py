"""Real numbers as Arb's balls: ends that are rounded outwards, and operations that keep a sign."""

from fractions import Fraction
from math import inf, isfinite, nextafter

import numpy as np
from flint import arb


class NotProved(Exception):
    """The checker cannot prove a bound; the message says why."""


class Undefined(Exception):
    """A number has no value, or no such derivative, somewhere in a set."""


def above(x: arb) -> float:
    """Return a float that no number of a ball exceeds."""
    high = x.upper()
    near = float(high)
    return near + 0.0 if arb(near) >= high else nextafter(near, inf)


def below(x: arb) -> float:
    """Return a float that no number of a ball is below."""
    return -above(-x) + 0.0  # not -0.0


def symmetric(x: arb) -> arb:
    """Return the ball around 0 that contains x and -x."""
    return arb(0, x.abs_upper())


def between(low: arb, high: arb) -> arb:
    """Return a ball that contains [low, high]; an end that is 0 stays exactly 0."""
    low, high = low.lower(), high.upper()
    ball = (low + high) / 2 + arb(0, ((high - low) / 2).upper())
    if low >= 0:
        return ball.nonnegative_part()
    return -((-ball).nonnegative_part()) if high <= 0 else ball


def hull(x: arb, y: arb) -> arb:
    """Return a ball that contains two others."""
    return between(min(x.lower(), y.lower()), max(x.upper(), y.upper()))


def common(x: arb, y: arb) -> arb:
    """Return a ball that contains all numbers that lie in both of two balls."""
    if y.contains(x):
        return x
    if x.contains(y):
        return y
    if not x.overlaps(y):
        raise Undefined("two enclosures of one number have nothing in common")
    return between(max(x.lower(), y.lower()), min(x.upper(), y.upper()))


def product(x: arb, y: arb) -> arb:
    """Return a product; the radius of a ball is rounded up, which must not change the sign."""
    z = x * y
    if not z.contains(0) or z.is_zero():
        return z
    negative = (x.upper() <= 0, y.upper() <= 0)
    if (negative[0] or x.lower() >= 0) and (negative[1] or y.lower() >= 0):
        return z.nonnegative_part() if negative[0] == negative[1] else -((-z).nonnegative_part())
    return z


def integral_range(rate: arb, h: arb) -> arb:
    """Return a ball that contains t r for all t in [0, h] and all r of a rate."""
    return between(min(arb(0), (rate * h).lower()), max(arb(0), (rate * h).upper()))


def constant(value: float) -> arb:
    """Return a ball that contains a double and the decimal number that its shortest text shows."""
    value = float(value)
    if not isfinite(value):
        raise NotProved(f"the constant {value}")
    if Fraction(repr(value)) == Fraction(value):
        return arb(value)
    return arb(value, float(np.spacing(abs(value))))


def positive_power(base: arb, exponent: arb) -> arb:
    """Return base^exponent for exponent > 0; the operation means 0 where the base is negative."""
    if not exponent.lower() > 0:
        raise Undefined("a power whose exponent is not positive")
    low, high = base.lower(), base.upper()
    return between((low**exponent).lower() if low > 0 else arb(0), (high**exponent).upper() if high > 0 else arb(0))
