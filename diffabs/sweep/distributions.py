"""What a parameter may be in a sweep: distributions, given by their quantile functions. On the host, in float64.

    value(u)         the quantile at u in [0, 1], the inverse of the cumulative distribution function
    from_normal(z)   the quantile at u = Phi(z), as exact for large z as for small ones

Each is written for p = u and q = 1 - u, of which the smaller is known to all its digits: Phi(7) is 1 - 1.28e-12 and has
lost twelve of them, Phi(-7) none. At u = 0 and 1 the value is the end of the support, which may be infinite."""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike

from diffabs.core.pytree import Spec, param
from diffabs.core.values import check_sound, format_table, kebab_case, read_one
from diffabs.sweep.discrete import Categorical as Categorical
from diffabs.sweep.discrete import Empirical as Empirical

MIN_TRUNCATED_PROBABILITY = 1e-290  # probability between the limits of a distribution; below, its tails have no digits


class Distribution(Protocol):
    """A scalar random variable. `scaled`: its fields that have the unit of the parameter."""

    scaled: ClassVar[tuple[str, ...]]

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


class _Continuous:
    """What distributions between `low` and `high` have in common: quantiles by p and q, numbers in their ranges."""

    low: Any
    high: Any

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
            if not spec.holds(value):
                lines.append(f"{name}: {field.name} = {value:g} is outside {spec.interval()}")
        if self.low >= self.high:
            lines.append(f"{name}: low = {self.low:g} is not below high = {self.high:g}")
        yield from lines or self._consistency_problems(name)

    def _consistency_problems(self, name: str) -> Iterator[str]:
        """What cannot be although each number by itself could."""
        del name
        yield from ()


@dataclasses.dataclass(frozen=True)
class Uniform(_Continuous):
    """q low + p high."""

    low: float = param(unit="1")
    high: float = param(unit="1")
    scaled = ("low", "high")

    def _at(self, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        return np.clip(q * self.low + p * self.high, self.low, self.high)


@dataclasses.dataclass(frozen=True)
class Normal(_Continuous):
    """mean + deviation Phi^-1(q Phi(a) + p Phi(b)): a normal distribution, cut off at its limits if it has any, which
    are a and b deviations from its mean."""

    mean: float = param(unit="1")
    deviation: float = param(unit="1", above=0.0)
    low: float = param(default=-math.inf, unit="1", infinite=True)
    high: float = param(default=math.inf, unit="1", infinite=True)
    scaled = ("mean", "deviation", "low", "high")

    def from_normal(self, z: ArrayLike) -> np.ndarray:
        if self.support() == (-math.inf, math.inf):
            return self.mean + self.deviation * np.asarray(z)
        return super().from_normal(z)

    def _at(self, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        from scipy.special import ndtr, ndtri

        a, b = self._limits()
        below, above = q * ndtr(a) + p * ndtr(b), q * ndtr(-a) + p * ndtr(-b)
        z = ndtri(np.minimum(below, above))
        return np.clip(self.mean + self.deviation * np.where(below < above, z, -z), self.low, self.high)

    def _limits(self) -> tuple[float, float]:
        return (self.low - self.mean) / self.deviation, (self.high - self.mean) / self.deviation

    def _consistency_problems(self, name: str) -> Iterator[str]:
        if self.left() < MIN_TRUNCATED_PROBABILITY:
            yield f"{name}: {format_table(self)} has nothing between its limits"

    def left(self) -> float:
        """The probability, without the limits, of what lies between them."""
        a, b = (end / math.sqrt(2) for end in self._limits())
        return max(math.erfc(-b) - math.erfc(-a), math.erfc(a) - math.erfc(b)) / 2


@dataclasses.dataclass(frozen=True)
class LogNormal(_Continuous):
    """exp of a normal distribution with mean log(median), cut off at its limits if it has any.

    deviation: of the natural logarithm; 0.1 is about a tenth of the median"""

    median: float = param(unit="1", above=0.0)
    deviation: float = param(unit="1", above=0.0)
    low: float = param(default=0.0, unit="1", low=0.0)
    high: float = param(default=math.inf, unit="1", infinite=True)
    scaled = ("median", "low", "high")

    def value(self, u: ArrayLike) -> np.ndarray:
        return np.clip(np.exp(self._logarithm().value(u)), self.low, self.high)

    def from_normal(self, z: ArrayLike) -> np.ndarray:
        return np.clip(np.exp(self._logarithm().from_normal(z)), self.low, self.high)

    def _logarithm(self) -> Normal:
        low, high = (math.log(end) if end > 0 else -math.inf for end in self.support())
        return Normal(math.log(self.median), self.deviation, low, high)

    def _consistency_problems(self, name: str) -> Iterator[str]:
        if self._logarithm().left() < MIN_TRUNCATED_PROBABILITY:
            yield f"{name}: {format_table(self)} has nothing between its limits"


@dataclasses.dataclass(frozen=True)
class Triangular(_Continuous):
    """low + sqrt(p (high - low) (mode - low)) below the mode, high - sqrt(q (high - low) (high - mode)) above it."""

    low: float = param(unit="1")
    mode: float = param(unit="1")
    high: float = param(unit="1")
    scaled = ("low", "mode", "high")

    def _at(self, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        width, rise, fall = self.high - self.low, self.mode - self.low, self.high - self.mode
        rising, falling = self.low + np.sqrt(p * width * rise), self.high - np.sqrt(q * width * fall)
        return np.clip(np.where(p * width < rise, rising, falling), self.low, self.high)

    def _consistency_problems(self, name: str) -> Iterator[str]:
        between = Spec("1", self.low, self.high)
        if not between.holds(self.mode):
            yield f"{name}: mode = {self.mode:g} is outside {between.interval()}"


DISTRIBUTION_TYPES = {
    kebab_case(cls.__name__): cls for cls in (Uniform, Normal, LogNormal, Triangular, Categorical, Empirical)
}


def read_distribution(given: Any, where: str, kinds: Mapping[str, type] = DISTRIBUTION_TYPES) -> Any:
    """The distribution of a table. Raises ScenarioError, one line, for an unknown type, a missing or unknown field, a
    value that is not a number, and for whatever the distribution itself objects to."""
    return check_sound(read_one(kinds, given, where), where)


def convert_distribution_to_si(distribution: Any, scale: float) -> Any:
    """Return the distribution of a parameter in SI, given in units of which `scale` make one."""

    def divided(value: Any) -> Any:
        return tuple(x / scale for x in value) if isinstance(value, tuple) else value / scale

    return dataclasses.replace(distribution, **{n: divided(getattr(distribution, n)) for n in distribution.scaled})


def support_interval(distribution: Distribution) -> Spec:
    """The support as an interval: open where u = 0 or 1 alone would get there."""
    low, high = distribution.support()
    open_low = low == -math.inf or (isinstance(distribution, LogNormal) and low == 0)
    return Spec("1", low, high, open_low, high == math.inf)


def describe_out_of_range(distribution: Distribution, spec: Spec, name: str) -> str | None:
    """A line if a parameter that is distributed so can leave its range, else None."""
    if isinstance(distribution, Categorical) and distribution.textual():
        return f"{name} = {format_table(distribution)} is text; a number in {spec.interval()} is needed"
    own = support_interval(distribution)
    below = own.low < spec.low or (own.low == spec.low and spec.open_low and not own.open_low)
    above = own.high > spec.high or (own.high == spec.high and spec.open_high and not own.open_high)
    if not (below or above):
        return None
    hint = "; truncate it with low and high" if isinstance(distribution, Normal | LogNormal) else ""
    return f"{name} = {format_table(distribution)} reaches {own.interval()}, outside {spec.interval()}{hint}"
