"""How a run is judged when it is over: its metrics, and whether it can have been.

An unstable step may leave every number finite. So a run has `diverged`, too, if its landing did not come to rest on the
crossing, if a metric is outside of its physical range, or if the plant's own audit says that it cannot have been."""

import math
from typing import Any

import jax.numpy as jnp

from diffabs.core.loop import Loop, LoopState
from diffabs.core.protocols import Ending, Objective
from diffabs.core.pytree import prepare_parts
from diffabs.simulate.condition import RunStatus
from diffabs.simulate.solution import Run, Trajectory

PHYSICAL_RANGE_TOLERANCE = 1e-9  # of a metric beyond its physical range
AUDIT_METRIC = ""  # the name of a plant's audit among the objectives; no metric is called so


def prepare(loop: Loop) -> tuple[Loop, dict[str, Objective]]:
    """The loop with everything worked out that does not change during a run, and what its plant watches it by."""
    loop = prepare_parts(loop)
    audit = getattr(loop.plant, "audit", None)
    return loop, {AUDIT_METRIC: audit(loop.initial)} if audit else {}


def finish_run(loop: Loop, objectives: dict[str, Objective], carry: Any) -> tuple[Run, Trajectory]:
    """The result of a run that is over, and its last instant; of the carry of whatever chose its steps. `objectives`
    with the plant's audit."""
    last = observe(loop, carry.point.t, carry.point.state, carry.running)
    stopped = carry.status == RunStatus.STOPPED
    ending = Ending(last.sample, stopped, *loop.stop.remainder(last.sample, stopped))
    metrics = {name: o.value(carry.point.accumulators[name], ending) for name, o in objectives.items()}
    wrong = [_is_impossible(name, objectives[name], value) for name, value in metrics.items()]
    diverged = jnp.any(jnp.stack([carry.status == RunStatus.DIVERGED, *wrong]))
    metrics = {n: jnp.where(diverged, jnp.nan, value) for n, value in metrics.items() if n != AUDIT_METRIC}
    timed_out = (carry.status == RunStatus.TIMED_OUT) & ~diverged
    return Run(metrics, stopped & ~diverged, diverged, timed_out, ending, None), last


def observe(loop: Loop, t: Any, state: LoopState, running: Any) -> Trajectory:
    """Return what is seen of the loop at an instant."""
    signals = loop.signals(t, state)
    return Trajectory(signals.sample, signals.measured, state.plant, running)


def _is_impossible(name: str, objective: Objective, value: Any) -> Any:
    """Whether no real run has this value: of an audit more than 1, of a metric one outside its range, or no number."""
    if name == AUDIT_METRIC:
        return ~(value <= 1)
    low, high = getattr(objective, "physical", (-math.inf, math.inf))
    if math.isinf(low) and math.isinf(high):
        return jnp.asarray(False)
    inside = (
        (value >= low - PHYSICAL_RANGE_TOLERANCE) & (value <= high + PHYSICAL_RANGE_TOLERANCE) & jnp.isfinite(value)
    )
    unreached = getattr(objective, "unreached", None)  # an infinite value is the answer of a run that never gets there
    return ~inside if unreached is None else ~(inside | (value == unreached))
