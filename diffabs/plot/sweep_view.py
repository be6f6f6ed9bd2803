"""What the figures ask of a sweep: which metrics vary, which variables move them, and the cells of a map.

Columns are in SI; variables that are speeds are drawn in km/h."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from diffabs.plot.style import KMH
from diffabs.sweep.results import Results

CELL_COUNTS = (
    4,
    24,
)  # of a map along one variable, fewest and most; one with fewer different values has a cell for each
MIN_RUNS_PER_CELL = 10  # of a cell on average, if there are enough
ROUNDING_EPS = 16  # epsilons: metrics are differences of numbers around one


class AxisVariable(NamedTuple):
    """A column for an axis: numbers, or places in a list of names."""

    label: str
    values: np.ndarray
    names: list[str]


class SweepView:
    """What the figures ask of a sweep."""

    def __init__(self, found: Results, units: Mapping[str, str] = {}):
        """`units`: by the name of a column."""
        self.found, self.units, self.bounds = found, units, found.study["failures"]
        self.design, self.good = found.study["space"]["design"]["type"], ~found.column("diverged")
        self.accepted = found.accepted
        self.good &= self.accepted
        period = len(found.study["space"]["variables"]) + 2 if self.design == "saltelli" else 1
        self.rows = self.good & (found.column("sample") % period == 0)  # those in the statistics: A of (A, B, AB)
        least = ROUNDING_EPS * np.finfo(found.study["dtype"]).eps
        columns = ((name, found.column(name)[self.rows]) for name in found.metrics if self.rows.any())
        finite = ((name, x[np.isfinite(x)]) for name, x in columns)
        self.varying = [name for name, x in finite if x.size and np.ptp(x) > least * max(1.0, np.abs(x).max())]
        self.leading = next((name for name in [*self.bounds, *self.varying] if name in self.varying), "")

    def known(self, name: str, rows: np.ndarray) -> np.ndarray:
        """Those of the rows in which a metric is finite: a run that never settles has no place in a figure."""
        return rows & np.isfinite(self.found.column(name)) if name else rows

    def never(self, name: str) -> str:
        """How many runs a figure of this metric leaves out; empty for none."""
        count = np.sum(self.rows & ~self.known(name, self.rows))
        return f" ({count} never: left out)" if count else ""

    def named(self, name: str) -> str:
        """A column's name with its unit."""
        unit = self.units.get(name, "")
        if ", " in unit:  # of a list, one after the other
            unit = unit.split(", ")[int(name.rpartition(".")[2])]
        return f"{name} [{unit}]" if unit else name

    def title(self, what: str, rows: np.ndarray) -> str:
        """With the scenario's name, if it has one, and how many runs are behind the figure."""
        name, bad = self.found.manifest.get("source", {}).get("name"), np.sum(self.accepted & ~self.good)
        refused = np.sum(~self.accepted)
        runs = f"{np.sum(rows):,} runs" + (f" ({bad:,} diverged)" if bad else "")
        runs += f" ({refused:,} refused)" if refused else ""
        return f"{name}: {what} {runs}" if name else f"{what} {runs}"

    def variable(self, path: str, rows: np.ndarray) -> AxisVariable:
        """A varied parameter in these rows, for an axis."""
        values = self.found.column(path)[rows]
        if not self.found.is_number(path):
            names, places = np.unique(values.astype(str), return_inverse=True)
            return AxisVariable(path, places, names.tolist())
        fast = self.units.get(path) == "m/s"
        return AxisVariable(f"{path} [km/h]" if fast else self.named(path), values * (KMH if fast else 1.0), [])

    def influential(self, rows: np.ndarray, result: np.ndarray, *, numbers_first: bool = False) -> list[str]:
        """The variable that moves a result most, and the one that moves most of what the first leaves unexplained;
        names last because the upward axis has room for them."""
        best: list[str] = []
        for _ in range(2 if len(result) else 0):
            rank = {}
            for path in self.found.variables:
                one = self.variable(path, rows)
                if path not in best and np.ptp(one.values) > 0:
                    rank[path] = (numbers_first and bool(one.names), -np.var(cell_means(one, result)))
            if rank:
                best.append(min(rank, key=rank.__getitem__))
                result = result - cell_means(self.variable(best[-1], rows), result)
        return sorted(best, key=lambda path: not self.found.is_number(path))


def assign_cells(one: AxisVariable, along: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """The place of each run among cells, and their edges: around each value if there are few, else equally wide."""
    levels, n = np.unique(one.values), len(one.values)
    if one.names or len(levels) <= min(CELL_COUNTS[1], n / 2):
        middles = (levels[1:] + levels[:-1]) / 2
        edges = np.array([2 * levels[0] - middles[0], *middles, 2 * levels[-1] - middles[-1]])
    else:
        edges = np.linspace(
            levels[0], levels[-1], int(np.clip((n / MIN_RUNS_PER_CELL) ** (1 / along), *CELL_COUNTS)) + 1
        )
    return np.clip(np.searchsorted(edges, one.values, side="right") - 1, 0, len(edges) - 2), edges


def cell_means(one: AxisVariable, result: np.ndarray) -> np.ndarray:
    """For each run the mean of the result over its cell. Unlike a correlation their variance sees a result that is
    worst in the middle, and what names do."""
    place = assign_cells(one)[0]
    return (np.bincount(place, result) / np.maximum(np.bincount(place), 1))[place]
