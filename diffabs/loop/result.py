"""Results of a run that is over: its metrics, and whether the run is physically possible.

An unstable step may leave every number finite. A run with finite numbers has `diverged` in three cases. Its landing
misses the zero of the stop's margin, a metric is outside its physical range, or the plant's audit rejects the run.
"""

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core import shapes
from diffabs.core.jax_flags import default_flags
from diffabs.core.numerics import invalidate, void_derivatives
from diffabs.core.protocols import Ending, Objective, Plant, Sample
from diffabs.core.types import AnyArray, Bool, PyTree, Scalar
from diffabs.engine.step.event_location import RunStatus
from diffabs.engine.step.slides import Slide, has_slid, slide_of
from diffabs.loop import convert
from diffabs.loop.closed_loop import AUDIT_METRIC, Loop, LoopState
from diffabs.loop.faults import Fault

if TYPE_CHECKING:
    import pandas
    import xarray

PHYSICAL_RANGE_TOLERANCE = 1e-9  # a metric may exceed its physical range by this much
FAULTS = {
    RunStatus.DIVERGED: Fault.NUMBER,
    RunStatus.EXHAUSTED: Fault.STEPS,
    RunStatus.MISSED: Fault.LANDING,
    RunStatus.REFUSED: Fault.REFUSED,
    RunStatus.SLID: Fault.SLIDE,
}


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

        It is False for a slide that the run follows (`follow_slides` of the solver). A run with fixed steps for values
        notices a slide only if it ends steps on switching surfaces (`FixedStep.kinks`).
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


def differs_in_kind(first: Scalar, second: Scalar) -> Bool:
    """Return True where two values of a metric differ and are not both finite, such as 0.3 s and "never".

    Such a change has no size: the difference would be infinite or NaN.
    """
    finite = np.isfinite(first) & np.isfinite(second)
    return ~finite & (np.asarray(first) != second) & ~(np.isnan(first) & np.isnan(second))


def finish_run(loop: Loop, objectives: dict[str, Objective], carry: PyTree) -> tuple[Run, Trajectory]:
    """Return the result of a run that is over, and its last instant; the objectives include the plant's audit."""
    last = observe(loop, carry.point.t, carry.point.state, carry.running)
    stopped = carry.status == RunStatus.STOPPED
    ending = Ending(last.sample, stopped, *loop.stop.remainder(last.sample, stopped))
    metrics = {name: o.value(carry.point.accumulators[name], ending) for name, o in objectives.items()}
    fault = jnp.asarray(Fault.NONE.value)
    for status, name in FAULTS.items():
        fault = jnp.where(carry.status == status, name.value, fault)
    for name, value in metrics.items():
        wrong = (fault == Fault.NONE) & _is_impossible(name, objectives[name], value)
        fault = jnp.where(wrong, (Fault.AUDIT if name == AUDIT_METRIC else Fault.METRIC).value, fault)
    diverged = fault != Fault.NONE
    metrics = {name: value for name, value in metrics.items() if name != AUDIT_METRIC}
    metrics = invalidate(metrics, diverged, (loop, objectives))
    timed_out = (carry.status == RunStatus.TIMED_OUT) & ~diverged
    slide = slide_of(carry)
    metrics, ending, last = void_derivatives((metrics, ending, last), has_slid(slide), loop)
    return Run(metrics, stopped & ~diverged, diverged, timed_out, ending, None, slide, fault), last


def observe(loop: Loop, t: Scalar, state: LoopState, running: AnyArray) -> Trajectory:
    """Return the signals of the loop at an instant, `running` if the run goes on there."""
    signals = loop.signals(t, state)
    return Trajectory(signals.sample, signals.measured, state.plant, running)


def _is_impossible(name: str, objective: Objective, value: Any) -> Bool:
    """Return True if no real run has this value.

    An audit must be at most 1. A metric must be finite and within its range `physical`, or equal to its `unreached`. A
    metric without a physical range may have any value, also NaN.
    """
    if name == AUDIT_METRIC:
        # The negation counts NaN as impossible, too.
        return ~(value <= 1)
    low, high = getattr(objective, "physical", (-math.inf, math.inf))
    if math.isinf(low) and math.isinf(high):
        return jnp.asarray(False)
    inside = (
        (value >= low - PHYSICAL_RANGE_TOLERANCE) & (value <= high + PHYSICAL_RANGE_TOLERANCE) & jnp.isfinite(value)
    )
    # `unreached` is the infinite or NaN value of a run that has no such metric: a valid answer.
    unreached = getattr(objective, "unreached", None)
    if unreached is None:
        return ~inside
    return ~(inside | (jnp.isnan(value) if math.isnan(unreached) else value == unreached))
