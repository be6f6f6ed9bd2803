"""One run of a scenario with its objectives, and what the run alone does not say: warnings, and values for JSON."""

import dataclasses
import math
from collections.abc import Iterator
from typing import NamedTuple

import jax
import numpy as np

from diffabs.core.types import JsonObject, Key
from diffabs.core.units import control_units
from diffabs.engine.solvers import Adaptive, Solver, describe_solver
from diffabs.host.values import ScenarioError
from diffabs.loop.checking import check_run_accuracy, describe_loose_metrics
from diffabs.loop.faults import describe_faults
from diffabs.loop.result import Run
from diffabs.loop.run import measure, rollout
from diffabs.loop.sliding import describe_slide
from diffabs.parts.objectives import PeakOutput, at_limits
from diffabs.scenario import model
from diffabs.scenario.registry import unit_of
from diffabs.scenario.scenario import Scenario

AT_LIMIT = "at a limit\n"  # key among a run's objectives; the names in a scenario have no line break
WARNED_LIMIT_SHARE = 0.5  # share of time at a limit, above which a run gets a warning


class Simulation(NamedTuple):
    """A run of a scenario.

    Attributes:
        scenario: Scenario.
        run: The run, on the host, with the scenario's objectives.
        at_limit: Share of the run's time with the control at a limit.
        key: Random key of the noise of sensors.
        max_rows: Greatest number of rows of the trajectory; 0 for a run without one.
    """

    scenario: Scenario
    run: Run
    at_limit: float
    key: Key
    max_rows: int

    def warnings(self) -> Iterator[str]:
        """Yield warnings: unexpected ends, metrics never reached, outputs beyond the model, controls at limits."""
        scenario, run, stop = self.scenario, self.run, self.scenario.loop.stop
        stopped = bool(run.stopped)
        if bool(run.diverged):
            return
        if stopped != stop.success:
            otherwise = getattr(stop, "otherwise", "")
            late = (
                f"NOT STOPPED within solver.duration = {scenario.solver.duration:g} s{otherwise and f'; {otherwise}'}"
            )
            yield (otherwise or "STOPPED EARLY: the run reached its stop") if stopped else late
        for name in scenario.objectives:
            if math.isinf(run.metrics[name]):
                yield f"{name} is infinite: the run ends before the event that it measures"
            elif math.isnan(run.metrics[name]):
                yield f"{name} is not a number: the run lacks what it measures, as an overshoot needs a step"
        valid = getattr(scenario.loop.plant, "valid_magnitudes", {})
        for name, objective in scenario.objectives.items():
            output = objective.output if isinstance(objective, PeakOutput) else ""
            if run.metrics[name] > valid.get(output, math.inf):
                limit = f"{valid[output]:.4g} {unit_of(objective, scenario.loop.plant)}"
                yield f"{name} = {run.metrics[name]:.4g} is beyond {limit}, where the plant's model ends"
        if self.at_limit > WARNED_LIMIT_SHARE:
            limits, units = at_limits(scenario.loop), control_units(scenario.loop.plant)
            each = zip(units.items(), np.ravel(limits.low), np.ravel(limits.high), strict=True)
            bounded = [row for row in each if np.isfinite(row[1:]).any()]
            named = [(f"{name} " if len(units) > 1 else "", unit, low, high) for (name, unit), low, high in bounded]
            ends = ", ".join(f"{name}{low:g} to {high:g} {unit}" for name, unit, low, high in named)
            share = f"{100 * self.at_limit:.0f} % of the run"
            yield f"the control is at a limit ({ends}) for {share}: gains hardly matter there"

    def loose_metrics(self) -> list[str]:
        """Return warnings of metrics that depend on `rtol`, from a second run with the same compiled program."""
        scenario, solver = self.scenario, self.scenario.solver
        if not isinstance(solver, Adaptive) or self.run.diverged:
            return []

        def run_again(other: Solver) -> Run:
            return _run(dataclasses.replace(scenario, solver=other), self.key, self.max_rows)[0]

        return describe_loose_metrics(self.run.metrics, solver, run_again)

    def accuracy(self) -> JsonObject:
        """Return the accuracy of each metric, from further runs; see `check_run_accuracy`. Raises ScenarioError."""
        try:
            return check_run_accuracy(self.scenario.loop, self.scenario.solver, self.scenario.objectives, self.key)
        except ValueError as error:
            raise ScenarioError(str(error)) from None

    def slide(self) -> str:
        """Return one line about a slide of the run along a switching surface; empty without one."""
        loop = self.scenario.loop
        objectives = {**self.scenario.objectives, AT_LIMIT: at_limits(loop)}
        return describe_slide(loop, self.scenario.solver, objectives, self.run)

    def record(self) -> JsonObject:
        """Return metrics and end of the run, and the scenario's parts, parameters and solver, as JSON values."""
        scenario, run = self.scenario, self.run
        return {
            "scenario": scenario.name,
            "metrics": {name: float(run.metrics[name]) for name in scenario.objectives},
            "stopped": bool(run.stopped),
            "diverged": bool(run.diverged),
            "fault": describe_faults(run),
            "at_limit": self.at_limit,
            "warnings": list(self.warnings()),
            "title": scenario.title,
            "parts": model.describe_parts(scenario),
            "parameters": model.describe_numbers(scenario),
            "solver": {**describe_solver(scenario.solver), "seed": scenario.seed},
        }


def simulate(scenario: Scenario, key: Key | None = None, *, max_rows: int = 0) -> Simulation:
    """Return one run of a scenario with its objectives.

    Args:
        scenario: Loop, solver and objectives.
        key: Random key of the noise of sensors; by default that of the scenario's seed.
        max_rows: Greatest number of rows of the run's trajectory, which is thinned on the device, before it takes
            memory. With 0 the run has no trajectory.

    Raises:
        ValueError: A parameter is not admissible, or the step is not stable for the loop.

    See also:
        `diffabs.rollout`, `diffabs.measure`: The run alone, of any loop, also inside JAX transformations.

    Examples:
        >>> from diffabs.scenario import load, simulate
        >>> simulation = simulate(load("slip-lmi", ["solver.step=1e-3"]))
        >>> f"{simulation.record()['metrics']['stop_time']:.4f} s, at a limit {simulation.at_limit:.0%}"
        '1.6119 s, at a limit 0%'
    """
    key = scenario.key() if key is None else key
    return Simulation(scenario, *_run(scenario, key, max_rows), key, max_rows)


def _run(scenario: Scenario, key: Key, max_rows: int) -> tuple[Run, float]:
    """Return the run, on the host, and the share of its time with the control at a limit."""
    measured = {**scenario.objectives, AT_LIMIT: at_limits(scenario.loop)}
    if max_rows:
        steps = scenario.solver.steps
        every = min(max(scenario.solver.every, math.ceil(steps / max_rows)), steps)
        run = rollout(scenario.loop, dataclasses.replace(scenario.solver, every=every), measured, key=key)
    else:
        run = measure(scenario.loop, scenario.solver, measured, key=key)
    run = jax.device_get(run)
    return run._replace(metrics={name: run.metrics[name] for name in scenario.objectives}), float(run.metrics[AT_LIMIT])
