"""Distributions of a parameter in a sweep, given by their quantile functions; on the host, in float64.

    value(u)         quantile at u in [0, 1], the inverse of the cumulative distribution function
    from_normal(z)   quantile at u = Phi(z), equally exact for large and small z

Each is a formula in p = u and q = 1 - u. It uses the smaller of both, which has all its digits. Phi(7) = 1 - 1.28e-12
has lost twelve digits, and Phi(-7) none. At u = 0 and 1 the value is the end of the support, which may be infinite.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike

from diffabs.core.pytree import ParameterSpec, param
from diffabs.core.types import Scalar
from diffabs.host.values import check_sound, format_table, kebab_case, read_one
from diffabs.uncertainty.sweep.discrete import Categorical as Categorical
from diffabs.uncertainty.sweep.discrete import Empirical as Empirical
from diffabs.uncertainty.sweep.discrete import is_numeric

# Smallest probability between the limits of a distribution. Below it, its tails have no correct digits.
MIN_TRUNCATED_PROBABILITY = 1e-290


class Distribution(Protocol):
    """A scalar random variable.

    Attributes:
        scaled: Names of the fields that have the unit of the parameter.
    """

    scaled: ClassVar[tuple[str, ...]]

    def value(self, u: ArrayLike) -> np.ndarray:
        """Return the quantile at u in [0, 1], any shape."""
        ...

    def from_normal(self, z: ArrayLike) -> np.ndarray:
        """Return the quantile at Phi(z), any shape."""
        ...

    def support(self) -> tuple[float, float]:
        """Return the smallest and the largest value."""
        ...

    def problems(self, name: str) -> Iterator[str]:
        """Yield an error for each wrong field; `name` stands in the messages."""
        ...


class _Continuous:
    """Common methods of distributions between `low` and `high`: quantiles by p and q, ranges of the fields."""

    low: float
    high: float

    def value(self, u: ArrayLike) -> np.ndarray:
        return self._at(np.asarray(u), 1 - np.asarray(u))

    def from_normal(self, z: ArrayLike) -> np.ndarray:
        from scipy.special import ndtr

        return self._at(ndtr(z), ndtr(-np.asarray(z)))

    def _at(self, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def support(self) -> tuple[float, float]:
        return self.low, self.high

    def problems(self, name: str) -> Iterator[str]:
        lines = []
        for field in dataclasses.fields(self):  # pyright: ignore[reportArgumentType]
            value, spec = getattr(self, field.name), field.metadata["spec"]
            if not is_numeric(value):
                lines.append(f"{name}: {field.name} = {value!r} is no number; one in {spec.interval()} is needed")
            elif not spec.holds(value):
                lines.append(f"{name}: {field.name} = {value:g} is outside {spec.interval()}")
        if not lines and self.low >= self.high:
            lines.append(f"{name}: low = {self.low:g} is not below high = {self.high:g}")
        yield from lines or self._consistency_problems(name)

    def _consistency_problems(self, name: str) -> Iterator[str]:
        """Yield an error for fields that contradict each other although each is in its range."""
        del name
        yield from ()


@dataclasses.dataclass(frozen=True)
class Uniform(_Continuous):
    """A uniform distribution between `low` and `high`: q low + p high."""

    low: float = param(unit="1")
    high: float = param(unit="1")
    scaled: ClassVar[tuple[str, ...]] = ("low", "high")

    def _at(self, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        return np.clip(q * self.low + p * self.high, self.low, self.high)


@dataclasses.dataclass(frozen=True)
class Normal(_Continuous):
    """A normal distribution, truncated at `low` and `high` if they are finite.

        mean + deviation Phi^-1(q Phi(a) + p Phi(b))

    The limits are a and b standard deviations from the mean.
    """

    mean: float = param(unit="1")
    deviation: float = param(unit="1", above=0.0)
    low: float = param(default=-math.inf, unit="1", infinite=True)
    high: float = param(default=math.inf, unit="1", infinite=True)
    scaled: ClassVar[tuple[str, ...]] = ("mean", "deviation", "low", "high")

    def from_normal(self, z: ArrayLike) -> np.ndarray:
        """Return the quantile at Phi(z); linear in z without limits."""
        if self.support() == (-math.inf, math.inf):
            return self.mean + self.deviation * np.asarray(z)
        return super().from_normal(z)

    def _at(self, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        from scipy.special import ndtr, ndtri

        a, b = self._limits()
        below, above = q * ndtr(a) + p * ndtr(b), q * ndtr(-a) + p * ndtr(-b)
        # Invert in the tail with the smaller probability: it has all digits, and the other is 1 minus it.
        z = ndtri(np.minimum(below, above))
        return np.clip(self.mean + self.deviation * np.where(below < above, z, -z), self.low, self.high)

    def _limits(self) -> tuple[float, float]:
        return (self.low - self.mean) / self.deviation, (self.high - self.mean) / self.deviation

    def _consistency_problems(self, name: str) -> Iterator[str]:
        if self.probability_within_limits() < MIN_TRUNCATED_PROBABILITY:
            yield f"{name}: {format_table(self)} has nothing between its limits"

    def probability_within_limits(self) -> float:
        """Return the probability of the interval between the limits under the normal distribution without limits."""
        a, b = (end / math.sqrt(2) for end in self._limits())
        # Both differences are equal in exact arithmetic; in a tail one of them loses its digits, and becomes 0.
        return max(math.erfc(-b) - math.erfc(-a), math.erfc(a) - math.erfc(b)) / 2


@dataclasses.dataclass(frozen=True)
class LogNormal(_Continuous):
    """exp of a normal distribution with mean log(median), truncated at `low` and `high`.

    Attributes:
        median: Median of the distribution without limits.
        deviation: Standard deviation of the natural logarithm; 0.1 is about a tenth of the median.
    """

    median: float = param(unit="1", above=0.0)
    deviation: float = param(unit="1", above=0.0)
    low: float = param(default=0.0, unit="1", low=0.0)
    high: float = param(default=math.inf, unit="1", infinite=True)
    scaled: ClassVar[tuple[str, ...]] = ("median", "low", "high")

    def value(self, u: ArrayLike) -> np.ndarray:
        """Return the quantile at u in [0, 1]."""
        return np.clip(np.exp(self._logarithm().value(u)), self.low, self.high)

    def from_normal(self, z: ArrayLike) -> np.ndarray:
        """Return the quantile at Phi(z)."""
        return np.clip(np.exp(self._logarithm().from_normal(z)), self.low, self.high)

    def _logarithm(self) -> Normal:
        low, high = (math.log(end) if end > 0 else -math.inf for end in self.support())
        return Normal(math.log(self.median), self.deviation, low, high)

    def _consistency_problems(self, name: str) -> Iterator[str]:
        if self._logarithm().probability_within_limits() < MIN_TRUNCATED_PROBABILITY:
            yield f"{name}: {format_table(self)} has nothing between its limits"


@dataclasses.dataclass(frozen=True)
class Triangular(_Continuous):
    """A triangular distribution with its peak at `mode`. The quantiles below and above the mode are:

        low + sqrt(p (high - low) (mode - low))
        high - sqrt(q (high - low) (high - mode))

    p = u and q = 1 - u.
    """

    low: float = param(unit="1")
    mode: float = param(unit="1")
    high: float = param(unit="1")
    scaled: ClassVar[tuple[str, ...]] = ("low", "mode", "high")

    def _at(self, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        width, rise, fall = self.high - self.low, self.mode - self.low, self.high - self.mode
        rising, falling = self.low + np.sqrt(p * width * rise), self.high - np.sqrt(q * width * fall)
        return np.clip(np.where(p * width < rise, rising, falling), self.low, self.high)

    def _consistency_problems(self, name: str) -> Iterator[str]:
        between = ParameterSpec("1", self.low, self.high)
        if not between.holds(self.mode):
            yield f"{name}: mode = {self.mode:g} is outside {between.interval()}"


DISTRIBUTION_TYPES = {
    kebab_case(cls.__name__): cls for cls in (Uniform, Normal, LogNormal, Triangular, Categorical, Empirical)
}


def read_distribution(table: object, where: str, kinds: Mapping[str, type] = DISTRIBUTION_TYPES) -> Distribution:
    """Return the distribution that a table describes."""
    return check_sound(read_one(kinds, table, where), where)


def convert_distribution_to_si(distribution: Any, scale: float) -> Scalar:
    """Return the distribution of a parameter in SI units: fields with a unit are divided by `scale`, 3.6 for km/h."""

    def divide(value: Scalar) -> Any:
        return tuple(x / scale for x in value) if isinstance(value, tuple) else value / scale

    return dataclasses.replace(distribution, **{n: divide(getattr(distribution, n)) for n in distribution.scaled})


def support_interval(distribution: Distribution) -> ParameterSpec:
    """Return the support as a `ParameterSpec` with unit "1"; infinite ends, and 0 of a `LogNormal`, are open."""
    low, high = distribution.support()
    open_low = low == -math.inf or (isinstance(distribution, LogNormal) and low == 0)
    return ParameterSpec("1", low, high, open_low, high == math.inf)


def describe_out_of_range(distribution: Distribution, spec: ParameterSpec, name: str) -> str | None:
    """Return a line if a parameter with this distribution can leave its range, else None."""
    if isinstance(distribution, Categorical) and distribution.textual():
        return f"{name} = {format_table(distribution)} is text; a number in {spec.interval()} is needed"
    support = support_interval(distribution)
    below = support.low < spec.low or (support.low == spec.low and spec.open_low and not support.open_low)
    above = support.high > spec.high or (support.high == spec.high and spec.open_high and not support.open_high)
    if not (below or above):
        return None
    hint = "; truncate it with low and high" if isinstance(distribution, Normal | LogNormal) else ""
    return f"{name} = {format_table(distribution)} reaches {support.interval()}, outside {spec.interval()}{hint}"
