"""Tuning from the values shown: what is free, what is made small, how far it is."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from diffabs.core.pytree import get, parameters
from diffabs.core.values import ScenarioError
from diffabs.explore.knobs import Knob
from diffabs.scenario.scenario import Scenario


class Posed(NamedTuple):
    """The lanes of a tuning, and its constraints."""

    batch: Any
    constraints: Sequence[Any]


class Found(NamedTuple):
    """What a tuning has found: the scenario, the loss at each iteration, whether the constraints are met, and why it
    ended, in words."""

    after: Scenario
    losses: tuple[float, ...]
    met: bool
    reason: str


def free(chosen: Scenario) -> list[str]:
    """Return the parameters that can be tuned, by path: those of the scenario first, then those of its controller and
    reference."""
    there = [
        path
        for path, spec, value in parameters(chosen.loop)
        if spec.tunable and path.startswith(("controller.", "reference.")) and np.isfinite(value).all()
    ]
    return list(dict.fromkeys([*chosen.tune.free, *there]))


def usual(chosen: Scenario) -> tuple[list[str], str]:
    """Return what is tuned unless one says otherwise: the scenario's own, else the gains; and the metric."""
    paths = list(chosen.tune.free) or [path for path in free(chosen) if path.startswith("controller.")][:1]
    return paths, next(iter(chosen.tune.objective or chosen.objectives), "")


def goal(chosen: Scenario, paths: Sequence[str], metric: str, known: Mapping[str, Knob]) -> Scenario:
    """Return the scenario with these parameters free and this metric made small; ranges and constraints are those of
    its [tune], else ranges are those of the sliders. Raises ScenarioError where nothing is free or no such metric is
    there."""
    if not paths:
        raise ScenarioError("tune.free is empty: choose at least one parameter")
    if metric not in chosen.objectives:
        raise ScenarioError(f"tune.objective = {metric!r} is not measured; there is {', '.join(chosen.objectives)}")
    ranges = {path: chosen.tune.free.get(path) or _range(chosen, path, known) for path in paths}
    weights = chosen.tune.objective if metric in chosen.tune.objective else {metric: 1.0}
    task = dataclasses.replace(chosen.tune, free=ranges, objective=weights, starts=1)
    return dataclasses.replace(chosen, tune=task)


def tuned(chosen: Scenario, posed: Posed, told: Callable[[int, float], None], stopping: Callable[[], bool]) -> Found:
    """Return what `diffabs tune` finds for a scenario's [tune]. `told` hears iteration and loss.

    Raises ValueError for a start that cannot be left, ModuleNotFoundError without the extra `diffabs[tune]`."""
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
    return Found(dataclasses.replace(chosen, loop=found.loop), losses, found.met, found.reason.value)


def _range(chosen: Scenario, path: str, known: Mapping[str, Knob]) -> tuple[Any, Any]:
    """The ends of the sliders of a parameter, in SI, with the value well inside."""
    shape = np.shape(get(chosen.loop, path))
    mine = [knob for knob in known.values() if knob.path == path]
    if any(knob.low is None or knob.high is None for knob in mine):
        raise ScenarioError(f"tune.free.{path} has no range: it is not finite here")
    ends = [[getattr(knob, end) / knob.scale for knob in mine] for end in ("low", "high")]
    low, high = (tuple(end) if shape else end[0] for end in ends)
    return low, high
