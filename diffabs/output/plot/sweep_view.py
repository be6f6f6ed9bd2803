"""Statistics of a sweep for its figures: varying metrics, influential variables, and the cells of a map.

Columns are in SI units. Variables that are speeds are drawn in km/h.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from diffabs.core.types import Scalar
from diffabs.output.plot.style import KMH
from diffabs.uncertainty.sweep.results import Results
from diffabs.uncertainty.sweep.statistics.rows import RowMasks

# Fewest and most cells of a map along one variable. A variable with fewer different values has one cell for each.
CELL_COUNTS = (4, 24)
MIN_RUNS_PER_CELL = 10  # on average over the cells, if there are enough runs
# In machine epsilons. Metrics are differences of numbers around 1: a smaller range of values is rounding.
LEVEL_ROUNDING_EPS = 16


class AxisVariable(NamedTuple):
    """A column for an axis.

    Attributes:
        label: Label of the axis, with unit.
        values: Numbers, or indices into `names`.
        names: Names of a variable that is not a number; empty for numbers.
    """

    label: str
    values: np.ndarray
    names: list[str]


class SweepView:
    """The rows, metrics and variables of a sweep that its figures show.

    Attributes:
        results: Results of the sweep.
        units: Units by the name of a column.
        bounds: Bounds of a failure by metric.
        design: Type of the sampling design.
        period: Number of runs in a group of a Saltelli design, else 1.
        accepted: Mask of the samples that were not refused.
        good: Mask of the accepted runs that did not diverge.
        rows: Mask of the good runs that statistics use: of a Saltelli design one of each group, else all of them.
        varying: Metrics whose finite values differ by more than rounding.
        leading: First varying metric with a bound, else the first varying metric; "" if none varies.
    """

    def __init__(self, results: Results, units: Mapping[str, str] = {}):
        """Select the rows and metrics of the sweep `results`; `units` are by the name of a column."""
        self.results = results
        self.units = units
        self.bounds: Mapping[str, Any] = results.study["failures"]
        masks = RowMasks(results)
        self.design: str = masks.design
        self.period: int = masks.period
        self.accepted: np.ndarray = masks.accepted
        self.good: np.ndarray = masks.good
        self.rows: np.ndarray = masks.good & masks.rows
        rounding = LEVEL_ROUNDING_EPS * np.finfo(results.study["dtype"]).eps
        columns = ((name, results.column(name)[self.rows]) for name in results.metrics if self.rows.any())
        finite = ((name, x[np.isfinite(x)]) for name, x in columns)
        self.varying: list[str] = [
            name for name, x in finite if x.size and np.ptp(x) > rounding * max(1.0, np.abs(x).max())
        ]
        self.leading: str = next((name for name in [*self.bounds, *self.varying] if name in self.varying), "")

    def known_rows(self, name: str, rows: np.ndarray) -> np.ndarray:
        """Return those of the `rows` in which the metric `name` is finite; both are Boolean masks, shape (runs,).

        For example, a run that never settles has an infinite settling time and is left out.
        """
        return rows & np.isfinite(self.results.column(name)) if name else rows

    def never(self, name: str, rows: np.ndarray) -> str:
        """Return a note such as " (3 never: left out)" on the runs of the mask `rows` with an infinite metric `name`.

        The note is empty if there are none.
        """
        count = np.sum(rows & ~self.known_rows(name, rows))
        return f" ({count} never: left out)" if count else ""

    def label(self, name: str) -> str:
        """Return the column's `name` with its unit."""
        unit = self.units.get(name, "")
        return f"{name} [{unit}]" if unit else name

    def title(self, statement: str, count: Scalar) -> str:
        """Return a title: name of the scenario, the words of `statement`, and the number of runs `count`.

        The numbers of diverged and refused runs follow in brackets.
        """
        name, bad = self.results.manifest.get("source", {}).get("name"), np.sum(self.accepted & ~self.good)
        refused = np.sum(~self.accepted)
        runs = f"{count:,} runs" + (f" ({bad:,} diverged)" if bad else "")
        runs += f" ({refused:,} refused)" if refused else ""
        return f"{name}: {statement} {runs}" if name else f"{statement} {runs}"

    def variable(self, path: str, rows: np.ndarray) -> AxisVariable:
        """Return the varied parameter `path` in the runs of the mask `rows`, for an axis."""
        values = self.results.column(path)[rows]
        if not self.results.is_number(path):
            names, places = np.unique(values.astype(str), return_inverse=True)
            return AxisVariable(path, places, names.tolist())
        fast = self.units.get(path) == "m/s"
        return AxisVariable(f"{path} [km/h]" if fast else self.label(path), values * (KMH if fast else 1.0), [])

    def influential(self, rows: np.ndarray, result: np.ndarray, *, numbers_first: bool = False) -> list[str]:
        """Return the paths of the at most two variables with the most influence on `result`, given in the runs of the
        mask `rows`.

        The first variable explains the largest variance between cells. The second explains the largest variance of the
        rest. With `numbers_first`, a variable with names is chosen only if no numeric one varies. Variables with names
        come last in the list, because the vertical axis has room for them.
        """
        best: list[str] = []
        for _ in range(2 if len(result) else 0):
            rank = {}
            for path in self.results.variables:
                variable = self.variable(path, rows)
                if path not in best and np.ptp(variable.values) > 0:
                    rank[path] = (numbers_first and bool(variable.names), -np.var(cell_means(variable, result)))
            # The second variable is chosen on the residual of the first.
            if rank:
                best.append(min(rank, key=rank.__getitem__))
                result = result - cell_means(self.variable(best[-1], rows), result)
        return sorted(best, key=lambda path: not self.results.is_number(path))


def assign_cells(variable: AxisVariable, along: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Return the cell index of each run, shape (runs,), and the edges of the cells, shape (cells + 1,).

    A variable with few different values has one cell around each value. Other cells are equally wide.

    Args:
        along: Number of variables of the map, 1 or 2; two variables get fewer cells each.
    """
    levels, n = np.unique(variable.values), len(variable.values)
    if variable.names or len(levels) <= min(CELL_COUNTS[1], n / 2):
        middles = (levels[1:] + levels[:-1]) / 2
        edges = np.array([2 * levels[0] - middles[0], *middles, 2 * levels[-1] - middles[-1]])
    else:
        edges = np.linspace(
            levels[0], levels[-1], int(np.clip((n / MIN_RUNS_PER_CELL) ** (1 / along), *CELL_COUNTS)) + 1
        )
    return np.clip(np.searchsorted(edges, variable.values, side="right") - 1, 0, len(edges) - 2), edges


def cell_means(variable: AxisVariable, result: np.ndarray) -> np.ndarray:
    """Return for each run the mean of the result over its cell, shape (runs,).

    The variance of these means measures influence. Unlike a correlation, it shows a result that is worst in the middle
    of a range. It also shows the influence of a variable with names.
    """
    place = assign_cells(variable)[0]
    return (np.bincount(place, result) / np.maximum(np.bincount(place), 1))[place]
