"""Tuning from the values shown: what is free, what is made small, how far it is."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from diffabs.core.pytree import get, parameters
from diffabs.core.values import ScenarioError
from diffabs.explore.knobs import Knob
from diffabs.scenario.scenario import Scenario


class TuningTask(NamedTuple):
    """The lanes of a tuning, and its constraints."""

    batch: Any
    constraints: Sequence[Any]


class TuningFound(NamedTuple):
    """What a tuning has found: the scenario, the loss at each iteration, whether the constraints are met, and why it
    ended, in words."""

    after: Scenario
    losses: tuple[float, ...]
    met: bool
    reason: str


def tunable_parameters(chosen: Scenario) -> list[str]:
    """Return the parameters that can be tuned, by path: those of the scenario first, then those of its controller and
    reference."""
    there = [
        path
        for path, spec, value in parameters(chosen.loop)
        if spec.tunable and path.startswith(("controller.", "reference.")) and np.isfinite(value).all()
    ]
    return list(dict.fromkeys([*chosen.tune.free, *there]))


def default_tuning(chosen: Scenario) -> tuple[list[str], str]:
    """Return what is tuned unless one says otherwise: the scenario's own, else the gains; and the metric."""
    paths = (
        list(chosen.tune.free) or [path for path in tunable_parameters(chosen) if path.startswith("controller.")][:1]
    )
    return paths, next(iter(chosen.tune.objective or chosen.objectives), "")


def bounds_on_page(chosen: Scenario, path: str, known: Mapping[str, Knob]) -> dict[str, tuple[float, float]]:
    """Return the bounds of a free parameter as the page shows them, by the key of each of its numbers: those of [tune],
    else the ends of its sliders. Raises ScenarioError for a parameter without a range."""
    mine = {key: knob for key, knob in known.items() if knob.path == path}
    given = chosen.tune.free.get(path)
    if given is None and any(knob.low is None or knob.high is None for knob in mine.values()):
        raise ScenarioError(f"tune.free.{path} has no range: it is not finite here")

    def end(knob: Knob, side: int) -> float:
        if given is None:
            return float((knob.low, knob.high)[side] or 0.0)
        values = np.asarray(given[side], float)
        return float(values if knob.place is None or not values.ndim else values[knob.place]) * knob.scale

    return {key: (end(knob, 0), end(knob, 1)) for key, knob in mine.items()}


def scenario_with_goal(
    chosen: Scenario,
    paths: Sequence[str],
    metric: str,
    known: Mapping[str, Knob],
    bounded: Mapping[str, tuple[Any, Any]] | None = None,
) -> Scenario:
    """Return the scenario with these parameters free and this metric made small.

    Args:
        chosen: the scenario; its constraints stay
        paths: of the free parameters
        metric: name of the objective
        known: the numbers of the loop by key
        bounded: low and high end by key of a number, as typed on the page; without one those of `bounds`

    Raises:
        ScenarioError: nothing is free; there is no such metric; a bound is not in the parameter's range; the low end is
            not below the high one
    """
    if not paths:
        raise ScenarioError("tune.free is empty: choose at least one parameter")
    if metric not in chosen.objectives:
        raise ScenarioError(f"tune.objective = {metric!r} is not measured; there is {', '.join(chosen.objectives)}")
    ranges = {path: _range(chosen, path, known, bounded or {}) for path in paths}
    weights = chosen.tune.objective if metric in chosen.tune.objective else {metric: 1.0}
    task = dataclasses.replace(chosen.tune, free=ranges, objective=weights, starts=1)
    return dataclasses.replace(chosen, tune=task)


def tune_scenario(
    chosen: Scenario, posed: TuningTask, told: Callable[[int, float], None], stopping: Callable[[], bool]
) -> TuningFound:
    """Return what `diffabs tune` finds for a scenario's [tune]. `told` hears iteration and loss.

    Raises ValueError for a start that cannot be left, ModuleNotFoundError without the extra `tune`."""
    from diffabs.tune import Method, Stopping, tune

    task = chosen.tune
    found = tune(
        chosen.loop,
        free=task.free,
        objective=task.objective,
        over=posed.batch,
        solver=chosen.solver,
        measured=chosen.objectives,
        aggregate=task.aggregated(),
        constraints=posed.constraints,
        method=Method(starts=1, seed=task.seed, stopping=Stopping(iterations=task.iterations)),
        progress=lambda progress: told(progress.point.iteration, progress.point.loss),
        stopping=stopping,
    )
    losses = tuple(float(point.loss) for point in found.history)
    return TuningFound(dataclasses.replace(chosen, loop=found.loop), losses, found.met, found.reason.value)


def _range(
    chosen: Scenario, path: str, known: Mapping[str, Knob], bounded: Mapping[str, tuple[Any, Any]]
) -> tuple[Any, Any]:
    """Low and high end of a parameter in SI, in its shape."""
    ends = {
        **bounds_on_page(chosen, path, known),
        **{key: ends for key, ends in bounded.items() if known[key].path == path},
    }
    read = {key: tuple(known[key].read(end) for end in pair) for key, pair in ends.items()}
    for key, (low, high) in read.items():
        if not low < high:
            knob = known[key]
            raise ScenarioError(
                f"tune.free.{knob.name}: {knob.text(low)} is not below {knob.text(high)} {knob.spec.unit}"
            )
    low, high = zip(*read.values(), strict=True)
    return (low, high) if np.shape(get(chosen.loop, path)) else (low[0], high[0])
