"""Accuracy of a run's metrics as JSON values: against half steps, quarter steps and single precision."""

import dataclasses
import math
from collections.abc import Callable, Mapping

import jax
import numpy as np

from diffabs.core.protocols import Objective
from diffabs.core.summary import format_metric
from diffabs.core.types import JsonObject, Key, Params
from diffabs.engine.solvers import MAX_SOLVER_STEPS, Adaptive, Solver, describe_solver, refine_solver
from diffabs.loop.accuracy import estimate_accuracy, incomparability_reasons, needs_key
from diffabs.loop.closed_loop import Loop
from diffabs.loop.result import Run, differs_in_kind
from diffabs.loop.run import run_unchecked

MIN_CHANGE = 1e-6  # of a value; the order of a smaller error does not matter
ROUNDING = 1e-12  # in the metric's unit; a smaller error of a value near 0 is rounding
FINEST = 4  # the shortest step of the check is the scenario's divided by this
CLOSER = 16  # `rtol` of the run with adaptive steps is divided by this for the comparison
LOOSE, LEAST = 100, 0.01  # a change above LOOSE * rtol * max(|metric|, LEAST) is reported


def check_run_accuracy(loop: Loop, solver: Solver, objectives: Mapping[str, Objective], key: Key) -> JsonObject:
    """Return the accuracy of each metric of a run as JSON values.

    The key "metrics" has a row by metric. "value" is the metric itself. "difference" and "relative" give its change by
    half steps, and "finer difference" the further change by quarter steps. "float32 difference" gives the change by
    single precision, None for a loop with noise. "order", "converges" and "error" are estimates from these runs.

    The keys beside it are "solvers", "comparable", "reasons", "ended alike" and "turned". If the runs are not
    comparable, "reasons" says why. "turned" names the metrics that are finite with one step, and not with another.
    """
    if FINEST * solver.duration / solver.step > MAX_SOLVER_STEPS:
        min_step = FINEST * solver.duration / MAX_SOLVER_STEPS
        raise ValueError(
            f"solver.step = {solver.step:g} s is outside [{min_step:g}, {solver.duration:g}] s: a quarter of it takes "
            "too many steps for --check"
        )
    why = incomparability_reasons(loop, solver, key)
    accuracy = jax.device_get(estimate_accuracy(loop, solver, objectives, key=key))
    single = {} if needs_key(loop) else _run_in_single_precision(loop, solver, objectives)
    metrics = {}
    for name in objectives:
        estimate = accuracy.estimates[name]
        value, low = float(estimate.value), single.get(name)
        metrics[name] = {
            "value": value,
            "difference": float(estimate.difference),
            "relative": _relative_change(float(estimate.difference), value),
            "finer difference": float(estimate.finer),
            "order": float(estimate.order),
            "converges": bool(estimate.converges),
            "error": float(estimate.error),
            "float32 difference": None if low is None else low - value,
        }
    return {
        "solvers": [describe_solver(refine_solver(solver, times)) for times in (1, 2, FINEST)],
        "comparable": not why,
        "reasons": why,
        "ended alike": bool(accuracy.alike),
        "turned": [name for name, estimate in accuracy.estimates.items() if estimate.turned],
        "metrics": metrics,
    }


def describe_loose_metrics(metrics: Params, solver: Adaptive, again: Callable[[Solver], Run]) -> list[str]:
    """Return a list of one line that names the metrics which depend on `rtol`; the list is empty without such metrics.

    The run is made again with `rtol` / 16. A change is reported if it exceeds 100 `rtol` of the metric's new value, or
    of 0.01 if that value is smaller. Such a run chatters, or amplifies its errors. A closer run that diverges has no
    metrics to compare, and the line says so.
    """
    closer = dataclasses.replace(solver, rtol=solver.rtol / CLOSER)
    finer, loose_metrics = again(closer), []
    if finer.diverged:
        return [f"the run diverges with solver.rtol = {closer.rtol:.2g}: its metrics cannot be trusted"]
    for name, finer_value in finer.metrics.items():
        value, finer_value = float(metrics[name]), float(finer_value)
        if differs_in_kind(value, finer_value):
            loose_metrics.append(f"{name} from {format_metric(value)} to {format_metric(finer_value)}")
        elif abs(value - finer_value) > LOOSE * solver.rtol * max(abs(finer_value), LEAST):
            loose_metrics.append(f"{name} by {100 * abs(value - finer_value) / max(abs(finer_value), LEAST):.2g} %")
    if not loose_metrics:
        return []
    why = "the run chatters or amplifies its errors; choose a smaller solver.rtol, or see --check"
    return [f"solver.rtol = {closer.rtol:.2g} changes {', '.join(loose_metrics)}: {why}"]


def describe_check(accuracy: JsonObject) -> list[str]:
    """Return the warnings of a check, a line each."""
    lines = [f"accuracy unknown: {why}" for why in accuracy["reasons"]]
    if accuracy["comparable"] and not accuracy["ended alike"]:
        lines.append("accuracy unknown: with a shorter step the run ends differently")
    rows = accuracy["metrics"].items()
    tolerances = {name: max(MIN_CHANGE * abs(row["value"]), ROUNDING) for name, row in rows}
    loose = [name for name, row in rows if not row["converges"] and row["error"] > tolerances[name]]
    if accuracy["comparable"] and loose:
        lines.append(f"shorter steps do not converge for {', '.join(loose)}: the error is a guess")
    never = "is finite with one step and never with another: its value cannot be trusted"
    return [*lines, *(f"{name} {never}" for name in accuracy["turned"])]


def _run_in_single_precision(loop: Loop, solver: Solver, objectives: Mapping[str, Objective]) -> dict[str, float]:
    """Return the metrics in single precision. The loop has no noise: single precision would draw another noise."""
    with jax.enable_x64(False):
        loop, objectives = jax.tree.map(lambda x: np.asarray(x, np.float32), (loop, dict(objectives)))
        return {name: float(x) for name, x in run_unchecked(loop, solver, objectives, None, 0).metrics.items()}


def _relative_change(difference: float, value: float) -> float:
    if difference == 0 or math.isnan(difference):
        return abs(difference)
    return abs(difference / value) if value else float("inf")
