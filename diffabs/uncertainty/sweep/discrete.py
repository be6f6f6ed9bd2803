"""Discrete distributions: numbers or names, the values of a sample, and the rows of a table."""

import dataclasses
import reprlib
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from diffabs.core.pytree import ParameterSpec
from diffabs.core.types import PyTree, Table
from diffabs.host.values import (
    FINITE_SPEC,
    POSITIVE_SPEC,
    as_plain,
    list_reader,
    read_any_number,
    read_as_given,
    table_field,
    table_reader,
)


def _weight_problems(weights: Sequence[float] | None, count: int, name: str, each: ParameterSpec) -> Iterator[str]:
    """Yield an error for weights of a wrong number, for weights outside `each`, and for weights that are all zero."""
    if weights is None:
        return
    if len(weights) != count:
        yield f"{name}: weights are {len(weights)}; there are {count} to weigh"
    if not each.holds(np.asarray(weights, float)):
        yield f"{name}: weights = {reprlib.repr(as_plain(weights))} are not all in {each.interval()}"
    elif not np.sum(weights) > 0:
        yield f"{name}: weights have sum {np.sum(weights):g}"


def is_numeric(column: ArrayLike) -> bool:
    """Return whether values have a type of numbers; objects and booleans have not."""
    return np.asarray(column).dtype.kind in "fiu"


class _Discrete:
    """A discrete distribution, whose value at Phi(z) is the value at u = Phi(z)."""

    def value(self, u: ArrayLike) -> Any:
        raise NotImplementedError

    def from_normal(self, z: ArrayLike) -> np.ndarray:
        from scipy.special import ndtr

        return self.value(ndtr(z))


class _Weighted(_Discrete):
    """A discrete distribution of items with equal or weighted probabilities."""

    weights: PyTree

    @property
    def size(self) -> int:
        """Number of items."""
        raise NotImplementedError

    def index(self, u: ArrayLike) -> np.ndarray:
        """Return the index of the item at u. It is the smallest k with u < F(k), at u = 1 the last with a positive
        weight.

        F(k) is the weight of the items 0 to k over the weight of all.
        """
        edges = self._cumulative_probabilities()
        # The second term is the last item with a positive weight: u = 1 would otherwise give an index past the end.
        return np.minimum(np.searchsorted(edges, u, side="right"), np.searchsorted(edges, 1.0))

    def middles(self) -> np.ndarray:
        """Return for each item with a positive weight the middle of its interval of u."""
        edges = self._cumulative_probabilities()
        widths = np.diff(edges, prepend=0.0)
        return (edges - widths / 2)[widths > 0]

    def _cumulative_probabilities(self) -> np.ndarray:
        edges = np.cumsum(np.ones(self.size) if self.weights is None else np.asarray(self.weights, float))
        return edges / edges[-1]


@dataclasses.dataclass(frozen=True)
class Categorical(_Weighted):
    """One of several numbers, or one of several texts.

    Attributes:
        choices: Numbers, in the parameter's unit, or texts.
        weights: Numbers in proportion to the probabilities; None for equal probabilities.
    """

    choices: tuple[float | str, ...]
    weights: tuple[float, ...] | None = None
    scaled: ClassVar[tuple[str, ...]] = ("choices",)

    @property
    def size(self) -> int:
        """Number of choices."""
        return len(self.choices)

    def value(self, u: ArrayLike) -> np.ndarray:
        """Return the choice at u; an array of objects for texts."""
        return np.array(self.choices, object if self.textual() else float)[self.index(u)]

    def textual(self) -> bool:
        """Return whether the choices are texts."""
        return any(isinstance(choice, str) for choice in self.choices)

    def support(self) -> tuple[float, float]:
        """Return the smallest and the largest choice; for texts those of their indices, from 0."""
        values = range(len(self.choices)) if self.textual() else np.array(self.choices, float)
        return float(min(values)), float(max(values))

    def problems(self, name: str) -> Iterator[str]:
        numbers = [choice for choice in self.choices if not isinstance(choice, str)]
        if not self.choices:
            yield f"{name}: choices are empty"
        if len(numbers) not in (0, len(self.choices)):
            yield f"{name}: choices = {reprlib.repr(list(self.choices))} mix numbers and texts"
        if not FINITE_SPEC.holds(np.array(numbers, float)):
            yield f"{name}: choices = {reprlib.repr(list(self.choices))} are not all in {FINITE_SPEC.interval()}"
        yield from _weight_problems(self.weights, len(self.choices), name, POSITIVE_SPEC)


@dataclasses.dataclass(frozen=True)
class Empirical(_Discrete):
    """The values of a sample, in any order, with equal probabilities: the smallest value with F(value) >= u.

    Attributes:
        values: Values, in the parameter's unit.
        interpolated: Interpolate linearly between neighbours, the k-th of n at u = (k - 1)/(n - 1), as
            `numpy.quantile`.
    """

    values: tuple[float, ...]
    interpolated: bool = False
    scaled: ClassVar[tuple[str, ...]] = ("values",)

    def value(self, u: ArrayLike) -> np.ndarray:
        method = "linear" if self.interpolated else "inverted_cdf"
        return np.quantile(np.array(self.values, float), np.asarray(u), method=method)

    def support(self) -> tuple[float, float]:
        """Return the smallest and the largest value."""
        return min(self.values), max(self.values)

    def problems(self, name: str) -> Iterator[str]:
        if not len(self.values):
            yield f"{name}: values are empty"
        if not FINITE_SPEC.holds(np.array(self.values, float)):
            yield f"{name}: values = {reprlib.repr(list(self.values))} are not all in {FINITE_SPEC.interval()}"


def _read_columns(table: object, where: str) -> dict[str, np.ndarray]:
    return {
        path: np.array(column)
        for path, column in table_reader(list_reader(read_as_given), "lists")(table, where).items()
    }


@dataclasses.dataclass(frozen=True, eq=False)
class Rows(_Weighted):
    """Whole rows of a table, with equal or weighted probabilities: the joint distribution of its columns.

    Each column is a parameter by path. One uniform picks a row.

    Attributes:
        columns: Finite numbers, or texts, of each parameter, by path, shape (rows,).
        weights: Numbers in proportion to the probabilities of the rows; None for equal probabilities.
    """

    columns: Table = table_field(_read_columns)
    weights: PyTree = table_field(list_reader(read_any_number), None)

    @property
    def size(self) -> int:
        """Number of rows."""
        return len(next(iter(self.columns.values())))

    def value(self, u: ArrayLike) -> dict[str, np.ndarray]:
        """Return the rows at u, by column."""
        rows = self.index(u)
        return {path: np.asarray(column)[rows] for path, column in self.columns.items()}

    def problems(self, name: str) -> Iterator[str]:
        """Yield an error for each wrong field."""
        lengths = {path: np.shape(column) for path, column in self.columns.items()}
        shapes = set(lengths.values())
        if len(shapes) != 1 or len(next(iter(shapes))) != 1 or (0,) in shapes:
            described = ", ".join(f"{path} {shape}" for path, shape in lengths.items()) or "none"
            yield f"{name}: columns need one shape (n,); there is {described}"
            return
        for path, column in self.columns.items():
            if is_numeric(column):
                if not np.isfinite(column).all():
                    yield f"{name}: column {path} is not finite in row {int(np.argmin(np.isfinite(column)))}"
            elif not all(isinstance(value, str) for value in column):
                kind = np.asarray(column).dtype
                yield f"{name}: column {path} is of type {kind}; numbers of type float, or texts, are needed"
        yield from _weight_problems(self.weights, self.size, name, ParameterSpec("1", low=0.0))
