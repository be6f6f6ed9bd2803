"""The task of a tuning, and the JSON values of its result."""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from diffabs.core.bijectors import reached_bound
from diffabs.core.pytree import get, parameters
from diffabs.core.types import JsonObject, Params, Scalar
from diffabs.host.values import ScenarioError
from diffabs.linear.robustness import box_points
from diffabs.loop.admissible import first_refusal
from diffabs.loop.batch import Batch
from diffabs.loop.closed_loop import Loop
from diffabs.scenario import proving
from diffabs.scenario.proving import Proved
from diffabs.scenario.scenario import Scenario
from diffabs.scenario.section_tune import FrequencyConstraints

if TYPE_CHECKING:
    from diffabs.assess import Clause, ClauseBounds
    from diffabs.robust.design.loop_task import ProofTask
    from diffabs.tune import FrequencyBounds, Method, Tuned
    from diffabs.tune.problem import Problem

WHEN = ("before", "after")
MARGIN_CONSTRAINTS = "margins"  # name of the constraints of [tune.constraints]
CLAUSE_CONSTRAINTS = "clauses"  # name of the clauses of [tune]


class Work(NamedTuple):
    """The task of a tuning.

    Attributes:
        scenario: Scenario.
        batch: Runs.
        constraints: Constraints by name.
        task: Linear systems for a decay rate or damping; None without these constraints.
    """

    scenario: Scenario
    batch: Batch
    constraints: JsonObject
    task: "ProofTask | None"

    @property
    def frequency_bounds(self) -> "FrequencyBounds | None":
        """The bounds of [tune.constraints]; None without any."""
        return self.constraints.get(MARGIN_CONSTRAINTS)


def build_work(scenario: Scenario) -> Work:
    """Return the runs and constraints of a tuning."""
    from diffabs.tune import AtMost, CertifiedDecay, Poles
    from diffabs.tune.frequency_bounds import check_one_control

    try:
        check_one_control(scenario.tune.constraints.bounds(), scenario.loop)
    except ValueError as error:
        raise ScenarioError(f"tune.constraints: {error}") from None
    goal = scenario.tune.check(scenario.loop)
    batch = goal.batch(scenario.seed).check(scenario.loop)
    if line := first_refusal(scenario.loop, batch.values, scenario.solver):
        raise ScenarioError(f"tune.over: {line}")
    constraints: JsonObject = {name: AtMost(metric=name, bound=bound) for name, bound in goal.limits.items()}
    task = proving.build_proof_task(scenario) if goal.decay or goal.damping else None
    if task and goal.decay:
        constraints["certified decay"] = CertifiedDecay(task.polytope, goal.decay)
    if task and goal.damping:
        constraints["damping"] = Poles(task.polytope, damping=goal.damping)
    if goal.constraints.bounds():
        constraints[MARGIN_CONSTRAINTS] = build_frequency_bounds(scenario)
    if goal.clauses:
        constraints[CLAUSE_CONSTRAINTS] = build_clause_bounds(scenario)
    return Work(scenario, batch, constraints, task)


def build_frequency_bounds(scenario: Scenario) -> "FrequencyBounds":
    """Return the bounds of [tune.constraints] at the corners of [design.over] and at points inside.

    Raises:
        ScenarioError: A bound is of one control and the plant has several, or the loop has no margins at a point.
    """
    from diffabs.tune import FrequencyBounds

    section, loop = scenario.tune.constraints, scenario.loop
    ranges = scenario.design.ranges(loop)
    points = np.array(box_points(list(ranges.values()), section.samples))
    bounds = FrequencyBounds(
        **{name: getattr(section, name) for name in section.bounds()},
        points=Batch({path: points[:, i] for i, path in enumerate(ranges)}),
    )
    try:
        _check_reachable(section, loop)
        worst = bounds.worst(loop)
    except ValueError as error:
        raise ScenarioError(f"tune.constraints: {error}") from None
    if missing := [name for name, value in worst.items() if math.isnan(value)]:
        raise ScenarioError(
            f"tune.constraints: no {', '.join(missing)} at the start: the loop is unstable, or has no linear model, at "
            "a point of [design.over]; `diffabs margins` says where"
        )
    return bounds


def build_clause_bounds(scenario: Scenario) -> "ClauseBounds":
    """Return the clauses of [tune], for the stops of [assess].

    Raises:
        ScenarioError: A clause has no finite figure at the start, so that the search has no derivative.
    """
    from diffabs.assess import ClauseBounds, StopProgram

    bounds = ClauseBounds(scenario.tune.clauses, scenario.solver, scenario.assess or StopProgram())
    for clause in bounds.judge(scenario.loop):
        if clause.diverged:
            why = f"{clause.diverged} runs diverge or do not reach 15 km/h"
        elif not math.isfinite(clause.figure):
            why = f"the {clause.rule} is not finite, in {clause.stop}"
        else:
            continue
        raise ScenarioError(f"tune.clauses: {clause.number} has no derivative at the start: {why}")
    return bounds


def _check_reachable(section: FrequencyConstraints, loop: Loop) -> None:
    """Raise a ValueError for a bound that no loop of this kind meets, or for poles that a pure delay multiplies."""
    from diffabs.linear.responses import open_transfer

    if not (section.shape or section.pole_decay or section.pole_damping):
        return
    opened = open_transfer(loop)
    if section.shape and opened.period is None and (end := section.shape[-1][1]) < 1:
        raise ValueError(f"shape ends at {end:g}, but |S| of a loop in continuous time tends to 1 at high frequencies")
    if (section.pole_decay or section.pole_damping) and float(opened.delay) > 0:
        raise ValueError(
            f"pole_decay and pole_damping are of loops without pure delay; this one has {float(opened.delay):g} s"
        )


def build_tuning(work: Work, engine: str = "auto") -> "Problem":
    """Return the problem of a tuning, for `tune.tune` with the `engine` of its runs."""
    from diffabs import tune

    goal, constraints = work.scenario.tune, dict(work.constraints)
    if clauses := constraints.get(CLAUSE_CONSTRAINTS):
        constraints[CLAUSE_CONSTRAINTS] = dataclasses.replace(clauses, engine=engine)
    return tune.build_problem(
        work.scenario.loop,
        free=goal.free,
        objective=goal.objective,
        over=work.batch,
        solver=work.scenario.solver,
        measured=work.scenario.objectives,
        aggregate=goal.read_aggregate(),
        constraints=list(constraints.values()),
        engine=engine,
    )


def build_method(work: Work) -> "Method":
    """Return the starts and the end of a tuning, for `tune.tune`."""
    from diffabs.tune import Method, Stopping

    goal = work.scenario.tune
    return Method(starts=goal.starts, seed=goal.seed, stopping=Stopping(iterations=goal.iterations))


def describe_tuning(work: Work, tuned: "Tuned", proved: Proved) -> JsonObject:
    """Return the JSON values of a tuning and of the proof about its result."""
    scenario, goal = work.scenario, work.scenario.tune
    return {
        "lanes": work.batch.size,
        "free": {path: _free(scenario, tuned, path) for path in goal.free},
        "objective": dict(zip(WHEN, map(float, tuned.objective), strict=True)),
        "metrics": {when: _over_lanes(m, scenario) for when, m in zip(WHEN, tuned.metrics, strict=True)},
        "constraints": (rows := _constraints(work, tuned, proved)),
        "met": all(row["met"] for row in rows),
        "reason": tuned.reason.value,
        "gradient_norm": float(tuned.gradient),
        "evaluations": tuned.evaluations,
        "mode": tuned.mode.value,
        "engine": tuned.engine,
        "history": [point._asdict() for point in tuned.history],
        "starts": [
            {"objective": float(s.objective), "violation": float(s.violation), "reason": s.reason.value}
            for s in tuned.starts
        ],
        "parameters": {path: _plain(value) for path, _, value in parameters(tuned.loop)},
        "certificate": proved.document,
    }


def with_unproved(work: Work, result: JsonObject) -> JsonObject:
    """Return the values of a tuning with its unchecked constraints added, as not met."""
    names = [row["name"] for row in result["constraints"]]
    goal = work.scenario.tune
    bounds = {"certified decay": goal.decay, "damping": goal.damping}
    unseen = [
        {"name": name, "bound": bounds[name], "before": None, "after": None, "met": False, "missed": None}
        for name in work.constraints
        if name in bounds and name not in names
    ]
    return result | {"constraints": result["constraints"] + unseen, "met": result["met"] and not unseen}


def _free(scenario: Scenario, tuned: "Tuned", path: str) -> JsonObject:
    spec = next(spec for name, spec, _ in parameters(scenario.loop) if name == path)
    low, high = scenario.tune.free[path] or (spec.low, spec.high)
    before, after = (_plain(get(loop, path)) for loop in (scenario.loop, tuned.loop))
    return {"before": before, "after": after, "low": _plain(low), "high": _plain(high), "unit": spec.unit}


def _over_lanes(metrics: JsonObject, scenario: Scenario) -> dict[str, dict[str, float]]:
    """Return mean and worst metrics; NaN if a run diverged, because a mean of the others would hide it."""
    each = {name: np.asarray(metrics[name], float) for name in scenario.objectives}
    return {
        "mean": {name: float(values.mean()) for name, values in each.items()},
        "worst": {name: float(values.max()) for name, values in each.items()},
    }


def _constraints(work: Work, tuned: "Tuned", proved: Proved) -> list[JsonObject]:
    """Return a row for each constraint: its worst value before and after, and whether it is met."""
    goal, rows = work.scenario.tune, []
    for name, bound in goal.limits.items():
        before, after = (float(np.max(metrics[name])) for metrics in tuned.metrics)
        rows.append(_constraint_row(name, bound, before, after, at_most=True))
    if bounds := work.constraints.get(MARGIN_CONSTRAINTS):
        from diffabs.tune.frequency_bounds import AT_MOST

        before, after = bounds.worst(work.scenario.loop), bounds.worst(tuned.loop)
        for name, bound in bounds.bounds.items():
            rows.append(_constraint_row(name, bound, before[name], after[name], at_most=name in AT_MOST))
    if clauses := work.constraints.get(CLAUSE_CONSTRAINTS):
        pairs = zip(*(clauses.judge(loop) for loop in (work.scenario.loop, tuned.loop)), strict=True)
        rows += [describe_clause(before, after) for before, after in pairs]
    if work.task and goal.decay:
        before, after = work.task.certify().decay_rate, proved.document["decay_rate"]
        rows.append(_constraint_row("certified decay", goal.decay, before, after, at_most=False))
    if work.task and goal.damping:
        before = _least_damping(work.task, work.scenario.loop)
        after = _least_damping(proved.task or work.task, tuned.loop)
        rows.append(_constraint_row("damping", goal.damping, before, after, at_most=False))
    return rows


def _constraint_row(name: str, bound: float, before: float | None, after: float | None, *, at_most: bool) -> JsonObject:
    """Return a row of the constraints.

    A constraint is met without tolerance. `missed` is the amount by which it is not met, null if unknown.
    """
    reached = math.nan if after is None else after
    beyond = reached - bound if at_most else bound - reached
    missed = None if math.isnan(beyond) else max(beyond, 0.0)
    row = {"name": name, "bound": bound, "before": before, "after": after}
    return {**row, "met": beyond <= 0, "missed": missed}


def describe_clause(before: "Clause", after: "Clause") -> JsonObject:
    """Return the row of a clause; an undecided one has no figure, so that it does not count as met."""
    figures = (math.nan if clause.verdict == "undecided" else clause.figure for clause in (before, after))
    sense = f"{'at least' if after.at_least else 'at most'}{'' if after.unit == '1' else f', in {after.unit}'}"
    return _constraint_row(f"{after.number} {after.rule} ({sense})", after.limit, *figures, at_most=not after.at_least)


def _least_damping(task: "ProofTask", loop: Loop) -> float:
    """Return the least damping of the poles over the vertices."""
    from diffabs.tune import Poles

    return float(Poles(task.polytope).least_damping(loop))


def _plain(value: Scalar) -> Any:
    return np.asarray(value, float).tolist()


def format_shortfall(row: JsonObject) -> str:
    """Return the amount by which a constraint is not met, in words."""
    if row["missed"] is None:
        return "not known"
    part = f" ({100 * row['missed'] / abs(row['bound']):.2g} %)" if row["bound"] else ""
    return f"by {row['missed']:.3g}{part}"


def describe_unmet(rows: Sequence[JsonObject]) -> str:
    """Return which constraints are not met, and by how much."""
    return ", ".join(f"{row['name']} {format_shortfall(row)}" for row in rows if not row["met"])


def numbers_at_bounds(free: Params) -> Iterator[str]:
    """Yield each tuned number at a bound of its range, with the bound.

    A number is at a bound if it is in the outer hundredth of its range (`reached_bound`).
    """
    for path, row in free.items():
        after, low, high = np.broadcast_arrays(*(np.asarray(row[key], float) for key in ("after", "low", "high")))
        for at in np.ndindex(after.shape):
            name = ".".join([path, *map(str, at)])
            if side := reached_bound(*(float(column[at]) for column in (low, high, after))):
                yield f"{name} ({side}, {(low if side == 'lower' else high)[at]:g})"
