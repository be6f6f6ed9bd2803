"""Discrete distributions: numbers or names, the values of a sample, and the rows of a table."""

import dataclasses
import reprlib
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from diffabs.config.values import (
    FINITE_SPEC,
    POSITIVE_SPEC,
    as_plain,
    list_reader,
    read_any_number,
    read_as_given,
    table_field,
    table_reader,
)
from diffabs.core.pytree import ParameterSpec
from diffabs.core.types import PyTree, Table


def choose_indices(u: ArrayLike, count: int, weights: Sequence[float] | None = None) -> np.ndarray:
    """Return the index of the item that each uniform u picks.

    It is the smallest k with u < F(k). F(k) is the weight of the items 0 to k over the weight of all. At u = 1 it is
    the last item with a positive weight.

    Args:
        u: Uniforms in [0, 1], any shape.
        count: Number of items.
        weights: Weight of each item; None for equal weights.
    """
    edges = _cumulative_probabilities(count, weights)
    # The second term is the last item with a positive weight: u = 1 would otherwise give an index past the end.
    return np.minimum(np.searchsorted(edges, u, side="right"), np.searchsorted(edges, 1.0))


def probability_midpoints(count: int, weights: Sequence[float] | None = None) -> np.ndarray:
    """Return for each item with a positive weight the middle of its interval of u.

    Args:
        count: Number of items.
        weights: Weight of each item; None for equal weights.
    """
    edges = _cumulative_probabilities(count, weights)
    widths = np.diff(edges, prepend=0.0)
    return (edges - widths / 2)[widths > 0]


def _cumulative_probabilities(count: int, weights: Sequence[float] | None) -> np.ndarray:
    edges = np.cumsum(np.ones(count) if weights is None else np.asarray(weights, float))
    return edges / edges[-1]


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


class _Discrete:
    """A discrete distribution, whose value at Phi(z) is the value at u = Phi(z)."""

    def value(self, u: ArrayLike) -> Any:
        raise NotImplementedError

    def from_normal(self, z: ArrayLike) -> Any:
        from scipy.special import ndtr

        return self.value(ndtr(z))


@dataclasses.dataclass(frozen=True)
class Categorical(_Discrete):
    """One of several numbers, or one of several texts.

    Attributes:
        choices: Numbers, in the parameter's unit, or texts.
        weights: Numbers in proportion to the probabilities; None for equal probabilities.
    """

    choices: tuple[float | str, ...]
    weights: tuple[float, ...] | None = None
    scaled = ("choices",)

    def index(self, u: ArrayLike) -> np.ndarray:
        """Return the index of the choice at u, from 0."""
        return choose_indices(u, len(self.choices), self.weights)

    def value(self, u: ArrayLike) -> np.ndarray:
        """Return the choice at u; an array of objects for texts."""
        return np.array(self.choices, object if self.textual() else float)[self.index(u)]

    def textual(self) -> bool:
        """Return whether the choices are texts."""
        return any(isinstance(choice, str) for choice in self.choices)

    def middles(self) -> np.ndarray:
        """Return values of u that give each choice once."""
        return probability_midpoints(len(self.choices), self.weights)

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
    scaled = ("values",)

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


def _read_columns(given: PyTree, where: str) -> dict[str, np.ndarray]:
    return {
        path: np.array(column)
        for path, column in table_reader(list_reader(read_as_given), "lists")(given, where).items()
    }


@dataclasses.dataclass(frozen=True, eq=False)
class Rows(_Discrete):
    """Whole rows of a table, with equal or weighted probabilities: the joint distribution of its columns.

    Each column is a parameter by path. One uniform picks a row.

    Attributes:
        columns: Values of each parameter, by path, shape (rows,).
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
        rows = choose_indices(u, self.size, self.weights)
        return {path: np.asarray(column)[rows] for path, column in self.columns.items()}

    def middles(self) -> np.ndarray:
        """Return values of u that give each row with a positive weight once."""
        return probability_midpoints(self.size, self.weights)

    def problems(self, name: str) -> Iterator[str]:
        """Yield an error for each wrong field."""
        lengths = {path: np.shape(column) for path, column in self.columns.items()}
        shapes = set(lengths.values())
        if len(shapes) != 1 or len(next(iter(shapes))) != 1 or (0,) in shapes:
            found = ", ".join(f"{path} {shape}" for path, shape in lengths.items()) or "none"
            yield f"{name}: columns need one shape (n,); there is {found}"
            return
        for path, column in self.columns.items():
            if np.asarray(column).dtype.kind in "fiu" and not np.isfinite(column).all():
                yield f"{name}: column {path} is not finite in row {int(np.argmin(np.isfinite(column)))}"
        yield from _weight_problems(self.weights, self.size, name, ParameterSpec("1", low=0.0))
