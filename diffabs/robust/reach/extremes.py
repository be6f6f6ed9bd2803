"""The runs of a grid over a box with the least and greatest slip, stop time and stop distance.

A proof need not be narrower than these runs, and a bound that one of them violates is false.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from diffabs.core.protocols import BrakeOutput
from diffabs.engine.solvers import Solver
from diffabs.loop.batch import Batch
from diffabs.loop.closed_loop import Loop
from diffabs.loop.ensemble import run_batch
from diffabs.parts.objectives import MaxSlip, StopDistance, StopTime
from diffabs.parts.stops import SpeedReached

FEW_PARAMETERS_RUNS = (9, 17)  # runs along the first and the second of at most two parameters
MAX_RUNS_PER_AXIS, MAX_RUNS = 5, 1_000  # runs along each of more parameters; fewer where the grid would have more runs
ROUNDING = 1e-12  # relative; a narrower range is a single value


class ExtremeRuns(NamedTuple):
    """Extreme values of the runs of a grid.

    Attributes:
        ranges: Least and greatest value by quantity: `greatest slip` [1], `stop_time` [s] and `stop_distance` [m].
        worst: Parameters, in the order of the box, of the run with the greatest value, by quantity.
    """

    ranges: dict[str, tuple[float, float]]
    worst: dict[str, list[float]]

    @property
    def points(self) -> list[list[float]]:
        """The parameters of the runs with a greatest value, each once."""
        return list(map(list, dict.fromkeys(map(tuple, self.worst.values()))))


def find_extreme_runs(loop: Loop, solver: Solver, over: Mapping[str, tuple[float, float]]) -> ExtremeRuns:
    """Return the extreme runs of a grid of at most 1,000 runs over a box.

    Only a brake has these quantities. A loop that does not stop at a given speed has no stop time and distance, because
    its metrics extrapolate to rest.

    Args:
        over: Range (low, high) of each parameter of the box, by path, in SI units.

    Examples:
        >>> from diffabs.robust.reach.extremes import find_extreme_runs
        >>> from diffabs.scenario import load
        >>> scenario = load("slip-lmi", ["solver.duration=2"])
        >>> extremes = find_extreme_runs(scenario.loop, scenario.solver, {"initial.speed": (5.0, 6.0)})
        >>> extremes.worst["stop_distance"]  # the fastest run needs the longest way
        [6.0]
    """
    if loop.plant.shows is not BrakeOutput:
        return ExtremeRuns({}, {})
    points = np.array(list(itertools.product(*_grid_axes(over))))
    batch = Batch(dict(zip(over, points.T, strict=True)))
    metrics = {"greatest slip": MaxSlip(), "stop_time": StopTime(), "stop_distance": StopDistance()}
    columns = {name: np.asarray(x) for name, x in run_batch(loop, batch, solver, metrics).metrics.items()}
    if not isinstance(loop.stop, SpeedReached):
        # These metrics extrapolate to rest; the proof is about the stop's own speed.
        del columns["stop_time"], columns["stop_distance"]
    worst = {name: int(np.nanargmax(column)) for name, column in columns.items() if np.isfinite(column).any()}
    return ExtremeRuns(
        {name: (float(np.nanmin(columns[name])), float(columns[name][i])) for name, i in worst.items()},
        {name: points[i].tolist() for name, i in worst.items()},
    )


def is_wide(ends: Sequence[float]) -> bool:
    """Return whether a range has more than one value, apart from rounding."""
    return ends[1] - ends[0] > ROUNDING * max(map(abs, ends))


def _grid_axes(over: Mapping[str, tuple[float, float]]) -> list[np.ndarray]:
    """Return the values along each parameter; a single value is the middle of its range."""
    wide = sum(map(is_wide, over.values()))
    per_axis = next(n for n in range(MAX_RUNS_PER_AXIS, 0, -1) if n**wide <= MAX_RUNS)
    counts = FEW_PARAMETERS_RUNS if len(over) < 3 else (per_axis,) * len(over)
    return [
        np.linspace(*ends, n) if n > 1 and is_wide(ends) else np.array([0.5 * sum(ends)])
        for ends, n in zip(over.values(), counts, strict=False)
    ]
