"""How a run is asked for, and what it returns."""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.protocols import Ending, Sample
from diffabs.simulate import convert


@dataclasses.dataclass(frozen=True)
class FixedStep:
    """Steps of equal length [s], up to `duration` [s]; a trajectory keeps every `every`-th instant.

    kinks: whether a step ends where a comparison in the flow changes (a limit, the knot of a measured road, a wheel
    that locks) as it does on events. None: where a derivative is asked for, and where the rates of a part jump there
    (conditional integration). Without, a value is exact to h^2 in such a step, where a rate jumps only to h, and a
    derivative to one order less; it costs up to twice as much."""

    step: float = 1e-3
    duration: float = 10.0
    every: int = 1
    kinks: bool | None = None

    @property
    def steps(self) -> int:
        """How many steps the duration takes."""
        return math.ceil(self.duration / self.step * (1 - 1e-12))


@dataclasses.dataclass(frozen=True)
class Adaptive:
    """Steps as long as their error allows, up to `duration` [s]; they end where a comparison in the flow changes (a
    limit, the knot of a measured road, a wheel that locks), on events, and where a clock strikes. The method is
    Tsitouras' of fifth order; the reference remains `FixedStep`.

    A signal that depends on time alone limits no step unless states follow it: an integral over a setpoint that swings
    faster than everything else is as wrong as a cubic over a step is. Take fixed steps for it.

    rtol: the error of a step, as a fraction of the greatest value so far of each state and of the first signal that the
        plant shows. What a run measures is off by some ten times as much (`accuracy` estimates it)
    step: of a grid [s] on which clocks strike, delays remember, and of which a trajectory keeps every `every`-th
        instant, by interpolation. No step of the integration has to end there"""

    rtol: float = 1e-5
    duration: float = 10.0
    step: float = 1e-3
    every: int = 1

    @property
    def steps(self) -> int:
        """How many instants the grid has after the first."""
        return math.ceil(self.duration / self.step * (1 - 1e-12))


Solver = FixedStep | Adaptive
SOLVER_TYPES: dict[str, type[Any]] = {"fixed": FixedStep, "adaptive": Adaptive}  # by their names in a scenario
ADAPTIVE_ERROR_ORDER = 4  # of the error of an adaptive step, in its length


def refine_solver(solver: Solver, times: int) -> Solver:
    """Return the solver whose steps, and those of its grid, are so many times shorter, over the same whole ones."""
    step = solver.step / times
    shorter = dataclasses.replace(solver, step=step, duration=solver.steps * times * step)
    if isinstance(shorter, Adaptive):
        return dataclasses.replace(shorter, rtol=shorter.rtol / times**ADAPTIVE_ERROR_ORDER)
    return shorter


def describe_solver(solver: Solver) -> dict[str, Any]:
    """Return what decides a run's results, for a file."""
    said = {"step": solver.step, "duration": solver.duration}
    return said | ({"type": "adaptive", "rtol": solver.rtol} if isinstance(solver, Adaptive) else {})


class Trajectory(NamedTuple):
    """What was seen, with a leading time axis. After the end of a run its last sample is repeated."""

    sample: Sample
    measured: Any  # output of the sensor
    state: Any  # of the plant
    running: Any  # bool: False once the run has ended

    def finite(self) -> Any:
        """Whether every number of the run is finite."""
        return jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(self.sample)]))


class Run(NamedTuple):
    """The result: metrics by name (NaN for a run that diverged), how it ended, and the trajectory if asked for."""

    metrics: dict[str, Any]
    stopped: Any  # bool: the stop was reached in time
    diverged: Any  # bool: its numbers mean nothing: one became infinite, NaN or impossible, or it began beyond its stop
    timed_out: Any  # bool: the duration was over before the stop; a run is one of the three, or was ended from outside
    ending: Ending
    trajectory: Trajectory | None

    def __repr__(self) -> str:
        """How it ended, and what was measured."""
        return str(convert.summarise_run(self))

    def _repr_html_(self) -> str:
        """The same for a notebook."""
        return convert.summarise_run(self)._repr_html_()

    def pandas(self, plant: Any = None) -> Any:
        """The trajectory as a pandas.DataFrame indexed by time, with `attrs["units"]`; of a run without one its
        metrics, a row for each lane. `plant` says the unit of the control. Raises ValueError for many trajectories."""
        return convert.to_pandas(self, plant)

    def xarray(self, plant: Any = None) -> Any:
        """The trajectory as an xarray.Dataset over the time, each variable with `units`. Raises ValueError for a run
        without one, or for many."""
        return convert.to_xarray(self, plant)

    def plot(self, plant: Any = None, *, title: str = "") -> Any:
        """The run as a figure of matplotlib (extra `plot`); `plant` says the unit of the control. Raises
        ValueError for a run without a trajectory."""
        return convert.to_figure(self, plant, title)
