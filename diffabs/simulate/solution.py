"""Solvers and results of a run."""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.protocols import Ending, Sample
from diffabs.core.types import AnyArray, Bool, Part, PyTree, Scalar
from diffabs.simulate import convert


@dataclasses.dataclass(frozen=True)
class FixedStep:
    """Steps of equal length up to a duration.

    With `kinks` a step ends where a comparison of the flow changes, as it does on events. Examples are a limit, the
    knot of a measured road, and a wheel that locks. Without, a step across such a kink is exact to h^2, or to h where a
    rate jumps. A derivative is exact to one order less. `kinks` costs up to twice as much time.

    Attributes:
        step: Length of a step [s].
        duration: Longest time of the run [s].
        every: A trajectory keeps every `every`-th instant.
        kinks: True if steps end on switching surfaces. None does so for derivatives, and if a rate of a part jumps
            there (conditional integration).
    """

    step: float = 1e-3
    duration: float = 10.0
    every: int = 1
    kinks: bool | None = None

    @property
    def steps(self) -> int:
        """Number of steps in the duration."""
        # The factor keeps the rounding of the quotient from adding a step.
        return math.ceil(self.duration / self.step * (1 - 1e-12))


@dataclasses.dataclass(frozen=True)
class Adaptive:
    """Steps as long as their error allows, by Tsitouras' method of fifth order. The reference method remains
    `FixedStep`.

    Steps end on events, where a clock strikes, and where a comparison of the flow changes. Examples are a limit, the
    knot of a measured road, and a wheel that locks.

    A signal that depends on time alone limits no step unless states follow it. The integral of a setpoint that swings
    faster than everything else has the error of a cubic over a step. Use fixed steps for it.

    Attributes:
        rtol: Error of a step, as a fraction of the greatest value so far of each state and of the plant's first signal.
            The error of a metric is some ten times as much (`accuracy` estimates it).
        duration: Longest time of the run [s].
        step: Step of a grid [s]. Clocks strike and delays remember on this grid. No step of the integration has to end
            there.
        every: A trajectory keeps every `every`-th instant of the grid, by interpolation.
    """

    rtol: float = 1e-5
    duration: float = 10.0
    step: float = 1e-3
    every: int = 1

    @property
    def steps(self) -> int:
        """Number of instants of the grid after the first."""
        return math.ceil(self.duration / self.step * (1 - 1e-12))


Solver = FixedStep | Adaptive
SOLVER_TYPES: dict[str, type[PyTree]] = {"fixed": FixedStep, "adaptive": Adaptive}  # by their names in a scenario
ADAPTIVE_ERROR_ORDER = 4  # order of the error of an adaptive step in its length


def refine_solver(solver: Solver, times: int) -> Solver:
    """Return the solver with steps and grid `times` shorter, over the same number of original steps.

    Args:
        solver: Solver to refine.
        times: Factor by which the step shrinks, a whole number.
    """
    step = solver.step / times
    # The duration is a multiple of the original step, so both solvers end at the same time.
    shorter = dataclasses.replace(solver, step=step, duration=solver.steps * times * step)
    if isinstance(shorter, Adaptive):
        return dataclasses.replace(shorter, rtol=shorter.rtol / times**ADAPTIVE_ERROR_ORDER)
    return shorter


def describe_solver(solver: Solver) -> dict[str, PyTree]:
    """Return the numbers of a solver that determine a run's results, for a file.

    Args:
        solver: Solver of the run.
    """
    said = {"step": solver.step, "duration": solver.duration}
    return said | ({"type": "adaptive", "rtol": solver.rtol} if isinstance(solver, Adaptive) else {})


class Trajectory(NamedTuple):
    """Signals of a run with a leading time axis (instants,). After the end of a run the last sample is repeated."""

    sample: Sample
    measured: PyTree  # output of the sensor
    state: PyTree  # state of the plant
    running: AnyArray  # bool: False after the end of the run

    def finite(self) -> Scalar:
        """Return True if every number of the run is finite."""
        return jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(self.sample)]))


class Run(NamedTuple):
    """The result of a run: metrics by name (NaN for a run that diverged), end flags, and a requested trajectory."""

    metrics: dict[str, PyTree]
    stopped: Bool  # bool: the run reached its stop in time
    diverged: Bool  # bool: invalid numbers (one is infinite, NaN or impossible), or a start beyond the stop
    timed_out: Bool  # bool: the duration ended before the stop. At most one of the three is True; none if ended early
    ending: Ending
    trajectory: Trajectory | None

    def __repr__(self) -> str:
        """Return how the run ended, and its metrics."""
        return str(convert.summarise_run(self))

    def _repr_html_(self) -> str:
        """Return the summary for a notebook."""
        return convert.summarise_run(self)._repr_html_()

    def pandas(self, plant: Part = None) -> Scalar:
        """Return the trajectory as a pandas.DataFrame indexed by time, with `attrs["units"]`; without one, a row of
        metrics for each run.

        The `plant` defines the unit of the control. Trajectories of a batch raise a ValueError.
        """
        return convert.to_pandas(self, plant)

    def xarray(self, plant: Part = None) -> Scalar:
        """Return the trajectory as an xarray.Dataset over the time, each variable with `units`.

        The `plant` defines the unit of the control. A run without a trajectory or a batch raises a ValueError.
        """
        return convert.to_xarray(self, plant)

    def plot(self, plant: Part = None, *, title: str = "") -> Scalar:
        """Return the run as a matplotlib figure (extra `plot`) with this `title`.

        The `plant` defines the unit of the control. A run without a trajectory raises a ValueError.
        """
        return convert.to_figure(self, plant, title)
