"""Results of a run that is over: its metrics, and whether the run is physically possible.

An unstable step may leave every number finite. A run with finite numbers has `diverged` in three cases. Its landing
misses the zero of the stop's margin, a metric is outside its physical range, or the plant's audit rejects the run.
"""

import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from diffabs.core.loop import Loop, LoopState
from diffabs.core.numerics import invalidate, void_derivatives
from diffabs.core.protocols import Ending, Objective
from diffabs.core.pytree import prepare_parts
from diffabs.core.types import AnyArray, Bool, PyTree, Scalar
from diffabs.engine.faults import Fault
from diffabs.engine.step.slides import has_slid, slide_of
from diffabs.engine.step.status import RunStatus
from diffabs.engine.types import Run, Trajectory

PHYSICAL_RANGE_TOLERANCE = 1e-9  # a metric may exceed its physical range by this much
Finish = Callable[[Any, Any, PyTree], tuple[Any, PyTree]]  # from loop, objectives and last carry: result, last instant
FAULTS = {
    RunStatus.DIVERGED: Fault.NUMBER,
    RunStatus.EXHAUSTED: Fault.STEPS,
    RunStatus.MISSED: Fault.LANDING,
    RunStatus.REFUSED: Fault.REFUSED,
    RunStatus.SLID: Fault.SLIDE,
}
AUDIT_METRIC = ""  # name of a plant's audit among the objectives; no metric has an empty name


def prepare(loop: Loop) -> tuple[Loop, dict[str, Objective]]:
    """Return the loop with everything precomputed that is constant during a run, and the plant's audit as an objective.

    The dictionary of the audit is empty if the plant has none.
    """
    loop = prepare_parts(loop)
    audit = getattr(loop.plant, "audit", None)
    return loop, {AUDIT_METRIC: audit(loop.initial)} if audit else {}


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
