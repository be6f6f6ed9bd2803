"""Solvers and results of a run."""

import dataclasses
import math
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core import shapes
from diffabs.core.jax_flags import default_flags
from diffabs.core.meanings import document_fields
from diffabs.core.protocols import Ending, Plant, Sample
from diffabs.core.types import AnyArray, Bool, PyTree, Scalar
from diffabs.engine import convert

if TYPE_CHECKING:
    import pandas
    import xarray


@document_fields
@dataclasses.dataclass(frozen=True)
class FixedStep:
    """Steps of equal length with the classical fourth-order Runge-Kutta method, up to a duration.

    A kink is an instant at which a comparison of the flow changes. Examples are a limit, the knot of a measured road,
    and a wheel that locks. A step that ends on the kink keeps its order. A step across it is exact to h^2, or to h
    where a rate jumps. Its derivative is exact to one order less.

    See also:
        `Adaptive`: Steps as long as a tolerance allows.
        `solve`, `rollout`, `measure`: What takes steps.

    Notes:
        A step of length h takes four evaluations of the rates

            k1 = f(t, x),   k2 = f(t + h/2, x + h/2 k1),   k3 = f(t + h/2, x + h/2 k2),   k4 = f(t + h, x + h k3)
            x+ = x + h/6 (k1 + 2 k2 + 2 k3 + k4)

        with an error of h^5, so h^4 over a run. Steps are stable for h |lambda| < 2.8 about, with the fastest
        eigenvalue lambda; an unstable step is refused. Source: E. Hairer, S. P. Norsett and G. Wanner, Solving Ordinary
        Differential Equations I, 2nd ed., sec. II.1.

    Examples:
        Half the step has a sixteenth of the error:

        >>> import jax, math
        >>> import diffabs as d
        >>> jax.config.update("jax_enable_x64", True)
        >>> for step in (0.1, 0.05):
        ...     y = d.solve(lambda t, y, args: -y, 1.0, 0.0, 1.0, solver=d.FixedStep(step, 1.0)).y
        ...     print(f"{abs(y - math.exp(-1.0)):.1e}")
        3.3e-07
        2.0e-08
    """

    step: float = 1e-3
    """Length of a step [s]."""
    duration: float = 10.0
    """Longest time of the run [s]. The run ends at the first instant that is not before it."""
    every: int = 1
    """A trajectory keeps every `every`-th instant."""
    kinks: bool | None = None
    """True if steps end on kinks, which costs up to twice as much time; False if they do not. None means True for
    derivatives, and for values only if a rate jumps at a kink (conditional integration).
    """

    @property
    def steps(self) -> int:
        """Number of steps: duration/step, rounded up."""
        # The factor keeps the rounding of the quotient from adding a step.
        return math.ceil(self.duration / self.step * (1 - 1e-12))


@document_fields
@dataclasses.dataclass(frozen=True)
class Adaptive:
    """Steps as long as their error allows, by Tsitouras' method of fifth order. The reference method remains
    `FixedStep`.

    Steps end on events, where a clock strikes, and where a comparison of the flow changes. Examples are a limit, the
    knot of a measured road, and a wheel that locks.

    The error of the states and of the plant's first signal controls the step. A signal that depends on time alone has
    no influence, unless states follow it. If a setpoint swings faster than every state, use fixed steps for an integral
    over it.

    See also:
        `FixedStep`: Steps of equal length.
        `solve`, `rollout`, `measure`: What takes steps.

    Notes:
        A step takes six evaluations of the rates. Its error e, that of the cubic between its ends, falls as h^4, so the
        next step has about the length

            0.85 h (rtol max|x|/e)^(1/4)

        within limits: stability, the surface where a comparison changes next, clocks. The states' largest values so far
        are the scales, so no part declares any. Source: Ch. Tsitouras, Runge-Kutta pairs of order 5(4) satisfying only
        the first column simplifying assumption, Comput. Math. Appl. 62 (2011).

    Examples:
        >>> import jax, math
        >>> import diffabs as d
        >>> jax.config.update("jax_enable_x64", True)
        >>> y = d.solve(lambda t, y, args: -y, 1.0, 0.0, 1.0, solver=d.Adaptive(1e-8)).y
        >>> print(abs(y - math.exp(-1.0)) < 1e-8)
        True
    """

    rtol: float = 1e-5
    """Error of a step, as a fraction of the greatest value so far of each state and of the plant's first signal.
    The error of a metric is some ten times as much (`estimate_accuracy` estimates it).
    """
    duration: float = 10.0
    """Longest time of the run [s]. The run ends at the first instant of the grid that is not before it."""
    step: float = 1e-3
    """Step of a grid [s]. Clocks strike and delays remember on this grid. No step of the integration has to end there.
    """
    every: int = 1
    """A trajectory keeps every `every`-th instant of the grid, by interpolation."""

    @property
    def steps(self) -> int:
        """Number of instants of the grid after t = 0: duration/step, rounded up."""
        return math.ceil(self.duration / self.step * (1 - 1e-12))


Solver = FixedStep | Adaptive
SOLVER_TYPES: dict[str, type[PyTree]] = {"fixed": FixedStep, "adaptive": Adaptive}  # by their names in a scenario
ADAPTIVE_ERROR_ORDER = 4  # order of the error of an adaptive step in its length


def refine_solver(solver: Solver, times: int) -> Solver:
    """Return the solver with `times` as many steps, or instants of the grid, over the same time.

    The time is the original duration, rounded up to whole steps. An `Adaptive` solver also gets `rtol`/`times`^4, so
    that its own steps shrink about as much.
    """
    step = solver.step / times
    # The duration is a multiple of the original step, so both solvers end at the same time.
    shorter = dataclasses.replace(solver, step=step, duration=solver.steps * times * step)
    if isinstance(shorter, Adaptive):
        return dataclasses.replace(shorter, rtol=shorter.rtol / times**ADAPTIVE_ERROR_ORDER)
    return shorter


def describe_solver(solver: Solver) -> dict[str, PyTree]:
    """Return the fields of a solver that decide the metrics, by name, as JSON values: step and duration [s].

    `Adaptive` adds its type and `rtol`, `FixedStep` its `kinks` unless they are None.
    """
    fields = {"step": solver.step, "duration": solver.duration}
    if isinstance(solver, Adaptive):
        return fields | {"type": "adaptive", "rtol": solver.rtol}
    return fields if solver.kinks is None else fields | {"kinks": solver.kinks}


def differs_in_kind(first: Scalar, second: Scalar) -> Bool:
    """Return True where two values of a metric differ and are not both finite, such as 0.3 s and "never".

    Such a change has no size: the difference would be infinite or NaN.
    """
    finite = np.isfinite(first) & np.isfinite(second)
    return ~finite & (np.asarray(first) != second) & ~(np.isnan(first) & np.isnan(second))


class Trajectory(NamedTuple):
    """Signals of a run with a leading time axis (instants,). After the end of a run the last sample is repeated.

    Attributes:
        sample: Time, plant outputs, target, setpoint, feedforward, command and control.
        measured: Output of the sensor.
        state: State of the plant.
        running: True before the end of the run, False from its end on; bool, shape (instants,).
    """

    sample: Sample
    measured: PyTree
    state: PyTree
    running: shapes.Bool[AnyArray, "*runs instants"]

    def finite(self) -> Scalar:
        """Return True if every number of `sample` is finite; `measured` and `state` are not checked."""
        return jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(self.sample)]))


class Slide(NamedTuple):
    """The first slide of a run.

    Attributes:
        comparison: Number of the comparison along whose surface the run slides; -1 without a slide.
        t: Time at which it begins [s]; NaN without a slide.
    """

    comparison: shapes.Int[AnyArray, "*runs"]
    t: Scalar


class Run(NamedTuple):
    """The result of a run: metrics, end flags and, on request, a trajectory. At most one end flag is True.

    In a batch every field has a leading axis (runs,). All flags are False if `EarlyEnd` ended the run.

    Attributes:
        metrics: Values of the objectives by name. All are NaN if the run diverged.
        stopped: True if the run reached its stop within the duration.
        diverged: True if a number is not finite or not physically possible, or if the start is beyond the stop. Also
            True for a missed landing, for steps that are too many or cannot meet their tolerance, for a run that was
            not accepted, and for a run with adaptive steps that slides.
        timed_out: True if the duration ended before the stop. Metrics are valid then.
        ending: Last sample, whether the run stopped, and the time and distance that remain.
        trajectory: Signals at the kept instants; None if no trajectory was requested.
        slide: First slide along a switching surface; None if it is not known. All derivatives of such a run are NaN.
            The values of a run with fixed steps stay. Values alone do not always show a slide: see `slid`.
        fault: Reason for `diverged` as a number (`simulate.faults.Fault`); None if it is not known. `repr` has words.
    """

    metrics: dict[str, shapes.Float[AnyArray, "*runs"]]
    stopped: shapes.Bool[AnyArray, "*runs"]
    diverged: shapes.Bool[AnyArray, "*runs"]
    timed_out: shapes.Bool[AnyArray, "*runs"]
    ending: Ending
    trajectory: Trajectory | None
    slide: Slide | None = None
    fault: shapes.Int[AnyArray, "*runs"] | None = None

    @property
    @default_flags()
    def slid(self) -> Bool:
        """True if the run slides along a switching surface, because the flows of both sides push onto it.

        A run with fixed steps for values notices it only if it ends steps on switching surfaces (`FixedStep.kinks`).
        """
        return False if self.slide is None else self.slide.comparison >= 0

    def __getattr__(self, name: str) -> Any:
        """Raise the AttributeError for a `name` that is no field, with the metrics of the run."""
        line = f"a Run has no field {name}"
        if not name.startswith("_") and isinstance(self.metrics, dict):
            metrics = f"its metrics are {', '.join(self.metrics)}" if self.metrics else "it has no metrics"
            line += f'; run.metrics["{name}"] is a metric' if name in self.metrics else f"; {metrics}"
        raise AttributeError(line, name=name, obj=self)

    def __repr__(self) -> str:
        """Return how the run ended, and its metrics."""
        return str(convert.summarise_run(self))

    def _repr_html_(self) -> str:
        """Return the summary for a notebook."""
        return convert.summarise_run(self)._repr_html_()

    def pandas(self, plant: Plant | None = None) -> "pandas.DataFrame":
        """Return a pandas.DataFrame: the trajectory indexed by `t`, or without a trajectory one row per run.

        See `to_pandas`. The `plant` defines the unit of the control. Trajectories of a batch raise a ValueError.
        """
        return convert.to_pandas(self, plant)

    def xarray(self, plant: Plant | None = None) -> "xarray.Dataset":
        """Return the trajectory as an xarray.Dataset over the time, each variable with `units`.

        The `plant` defines the unit of the control. A run without a trajectory or a batch raises a ValueError.
        """
        return convert.to_xarray(self, plant)

    def plot(self, plant: Plant | None = None, *, title: str = "") -> Any:
        """Return the run as a matplotlib figure (extra `plot`) with this `title`.

        The `plant` defines the unit of the control. A run without a trajectory raises a ValueError.
        """
        return convert.to_figure(self, plant, title)
