"""The free parameters of a part as one unbounded vector z.

    range                          value
    finite                         low + (high - low) s(z),   s(z) = 1/(1 + exp(-z))
    finite, over a decade or more  the same in the logarithm of |value|
    half open                      low + scale exp(z), high - scale exp(z)
    everywhere                     start + scale z

No step in z leaves a range, and one unit of z is a reasonable step everywhere. The range is the declared range of the
parameter or a narrower one from the caller.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.kinds import find_value_objection, format_value
from diffabs.core.pytree import ParameterSpec, parameters, replace
from diffabs.core.types import AnyArray, PyTree, Scalar

LOGARITHMIC_RATIO = 10.0  # ratio of the ends from which a range is mapped in the logarithm
BOUND_STEEPNESS = 0.0396  # 4 s (1 - s) at s = 0.01: slope of the map at a hundredth of a range, relative to its middle
END_SHARE = 1e-9  # of a finite range as it is mapped: near an end the map is flat; of a lone end: rounding

Range = tuple[Any, Any]
RANGE_END_SHARE = 0.3  # spread in z on half lines, over that on finite ranges: exp(0.3 * 3.9) is about 3
T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Interval:
    """The map value = low + (high - low) s(z) onto a finite range."""

    low: float
    high: float

    def value(self, z: AnyArray) -> Scalar:
        """Return the value at `z`, inside (low, high)."""
        return self.low + (self.high - self.low) * jax.nn.sigmoid(z)

    def steepness(self, z: np.ndarray) -> np.ndarray:
        """Return the slope of the map at `z`, divided by its slope at 0."""
        return 1.0 / np.cosh(0.5 * z) ** 2

    def place(self, value: float) -> float:
        """Return z of a `value`."""
        part = (value - self.low) / (self.high - self.low)
        return math.log(part) - math.log1p(-part)


@dataclasses.dataclass(frozen=True)
class Decades:
    """The map value = sign exp(Interval in ln |value|) onto a finite range of one sign and at least a decade."""

    logarithm: Interval
    sign: float

    def value(self, z: AnyArray) -> Scalar:
        """Return the value at `z`, between two numbers of one sign."""
        return self.sign * jnp.exp(self.logarithm.value(z))

    def steepness(self, z: np.ndarray) -> np.ndarray:
        """Return the slope of the map of the logarithm at `z`, divided by its slope at 0."""
        return self.logarithm.steepness(z)

    def place(self, value: float) -> float:
        """Return z of a `value`."""
        return self.logarithm.place(math.log(self.sign * value))


@dataclasses.dataclass(frozen=True)
class HalfLine:
    """The map value = end + scale exp(z) onto a half-open range, below `end` if the scale is negative."""

    end: float
    scale: float

    def value(self, z: AnyArray) -> Scalar:
        """Return the value at `z`, on one side of `end`."""
        return self.end + self.scale * jnp.exp(z)

    def steepness(self, z: np.ndarray) -> np.ndarray:
        """Return the slope of the map at `z`, divided by its slope at 0, and at most 1."""
        return np.exp(np.minimum(z, 0.0))

    def place(self, value: float) -> float:
        """Return z of a `value`."""
        return math.log((value - self.end) / self.scale)


@dataclasses.dataclass(frozen=True)
class UnboundedLine:
    """The map value = start + scale z onto all numbers."""

    start: float
    scale: float

    def value(self, z: AnyArray) -> Scalar:
        """Return the value at `z`."""
        return self.start + self.scale * z

    def steepness(self, z: np.ndarray) -> np.ndarray:
        """Return 1 at every `z`: the map has the same slope everywhere."""
        return np.ones_like(z)

    def place(self, value: float) -> float:
        """Return z of a `value`."""
        return (value - self.start) / self.scale


Bijection = Interval | Decades | HalfLine | UnboundedLine


def bijection(low: float, high: float, start: float) -> Bijection:
    """Return the map from the unbounded z onto the range (low, high).

    For a range with an infinite end, `start` is the value at z = 0, and it sets the scale. A finite range ignores it.
    """
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


def reached_bound(low: float, high: float, value: float) -> str:
    """Return "lower" or "upper" if a value is in the outer hundredth of a finite range as it is mapped, else ""."""
    if not (math.isfinite(low) and math.isfinite(high)):
        return ""
    if not low < value < high:
        return "lower" if value <= low else "upper"
    scale = bijection(low, high, value)
    if float(scale.steepness(np.asarray(scale.place(value)))) > BOUND_STEEPNESS:
        return ""
    return "lower" if value - low < high - value else "upper"


@dataclasses.dataclass(frozen=True)
class FreeParameter:
    """A free parameter: its path and shape, and the map and the range of each element, in row-major order."""

    path: str
    shape: tuple[int, ...]
    maps: tuple[Bijection, ...]
    ranges: tuple[tuple[float, float], ...]


@dataclasses.dataclass(frozen=True)
class FreeSpace:
    """The free parameters of a part, in the order in which they were given; z has shape (size,)."""

    entries: tuple[FreeParameter, ...]

    @property
    def size(self) -> int:
        """Number of free elements, over all parameters."""
        return sum(len(entry.maps) for entry in self.entries)

    @property
    def names(self) -> list[str]:
        """Name of each free element: `controller.kp`, `controller.gain.0`."""
        return [
            entry.path + ("." + ".".join(map(str, at)) if at else "")
            for entry in self.entries
            for at in np.ndindex(entry.shape)
        ]

    @property
    def ranges(self) -> list[tuple[float, float]]:
        """Range (low, high) of each free element."""
        return [ends for entry in self.entries for ends in entry.ranges]

    def values(self, z: AnyArray) -> dict[str, PyTree]:
        """Return the parameters at `z` by path. Differentiable."""
        by_path, first = {}, 0
        for entry in self.entries:
            numbers = [m.value(z[first + i]) for i, m in enumerate(entry.maps)]
            by_path[entry.path] = jnp.stack(numbers).reshape(entry.shape) if entry.shape else numbers[0]
            first += len(entry.maps)
        return by_path

    def at(self, part: T, z: AnyArray) -> T:
        """Return `part` with its free parameters at `z`. Differentiable."""
        return replace(part, self.values(z))

    def steepness(self, z: np.ndarray) -> np.ndarray:
        """Return the steepness of each element's map at `z` (size,): 1 in the middle, towards 0 at a finite end."""
        maps = [m for entry in self.entries for m in entry.maps]
        return np.array([float(m.steepness(x)) for m, x in zip(maps, z, strict=True)])

    def place(self, part: object) -> np.ndarray:
        """Return z of the present values of `part`; one that is not inside its range is a ValueError."""
        present = {path: value for path, _, value in parameters(part)}
        values = [np.asarray(present[entry.path], float).ravel() for entry in self.entries]
        positions = []
        for entry, numbers in zip(self.entries, values, strict=True):
            for x, m, ends in zip(numbers, entry.maps, entry.ranges, strict=True):
                _check_inside(entry.path, float(x), m, ends)
            positions.append(np.array([m.place(float(x)) for m, x in zip(entry.maps, numbers, strict=True)]))
        return np.concatenate(positions)

    def spread(self, key: jax.Array, count: int) -> np.ndarray:
        """Return `count` random starts z (count, size) from the random `key`.

        On a finite range the values are uniform, or uniform in the logarithm if the map is `Decades`. They stay 2 %
        away from both ends. On other ranges they surround the value x0 that the part had when the space was made. On a
        range with one infinite end, the distance from the finite end changes by at most a factor of about three. On an
        unbounded range, the values differ from x0 by at most 1.2 max(|x0|, 1).
        """
        u = np.asarray(jax.random.uniform(key, (count, self.size), minval=0.02, maxval=0.98))
        bounded = [isinstance(m, Interval | Decades) for entry in self.entries for m in entry.maps]
        # The logit of a uniform number is uniform over the range once s(z) maps it back.
        return (np.log(u) - np.log1p(-u)) * np.where(bounded, 1.0, RANGE_END_SHARE)


def parameter_space(part: object, free: Sequence[str] | Mapping[str, Range | None]) -> FreeSpace:
    """Return the space of some parameters of a part, as a map from an unbounded vector z.

    `free` has dotted paths, or ranges by path: pairs of numbers or of arrays of the parameter's shape; None is the
    declared range. A present value at an end of its range, or a range that leaves the declared one, is a ValueError.
    """
    if isinstance(free, str):
        raise ValueError(f"free = {free!r} is text; a list of paths, or ranges by path, is needed")
    ranges = free if isinstance(free, Mapping) else dict.fromkeys(free)
    if not ranges:
        raise ValueError("no parameter is free")
    declared = {path: (spec, np.asarray(value, float)) for path, spec, value in parameters(part)}
    for path in ranges:
        if path not in declared:
            raise ValueError(f"{path} is not a parameter; there is {', '.join(declared)}")
        if not declared[path][0].tunable:
            raise ValueError(f"{path} cannot be tuned: a run does not depend smoothly on it")
    return FreeSpace(tuple(_entry(path, *declared[path], ends) for path, ends in ranges.items()))


def _entry(path: str, spec: ParameterSpec, value: np.ndarray, ends: Range | None) -> FreeParameter:
    try:
        pair = (spec.low, spec.high) if ends is None else ends
        if any(map(find_value_objection, pair)):  # NumPy would parse text
            raise ValueError
        low, high = (np.broadcast_to(np.asarray(x, float), value.shape) for x in pair)
    except (TypeError, ValueError):
        shape = f" of shape {value.shape}" if value.shape else ""
        needed = f"a pair (low, high) of numbers{shape}"
        raise ValueError(f"{path}: the range {format_value(ends)} is not {needed}") from None
    maps = []
    for a, b, x in zip(low.ravel(), high.ravel(), value.ravel(), strict=True):
        a, b, x = float(a), float(b), float(x)
        if not a < b:
            raise ValueError(f"{path}: the range [{a:g}, {b:g}] is empty")
        if a < spec.low or b > spec.high:
            raise ValueError(f"{path}: the range [{a:g}, {b:g}] leaves the declared one, {spec.interval()}")
        maps.append(bijection(a, b, x))
        _check_inside(path, x, maps[-1], (a, b))
    return FreeParameter(
        path, value.shape, tuple(maps), tuple(zip(low.ravel().tolist(), high.ravel().tolist(), strict=True))
    )


def _check_inside(path: str, value: float, mapping: Bijection, ends: tuple[float, float]) -> None:
    """Raise a ValueError if a value is too close to an end of its range, or outside."""
    (low, high), x = ends, value
    inside = low < value < high
    if inside and isinstance(mapping, Decades):
        low, high, x = mapping.logarithm.low, mapping.logarithm.high, math.log(mapping.sign * value)
    finite = [abs(end) for end in (low, high) if math.isfinite(end)]
    room = END_SHARE * (high - low if len(finite) == 2 else sum(finite))
    if not (inside and low + room <= x <= high - room):
        low, high = ends
        raise ValueError(f"{path} = {value:g} is not inside ({low:g}, {high:g}): it cannot be moved from there")
