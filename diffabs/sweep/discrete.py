"""What is drawn from a list: numbers or names, the values of a sample, the rows of a table."""

import dataclasses
import reprlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr

from diffabs.core.pytree import Spec
from diffabs.sweep.tables import FINITE, POSITIVE, table, weightless


def chosen(u: ArrayLike, count: int, weights: Sequence[float] | None = None) -> np.ndarray:
    """Which of `count` items the uniform u picks: the smallest k with u < F(k), the probabilities proportional to the
    weights; at u = 1 the last that has any."""
    edges = _edges(count, weights)
    return np.minimum(np.searchsorted(edges, u, side="right"), np.searchsorted(edges, 1.0))


def middles(count: int, weights: Sequence[float] | None = None) -> np.ndarray:
    """One u for each item that has a weight."""
    edges = _edges(count, weights)
    widths = np.diff(edges, prepend=0.0)
    return (edges - widths / 2)[widths > 0]


def _edges(count: int, weights: Sequence[float] | None) -> np.ndarray:
    edges = np.cumsum(np.ones(count) if weights is None else np.asarray(weights, float))
    return edges / edges[-1]


@dataclasses.dataclass(frozen=True)
class Categorical:
    """One of some numbers, or of some texts. `weights`: in proportion to the probabilities; all equal if None."""

    choices: tuple[float | str, ...]
    weights: tuple[float, ...] | None = None

    def index(self, u: ArrayLike) -> np.ndarray:
        """The number of the choice, from 0."""
        return chosen(u, len(self.choices), self.weights)

    def value(self, u: ArrayLike) -> np.ndarray:
        """The choice: an array of objects for texts."""
        return np.array(self.choices, object if self.textual() else float)[self.index(u)]

    def from_normal(self, z: ArrayLike) -> np.ndarray:
        return self.value(ndtr(z))

    def textual(self) -> bool:
        """Whether the choices are texts."""
        return any(isinstance(choice, str) for choice in self.choices)

    def middles(self) -> np.ndarray:
        """The u that give each choice once."""
        return middles(len(self.choices), self.weights)

    def support(self) -> tuple[float, float]:
        """Of the choices' numbers, from 0, if they are texts."""
        values = range(len(self.choices)) if self.textual() else np.array(self.choices, float)
        return float(min(values)), float(max(values))

    def problems(self, name: str) -> Iterator[str]:
        numbers = [choice for choice in self.choices if not isinstance(choice, str)]
        if not self.choices:
            yield f"{name}: choices are empty"
        if len(numbers) not in (0, len(self.choices)):
            yield f"{name}: choices = {reprlib.repr(list(self.choices))} mix numbers and texts"
        if not FINITE.holds(np.array(numbers, float)):
            yield f"{name}: choices = {reprlib.repr(list(self.choices))} are not all in {FINITE.interval()}"
        yield from weightless(self.weights, len(self.choices), name, POSITIVE)

    def table(self) -> dict[str, Any]:
        return table(self)


@dataclasses.dataclass(frozen=True)
class Empirical:
    """The values of a sample, in any order, each as likely: the smallest with F(value) >= u. `interpolated`: linearly
    between neighbours, the k-th of n at u = (k - 1)/(n - 1), as `numpy.quantile` does."""

    values: tuple[float, ...]
    interpolated: bool = False

    def value(self, u: ArrayLike) -> np.ndarray:
        method = "linear" if self.interpolated else "inverted_cdf"
        return np.quantile(np.array(self.values, float), np.asarray(u), method=method)

    def from_normal(self, z: ArrayLike) -> np.ndarray:
        return self.value(ndtr(z))

    def support(self) -> tuple[float, float]:
        return min(self.values), max(self.values)

    def problems(self, name: str) -> Iterator[str]:
        if not len(self.values):
            yield f"{name}: values are empty"
        if not FINITE.holds(np.array(self.values, float)):
            yield f"{name}: values = {reprlib.repr(list(self.values))} are not all in {FINITE.interval()}"

    def table(self) -> dict[str, Any]:
        return table(self)


@dataclasses.dataclass(frozen=True, eq=False)
class Rows:
    """Whole rows of a table, each as likely or by its weight: the joint distribution of its columns, which are
    parameters by path. One uniform picks a row."""

    columns: Mapping[str, Any]
    weights: Any = None

    @property
    def size(self) -> int:
        """How many rows."""
        return len(next(iter(self.columns.values())))

    def value(self, u: ArrayLike) -> dict[str, np.ndarray]:
        """The rows at u, by column."""
        rows = chosen(u, self.size, self.weights)
        return {path: np.asarray(column)[rows] for path, column in self.columns.items()}

    def from_normal(self, z: ArrayLike) -> dict[str, np.ndarray]:
        """The rows at Phi(z), by column."""
        return self.value(ndtr(z))

    def middles(self) -> np.ndarray:
        """The u that give each row once."""
        return middles(self.size, self.weights)

    def problems(self, name: str) -> Iterator[str]:
        """One line for each field that cannot be."""
        lengths = {path: np.shape(column) for path, column in self.columns.items()}
        shapes = set(lengths.values())
        if len(shapes) != 1 or len(next(iter(shapes))) != 1 or (0,) in shapes:
            found = ", ".join(f"{path} {shape}" for path, shape in lengths.items()) or "none"
            yield f"{name}: columns need one shape (n,); there is {found}"
            return
        for path, column in self.columns.items():
            if np.asarray(column).dtype.kind in "fiu" and not np.isfinite(column).all():
                yield f"{name}: column {path} is not finite in row {int(np.argmin(np.isfinite(column)))}"
        yield from weightless(self.weights, self.size, name, Spec("1", low=0.0))

    def table(self) -> dict[str, Any]:
        """As values of TOML."""
        return table(self)
