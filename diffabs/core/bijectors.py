"""The free parameters of a part as one unbounded vector z.

    range                          value
    finite                         low + (high - low) s(z),   s(z) = 1/(1 + exp(-z))
    finite, over a decade or more  the same in the logarithm of |value|
    half open                      low + scale exp(z), high - scale exp(z)
    everywhere                     start + scale z

so that no step leaves a range, and a unit of z is a reasonable step everywhere. A range is the declared one of the
parameter or a narrower one that the caller gives."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.pytree import Spec, parameters, replace

LOGARITHMIC_RATIO = 10.0
END_SHARE = 1e-9  # relative: a start this close to an end of its range cannot leave it

Range = tuple[Any, Any]
RANGE_END_SHARE = 0.3  # of the spread over a finite range: exp(0.3 * 3.9) is about three
T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Interval:
    """value = low + (high - low) s(z)."""

    low: float
    high: float

    def value(self, z: Any) -> Any:
        """Inside (low, high)."""
        return self.low + (self.high - self.low) * jax.nn.sigmoid(z)

    def place(self, value: float) -> float:
        """z of a value."""
        part = (value - self.low) / (self.high - self.low)
        return math.log(part) - math.log1p(-part)


@dataclasses.dataclass(frozen=True)
class Decades:
    """value = sign exp(Interval in ln |value|)."""

    logarithm: Interval
    sign: float

    def value(self, z: Any) -> Any:
        """Between two numbers of one sign."""
        return self.sign * jnp.exp(self.logarithm.value(z))

    def place(self, value: float) -> float:
        """z of a value."""
        return self.logarithm.place(math.log(self.sign * value))


@dataclasses.dataclass(frozen=True)
class HalfLine:
    """value = end + scale exp(z); below the end for a negative scale."""

    end: float
    scale: float

    def value(self, z: Any) -> Any:
        """On one side of the end."""
        return self.end + self.scale * jnp.exp(z)

    def place(self, value: float) -> float:
        """z of a value."""
        return math.log((value - self.end) / self.scale)


@dataclasses.dataclass(frozen=True)
class UnboundedLine:
    """value = start + scale z."""

    start: float
    scale: float

    def value(self, z: Any) -> Any:
        """Anywhere."""
        return self.start + self.scale * z

    def place(self, value: float) -> float:
        """z of a value."""
        return (value - self.start) / self.scale


Bijection = Interval | Decades | HalfLine | UnboundedLine


def bijection(low: float, high: float, start: float) -> Bijection:
    """The map for a range, with `start` inside it."""
    if math.isfinite(low) and math.isfinite(high):
        if low * high > 0:
            near, far = sorted((abs(low), abs(high)))
            if far / near >= LOGARITHMIC_RATIO:
                return Decades(Interval(math.log(near), math.log(far)), math.copysign(1.0, low))
        return Interval(low, high)
    if math.isfinite(low):
        return HalfLine(low, start - low)
    if math.isfinite(high):
        return HalfLine(high, start - high)
    return UnboundedLine(start, max(abs(start), 1.0))


@dataclasses.dataclass(frozen=True)
class FreeParameter:
    """A free parameter: its path, shape, and the map of each of its numbers."""

    path: str
    shape: tuple[int, ...]
    maps: tuple[Bijection, ...]
    ranges: tuple[tuple[float, float], ...]


@dataclasses.dataclass(frozen=True)
class FreeSpace:
    """The free parameters of a part, in order; z has shape (size,)."""

    entries: tuple[FreeParameter, ...]

    @property
    def size(self) -> int:
        """How many numbers are free."""
        return sum(len(entry.maps) for entry in self.entries)

    @property
    def names(self) -> list[str]:
        """One for each number: `controller.kp`, `controller.gain.0`."""
        return [
            entry.path + ("." + ".".join(map(str, at)) if at else "")
            for entry in self.entries
            for at in np.ndindex(entry.shape)
        ]

    @property
    def ranges(self) -> list[tuple[float, float]]:
        """One for each number."""
        return [ends for entry in self.entries for ends in entry.ranges]

    def values(self, z: Any) -> dict[str, Any]:
        """Parameters by path. Differentiable."""
        found, first = {}, 0
        for entry in self.entries:
            numbers = [m.value(z[first + i]) for i, m in enumerate(entry.maps)]
            found[entry.path] = jnp.stack(numbers).reshape(entry.shape) if entry.shape else numbers[0]
            first += len(entry.maps)
        return found

    def at(self, part: T, z: Any) -> T:
        """The part with its free parameters at z. Differentiable."""
        return replace(part, self.values(z))

    def place(self, part: Any) -> np.ndarray:
        """z of a part's own values. Raises ValueError for a value that is not inside its range."""
        return np.concatenate([self._placed(entry, value) for entry, value in self._of(part)])

    def spread(self, key: jax.Array, count: int) -> np.ndarray:
        """Random starts (count, size): uniform over finite ranges (over their logarithms where they span decades),
        within a factor of three of the present value on half lines."""
        u = np.asarray(jax.random.uniform(key, (count, self.size), minval=0.02, maxval=0.98))
        bounded = [isinstance(m, Interval | Decades) for entry in self.entries for m in entry.maps]
        return (np.log(u) - np.log1p(-u)) * np.where(bounded, 1.0, RANGE_END_SHARE)

    def _of(self, part: Any) -> list[tuple[FreeParameter, np.ndarray]]:
        there = {path: value for path, _, value in parameters(part)}
        return [(entry, np.asarray(there[entry.path], float)) for entry in self.entries]

    @staticmethod
    def _placed(entry: FreeParameter, value: np.ndarray) -> np.ndarray:
        for x, (low, high) in zip(value.ravel(), entry.ranges, strict=True):
            _check_inside(entry.path, float(x), low, high)
        return np.array([m.place(float(x)) for m, x in zip(entry.maps, value.ravel(), strict=True)])


def parameter_space(part: Any, free: Sequence[str] | Mapping[str, Range | None]) -> FreeSpace:
    """The space of some parameters of a part, by dotted path; with a range each (numbers, or arrays of the parameter's
    shape), or None for the declared one.

    Raises:
        ValueError: a path that is no parameter, or one on which a run does not depend smoothly; a range that is empty
            or leaves the declared one; a present value at an end of its range or beyond.
    """
    given = free if isinstance(free, Mapping) else dict.fromkeys(free)
    if not given:
        raise ValueError("no parameter is free")
    there = {path: (spec, np.asarray(value, float)) for path, spec, value in parameters(part)}
    for path in given:
        if path not in there:
            raise ValueError(f"{path} is not a parameter; there is {', '.join(there)}")
        if not there[path][0].tunable:
            raise ValueError(f"{path} cannot be tuned: a run does not depend smoothly on it")
    return FreeSpace(tuple(_entry(path, *there[path], ends) for path, ends in given.items()))


def _entry(path: str, spec: Spec, value: np.ndarray, ends: Range | None) -> FreeParameter:
    low, high = (np.broadcast_to(np.asarray(x, float), value.shape) for x in ends or (spec.low, spec.high))
    maps = []
    for a, b, x in zip(low.ravel(), high.ravel(), value.ravel(), strict=True):
        a, b, x = float(a), float(b), float(x)
        if not a < b:
            raise ValueError(f"{path}: the range [{a:g}, {b:g}] is empty")
        if a < spec.low or b > spec.high:
            raise ValueError(f"{path}: the range [{a:g}, {b:g}] leaves the declared one, {spec.interval()}")
        _check_inside(path, x, a, b)
        maps.append(bijection(a, b, x))
    return FreeParameter(
        path, value.shape, tuple(maps), tuple(zip(low.ravel().tolist(), high.ravel().tolist(), strict=True))
    )


def _check_inside(path: str, value: float, low: float, high: float) -> None:
    ends = [end for end in (low, high) if math.isfinite(end)]
    room = END_SHARE * (high - low if len(ends) == 2 else max(1.0, *map(abs, ends), 0.0) if ends else 1.0)
    if not low + room <= value <= high - room:
        raise ValueError(f"{path} = {value:g} is not inside ({low:g}, {high:g}): it cannot be moved from there")
