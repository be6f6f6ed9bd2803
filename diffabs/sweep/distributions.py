"""What a parameter may be in a sweep: distributions, given by their quantile functions. On the host, in float64.

    value(u)         the quantile at u in [0, 1], the inverse of the cumulative distribution function
    from_normal(z)   the quantile at u = Phi(z), as exact for large z as for small ones

Each is written for p = u and q = 1 - u, of which the smaller is known to all its digits: Phi(7) is 1 - 1.28e-12 and has
lost twelve of them, Phi(-7) none. At u = 0 and 1 the value is the end of the support, which may be infinite."""

import dataclasses
import math
from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr, ndtri

from diffabs.core.pytree import Spec
from diffabs.sweep.discrete import Categorical as Categorical
from diffabs.sweep.discrete import Empirical as Empirical
from diffabs.sweep.tables import FINITE, POSITIVE, crossed, described, kebab, outside, table, written

END = Spec("1", infinite=True)
LEAST = 1e-290  # probability between the limits of a distribution; below, its tails have no digits


class Distribution(Protocol):
    """A scalar random variable."""

    def value(self, u: ArrayLike) -> np.ndarray:
        """The quantile at u in [0, 1], of any shape."""
        ...

    def from_normal(self, z: ArrayLike) -> np.ndarray:
        """The quantile at Phi(z)."""
        ...

    def support(self) -> tuple[float, float]:
        """The least and the greatest value."""
        ...

    def problems(self, name: str) -> Iterator[str]:
        """One line for each field that cannot be."""
        ...

    def table(self) -> dict[str, Any]:
        """As values of TOML, which `read` reads."""
        ...


@dataclasses.dataclass(frozen=True)
class Uniform:
    """q low + p high."""

    low: float
    high: float

    def value(self, u: ArrayLike) -> np.ndarray:
        return self._at(np.asarray(u), 1 - np.asarray(u))

    def from_normal(self, z: ArrayLike) -> np.ndarray:
        return self._at(ndtr(z), ndtr(-np.asarray(z)))

    def _at(self, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        return np.clip(q * self.low + p * self.high, self.low, self.high)

    def support(self) -> tuple[float, float]:
        return self.low, self.high

    def problems(self, name: str) -> Iterator[str]:
        yield from outside(self, name, low=FINITE, high=FINITE)
        yield from crossed(self, name)

    def table(self) -> dict[str, Any]:
        return table(self)


@dataclasses.dataclass(frozen=True)
class Normal:
    """mean + deviation Phi^-1(q Phi(a) + p Phi(b)): a normal distribution, cut off at its limits if it has any, which
    are a and b deviations from its mean."""

    mean: float
    deviation: float
    low: float = -math.inf
    high: float = math.inf

    def value(self, u: ArrayLike) -> np.ndarray:
        return self._at(np.asarray(u), 1 - np.asarray(u))

    def from_normal(self, z: ArrayLike) -> np.ndarray:
        if self.support() == (-math.inf, math.inf):
            return self.mean + self.deviation * np.asarray(z)
        return self._at(ndtr(z), ndtr(-np.asarray(z)))

    def _at(self, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        a, b = self._limits()
        below, above = q * ndtr(a) + p * ndtr(b), q * ndtr(-a) + p * ndtr(-b)
        z = ndtri(np.minimum(below, above))
        return np.clip(self.mean + self.deviation * np.where(below < above, z, -z), self.low, self.high)

    def _limits(self) -> tuple[float, float]:
        return (self.low - self.mean) / self.deviation, (self.high - self.mean) / self.deviation

    def support(self) -> tuple[float, float]:
        return self.low, self.high

    def left(self) -> float:
        """The probability, without the limits, of what lies between them."""
        a, b = self._limits()
        return float(max(ndtr(b) - ndtr(a), ndtr(-a) - ndtr(-b)))

    def problems(self, name: str) -> Iterator[str]:
        lines = [*outside(self, name, mean=FINITE, deviation=POSITIVE, low=END, high=END), *crossed(self, name)]
        yield from lines
        if not lines and self.left() < LEAST:
            yield f"{name}: {written(self)} has nothing between its limits"

    def table(self) -> dict[str, Any]:
        return table(self)


@dataclasses.dataclass(frozen=True)
class LogNormal:
    """exp of a normal distribution with mean log(median), cut off at its limits if it has any.

    deviation: of the natural logarithm; 0.1 is about a tenth of the median"""

    median: float
    deviation: float
    low: float = 0.0
    high: float = math.inf

    def value(self, u: ArrayLike) -> np.ndarray:
        return np.clip(np.exp(self._logarithm().value(u)), self.low, self.high)

    def from_normal(self, z: ArrayLike) -> np.ndarray:
        return np.clip(np.exp(self._logarithm().from_normal(z)), self.low, self.high)

    def _logarithm(self) -> Normal:
        low, high = (math.log(end) if end > 0 else -math.inf for end in self.support())
        return Normal(math.log(self.median), self.deviation, low, high)

    def support(self) -> tuple[float, float]:
        return self.low, self.high

    def problems(self, name: str) -> Iterator[str]:
        ranges = {"median": POSITIVE, "deviation": POSITIVE, "low": Spec("1", low=0.0), "high": END}
        lines = [*outside(self, name, **ranges), *crossed(self, name)]
        yield from lines
        if not lines and self._logarithm().left() < LEAST:
            yield f"{name}: {written(self)} has nothing between its limits"

    def table(self) -> dict[str, Any]:
        return table(self)


@dataclasses.dataclass(frozen=True)
class Triangular:
    """low + sqrt(p (high - low) (mode - low)) below the mode, high - sqrt(q (high - low) (high - mode)) above it."""

    low: float
    mode: float
    high: float

    def value(self, u: ArrayLike) -> np.ndarray:
        return self._at(np.asarray(u), 1 - np.asarray(u))

    def from_normal(self, z: ArrayLike) -> np.ndarray:
        return self._at(ndtr(z), ndtr(-np.asarray(z)))

    def _at(self, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        width, rise, fall = self.high - self.low, self.mode - self.low, self.high - self.mode
        rising, falling = self.low + np.sqrt(p * width * rise), self.high - np.sqrt(q * width * fall)
        return np.clip(np.where(p * width < rise, rising, falling), self.low, self.high)

    def support(self) -> tuple[float, float]:
        return self.low, self.high

    def problems(self, name: str) -> Iterator[str]:
        lines = [*outside(self, name, low=FINITE, mode=FINITE, high=FINITE), *crossed(self, name)]
        yield from lines
        if not lines:
            yield from outside(self, name, mode=Spec("1", self.low, self.high))

    def table(self) -> dict[str, Any]:
        return table(self)


KINDS = {kebab(cls): cls for cls in (Uniform, Normal, LogNormal, Triangular, Categorical, Empirical)}


def read(given: Any, where: str) -> Distribution:
    """The distribution of a table. Raises ValueError, one line, for an unknown type, a missing or unknown field, a
    value that is not a number, and for whatever the distribution itself objects to."""
    return described(KINDS, given, where)


def reach(distribution: Distribution) -> Spec:
    """The support as an interval: open where u = 0 or 1 alone would get there."""
    low, high = distribution.support()
    open_low = low == -math.inf or (isinstance(distribution, LogNormal) and low == 0)
    return Spec("1", low, high, open_low, high == math.inf)


def leaving(distribution: Distribution, spec: Spec, name: str) -> str | None:
    """A line if a parameter that is distributed so can leave its range, else None."""
    if isinstance(distribution, Categorical) and distribution.textual():
        return f"{name} = {written(distribution)} is text; a number in {spec.interval()} is needed"
    own = reach(distribution)
    below = own.low < spec.low or (own.low == spec.low and spec.open_low and not own.open_low)
    above = own.high > spec.high or (own.high == spec.high and spec.open_high and not own.open_high)
    if not (below or above):
        return None
    hint = "; truncate it with low and high" if isinstance(distribution, Normal | LogNormal) else ""
    return f"{name} = {written(distribution)} reaches {own.interval()}, outside {spec.interval()}{hint}"
