"""Tuning from the current values: free parameters, their bounds, the objective, and the progress."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from diffabs.core.bijectors import reached_bound
from diffabs.core.pytree import get, parameters
from diffabs.core.types import PyTree
from diffabs.host.values import ScenarioError
from diffabs.loop.batch import Batch
from diffabs.output.explore.knobs import Knob
from diffabs.output.explore.stability import linear_stability, linearise_box
from diffabs.scenario.scenario import Scenario
from diffabs.scenario.tuning import build_work

if TYPE_CHECKING:
    from diffabs.tune.result import TuningProgress

OWN_OBJECTIVE = "[tune.objective]"  # no metric has this name


class TuningTask(NamedTuple):
    """The runs of a tuning, as a batch, and its constraints."""

    batch: Batch
    constraints: Sequence[PyTree]


def pose_tuning(scenario: Scenario) -> TuningTask:
    """Return runs and constraints of a scenario's [tune]."""
    try:
        work = build_work(scenario)
    except ModuleNotFoundError as error:
        raise ScenarioError(str(error)) from None
    return TuningTask(work.batch, list(work.constraints.values()))


class TuningFound(NamedTuple):
    """The result of a tuning.

    Attributes:
        after: Tuned scenario.
        met: Whether all constraints are met.
        reason: Reason for the end, in words.
        at_bounds: A sentence for each number that the tuning left at a bound of its range.
        unstable: What is not stable with these values, in words; empty if nothing is known to be unstable.
    """

    after: Scenario
    met: bool
    reason: str
    at_bounds: tuple[str, ...]
    unstable: str


def describe_own_objective(scenario: Scenario) -> str:
    """Return the objective of [tune] in words, such as "iae + 0.01 overshoot"; empty without any."""
    words = (name if weight == 1 else f"{weight:g} {name}" for name, weight in scenario.tune.objective.items())
    return " + ".join(words)


def tunable_parameters(scenario: Scenario) -> list[str]:
    """Return the paths of the tunable parameters: those of [tune.free], then others of controller and reference."""
    paths = [
        path
        for path, spec, value in parameters(scenario.loop)
        if spec.tunable
        and path.startswith(("controller.", "reference."))
        and np.ndim(value) < 2  # a matrix has no numbers on the page
        and np.isfinite(value).all()
    ]
    return list(dict.fromkeys([*scenario.tune.free, *paths]))


def default_tuning(scenario: Scenario) -> tuple[list[str], str]:
    """Return the default free parameters and the default objective.

    The parameters are those of the scenario's [tune], else the first tunable parameter of the controller. The objective
    is that of the scenario, `OWN_OBJECTIVE`, else the first metric; "" without any.
    """
    paths = (
        list(scenario.tune.free)
        or [path for path in tunable_parameters(scenario) if path.startswith("controller.")][:1]
    )
    return paths, OWN_OBJECTIVE if scenario.tune.objective else next(iter(scenario.objectives), "")


def bounds_on_page(scenario: Scenario, path: str, knobs: Mapping[str, Knob]) -> dict[str, tuple[float, float]]:
    """Return the bounds of a free parameter in SI, by the key of each of its numbers.

    They are the bounds or the declared range that [tune] gives. Without any they are the ends of the sliders.
    """
    numbers = {key: knob for key, knob in knobs.items() if knob.path == path}
    free_range = scenario.tune.free.get(path)
    if path not in scenario.tune.free and not (numbers and all(knob.low is not None for knob in numbers.values())):
        raise ScenarioError(f"tune.free.{path} has no range: it is a matrix, or not finite here")

    def end(knob: Knob, side: int) -> float:
        if free_range is None:
            ends = (knob.spec.low, knob.spec.high) if path in scenario.tune.free else (knob.low, knob.high)
            return float(ends[side] or 0.0) / knob.scale
        values = np.asarray(free_range[side], float)
        return float(values if knob.place is None or not values.ndim else values[knob.place])

    return {key: (end(knob, 0), end(knob, 1)) for key, knob in numbers.items()}


def scenario_with_goal(
    scenario: Scenario,
    paths: Sequence[str],
    metric: str,
    knobs: Mapping[str, Knob],
    bounded: Mapping[str, tuple[PyTree, PyTree]] | None = None,
) -> Scenario:
    """Return the scenario with these free parameters and this objective.

    The objective is the scenario's own, with all its weights, or one metric. The tuning has a single start.

    Args:
        bounded: Texts of the bounds (low, high) in the displayed unit, by key of a number. A bound without a text, or
            with an unchanged one, is that of `bounds_on_page`.
    """
    if not paths:
        raise ScenarioError("tune.free is empty: choose at least one parameter")
    objective = metric == OWN_OBJECTIVE and scenario.tune.objective
    if not objective and metric not in scenario.objectives:
        raise ScenarioError(f"tune.objective = {metric!r} is not measured; there is {', '.join(scenario.objectives)}")
    ranges = {path: _range(scenario, path, knobs, bounded or {}) for path in paths}
    task = dataclasses.replace(scenario.tune, free=ranges, objective=objective or {metric: 1.0}, starts=1)
    return dataclasses.replace(scenario, tune=task)


def at_bounds(scenario: Scenario, after: Scenario, knobs: Mapping[str, Knob]) -> tuple[str, ...]:
    """Return a sentence for each free number that the tuning left at a bound of its range."""
    sentences = []
    for path in scenario.tune.free:
        for key, (low, high) in bounds_on_page(scenario, path, knobs).items():
            knob = knobs[key]
            if side := reached_bound(low, high, knob.pick(get(after.loop, path))):
                sentences.append(f"{knob.label} is at its {side} bound, {knob.words(low if side == 'lower' else high)}")
    return tuple(sentences)


def describe_instability(after: Scenario) -> str:
    """Return what is not stable in the linearised loop, here and at points of the box of [design.over].

    The text is empty if all is stable, and if the loop has no linear model.
    """
    try:
        loop = linear_stability(after, linearise_box(after))
    except ValueError:
        return ""
    lost = [] if loop.stable else ["the loop is not stable"]
    if loop.box.unstable:
        lost.append(f"{loop.box.unstable} of {loop.box.systems} points of [design.over] are not stable")
    return "; ".join(lost)


def tune_scenario(
    scenario: Scenario,
    posed: TuningTask,
    knobs: Mapping[str, Knob],
    on_progress: "Callable[[TuningProgress], None]",
    stopping: Callable[[], bool],
) -> TuningFound:
    """Return the result of a tuning by a scenario's [tune], from one start: the current values.

    Raises ValueError if the descent cannot leave its start.
    """
    from diffabs.tune import Method, Stopping, build_problem, tune

    task = scenario.tune
    problem = build_problem(
        scenario.loop,
        free=task.free,
        objective=task.objective,
        over=posed.batch,
        solver=scenario.solver,
        measured=scenario.objectives,
        aggregate=task.read_aggregate(),
        constraints=posed.constraints,
    )
    tuned = tune(
        problem,
        method=Method(starts=1, seed=task.seed, stopping=Stopping(iterations=task.iterations)),
        progress=on_progress,
        stopping=stopping,
    )
    after = dataclasses.replace(scenario, loop=tuned.loop)
    return TuningFound(
        after, tuned.met, tuned.reason.value, at_bounds(scenario, after, knobs), describe_instability(after)
    )


def _range(
    scenario: Scenario, path: str, knobs: Mapping[str, Knob], bounded: Mapping[str, tuple[PyTree, PyTree]]
) -> tuple[PyTree, PyTree] | None:
    """Return the lower and the upper bound of a parameter in SI, in its shape; None for the declared range."""
    defaults, read = bounds_on_page(scenario, path, knobs), {}
    for key, ends in defaults.items():
        knob = knobs[key]
        typed = bounded.get(key, map(knob.text, ends))
        # The text of an unchanged bound is rounded; the exact bound is used instead.
        low, high = (end if text == knob.text(end) else knob.read(text) for text, end in zip(typed, ends, strict=True))
        if not low < high:
            raise ScenarioError(f"tune.free.{knob.name}: {knob.text(low)} is not below {knob.words(high)}")
        read[key] = (low, high)
    if path in scenario.tune.free and read == defaults:
        return scenario.tune.free[path]
    low, high = zip(*read.values(), strict=True)
    return (low, high) if np.shape(get(scenario.loop, path)) else (low[0], high[0])
